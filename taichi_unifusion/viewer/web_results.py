"""Results that a page shows: where they came from, what is on the stage, what was answered."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

from .answers import ShownAnswer
from .decimation import decimate, decimate_scene
from .scene import Box, Label, Scene, SceneMesh
from .several import share_scales
from .source import ResultsSource
from .web import WebViewer
from .web_stage import Stage

logger = logging.getLogger(__name__)

MOST_TRIANGLES = 1_000_000  # that a page is sent


class ShownResults:
    """The state that the controls of a page share."""

    def __init__(self, viewer: WebViewer, scene: Scene, sources: Sequence[ResultsSource]) -> None:
        """`sources` (M,) are where the meshes of the scene came from."""
        self.viewer, self.sources = viewer, tuple(sources)
        self.wholes = list(scene.meshes)  # before they were decimated for the page
        if scene.triangles > MOST_TRIANGLES:
            logger.info("%s triangles are simplified for the page", f"{scene.triangles:,}")
        shown = decimate_scene(scene, MOST_TRIANGLES)
        for mesh in shown.meshes:
            if mesh.note:
                logger.info("%s: %s", mesh.name, mesh.note)
        self.stage = Stage(viewer.server, shown)
        self.boxes: tuple[Box, ...] = ()  # of the last question's answers
        self.labels: tuple[Label, ...] = ()

    @property
    def scene(self) -> Scene:
        """What is shown."""
        return self.stage.scene

    @property
    def shared_scene(self) -> Scene:
        """What is shown, with the answers to the last question."""
        return replace(self.scene, boxes=self.boxes, labels=self.labels)

    def replace_mesh(self, i: int, whole: SceneMesh) -> None:
        """Show another mesh in the place of one."""
        self.wholes[i] = whole
        before = list(self.scene.meshes)
        before[i] = decimate(whole, MOST_TRIANGLES // len(self.wholes))
        for j, mesh in enumerate(share_scales(before)):
            if j == i:
                self.stage.replace_mesh(i, mesh)
            elif mesh is not before[j]:  # its scale has become wider
                self.stage.relayer_mesh(j, mesh)

    def add_answer(self, i: int, answer: ShownAnswer) -> None:
        """Give a mesh the layer of an answer."""
        self.stage.relayer_mesh(i, self.scene.meshes[i].with_layers([answer.layer]))
