"""Results on a page with everything that can be done to them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np

from .page import write_page
from .scene import Scene
from .source import ResultsSource
from .web import WebViewer
from .web_layers import LayerPanel
from .web_questions import AskPanel
from .web_results import ShownResults
from .web_text import paragraph
from .web_touch import PartPanel, PointPanel

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

RENDER_SECONDS = 30.0  # that a browser may take for a picture


class ResultsPage:
    """Results of one or several folders on a page, in folders of controls."""

    def __init__(self, viewer: WebViewer, scene: Scene, sources: Sequence[ResultsSource]) -> None:
        """`sources` (M,) are where the meshes of the scene came from."""
        self.results = results = ShownResults(viewer, scene, sources)
        self.viewer, self.stage = viewer, results.stage
        gui = viewer.server.gui
        with gui.add_folder("Show"):
            self.layers = LayerPanel(results)
        self.ask: AskPanel | None = None  # where there is nothing to ask
        if any(source.has_features for source in sources):
            with gui.add_folder("Ask"):
                self.ask = AskPanel(results, self.layers.show)
        with gui.add_folder("Point"):
            self.point = PointPanel(results)
        with gui.add_folder("Part", expand_by_default=False):
            self.part = PartPanel(results)
        with gui.add_folder("Keep", expand_by_default=False):
            self.keep = KeepPanel(results)
        viewer.server.on_client_connect(lambda _: viewer.request(self.greet))

    def greet(self) -> None:
        """Take old messages away where somebody opens the page, and nobody else reads them."""
        if len(self.viewer.server.get_clients()) > 1:
            return
        self.layers.cameras.leave()
        for panel in (self.ask, self.point, self.part, self.keep):
            if panel is not None:
                panel.forget_message()

    @property
    def scene(self) -> Scene:
        """What is shown."""
        return self.stage.scene


class KeepPanel:
    """A picture of the view, and a page to share."""

    def __init__(self, results: ShownResults) -> None:
        self.results, gui = results, results.viewer.server.gui
        request = results.viewer.request
        picture = gui.add_button("Save the picture (PNG)")
        picture.on_click(
            lambda event: request(lambda: self.save_picture(event.client), event.client)
        )
        share = gui.add_button("Write a page to share (HTML)")
        share.on_click(lambda event: request(lambda: self.write_page(event.client), event.client))
        self.said = gui.add_html("")

    def forget_message(self) -> None:
        """Say no more what was written."""
        self.said.content = ""

    def save_picture(self, client: viser.ClientHandle | None) -> None:
        """Let the browser save what it shows."""
        if client is None:
            return
        view = client.camera
        image = client.get_render(
            view.image_height,
            view.image_width,
            transport_format="png",
            timeout=RENDER_SECONDS,
        )
        client.send_file_download(f"{self.results.stage.layer}.png", encode_png(image))

    def write_page(self, client: viser.ClientHandle | None) -> None:
        """Write the shared page beside the results."""
        path = self.results.sources[0].page
        said = write_page(self.results.shared_scene, path)
        logger.info("%s: %s", path, said)
        self.said.content = paragraph(f"{path}: {said}")


def encode_png(image: np.ndarray) -> bytes:
    """The bytes of a PNG of an image (H, W, 3 or 4) RGB(A) uint8, on white."""
    if image.shape[2] == 4:
        share = image[..., 3:] / 255
        image = (image[..., :3] * share + 255 * (1 - share) + 0.5).astype(np.uint8)
    done, encoded = cv2.imencode(".png", np.ascontiguousarray(image[..., ::-1]))
    assert done
    return encoded.tobytes()
