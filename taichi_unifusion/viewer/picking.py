"""What a ray, or a rectangle of a picture, meets of the meshes in a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..rendering.raycaster import RayCaster
from ..types import Mesh, PinholeCamera
from .scene import Layer, SceneMesh

# a camera of one pixel, whose centre is the ray
ONE_PIXEL = PinholeCamera(1, 1, 1.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True)
class Hit:
    """Where a ray meets a mesh first."""

    shown: SceneMesh
    point: NDArray[np.float64]  # (3,) scene [m]
    normal: NDArray[np.float64]  # (3,) unit, scene
    distance: float  # [m] from where the ray began
    corners: NDArray[np.int64]  # (3,) vertices of the triangle
    shares: NDArray[np.float64]  # (3,) of the corners, together 1

    @property
    def point_in_map(self) -> NDArray[np.float64]:
        """(3,) [m] in the mesh's own world."""
        T = np.linalg.inv(self.shown.T_scene_map)
        return T[:3, :3] @ self.point + T[:3, 3]

    @property
    def normal_in_map(self) -> NDArray[np.float64]:
        """(3,) unit, in the mesh's own world."""
        return self.normal @ self.shown.T_scene_map[:3, :3]

    def color(self, layer: Layer) -> NDArray[np.uint8]:
        """(3,) RGB of a layer here."""
        return (self.shares @ layer.colors[self.corners] + 0.5).astype(np.uint8)

    def values(self, layer: Layer) -> NDArray[np.float64] | None:
        """(c,) of a layer here, of the nearest corner where they are classes; None if it has only
        colours.
        """
        if layer.values is None:
            return None
        if layer.legend is not None and layer.legend.names:
            return layer.values[self.corners[self.shares.argmax()]].astype(np.float64)
        return self.shares @ layer.values[self.corners]


class Picker:
    """Meets the sides of a mesh that face free space, as a page draws them."""

    def __init__(self, shown: SceneMesh, kept: NDArray[np.bool_] | None = None) -> None:
        """`kept` (F,) are the triangles that can be seen; all of them without it."""
        faces = shown.mesh.faces if kept is None else shown.mesh.faces[kept]
        self.shown, self.faces = shown, faces
        self.caster = (
            RayCaster(Mesh(shown.mesh.vertices, faces), shown.name) if len(faces) else None
        )

    def pick(self, origin: NDArray, direction: NDArray) -> Hit | None:
        """What a ray from `origin` (3,) scene [m] meets first; None where it meets nothing."""
        if self.caster is None:
            return None
        T_world_camera = camera_along(np.asarray(origin, float), np.asarray(direction, float))
        hits = self.caster.cast(ONE_PIXEL, T_world_camera, two_sided=False)
        if not hits.hit[0, 0]:
            return None
        point = hits.points(hits.hit)[0].astype(np.float64)
        corners = self.faces[hits.triangle[0, 0]].astype(np.int64)
        shares = self.caster.interpolate(hits, hits.hit, _one_hot(corners, self.shown))[0]
        normal = shares @ self.shown.normals[corners]
        length = np.linalg.norm(normal)
        return Hit(
            self.shown,
            point,
            normal / length if length > 0 else normal,
            float(hits.depth[0, 0]),
            corners,
            shares.astype(np.float64),
        )

    def seen(
        self, camera: PinholeCamera, T_world_camera: NDArray, mask: NDArray[np.bool_]
    ) -> NDArray[np.float64]:
        """Points (N, 3) scene [m] that the pixels (H, W) in `mask` see."""
        if self.caster is None:
            return np.zeros((0, 3))
        hits = self.caster.cast(camera, T_world_camera, two_sided=False)
        return hits.points(hits.hit & mask).astype(np.float64)


def _one_hot(corners: NDArray[np.int64], shown: SceneMesh) -> NDArray[np.float32]:
    """Values (V, 3) whose interpolation gives the share of each of three corners."""
    values = np.zeros((len(shown.mesh.vertices), 3), np.float32)
    values[corners, np.arange(3)] = 1
    return values


def camera_along(origin: NDArray, direction: NDArray) -> NDArray[np.float64]:
    """T_world_camera (4, 4) of a camera at `origin` that looks along `direction`."""
    forward = direction / np.linalg.norm(direction)
    right = np.cross(forward, np.eye(3)[np.abs(forward).argmin()])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = origin
    return T
