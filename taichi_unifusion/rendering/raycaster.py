"""Rays of a pinhole camera's pixels against a mesh: what is hit first, from either side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..types import Mesh, PinholeCamera, check_rigid
from .depth_buffer import draw_depth_buffer
from .mesh_checks import check_mesh

NEAR = 1e-3  # [m] nothing nearer to the camera is hit


@dataclass(frozen=True)
class RayHits:
    """What the rays through the pixel centres of one camera hit first."""

    depth: NDArray[np.float32]  # (H, W) [m] along the optical axis; inf where nothing is hit
    triangle: NDArray[np.int32]  # (H, W) -1 where nothing is hit
    camera: PinholeCamera
    T_world_camera: NDArray[np.float64]  # (4, 4)

    @property
    def hit(self) -> NDArray[np.bool_]:
        """(H, W) where something is hit."""
        return self.triangle >= 0

    def rays(self, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
        """Directions (N, 3) of the pixels in `mask` in the camera frame, of unit depth, row by row."""
        v, u = np.nonzero(mask)
        return self.camera.rays(u, v)

    def points(self, mask: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Points hit (N, 3) world [m] by the pixels in `mask`, row by row."""
        T = self.T_world_camera
        return ((self.rays(mask) * self.depth[mask][:, None]) @ T[:3, :3].T + T[:3, 3]).astype(
            np.float32
        )


class RayCaster:
    """A mesh to cast rays at. Raises InputError where the mesh is empty, not finite or
    inconsistent.

    The rays of a pinhole camera's pixel grid need no search tree: drawing the triangles into a
    depth buffer, at the pixel centres and in double precision, gives the same depths.
    """

    def __init__(self, mesh: Mesh, name: str = "mesh") -> None:
        self.mesh = check_mesh(mesh, name)

    def cast(
        self, camera: PinholeCamera, T_world_camera: NDArray, *, two_sided: bool = True
    ) -> RayHits:
        """What every pixel of the camera sees, of sides that face away too unless `two_sided` is
        False; raises PoseError for a pose that is no rigid transform.
        """
        T_world_camera = check_rigid(T_world_camera)
        drawn = draw_depth_buffer(
            self.mesh.vertices, self.mesh.faces, camera, T_world_camera, NEAR, two_sided=two_sided
        )
        return RayHits(drawn.depth(nothing=np.inf), drawn.triangle(), camera, T_world_camera)

    def interpolate(
        self, hits: RayHits, mask: NDArray[np.bool_], values: NDArray
    ) -> NDArray[np.float32]:
        """Vertex values (V, c), linear over each triangle, at the points that the pixels in `mask`
        hit: (N, c).
        """
        R, t = hits.T_world_camera[:3, :3], hits.T_world_camera[:3, 3]
        faces = self.mesh.faces[hits.triangle[mask]]
        a, b, c = ((self.mesh.vertices[faces[:, k]] - t) @ R for k in range(3))  # camera frame
        rays = hits.rays(mask)
        weights = np.stack(
            [np.einsum("nd,nd->n", rays, np.cross(p, q)) for p, q in ((b, c), (c, a), (a, b))],
            axis=1,
        )
        # either side of the triangle
        weights = np.maximum(weights * np.sign(weights.sum(axis=1, keepdims=True)), 0)
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
        return np.einsum("nk,nkc->nc", weights, np.asarray(values, np.float64)[faces]).astype(
            np.float32
        )
