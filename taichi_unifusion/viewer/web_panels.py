"""The controls beside the picture of a page, one class a folder of them."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from ..errors import UniFusionError
from ..language.pictures import cameras_that_see
from ..types import Trajectory
from .answers import ShownAnswer
from .decimation import decimate, decimate_scene
from .page import write_page
from .parts import box_around, measure_box, rectangle_camera, write_part
from .picking import Hit
from .scene import Box, Label, Scene, SceneCamera, SceneMesh
from .source import ResultsSource
from .web import WebViewer, fly
from .web_stage import Stage, quaternion_of
from .web_text import describe_hit, legend_html, paragraph, table

if TYPE_CHECKING:
    import viser

logger = logging.getLogger(__name__)

MOST_TRIANGLES = 1_000_000  # that a page is sent
RENDER_SECONDS = 30.0  # that a browser may take for a picture
ANSWER, MEASURED, PART = "answer", "measured", "part"  # groups of marks
PART_COLOR = (40, 160, 90)


class ResultsPage:
    """Results of one or several folders on a page, with everything that can be done to them."""

    def __init__(self, viewer: WebViewer, scene: Scene, sources: Sequence[ResultsSource]) -> None:
        """`sources` (M,) are where the meshes of the scene came from."""
        self.viewer, self.sources = viewer, tuple(sources)
        self.wholes = list(scene.meshes)  # before they were decimated for the page
        shown = decimate_scene(scene, MOST_TRIANGLES)
        for mesh in shown.meshes:
            if mesh.note:
                logger.info("%s: %s", mesh.name, mesh.note)
        self.stage = Stage(viewer.server, shown)
        gui = viewer.server.gui
        with gui.add_folder("Show"):
            self.layers = LayerPanel(self)
        if any(source.has_features for source in self.sources):
            with gui.add_folder("Ask"):
                self.ask = AskPanel(self)
        with gui.add_folder("Point"):
            self.point = PointPanel(self)
        with gui.add_folder("Part", expand_by_default=False):
            self.part = PartPanel(self)
        with gui.add_folder("Keep", expand_by_default=False):
            self.keep = KeepPanel(self)

    @property
    def scene(self) -> Scene:
        """What is shown."""
        return self.stage.scene

    def replace_mesh(self, i: int, whole: SceneMesh) -> None:
        """Show another mesh in the place of one."""
        self.wholes[i] = whole
        share = MOST_TRIANGLES // len(self.wholes)
        self.stage.replace_mesh(i, decimate(whole, share))
        self.layers.refresh()

    def add_answer(self, i: int, answer: ShownAnswer) -> None:
        """Give a mesh the layer of an answer."""
        self.stage.relayer_mesh(i, self.scene.meshes[i].with_layers([answer.layer]))


class LayerPanel:
    """Which layer, which results, how high, how fine."""

    def __init__(self, page: ResultsPage) -> None:
        self.page, stage, gui = page, page.stage, page.viewer.server.gui
        request = page.viewer.request
        self.layer = gui.add_dropdown("Layer", stage.scene.layer_names)
        self.layer.on_update(lambda _: request(self.show_chosen))
        self.legend = gui.add_html("")
        if len(stage.scene.meshes) > 1:
            for i, mesh in enumerate(stage.scene.meshes):
                box = gui.add_checkbox(mesh.name, True)
                box.on_update(
                    lambda event, i=i: request(
                        lambda: page.stage.set_visible(i, event.target.value), event.client
                    )
                )
        low, high = stage.scene.heights()
        step = max((high - low) / 100, 1e-3)
        self.height = gui.add_slider(
            "Cut above [m]", round(low, 3), round(high + step, 3), step, round(high + step, 3)
        )
        self.height.on_update(lambda _: request(self._cut))
        self.cameras = gui.add_checkbox("Cameras", False, disabled=not stage.scene.cameras)
        self.cameras.on_update(lambda event: request(self._show_cameras, event.client))
        if any(source.has_maps for source in page.sources):
            self.resolution = gui.add_slider("Cells a voxel", 1, 8, 1, 4)
            again = gui.add_button("Extract the mesh again")
            again.on_click(lambda event: request(lambda: self._extract(event.client), event.client))
        self.notes = gui.add_html("")
        self.refresh()

    def show(self, name: str) -> None:
        """Choose a layer, as the user of the page would."""
        self.layer.options = self.page.scene.layer_names
        self.layer.value = name
        self.show_chosen()

    def show_chosen(self) -> None:
        """Show the layer that is chosen, with its legend."""
        self.page.stage.show_layer(self.layer.value)
        meshes = self.page.scene.meshes
        shown = [mesh.layer(self.layer.value) for mesh in meshes]
        self.legend.content = legend_html(
            next((each.legend for each in shown if each.name == self.layer.value), None)
        )

    def refresh(self) -> None:
        """Say what there is now."""
        if self.layer.options != self.page.scene.layer_names:
            self.layer.options = self.page.scene.layer_names
        self.notes.content = "".join(
            paragraph(
                f"{mesh.name}: {mesh.note or f'{len(mesh.mesh.faces):,} triangles, all of them'}"
            )
            for mesh in self.page.scene.meshes
        )
        self.show_chosen()

    def _cut(self) -> None:
        self.page.stage.cut_above(self.height.value)

    def _show_cameras(self) -> None:
        stage, viewer = self.page.stage, self.page.viewer
        if not self.cameras.value:
            stage.hide_cameras()
            return
        if len(self.page.sources) == 1 and not any(
            each.image is not None for each in stage.scene.cameras
        ):
            stage.scene = self.page.sources[0].with_images(stage.scene)
        stage.show_cameras(
            stage.scene.cameras,
            lambda client, camera: viewer.request(lambda: look_from(client, camera), client),
        )

    def _extract(self, client: viser.ClientHandle | None) -> None:
        page, resolution = self.page, int(self.resolution.value)
        page.viewer.say("Extracting", f"{resolution} cells a voxel, from the saved maps", client)
        for i, source in enumerate(page.sources):
            if source.has_maps:
                page.replace_mesh(i, source.extract(page.scene, page.wholes[i], resolution))
        page.viewer.say("Extracted", f"{page.scene.triangles:,} triangles are shown", client)


def look_from(client: viser.ClientHandle, camera: SceneCamera) -> None:
    """Put the camera of a page where one of the recording was."""
    with client.atomic():
        client.camera.wxyz = quaternion_of(camera.T_world_camera)
        client.camera.position = camera.T_world_camera[:3, 3]


class AskPanel:
    """Questions in words, asked by Enter or the button."""

    def __init__(self, page: ResultsPage) -> None:
        self.page, gui = page, page.viewer.server.gui
        with gui.add_form(None) as form:
            self.text = gui.add_text("Where is", "", hint="Enter asks")
            button = gui.add_button("Ask")
        button.on_click(lambda _: form.submit())
        form.on_submit(
            lambda event: page.viewer.request(lambda: self.ask(event.client), event.client)
        )
        self.said = gui.add_html("")
        self.rows: list[Any] = []
        self.folder = gui.add_folder("Answers", visible=False)

    def ask(self, client: viser.ClientHandle | None = None) -> None:
        """Ask all results that can be asked, and show what they answer."""
        text, page = self.text.value.strip(), self.page
        self._forget()
        if not text:
            self.said.content = paragraph("Type what to look for, for example: chair")
            return
        self.said.content = paragraph(f"Asking for {text} ...")
        answers: list[tuple[int, ShownAnswer]] = []
        try:
            for i, source in enumerate(page.sources):
                if source.has_features:
                    answers.append((i, source.ask(page.scene.meshes[i], text)))
        except UniFusionError as error:
            self.said.content = paragraph(str(error))
            return
        for i, answer in answers:
            page.add_answer(i, answer)
        page.layers.show(answers[0][1].layer.name)
        page.stage.mark(
            ANSWER,
            boxes=[box for _, answer in answers for box in answer.boxes],
            labels=[label for _, answer in answers for label in answer.labels],
        )
        self._list(answers)

    def _list(self, answers: list[tuple[int, ShownAnswer]]) -> None:
        several = len(self.page.sources) > 1
        names = [self.page.scene.meshes[i].name if several else "" for i, _ in answers]
        sentences = [
            f"{name}: {answer.sentence}" if name else answer.sentence
            for name, (_, answer) in zip(names, answers, strict=True)
        ]
        self.said.content = "".join(map(paragraph, sentences))
        request = self.page.viewer.request
        with self.folder:
            for name, (_, answer) in zip(names, answers, strict=True):
                for box, row in zip(answer.boxes, answer.rows, strict=True):
                    button = self.page.viewer.server.gui.add_button(f"{name} {row}".strip())
                    button.on_click(
                        lambda event, box=box: request(
                            lambda: self._fly(event.client, box), event.client
                        )
                    )
                    self.rows.append(button)
        self.folder.visible = bool(self.rows)

    def _forget(self) -> None:
        self.page.stage.mark(ANSWER)
        for row in self.rows:
            row.remove()
        self.rows.clear()
        self.folder.visible = False

    def _fly(self, client: viser.ClientHandle | None, box: Box) -> None:
        """To where the camera stood that saw the middle of a box best; without cameras, above it."""
        if client is None:
            return
        scene, center = self.page.scene, box.corners.mean(axis=0)
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


class PointPanel:
    """What a click on the surface meets, and how far it is from the click before."""

    def __init__(self, page: ResultsPage) -> None:
        self.page, server = page, page.viewer.server
        self.said = server.gui.add_html(paragraph("Click on the surface; two clicks: a distance."))
        self.last: Hit | None = None
        clear = server.gui.add_button("Clear")
        clear.on_click(lambda _: page.viewer.request(self.clear))

        @server.scene.on_click()
        def _(event: viser.SceneClickEvent) -> None:
            origin, direction = np.array(event.ray_origin), np.array(event.ray_direction)
            page.viewer.request(lambda: self.click(origin, direction), event.client)

    def click(self, origin: np.ndarray, direction: np.ndarray) -> None:
        """Say what the ray meets."""
        met = self.page.stage.pick(origin, direction)
        if met is None:
            self.said.content = paragraph("There is no surface under the click.")
            return
        i, hit = met
        source, words = self.page.sources[i], []
        if source.has_features:
            try:
                words = source.words_at(hit.point_in_map)
            except UniFusionError as error:
                logger.warning("%s", error)
        rows = describe_hit(self.page.scene, hit, words)
        lines, labels = [], []
        if self.last is not None:
            distance = float(np.linalg.norm(hit.point - self.last.point))
            rows.append(("from the last point", f"{distance:.3f} m"))
            lines = [np.stack([self.last.point, hit.point])]
            labels = [Label(f"{distance:.3f} m", lines[0].mean(axis=0))]
        points = [each.point for each in (self.last, hit) if each is not None]
        self.page.stage.mark(MEASURED, points=points, lines=lines, labels=labels)
        self.said.content = table(rows)
        self.last = hit

    def clear(self) -> None:
        """Forget the points."""
        self.last = None
        self.page.stage.mark(MEASURED)
        self.said.content = paragraph("Click on the surface; two clicks: a distance.")


class PartPanel:
    """A box around what a rectangle shows: how large it is, and a file of what lies in it."""

    def __init__(self, page: ResultsPage) -> None:
        self.page, server = page, page.viewer.server
        gui, request = server.gui, page.viewer.request
        gui.add_html(
            paragraph(
                "Hold Shift and drag a rectangle: a box is put around the surface that it shows."
            )
        )
        low, high = page.scene.bounds()
        step = 0.01
        self.low = gui.add_vector3("From [m]", tuple(low.round(2)), step=step)
        self.high = gui.add_vector3("To [m]", tuple(high.round(2)), step=step)
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
        seen = self.page.stage.seen(camera, T_world_camera, mask)
        corners = box_around(np.concatenate([np.zeros((0, 3)), *seen.values()]))
        if corners is None:
            self.said.content = paragraph("There is no surface in the rectangle.")
            return
        self.low.value, self.high.value = tuple(corners[0]), tuple(corners[1])
        self.measure()

    @property
    def corners(self) -> np.ndarray:
        """(2, 3) scene [m]."""
        return np.array([self.low.value, self.high.value])

    def measure(self) -> None:
        """Draw the box, and say what lies in it."""
        measured = measure_box(self.page.wholes, self.corners)
        self.page.stage.mark(PART, boxes=[Box("part", self.corners, PART_COLOR)])
        self.said.content = paragraph(measured.sentence)

    def write(self) -> None:
        """Write what lies in the box beside the results that it is of."""
        written = []
        for whole, source in zip(self.page.wholes, self.page.sources, strict=True):
            if measure_box([whole], self.corners).triangles:
                path = source.next_part()
                part = write_part(path, whole, self.corners)
                written.append(f"{path}: {len(part.faces):,} triangles")
        if not written:
            self.said.content = paragraph("The box holds no triangle; draw it around some surface.")
            return
        for sentence in written:
            logger.info("%s", sentence)
        self.said.content = "".join(map(paragraph, written))


def _rotation(wxyz: np.ndarray) -> np.ndarray:
    from ..geometry.quaternions import quaternion_to_rotation

    return quaternion_to_rotation(np.roll(wxyz, -1)[None])[0]


class KeepPanel:
    """A picture of the view, and a page to share."""

    def __init__(self, page: ResultsPage) -> None:
        self.page, gui = page, page.viewer.server.gui
        request = page.viewer.request
        picture = gui.add_button("Save the picture (PNG)")
        picture.on_click(
            lambda event: request(lambda: self.save_picture(event.client), event.client)
        )
        share = gui.add_button("Write a page to share (HTML)")
        share.on_click(lambda event: request(lambda: self.write_page(event.client), event.client))
        self.said = gui.add_html("")

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
        client.send_file_download(f"{self.page.stage.layer}.png", encode_png(image))

    def write_page(self, client: viser.ClientHandle | None) -> None:
        """Write the shared page beside the results."""
        path = self.page.sources[0].page
        said = write_page(self.page.scene, path)
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
