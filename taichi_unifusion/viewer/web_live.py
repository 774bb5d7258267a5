"""A run on a page while it goes on: the mesh grows, with the camera, what it sees, the times of the
stages, and what was skipped; afterwards the page shows the results.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ..errors import UniFusionError
from ..files.ply import color_to_uint8
from ..pipeline import Pipeline
from ..run_log import SkippedFrame, StepResult
from ..types import Frame, Mesh
from .live import ABOVE, BACK, Block, ChangedChunks, Pace, upright
from .scene import Layer
from .source import ResultsSource
from .web import WAIT, WebViewer, fly
from .web_nodes import glb_of
from .web_page import ResultsPage
from .web_stage import quaternion_of
from .web_text import paragraph, table

logger = logging.getLogger(__name__)

IMAGE_WIDTH = 240  # [pixels] of what the camera sees
GREY = 190  # of a surface without colour


class WebLive:
    """Shows a run of so many frames on a page; see `Watcher`. `stop` says whether the run is asked
    to end, so that it does not wait for somebody to press a button; `open_results` gives what the
    page shows at the end.
    """

    def __init__(
        self,
        viewer: WebViewer,
        frames: int,
        stop: Callable[[], bool],
        open_results: Callable[[Path], ResultsSource] = ResultsSource,
    ) -> None:
        self.viewer, self.frames, self.stop, self.open_results = viewer, frames, stop, open_results
        self.chunks, self.pace = ChangedChunks(), Pace()
        self.nodes: dict[Block, Any] = {}
        self.camera: Any = None
        self.path: list[np.ndarray] = []
        self.done, self.skipped = 0, []
        self.paused, self.updates = False, 0
        gui = viewer.server.gui
        self.folder = gui.add_folder("Run")
        with self.folder:
            self.said = gui.add_html(paragraph("Waiting for the first frame"))
            self.image = gui.add_image(np.full((2, 2, 3), 255, np.uint8), label="Now")
            self.button = gui.add_button("Pause")
            self.follow = gui.add_checkbox("Follow the camera", False)
        self.button.on_click(lambda _: viewer.request(self.pause))

    def pause(self) -> None:
        """Let the run wait, or go on."""
        self.paused = not self.paused
        self.button.label = "Go on" if self.paused else "Pause"

    def on_step(self, frame: Frame, step: StepResult, pipeline: Pipeline) -> None:
        self.done += 1
        self.path.append(frame.require_pose()[:3, 3])
        self.viewer.poll()
        if self.pace.ready():
            self._update(frame, step, pipeline)
        while self.paused and not self.stop():
            self.viewer.poll()
            if self.chunks.waiting:  # the run has no use for the time now
                self._update(frame, step, pipeline)
            else:
                time.sleep(WAIT / 4)

    def on_skip(self, skipped: SkippedFrame) -> None:
        self.skipped.append(skipped)
        self.viewer.poll()

    def finish(self, directory: Path, stop: Callable[[], bool] = lambda: False) -> None:
        """Show the results in place of what has grown, until Ctrl-C."""
        source = self.open_results(directory)
        try:
            scene = source.open()
        except UniFusionError as error:
            logger.warning("%s", error)
            self.said.content = paragraph(f"The run is over; {error}")
        else:
            self._clear()
            ResultsPage(self.viewer, scene, [source])
        logger.info("the run is over; the page stays at %s until Ctrl-C", self.viewer.address)
        self.viewer.serve(stop)
        self.viewer.close()

    def close(self) -> None:
        self.viewer.close()

    def _update(self, frame: Frame, step: StepResult, pipeline: Pipeline) -> None:
        """Mesh some of what has changed, and show it."""
        started = time.perf_counter()
        chunks = self.chunks.take(pipeline, frame, self.pace.blocks())
        self._show(chunks)
        self._tell(frame, step)
        self.updates += 1
        self.pace.took(time.perf_counter() - started, len(chunks))

    def _show(self, chunks: Any) -> None:
        scene = self.viewer.server.scene
        with self.viewer.server.atomic():
            for block, mesh in chunks.items():
                if block in self.nodes:
                    self.nodes.pop(block).remove()
                if len(mesh.faces):
                    name = "/live/" + "_".join(map(str, block))
                    self.nodes[block] = scene.add_glb(
                        name, chunk_glb(mesh), cast_shadow=False, receive_shadow=False
                    )

    def _tell(self, frame: Frame, step: StepResult) -> None:
        """Where the camera is, what it sees, and how the run does."""
        T, image = frame.require_pose(), small_image(frame)
        self._place_camera(frame, image)
        if image is not None:
            self.image.image = image
        stages = [(name, f"{spent:.0f} ms") for name, spent in step.milliseconds.items()]
        rows = [
            ("frame", f"{step.index}: {self.done + len(self.skipped)} of {self.frames}"),
            ("skipped", str(len(self.skipped))),
            *[("", f"{each.index}: {each.message}") for each in self.skipped[-2:]],
            ("still to mesh", f"{len(self.chunks.waiting)} blocks"),
            *stages,
        ]
        self.said.content = table(rows)
        if self.follow.value:
            eye = T[:3, 3] - BACK * T[:3, 2]
            for client in self.viewer.server.get_clients().values():
                with client.atomic():
                    client.camera.up_direction = -T[:3, 1]
                    client.camera.position, client.camera.look_at = eye, T[:3, 3] + T[:3, 2]

    def _place_camera(self, frame: Frame, image: np.ndarray | None) -> None:
        server, T, camera = self.viewer.server, frame.require_pose(), frame.camera
        if self.camera is None:
            up = upright(-T[:3, 1])
            server.scene.set_up_direction(up)
            server.initial_camera.up = up
            server.initial_camera.position = T[:3, 3] - BACK * T[:3, 2] + ABOVE * up
            server.initial_camera.look_at = T[:3, 3] + 2 * T[:3, 2]
            for client in server.get_clients().values():
                fly(client, server.initial_camera.position, server.initial_camera.look_at, up)
            self.camera = server.scene.add_camera_frustum(
                "/live/camera",
                fov=2 * float(np.arctan(0.5 * camera.height / camera.fy)),
                aspect=camera.width / camera.height,
                scale=0.2,
                thickness=2.0,
                thickness_units="screen",
                color=(200, 60, 40),
                image=image,
                cast_shadow=False,
            )
        elif image is not None:
            self.camera.image = image
        self.camera.wxyz, self.camera.position = quaternion_of(T), T[:3, 3]
        if len(self.path) > 1:
            line = np.stack([self.path[:-1], self.path[1:]], axis=1).astype(np.float32)
            server.scene.add_line_segments(
                "/live/path", line, (200, 60, 40), thickness=2.0, thickness_units="screen"
            )

    def _clear(self) -> None:
        """Take away what was shown while the map grew."""
        self.viewer.server.scene.remove_by_name("/live")
        self.nodes.clear()
        self.folder.remove()


def chunk_glb(mesh: Mesh) -> bytes:
    """A chunk in its colours, or in grey under light, as the bytes of a GLB."""
    color = mesh.attributes.get("color")
    count = len(mesh.vertices)
    if color is None:
        layer = Layer("", np.full((count, 3), GREY, np.uint8), np.zeros((count, 1), np.float32))
    else:
        layer = Layer("", color_to_uint8(color))
    return glb_of(mesh, layer, np.ones(len(mesh.faces), bool))


def small_image(frame: Frame) -> np.ndarray | None:
    """What a frame's colour camera saw, (h, IMAGE_WIDTH, 3) RGB."""
    if frame.color is None:
        return None
    height = max(1, round(frame.color.shape[0] * IMAGE_WIDTH / frame.color.shape[1]))
    return np.asarray(
        cv2.resize(frame.color, (IMAGE_WIDTH, height), interpolation=cv2.INTER_AREA), np.uint8
    )
