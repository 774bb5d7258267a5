"""What a viser server shows of a scene: its meshes, cameras, answers and marks; and what is met on
it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..geometry.quaternions import rotation_to_quaternion
from ..types import PinholeCamera
from .picking import Hit, Picker
from .scene import Box, Label, Scene, SceneMesh
from .web_nodes import BANDS, MeshNodes

if TYPE_CHECKING:
    import viser

FRUSTUM = 0.025  # length of a camera's outline, of the size of the scene
POINT = 0.004  # radius of a marked point, of the size of the scene
EDGES = [
    (0, 1),
    (0, 2),
    (0, 4),
    (1, 3),
    (1, 5),
    (2, 3),
    (2, 6),
    (3, 7),
    (4, 5),
    (4, 6),
    (5, 7),
    (6, 7),
]
FIELD = 0.85  # [rad] of the first view, upright
MARK, LINE = (255, 80, 40), 3.0  # RGB; [pixels]


class Stage:
    """A scene on a server. Names of nodes say what they are: /mesh0, /camera3, /answer/..., /mark/..."""

    def __init__(self, server: viser.ViserServer, scene: Scene) -> None:
        self.server, self.scene = server, scene
        self.size = float(np.linalg.norm(np.diff(scene.bounds(), axis=0)))
        self.layer, self.bands = scene.layer_names[0], BANDS
        low, high = scene.heights()
        self.borders = np.linspace(low, high, BANDS + 1)  # [m] of the bands of height
        self.pickers: dict[int, Picker] = {}
        self.nodes: list[MeshNodes] = []
        self.cameras: list[Any] = []
        self.marked: dict[str, list[Any]] = {}
        eye, center = scene.overview()
        server.scene.set_up_direction(scene.up)
        server.initial_camera.up = scene.up
        server.initial_camera.fov = FIELD
        server.initial_camera.position, server.initial_camera.look_at = eye, center
        for i, shown in enumerate(scene.meshes):
            self.nodes.append(MeshNodes(server, f"/mesh{i}", shown, self._bands_of(shown)))
            self.nodes[i].show(self.layer)

    def _bands_of(self, shown: SceneMesh) -> NDArray[np.int64]:
        heights = self.scene.heights_of(shown.mesh.vertices)[shown.mesh.faces].mean(axis=1)
        return np.clip(np.searchsorted(self.borders, heights, side="right") - 1, 0, BANDS - 1)

    def show_layer(self, name: str) -> None:
        """Show a layer on every mesh that has it, and the first one on the others."""
        self.layer = name
        for nodes in self.nodes:
            nodes.show(name)

    def cut_above(self, height: float) -> None:
        """Hide what lies higher than `height` [m], to the next border of a band."""
        self.bands = int(np.clip(np.searchsorted(self.borders, height - 1e-9), 1, BANDS))
        self.pickers.clear()
        for nodes in self.nodes:
            nodes.cut(self.bands)

    def replace_mesh(self, i: int, shown: SceneMesh) -> None:
        """Show another mesh in the place of one."""
        self.nodes[i].remove()
        nodes = MeshNodes(self.server, f"/mesh{i}", shown, self._bands_of(shown))
        nodes.bands, nodes.visible, self.nodes[i] = self.bands, self.nodes[i].visible, nodes
        nodes.show(self.layer)
        self._keep(i, shown)

    def relayer_mesh(self, i: int, shown: SceneMesh) -> None:
        """Give a mesh other layers."""
        self.nodes[i].relayer(shown)
        self._keep(i, shown)

    def _keep(self, i: int, shown: SceneMesh) -> None:
        meshes = (*self.scene.meshes[:i], shown, *self.scene.meshes[i + 1 :])
        self.scene = replace(self.scene, meshes=meshes)
        self.pickers.pop(i, None)

    def set_visible(self, i: int, visible: bool) -> None:
        """Show or hide a mesh."""
        self.nodes[i].set_visible(visible)

    def pick(self, origin: NDArray, direction: NDArray) -> tuple[int, Hit] | None:
        """Which mesh a ray of the scene meets first, and where."""
        hits = [(i, picker.pick(origin, direction)) for i, picker in self._seen_pickers()]
        met = [(i, hit) for i, hit in hits if hit is not None]
        return min(met, key=lambda each: each[1].distance) if met else None

    def seen(
        self, camera: PinholeCamera, T_world_camera: NDArray, mask: NDArray[np.bool_]
    ) -> dict[int, NDArray[np.float64]]:
        """Points (N, 3) that the pixels in `mask` (H, W) see, by mesh."""
        return {i: picker.seen(camera, T_world_camera, mask) for i, picker in self._seen_pickers()}

    def _seen_pickers(self) -> Iterable[tuple[int, Picker]]:
        for i, nodes in enumerate(self.nodes):
            if nodes.visible:
                if i not in self.pickers:
                    self.pickers[i] = Picker(self.scene.meshes[i], nodes.kept)
                yield i, self.pickers[i]

    def show_cameras(self, on_click: Callable[[Any, int], None]) -> None:
        """Draw cameras as outlines with their images; `on_click` is told of a client and which one."""
        self.hide_cameras()
        for i, camera in enumerate(self.scene.cameras):
            pinhole = camera.camera
            handle = self.server.scene.add_camera_frustum(
                f"/camera{i}",
                fov=2 * float(np.arctan(0.5 * pinhole.height / pinhole.fy)),
                aspect=pinhole.width / pinhole.height,
                scale=FRUSTUM * self.size,
                thickness=1.5,
                thickness_units="screen",
                color=(60, 110, 200),
                image=camera.image,
                wxyz=quaternion_of(camera.T_world_camera),
                position=camera.T_world_camera[:3, 3],
                cast_shadow=False,
            )
            handle.on_click(lambda event, i=i: on_click(event.client, i))
            self.cameras.append(handle)

    def look_through(self, number: int | None) -> None:
        """Draw one camera alone, and without its image, which would hide what lies behind; None: all
        of them as they were.
        """
        with self.server.atomic():
            for i, handle in enumerate(self.cameras):
                handle.visible = number is None or i == number
                image = self.scene.cameras[i].image
                if number == i:
                    handle.image = None
                elif handle.image is None and image is not None:
                    handle.image = image

    def hide_cameras(self) -> None:
        """Take the cameras away."""
        for handle in self.cameras:
            handle.remove()
        self.cameras.clear()

    def mark(
        self,
        group: str,
        *,
        points: Iterable[NDArray] = (),
        lines: Iterable[NDArray] = (),
        boxes: Iterable[Box] = (),
        labels: Iterable[Label] = (),
    ) -> None:
        """Draw points (3,), lines (2, 3), boxes and labels, in place of what the group had before."""
        scene, made = self.server.scene, []
        for handle in self.marked.pop(group, ()):
            handle.remove()
        for point in points:
            made.append(
                scene.add_icosphere(
                    f"/{group}/{len(made)}", POINT * self.size, color=MARK, position=point
                )
            )
        segments = [(np.asarray(line), MARK) for line in lines]
        segments += [(edge, box.color) for box in boxes for edge in box_edges(box)]
        if segments:
            made.append(
                scene.add_line_segments(
                    f"/{group}/{len(made)}",
                    np.stack([line for line, _ in segments]).astype(np.float32),
                    np.array([[color, color] for _, color in segments], np.uint8),
                    thickness=LINE,
                    thickness_units="screen",
                )
            )
        for label in labels:
            made.append(
                scene.add_label(f"/{group}/{len(made)}", label.text, position=label.position)
            )
        self.marked[group] = made


def box_edges(box: Box) -> NDArray[np.float64]:
    """The twelve edges (12, 2, 3) of a box."""
    corners = np.array([[box.corners[k >> d & 1][d] for d in range(3)] for k in range(8)])
    return corners[np.array(EDGES)]


def quaternion_of(T: NDArray) -> NDArray[np.float64]:
    """The rotation of a pose (4, 4) as viser takes it, in the order w x y z."""
    return np.roll(rotation_to_quaternion(T[None, :3, :3])[0], 1)
