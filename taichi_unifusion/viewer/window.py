"""A scene in a window: layers by keys, a camera that orbits and flies, a legend, answers."""

from __future__ import annotations

import queue
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import UniFusionError
from ..files.images import write_png
from .answers import ShownAnswer
from .captions import EDGES, numbers_of
from .orbit import Orbit
from .scene import Scene
from .window_canvas import WindowCanvas

SIZE = (1280, 800)
SPEED = 0.6  # [m/s] of flying, in lengths of the scene divided by 8
WHEEL = 8.0  # steps of zoom a second while a key is held
FRAME = 1 / 60  # [s]
# of the layers, in their order: GGUI knows no digits, and the other letters do something else
LAYER_KEYS = "tyuigjkzxvnm"
HELP = (
    "a layer: its letter, TAB the next one",
    "drag left  turn around    drag right  look around",
    "W A S D  fly    E Q  up, down    R F  nearer, farther",
    "C  a recorded camera    O  overview",
    "P  save a picture    L  legend    B  backs of walls",
    "H  this help    ESC  end",
)


class SceneWindow:
    """Shows a scene until its window is closed. `visible` off makes pictures alone. Raises
    MissingDependency, with a sentence, where there can be no window.
    """

    def __init__(self, title: str, *, size: tuple[int, int] = SIZE, visible: bool = True) -> None:
        self.canvas = WindowCanvas(title, size, visible=visible)
        self.scene: Scene | None = None
        self.layer, self.cameras_shown = 0, 0
        self.orbit = Orbit(np.array([0.0, -3, 2]), np.zeros(3), np.array([0.0, 0, 1]))
        self.help, self.legend, self.said = True, True, ""
        self.last_cursor: tuple[float, float] | None = None
        self.dragging = self.held = False  # the scene by the mouse; a button of the mouse
        self.last_time = time.perf_counter()
        self.on_space: Callable[[], None] = lambda: None
        self.open = True

    @property
    def layers(self) -> tuple[str, ...]:
        """The names of the layers, in the order of their keys."""
        return () if self.scene is None else self.scene.layer_names

    def put(self, scene: Scene, *, keep_camera: bool = False) -> None:
        """Show another scene."""
        chosen = self.layers[self.layer] if self.layers else ""
        self.scene = scene
        self.layer = self.layers.index(chosen) if chosen in self.layers else 0
        parts = scene.meshes
        starts = np.cumsum([0, *(len(part.mesh.vertices) for part in parts)])
        faces = [part.mesh.faces + start for part, start in zip(parts, starts, strict=False)]
        self.canvas.mesh.put(
            np.concatenate([part.mesh.vertices for part in parts]),
            np.concatenate([part.normals for part in parts]),
            np.concatenate(faces),
        )
        self.choose(self.layer)
        self._put_boxes()
        if not keep_camera:
            self.look_from_above()

    def choose(self, number: int) -> None:
        """Show the layer of that number, counted from 0."""
        if self.scene is not None and number < len(self.layers):
            self.layer = number
            name = self.layers[number]
            colors = [part.layer(name).colors for part in self.scene.meshes]
            self.canvas.mesh.paint(np.concatenate(colors))

    def answer(self, found: ShownAnswer) -> None:
        """Show an answer: heat, boxes, and the best place from where it is seen."""
        if self.scene is None:
            return
        first, *others = self.scene.meshes
        meshes = (first.with_layers([found.layer]), *others)
        self.put(
            Scene(
                self.scene.name, meshes, self.scene.cameras, found.boxes, found.labels,
                self.scene.T_up_world,
            ),
            keep_camera=True,
        )  # fmt: skip
        self.choose(self.layers.index(found.layer.name))
        self.said = found.sentence
        if found.boxes:
            self._fly_to(found.boxes[0].corners)

    def look_from_above(self) -> None:
        """See everything."""
        if self.scene is not None:
            eye, target = self.scene.overview()
            self.orbit = Orbit(eye, target, self.scene.up)

    def look_from_camera(self) -> None:
        """Look from the next of the recorded cameras."""
        if self.scene is not None and self.scene.cameras:
            camera = self.scene.cameras[self.cameras_shown % len(self.scene.cameras)]
            self.cameras_shown += 1
            self.orbit = Orbit.of_pose(camera.T_world_camera, 1.5, self.scene.up)
            self.said = camera.name

    def press(self, key: str) -> None:
        """Do what a key says."""
        if key in LAYER_KEYS:
            self.choose(LAYER_KEYS.index(key))
        elif key == "Tab" and self.layers:
            self.choose((self.layer + 1) % len(self.layers))
        elif key == "Escape":
            self.open = False
        elif key in self._actions:
            self._actions[key]()

    @property
    def _actions(self) -> dict[str, Callable[[], None]]:
        return {
            " ": self.on_space,
            "o": self.look_from_above,
            "c": self.look_from_camera,
            "p": self.save_picture,
            "h": lambda: setattr(self, "help", not self.help),
            "b": lambda: setattr(self.canvas.mesh, "backs", not self.canvas.mesh.backs),
            "l": lambda: setattr(self, "legend", not self.legend),
        }

    def save_picture(self) -> None:
        """Write what is seen as a picture into the working directory, under a name that is free."""
        number = 1
        while (path := Path(f"view-{number}.png")).exists():
            number += 1
        self._stage()
        try:
            write_png(path, self.canvas.picture())
            self.said = f"{path.resolve()} is written"
        except UniFusionError as error:
            self.said = str(error)

    def poll(self) -> bool:
        """Handle keys and mouse, draw, and say whether the window is still there."""
        window = self.canvas.window
        if not self.open or not window.running:
            self.open = False
            return False
        import taichi as ti

        for event in window.get_events(ti.ui.PRESS):
            self.press(event.key)
        self._move()
        self._stage()
        self.canvas.show()
        return self.open

    def serve(
        self,
        ask: Callable[[str], ShownAnswer] | None = None,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Show until the window is closed, or `stop` says so; with `ask`, lines typed in the terminal
        are questions.
        """
        lines = _typed_lines() if ask is not None and sys.stdin.isatty() else None
        while self.poll() and not stop():
            if lines is not None and ask is not None:
                self._answer_typed(lines, ask)
            time.sleep(max(0.0, FRAME - (time.perf_counter() - self.last_time)))

    def picture(self) -> NDArray[np.uint8]:
        """What the window shows (H, W, 3) RGB, of one that is not visible."""
        self._stage()
        self.canvas.picture()  # text appears in the second picture
        self._stage()
        return self.canvas.picture()

    def close(self) -> None:
        """Take the window away."""
        self.open = False
        self.canvas.close()

    def _answer_typed(self, lines: queue.Queue[str], ask: Callable[[str], ShownAnswer]) -> None:
        while not lines.empty():
            if text := lines.get().strip():
                try:
                    found = ask(text)
                except UniFusionError as error:
                    print(error, flush=True)
                    continue
                print("\n".join([found.sentence, *found.rows]), flush=True)
                self.answer(found)

    def _move(self) -> None:
        """Turn and fly as mouse and keys say."""
        import taichi as ti

        window, now = self.canvas.window, time.perf_counter()
        seconds, self.last_time = min(now - self.last_time, 0.25), now
        x, y = window.get_cursor_pos()
        left, right = window.is_pressed(ti.ui.LMB), window.is_pressed(ti.ui.RMB)
        # a drag that begins on the panel moves that
        free = self.dragging or not (self.held or self.canvas.is_on_panel(x, y))
        self.held = left or right
        self.dragging = self.held and free
        left, right = left and self.dragging, right and self.dragging
        if self.last_cursor is not None and (left or right):
            across, along = x - self.last_cursor[0], y - self.last_cursor[1]
            turn = self.orbit.turned if left else self.orbit.looked_around
            self.orbit = turn(across, along)
        self.last_cursor = (x, y) if left or right else None
        speed = seconds * SPEED * self._reach()

        def held(more: str, less: str) -> float:
            return speed * (window.is_pressed(more) - window.is_pressed(less))

        self.orbit = self.orbit.flown(held("d", "a"), held("e", "q"), held("w", "s"))
        steps = WHEEL * seconds * (window.is_pressed("r") - window.is_pressed("f"))
        self.orbit = self.orbit.zoomed(steps) if steps else self.orbit

    def _reach(self) -> float:
        """How large what there is to see is, in lengths of 8 m: larger scenes are crossed faster."""
        if self.scene is None:
            return 1.0
        low, high = self.scene.bounds()
        return max(0.1, float(np.linalg.norm(high - low)) / 8)

    def _stage(self) -> None:
        legend = None
        if self.scene is not None and self.layers:
            legend = self.scene.legend(self.layers[self.layer])
        shown = legend if self.legend else None
        clicked = self.canvas.stage(self.orbit, shown, self._buttons(), self._text(legend))
        if clicked is not None:
            self.choose(clicked)

    def _buttons(self) -> list[str]:
        """One a layer, with its letter."""
        if not self.help:
            return []
        keys = [*LAYER_KEYS.upper(), *[" "] * max(0, len(self.layers) - len(LAYER_KEYS))]
        return [
            f"{key}  {name}{'  <' if i == self.layer else ''}##{i}"
            for i, (key, name) in enumerate(zip(keys, self.layers, strict=False))
        ]

    def _text(self, legend) -> list[str]:
        lines = []
        if self.legend and legend is not None:
            lines += ["", *_legend_lines(legend)]
        if self.said:
            lines += ["", self.said]
        return [*lines, "", *HELP] if self.help else lines

    def _put_boxes(self) -> None:
        boxes = () if self.scene is None else self.scene.boxes
        ends, colors = [], []
        for box in boxes:
            corners = [[box.corners[k >> d & 1][d] for d in range(3)] for k in range(8)]
            ends += [(corners[i], corners[j]) for i, j in EDGES]
            colors += [np.array(box.color) / 255] * len(EDGES)
        self.canvas.lines.put(
            np.array(ends, np.float32).reshape(-1, 2, 3),
            np.array(colors, np.float32).reshape(-1, 3),
        )

    def _fly_to(self, corners: NDArray) -> None:
        """Look at a box (2, 3) from where the camera is, not too far away."""
        middle = corners.mean(axis=0)
        size = max(0.5, float(np.linalg.norm(corners[1] - corners[0])))
        away = self.orbit.eye - middle
        distance = min(float(np.linalg.norm(away)), 3 * size)
        eye = middle + distance * away / max(float(np.linalg.norm(away)), 1e-9)
        self.orbit = Orbit(eye, middle, self.orbit.up)


def _legend_lines(legend) -> list[str]:
    """What stands for the colours, below the layers."""
    if legend.names:
        return [f"{legend.label}:", *(f"  {name}" for name in legend.names[:12])]
    low, middle, high = numbers_of(legend)
    return [legend.label, f"{low}  {middle}  {high}"]


def _typed_lines() -> queue.Queue[str]:
    """Lines as they are typed in the terminal, from a thread that ends with the process."""
    lines: queue.Queue[str] = queue.Queue()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)

    print("type what to look for, and Enter", flush=True)
    threading.Thread(target=read, daemon=True).start()
    return lines
