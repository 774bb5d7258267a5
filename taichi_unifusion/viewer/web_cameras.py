"""The controls of a page that show where the recorded pictures were taken, and look from there."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .web_results import ShownResults
from .web_stage import quaternion_of
from .web_text import paragraph

if TYPE_CHECKING:
    import viser

LEFT = 0.02  # of the size of the scene: whoever has moved so far looks from a camera no more


class CameraPanel:
    """The cameras, and the picture of the one that is looked from."""

    def __init__(self, results: ShownResults) -> None:
        self.results, server = results, results.viewer.server
        gui, request = server.gui, results.viewer.request
        self.shown = gui.add_checkbox("Cameras", False, disabled=not results.scene.cameras)
        self.shown.on_update(lambda event: request(self.show, event.client))
        self.name = gui.add_html("", visible=False)
        self.image = gui.add_image(np.full((2, 2, 3), 255, np.uint8), visible=False)
        self.through: int | None = None  # the camera that is looked from
        self.client: int | None = None  # and the page that does
        self.arrived = False

        def watch(client: viser.ClientHandle) -> None:
            client.camera.on_update(lambda _: self._moved(client))

        server.on_client_connect(watch)
        for client in server.get_clients().values():
            watch(client)

    def show(self) -> None:
        """Draw the cameras with what they saw, or take them away, as the box says."""
        stage = self.results.stage
        self.leave()
        if not self.shown.value:
            stage.hide_cameras()
            return
        if len(self.results.sources) == 1 and not any(
            each.image is not None for each in stage.scene.cameras
        ):
            stage.scene = self.results.sources[0].with_images(stage.scene)
        request = self.results.viewer.request
        stage.show_cameras(
            lambda client, i: request(lambda: self.look_from(client, i), client),
        )

    def look_from(self, client: viser.ClientHandle, number: int) -> None:
        """Put a page where a camera was: the map is seen with the outline of that camera alone, and
        what it saw stands among the controls.
        """
        camera = self.results.scene.cameras[number]
        self.through, self.client, self.arrived = number, client.client_id, False
        self.results.stage.look_through(number)
        self.name.content, self.name.visible = paragraph(camera.name), True
        if camera.image is not None:
            self.image.image = camera.image
        self.image.visible = camera.image is not None
        with client.atomic():
            client.camera.wxyz = quaternion_of(camera.T_world_camera)
            client.camera.position = camera.T_world_camera[:3, 3]

    def _moved(self, client: viser.ClientHandle) -> None:
        """Draw all cameras again when the page that looks from one has gone on from there."""
        if self.through is None or self.client != client.client_id:
            return
        eye = self.results.scene.cameras[self.through].T_world_camera[:3, 3]
        near = np.linalg.norm(client.camera.position - eye) < LEFT * self.results.stage.size
        if near:
            self.arrived = True
        elif self.arrived:  # not on its way there
            self.results.viewer.request(self.leave)

    def leave(self) -> None:
        """Draw all cameras, with what they saw."""
        if self.through is not None:
            self.through, self.arrived = None, False
            self.results.stage.look_through(None)
            self.name.visible = self.image.visible = False
