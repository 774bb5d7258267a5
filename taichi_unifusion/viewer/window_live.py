"""A run in a window while it goes on: the mesh grows, with the camera and its way; afterwards the
window shows the results.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingDependency, UniFusionError
from ..geometry.gravity import Up
from ..pipeline import Pipeline
from ..run_log import SkippedFrame, StepResult
from ..types import Frame, Mesh
from .live import ABOVE, BACK, Block, ChangedChunks, Pace, upright
from .null import NullViewer, Watcher
from .orbit import Orbit
from .results_scene import layers_of
from .scene import Scene, SceneCamera, SceneMesh
from .source import ResultsSource
from .window import SceneWindow

logger = logging.getLogger(__name__)

DRAWING_SHARE = 0.03  # of the time of a run that drawing what is not new may take
QUICKEST = 1 / 30  # [s] between two pictures
FRUSTUM = 0.25  # [m] length of the camera as it is drawn
RED = (0.78, 0.24, 0.16)


class WindowLive:
    """Shows a run in a window; see `Watcher`. Where the window is closed the run goes on."""

    def __init__(self, window: SceneWindow, frames: int, stop: Callable[[], bool]) -> None:
        self.window, self.frames, self.stop = window, frames, stop
        self.changes, self.pace = ChangedChunks(), Pace()
        self.chunks: dict[Block, Mesh] = {}
        self.path: list[np.ndarray] = []
        self.done, self.skipped = 0, 0
        self.draw_due = 0.0
        window.on_space = self.pause
        window.said = "waiting for the first frame"
        self.paused = False
        for _ in range(2):  # text appears in the second picture
            self._draw(due=True)

    def pause(self) -> None:
        """Let the run wait, or go on."""
        self.paused = not self.paused

    def on_step(self, frame: Frame, step: StepResult, pipeline: Pipeline) -> None:
        self.done += 1
        self.path.append(frame.require_pose()[:3, 3])
        if not self.window.open:
            return
        if self.pace.ready():
            self._update(frame, step, pipeline)
        self._draw()
        while self.paused and not self.stop() and self.window.open:
            self.window.poll()
            if self.changes.waiting:  # the run has no use for the time now
                self._update(frame, step, pipeline)
            else:
                time.sleep(QUICKEST)

    def _update(self, frame: Frame, step: StepResult, pipeline: Pipeline) -> None:
        """Mesh some of what has changed, and draw it."""
        started = time.perf_counter()
        taken = self.changes.take(pipeline, frame, self.pace.blocks())
        self.chunks.update(taken)
        self._put(frame, step)
        self._draw(due=True)
        self.pace.took(time.perf_counter() - started, len(taken))

    def on_skip(self, skipped: SkippedFrame) -> None:
        self.skipped += 1
        self._draw()

    def finish(self, directory: Path, stop: Callable[[], bool] = lambda: False) -> None:
        """Show the results in place of what has grown, until the window is closed."""
        if not self.window.open:
            return self.close()
        source = ResultsSource(directory)
        try:
            scene = source.open()
        except UniFusionError as error:
            logger.warning("%s", error)
            self.window.said = f"the run is over; {error}"
        else:
            self.window.put(scene)
            self.window.said = "the run is over: these are its results"
        logger.info("the run is over; ESC in the window, or Ctrl-C, ends it")
        self.window.serve(stop=stop)
        self.close()

    def close(self) -> None:
        self.window.close()

    def _draw(self, due: bool = False) -> None:
        """Draw what is new, and now and then what is not: whoever turns the scene waits for it."""
        started = time.perf_counter()
        if self.window.open and (due or started >= self.draw_due):
            if not self.window.poll():
                logger.info("the window was closed; the run goes on without it")
            spent = time.perf_counter() - started
            self.draw_due = time.perf_counter() + max(QUICKEST, spent / DRAWING_SHARE)

    def _put(self, frame: Frame, step: StepResult) -> None:
        """Give the window what there is by now."""
        T, window = frame.require_pose(), self.window
        first = window.scene is None
        mesh = joined([chunk for chunk in self.chunks.values() if len(chunk.faces)])
        if mesh is None:
            return
        up = upright(-T[:3, 1])
        level = Up(up, "cameras").T_up_world if window.scene is None else window.scene.T_up_world
        bare = Scene("run", (), T_up_world=level)
        layers = layers_of(mesh, None, bare)
        camera = SceneCamera(frame.label, frame.camera, T)
        scene = Scene("run", (SceneMesh("run", mesh, layers),), (camera,), T_up_world=level)
        window.put(scene, keep_camera=True)
        if first:
            eye = T[:3, 3] - BACK * T[:3, 2] + ABOVE * up
            window.orbit = Orbit(eye, T[:3, 3] + 2 * T[:3, 2], up)
        self._draw_camera(camera)
        total = sum(step.milliseconds.values())
        window.said = (
            f"frame {self.done + self.skipped} of {self.frames}, {self.skipped} skipped, "
            f"{total:.0f} ms    SPACE  pause"
        )

    def _draw_camera(self, camera: SceneCamera) -> None:
        """The camera as a pyramid, and the way that it came."""
        width, height = camera.camera.size
        corners = camera.camera.rays(
            np.array([0, width, width, 0]), np.array([0, 0, height, height])
        )
        T = camera.T_world_camera
        eye, ends = T[:3, 3], FRUSTUM * corners @ T[:3, :3].T + T[:3, 3]
        lines = [(eye, end) for end in ends]
        lines += list(zip(ends, np.roll(ends, 1, axis=0), strict=True))
        lines += list(zip(self.path[:-1], self.path[1:], strict=True))
        self.window.canvas.lines.put(
            np.array(lines, np.float32), np.tile(np.array(RED, np.float32), (len(lines), 1))
        )


def watch_in_window(title: str, frames: int, stop: Callable[[], bool] = lambda: False) -> Watcher:
    """A window that watches a run of so many frames; where there can be none, nothing does, and
    that is said.
    """
    try:
        return WindowLive(SceneWindow(title), frames, stop)
    except MissingDependency as error:
        logger.warning("%s; the run goes on without it", error)
        return NullViewer()


def joined(meshes: list[Mesh]) -> Mesh | None:
    """All triangles in one mesh, with the attributes that any has: grey, or NaN, where one has not
    got them yet. None where there are no triangles.
    """
    if not meshes:
        return None
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    channels = {name: each.shape[1] for mesh in meshes for name, each in mesh.attributes.items()}

    def values(mesh: Mesh, name: str) -> NDArray[np.float32]:
        lacking = 0.75 if name == "color" else np.nan
        absent = np.full((len(mesh.vertices), channels[name]), lacking, np.float32)
        return mesh.attributes.get(name, absent)

    has_normals = all(mesh.normals is not None for mesh in meshes)
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate(faces).astype(np.int32),
        np.concatenate([mesh.normals for mesh in meshes]) if has_normals else None,  # type: ignore[misc]
        {name: np.concatenate([values(mesh, name) for mesh in meshes]) for name in channels},
    )
