"""The controls of a page that ask, and list answers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import UniFusionError
from ..language.pictures import cameras_that_see
from ..types import Trajectory
from .answers import ShownAnswer
from .scene import Box
from .web import fly
from .web_results import ShownResults
from .web_text import paragraph

if TYPE_CHECKING:
    import viser

ANSWER = "answer"  # group of marks


class AskPanel:
    """Questions in words, asked by Enter or the button."""

    def __init__(self, results: ShownResults, show_layer: Callable[[str], None]) -> None:
        """`show_layer` chooses the layer of an answer."""
        self.results, self.show_layer, gui = results, show_layer, results.viewer.server.gui
        # of several lines, since a form drops letters that were typed just before Enter
        self.text = gui.add_text("Where is", "", hint="Enter asks", multiline=True)
        self.text.on_update(lambda event: self._typed(event.client))
        gui.add_button("Ask").on_click(
            lambda event: results.viewer.request(lambda: self.ask(event.client), event.client)
        )
        self.said = gui.add_html("")
        self.rows: list[Any] = []
        self.with_features = [i for i, each in enumerate(results.sources) if each.has_features]
        self.folder = gui.add_folder("Answers", visible=False)

    def put(self, text: str) -> None:
        """Ask as the user of the page would."""
        self.text.value = text
        self.ask()

    def forget_message(self) -> None:
        """Say no more why there was no answer; one that is shown keeps its words."""
        if not self.rows:
            self.said.content = ""

    def _typed(self, client: viser.ClientHandle | None) -> None:
        """Ask once Enter has been pressed, which ends the line."""
        if "\n" in self.text.value:
            self.text.value = self.text.value.replace("\n", "")
            self.results.viewer.request(lambda: self.ask(client), client)

    def ask(self, client: viser.ClientHandle | None = None) -> None:
        """Ask all results that can be asked, and show what they answer."""
        text, results = self.text.value.strip(), self.results
        self._forget()
        if not text:
            self.said.content = paragraph("Type what to look for, for example: chair")
            return
        self.said.content = paragraph(f"Asking for {text} ...")
        answers: list[tuple[int, ShownAnswer]] = []
        try:
            for i, source in enumerate(results.sources):
                if i in self.with_features:
                    answers.append((i, source.ask(results.scene.meshes[i], text)))
        except UniFusionError as error:
            self.said.content = paragraph(str(error))
            return
        for i, answer in answers:
            results.add_answer(i, answer)
        self.show_layer(answers[0][1].layer.name)
        results.boxes = tuple(box for _, answer in answers for box in answer.boxes)
        results.labels = tuple(label for _, answer in answers for label in answer.labels)
        results.stage.mark(ANSWER, boxes=results.boxes, labels=results.labels)
        self._list(answers)

    def _list(self, answers: list[tuple[int, ShownAnswer]]) -> None:
        several = len(self.results.sources) > 1
        names = [self.results.scene.meshes[i].name if several else "" for i, _ in answers]
        sentences = [
            f"{name}: {answer.sentence}" if name else answer.sentence
            for name, (_, answer) in zip(names, answers, strict=True)
        ]
        self.said.content = "".join(map(paragraph, sentences))
        request = self.results.viewer.request
        with self.folder:
            for name, (_, answer) in zip(names, answers, strict=True):
                for box, row in zip(answer.boxes, answer.rows, strict=True):
                    button = self.results.viewer.server.gui.add_button(f"{name} {row}".strip())
                    button.on_click(
                        lambda event, box=box: request(
                            lambda: self._fly(event.client, box), event.client
                        )
                    )
                    self.rows.append(button)
        self.folder.visible = bool(self.rows)

    def _forget(self) -> None:
        self.results.boxes, self.results.labels = (), ()
        self.results.stage.mark(ANSWER)
        for row in self.rows:
            row.remove()
        self.rows.clear()
        self.folder.visible = False

    def _fly(self, client: viser.ClientHandle | None, box: Box) -> None:
        """To where the camera stood that saw the middle of a box best; without cameras, above it."""
        if client is None:
            return
        scene, center = self.results.scene, box.corners.mean(axis=0)
        if scene.cameras:
            poses = np.array([camera.T_world_camera for camera in scene.cameras])
            best = cameras_that_see(
                Trajectory(np.arange(len(poses), dtype=np.float64), poses), center, count=1
            )
            assert best is not None
            eye = best.T_world_camera[0, :3, 3]
        else:
            away, _ = scene.overview()
            eye = center + 1.5 * (away - center) / np.linalg.norm(away - center)
        fly(client, eye, center, scene.up)
