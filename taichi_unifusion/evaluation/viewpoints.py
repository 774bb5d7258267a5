"""Which points a set of cameras had in view: in the image, in range and not hidden."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.triangles import area_vectors
from ..rendering.raycaster import RayCaster, RayHits
from ..types import Mesh, PinholeCamera, check_rigid

# largest change of depth a pixel, in pixel widths at that depth (about 80 degrees), for which a
# triangle's plane is extrapolated from the pixel's centre
STEEPEST = 8.0


@dataclass(frozen=True)
class Viewpoints:
    """The poses of one depth camera, and the range that it measures."""

    camera: PinholeCamera
    T_world_camera: NDArray[np.float64]  # (N, 4, 4)
    depth_min: float = 0.1  # [m]
    depth_max: float = 5.0  # [m]

    def __post_init__(self) -> None:
        poses = np.asarray(self.T_world_camera, np.float64)
        if poses.ndim != 3 or not len(poses):
            raise InputError(
                f"views: T_world_camera must be (N, 4, 4) with at least one pose, got {poses.shape}"
            )
        poses = np.stack([check_rigid(T, f"views: pose {i}") for i, T in enumerate(poses)])
        object.__setattr__(self, "T_world_camera", poses)
        if not 0 < self.depth_min < self.depth_max:
            raise InputError(
                f"views: need 0 < depth_min < depth_max, got {self.depth_min} and {self.depth_max}"
            )


def points_within_view(
    views: Viewpoints,
    mesh: Mesh,
    points: tuple[NDArray, ...],
    behind: tuple[float, ...],
) -> tuple[NDArray[np.bool_], ...]:
    """For each set of points (N, 3) world [m]: which (N,) lie in the view of at least one camera.

    In view means: inside the image, in the depth range, and no more than `behind` metres (one
    number a set) deeper than the first surface of `mesh` on the same ray; a ray that hits nothing
    is free to the end of the range.
    """
    caster = RayCaster(mesh, "ground truth")
    left = [np.asarray(p, np.float64) for p in points]  # not seen so far
    rows = [np.arange(len(p)) for p in left]  # of these in `points`
    seen = tuple(np.zeros(len(p), bool) for p in left)
    vertices = caster.mesh.vertices.astype(np.float64)
    corner = vertices[caster.mesh.faces[:, 0]]  # (F, 3) one of each triangle
    normals = area_vectors(vertices, caster.mesh.faces)
    for T_world_camera in views.T_world_camera:
        hits = caster.cast(views.camera, T_world_camera)
        for k, slack in enumerate(behind):
            inside = _in_view(views, hits, corner, normals, left[k], slack)
            seen[k][rows[k][inside]] = True
            left[k], rows[k] = left[k][~inside], rows[k][~inside]
    return seen


def _in_view(
    views: Viewpoints,
    hits: RayHits,
    corner: NDArray,
    normals: NDArray,
    points: NDArray,
    slack: float,
) -> NDArray[np.bool_]:
    """Which points (N, 3) world [m] one camera has in view; `corner` and `normals` are the planes
    of the triangles.
    """
    camera, eye, R_world_camera = (
        views.camera,
        hits.T_world_camera[:3, 3],
        hits.T_world_camera[:3, :3],
    )
    inside = np.zeros(len(points), bool)
    z = points @ R_world_camera[:, 2] - eye @ R_world_camera[:, 2]
    # few points remain: everything below is computed for these alone
    ahead = np.nonzero((z >= views.depth_min) & (z <= views.depth_max))[0]
    to_point, z = points[ahead] - eye, z[ahead]
    u = np.rint(camera.fx * (to_point @ R_world_camera[:, 0]) / z + camera.cx).astype(int)
    v = np.rint(camera.fy * (to_point @ R_world_camera[:, 1]) / z + camera.cy).astype(int)
    drawn = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    ahead, to_point, u, v, z = ahead[drawn], to_point[drawn], u[drawn], v[drawn], z[drawn]

    triangle = hits.triangle[v, u]
    depth = np.where(triangle >= 0, hits.depth[v, u].astype(np.float64), 0.0)
    normal = normals[triangle]
    # a ray within the triangle's plane gives no depth: the pixel's counts
    with np.errstate(divide="ignore", invalid="ignore"):
        there = (
            z
            * np.einsum("nd,nd->n", normal, corner[triangle] - eye)
            / np.einsum("nd,nd->n", normal, to_point)
        )
    trust = STEEPEST * depth / min(camera.fx, camera.fy)
    surface = np.where(np.isfinite(there), np.clip(there, depth - trust, depth + trust), depth)
    inside[ahead] = (triangle < 0) | (z <= surface + slack)
    return inside
