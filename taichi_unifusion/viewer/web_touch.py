"""The controls of a page that answer to clicks and rectangles on the surface."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import numpy as np

from ..errors import UniFusionError
from ..geometry.quaternions import quaternion_to_rotation
from .parts import box_around, measure_box, rectangle_camera, upright, write_part
from .picking import Hit
from .scene import Box, Label
from .web_results import ShownResults
from .web_stage import box_edges
from .web_text import describe_hit, paragraph, table

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

MEASURED, PART = "measured", "part"  # groups of marks
STEP = 0.01  # [m] by which a corner is moved
INVITATION = "Click on the surface; two clicks: a distance."


class PointPanel:
    """What a click on the surface meets, and how far it is from the click before."""

    def __init__(self, results: ShownResults) -> None:
        self.results, server = results, results.viewer.server
        self.said = server.gui.add_html(paragraph(INVITATION))
        self.last: Hit | None = None
        clear = server.gui.add_button("Clear")
        clear.on_click(lambda _: results.viewer.request(self.clear))

        @server.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            results.viewer.request(lambda: self.click(origin, direction), event.client)

    def click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Say what the ray meets."""
        met = self.results.stage.pick(origin, direction)
        if met is None:
            self.said.content = paragraph("There is no surface under the click.")
            return
        i, hit = met
        source, words = self.results.sources[i], []
        if source.has_features:
            try:
                words = source.words_at(hit.point_in_map)
            except UniFusionError as error:
                logger.warning("%s", error)
        rows = describe_hit(self.results.scene, hit, words)
        lines, labels = [], []
        if self.last is not None:
            distance = float(np.linalg.norm(hit.point - self.last.point))
            rows.append(("from the last point", f"{distance:.3f} m"))
            lines = [np.stack([self.last.point, hit.point])]
            labels = [Label(f"{distance:.3f} m", lines[0].mean(axis=0))]
        points = [each.point for each in (self.last, hit) if each is not None]
        self.results.stage.mark(MEASURED, points=points, lines=lines, labels=labels)
        self.said.content = table(rows)
        self.last = hit

    def forget_message(self) -> None:
        """Say no more that a click met nothing; points that are marked keep their words."""
        if self.last is None:
            self.said.content = paragraph(INVITATION)

    def clear(self) -> None:
        """Forget the points."""
        self.last = None
        self.results.stage.mark(MEASURED)
        self.said.content = paragraph(INVITATION)


class PartPanel:
    """A box around what a rectangle shows: how large it is, and a file of what lies in it."""

    def __init__(self, results: ShownResults) -> None:
        self.results, server = results, results.viewer.server
        gui, request = server.gui, results.viewer.request
        gui.add_html(
            paragraph(
                "Hold Shift and drag a rectangle: a box is put around the surface that it shows."
            )
        )
        points = np.concatenate([mesh.mesh.vertices for mesh in results.wholes])
        points = upright(points, results.scene.T_up_world)
        low = np.floor(100 * points.min(axis=0)) / 100
        high = np.ceil(100 * points.max(axis=0)) / 100
        self.low = gui.add_vector3("From [m]", tuple(low.tolist()), step=STEP)
        self.high = gui.add_vector3("To [m]", tuple(high.tolist()), step=STEP)
        for corner in (self.low, self.high):
            corner.on_update(lambda _: request(self.measure))
        self.said = gui.add_html("")
        write = gui.add_button("Write this part as PLY")
        write.on_click(lambda event: request(self.write, event.client))

        @server.scene.on_rect_select(modifier="shift")
        def _(event: viser.SceneRectSelectEvent) -> None:
            rectangle = np.array([event.screen_min, event.screen_max])
            request(lambda: self.draw(event.client, rectangle), event.client)

    def draw(self, client: viser.ClientHandle, rectangle: np.ndarray) -> None:
        """Put the box around what a rectangle of a page's view shows."""
        view = client.camera
        camera, mask = rectangle_camera(rectangle, view.fov, view.aspect)
        T_world_camera = np.eye(4)
        T_world_camera[:3, :3] = _rotation(view.wxyz)
        T_world_camera[:3, 3] = view.position
        seen = self.results.stage.seen(camera, T_world_camera, mask)
        points = np.concatenate([np.zeros((0, 3)), *seen.values()])
        corners = box_around(upright(points, self.results.scene.T_up_world))
        if corners is None:
            self.said.content = paragraph("There is no surface in the rectangle.")
            return
        self.low.value, self.high.value = tuple(corners[0]), tuple(corners[1])
        self.measure()

    def forget_message(self) -> None:
        """Say no more what was written, but how large the box is, if one is drawn."""
        self.said.content = ""
        if self.results.stage.marked.get(PART):
            self.measure()

    @property
    def corners(self) -> np.ndarray:
        """(2, 3) [m] in the upright frame of the scene."""
        return np.array([self.low.value, self.high.value])

    def measure(self) -> None:
        """Draw the box, and say what lies in it."""
        T_up_scene = self.results.scene.T_up_world
        measured = measure_box(self.results.wholes, self.corners, T_up_scene)
        edges = box_edges(Box("part", self.corners)).reshape(-1, 3)
        edges = upright(edges, np.linalg.inv(T_up_scene)).reshape(-1, 2, 3)
        self.results.stage.mark(PART, lines=edges)
        self.said.content = paragraph(measured.sentence)

    def write(self) -> None:
        """Write what lies in the box beside the results that it is of."""
        written, T_up_scene = [], self.results.scene.T_up_world
        for whole, source in zip(self.results.wholes, self.results.sources, strict=True):
            if measure_box([whole], self.corners, T_up_scene).triangles:
                path = source.next_part()
                part = write_part(path, whole, self.corners, T_up_scene)
                written.append(f"{path}: {len(part.faces):,} triangles")
        if not written:
            self.said.content = paragraph("The box holds no triangle; draw it around some surface.")
            return
        for sentence in written:
            logger.info("%s", sentence)
        self.said.content = "".join(map(paragraph, written))


def _rotation(wxyz: np.ndarray) -> np.ndarray:
    return quaternion_to_rotation(np.roll(wxyz, -1)[None])[0]
