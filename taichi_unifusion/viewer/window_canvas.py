"""A window of Taichi's GGUI: what can be drawn in it, held in fields that grow."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..device_arrays import grown
from ..errors import MissingDependency
from ..files.ply import color_to_uint8
from ..geometry.triangles import area_vectors
from ..rendering.drawing import BACKGROUND
from .orbit import Orbit
from .scene import Legend

FOV = 55.0  # vertical [degrees]
NEAR, FAR = 0.03, 1000.0  # [m]
AMBIENT, LIGHT = 0.8, 0.25  # shares of the colours; the light is where the camera is
BAR = (
    0.02,
    0.03,
    0.30,
    0.055,
)  # left, bottom, right and top of a legend's bar, shares of the window
LAYOUT = Path("imgui.ini")  # that Dear ImGui leaves in the working directory
STEPS = 32  # pieces of a bar
# rows before any field grows: of a mesh, of lines, of a bar
VERTICES, ENDS, CORNERS = 1 << 18, 1 << 12, 6 << 7
LINE = 2.0  # width of lines
PANEL = (0.01, 0.01, 0.34)  # left, top and width of the panel
BUTTON, ROW = 23, 17  # [pixels] heights of a button and of a line of text in it


def why_no_window() -> str:
    """Why there can be no window here, as a clause; "" where nothing speaks against one.

    Taichi would end the process where there is no screen, so that is tried first.
    """
    if sys.platform != "linux":
        return ""
    name = os.environ.get("DISPLAY", "")
    if not name:
        return "there is no screen (DISPLAY is not set)"
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return "the library libX11 is missing; run: apt-get install -y libx11-6"
    x11.XOpenDisplay.restype = ctypes.c_void_p
    display = x11.XOpenDisplay(name.encode())
    if not display:
        return f"the screen DISPLAY={name} does not answer"
    x11.XCloseDisplay(ctypes.c_void_p(display))
    return ""


class WindowCanvas:
    """A window, or with `visible` off its picture alone. Raises MissingDependency, with a sentence,
    where there is no screen or no Vulkan.
    """

    def __init__(self, title: str, size: tuple[int, int], *, visible: bool = True) -> None:
        if visible and (trouble := why_no_window()):
            raise MissingDependency(
                f"no window: {trouble}; `unifusion view` shows a page in the browser, `unifusion render` "
                "writes pictures"
            )
        runtime.current()
        import taichi as ti

        self.kept_layout = LAYOUT.exists()

        try:
            with _silent_stderr():
                self.window: Any = ti.ui.Window(title, size, show_window=visible, vsync=True)
        except Exception as error:  # RuntimeError of Taichi, or what a driver makes of it
            raise MissingDependency(
                "no window: Taichi found no Vulkan driver; install one, in software: apt-get install -y "
                "libvulkan1 mesa-vulkan-drivers"
            ) from error
        self.visible = visible
        self.canvas, self.scene = self.window.get_canvas(), self.window.get_scene()
        self.camera = ti.ui.Camera()
        self.camera.fov(FOV)
        self.camera.z_near(NEAR)
        self.camera.z_far(FAR)
        self.mesh, self.lines, self.bar = _Mesh(), _Lines(), _Bar()
        self.panel_height = 0.0

    def stage(
        self, orbit: Orbit, legend: Legend | None, buttons: Sequence[str], text: Sequence[str]
    ) -> int | None:
        """Say what the next picture holds: mesh and lines from a camera, a legend's bar, and a panel
        of buttons and lines of text. Gives the number of the button that is clicked, if one is.
        """
        self.canvas.set_background_color(BACKGROUND)
        self.camera.position(*map(float, orbit.eye))
        self.camera.lookat(*map(float, orbit.target))
        self.camera.up(*map(float, orbit.up))
        self.scene.set_camera(self.camera)
        self.scene.ambient_light((AMBIENT,) * 3)
        self.scene.point_light(tuple(map(float, orbit.eye)), (LIGHT,) * 3)
        self.mesh.draw(self.scene, orbit.eye)
        self.lines.draw(self.scene)
        self.canvas.scene(self.scene)
        if legend is not None and len(legend.colors):
            self.bar.draw(self.canvas, legend)
        if not (buttons or text):
            self.panel_height = 0.0
            return None
        pixels = 40 + BUTTON * len(buttons) + ROW * len(text)
        self.panel_height = min(0.98, pixels / self.window.get_window_shape()[1])
        # what follows ## is not shown: a panel of another height is another one, as its size is kept
        name = f"unifusion##{len(buttons)},{len(text)}"
        clicked = None
        with self.window.get_gui().sub_window(name, *PANEL, self.panel_height) as gui:
            for number, label in enumerate(buttons):
                clicked = number if gui.button(label) else clicked
            for line in text:
                gui.text(line)
        return clicked

    def is_on_panel(self, x: float, y: float) -> bool:
        """Whether a place of the window, from 0 to 1 rightwards and upwards, lies on the panel."""
        left, top, width = PANEL
        return left <= x <= left + width and top <= 1 - y <= top + self.panel_height

    def show(self) -> None:
        """Put what was staged on the screen."""
        self.window.show()

    def picture(self) -> NDArray[np.uint8]:
        """What was staged as a picture (H, W, 3) RGB; instead of `show`, of a window that is not
        visible.
        """
        buffer = self.window.get_image_buffer_as_numpy()  # (W, H, 4) from below
        rgb = buffer[..., :3].transpose(1, 0, 2)[::-1]
        return np.ascontiguousarray(color_to_uint8(rgb))

    def close(self) -> None:
        """Take the window away."""
        self.window.destroy()
        if not self.kept_layout:
            with suppress(OSError):
                LAYOUT.unlink()


class _silent_stderr:
    """While it is entered, what Taichi's C++ writes to stderr is dropped: it says the same again."""

    def __enter__(self) -> None:
        self.kept = os.dup(2)
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 2)
        os.close(nothing)

    def __exit__(self, *exception: object) -> None:
        os.dup2(self.kept, 2)
        with suppress(OSError):
            os.close(self.kept)


class _Rows:
    """Rows of numbers in a field that doubles when it is full: Taichi frees no field, and compiles
    for each one anew, which takes a second.
    """

    def __init__(self, columns: int, room: int, integer: bool = False) -> None:
        self.columns, self.integer, self.room = columns, integer, room
        self.field: Any = None

    def put(self, rows: NDArray) -> None:
        """Hold `rows` (N, columns), or (N,) for one column; what lies behind them is left over."""
        import taichi as ti

        kind = np.int32 if self.integer else np.float32
        if len(rows) > self.room or self.field is None:
            self.room = grown(self.room, len(rows))
            if self.integer:
                self.field = ti.field(ti.i32, self.room)
            else:
                self.field = ti.Vector.field(self.columns, ti.f32, self.room)
        padded = np.zeros((self.room, self.columns), kind)
        padded[: len(rows)] = rows.reshape(-1, self.columns)
        self.field.from_numpy(padded[:, 0] if self.integer else padded)


class _Mesh:
    """Triangles with a colour a vertex."""

    def __init__(self) -> None:
        self.vertices, self.normals, self.colors = (_Rows(3, VERTICES) for _ in range(3))
        self.indices, self.faces = _Rows(1, 6 * VERTICES, integer=True), np.empty((0, 3), np.int32)
        self.planes = np.empty(
            (0, 4), np.float32
        )  # of the triangles: normal, distance to the origin
        self.backs = False  # whether sides that face away are drawn too
        self.seen_from: tuple[float, ...] | None = None  # eye that the indices are for

    def put(self, vertices: NDArray, normals: NDArray, faces: NDArray) -> None:
        self.vertices.put(vertices)
        self.normals.put(normals)
        self.faces = faces
        across = area_vectors(vertices, faces).astype(np.float32)
        offset = np.einsum("nd,nd->n", across, vertices[faces[:, 0]])
        self.planes = np.column_stack([across, offset])
        self.seen_from = None

    def paint(self, colors: NDArray[np.uint8]) -> None:
        self.colors.put(colors / np.float32(255))

    def draw(self, scene: Any, eye: NDArray) -> None:
        """Draw what faces the eye (3,): through walls that face away one sees into a room."""
        if not len(self.faces) or self.colors.room != self.vertices.room:
            return
        if self.seen_from != (*eye, self.backs):
            facing = self.planes[:, :3] @ eye.astype(np.float32) > self.planes[:, 3]
            shown = self.faces if self.backs else np.where(facing[:, None], self.faces, 0)
            self.indices.put(shown.ravel())
            self.seen_from = (*eye, self.backs)
        scene.mesh(
            self.vertices.field,
            indices=self.indices.field,
            normals=self.normals.field,
            per_vertex_color=self.colors.field,
            index_count=3 * len(self.faces),
        )


class _Lines:
    """Coloured lines."""

    def __init__(self) -> None:
        self.ends, self.colors, self.count = _Rows(3, ENDS), _Rows(3, ENDS), 0

    def put(self, ends: NDArray, colors: NDArray) -> None:
        """Lines (N, 2, 3) in colours (N, 3) of 0..1."""
        self.ends.put(ends.reshape(-1, 3))
        self.colors.put(np.repeat(colors, 2, axis=0))
        self.count = 2 * len(ends)

    def draw(self, scene: Any) -> None:
        if self.count:
            scene.lines(
                self.ends.field,
                width=LINE,
                per_vertex_color=self.colors.field,
                vertex_count=self.count,
            )


class _Bar:
    """The colours of a legend as a strip, or one below the other where they stand for names."""

    def __init__(self) -> None:
        self.corners, self.colors = _Rows(2, CORNERS), _Rows(3, CORNERS)

    def draw(self, canvas: Any, legend: Legend) -> None:
        left, bottom, right, top = BAR
        steps = len(legend.names) or STEPS
        edges = np.linspace(left, right, steps + 1)
        quads = [
            [(a, bottom), (b, bottom), (b, top), (a, bottom), (b, top), (a, top)]
            for a, b in zip(edges[:-1], edges[1:], strict=True)
        ]
        rows = np.linspace(0, len(legend.colors) - 1, steps).round().astype(int)
        colors = np.repeat(legend.colors[rows] / np.float32(255), 6, axis=0)
        # all rows are drawn: those that are left over are points in a corner
        self.corners.put(np.array(quads, np.float32).reshape(-1, 2))
        self.colors.put(colors)
        canvas.triangles(self.corners.field, per_vertex_color=self.colors.field)
