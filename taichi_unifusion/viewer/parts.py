"""A box in a scene: what lies in it, how large that is, and a file of just that part.

Boxes stand upright: their corners are given in the frame `up`, whose z points up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.meshes import write_mesh
from ..geometry.triangles import areas
from ..types import Mesh, PinholeCamera
from .scene import SceneMesh

RECTANGLE_SIDE = 60  # pixels that the longer side of a rectangle is looked at with
STRAY = 1.0  # percent of what a rectangle shows that may lie outside its box, at each end
MARGIN = 0.01  # [m] around what a rectangle shows


@dataclass(frozen=True)
class BoxMeasure:
    """How large a box is, and what lies in it."""

    size: NDArray[np.float64]  # (3,) [m]
    volume: float  # [m^3] of the box
    area: float  # [m^2] of the surface in it
    triangles: int

    @property
    def sentence(self) -> str:
        """The measures in words."""
        size = " x ".join(f"{edge:.2f}" for edge in self.size)
        return (
            f"{size} m, {self.volume:.3g} m³; {self.area:.3g} m² of surface in it, "
            f"{self.triangles:,} triangles"
        )


def measure_box(meshes: Sequence[SceneMesh], corners: NDArray, T_up_scene: NDArray) -> BoxMeasure:
    """What lies in a box (2, 3) up [m]: triangles with all corners inside."""
    size = np.maximum(corners[1] - corners[0], 0)
    parts = [_inside(shown, corners, T_up_scene).mesh for shown in meshes]
    area = sum(float(areas(part.vertices, part.faces).sum()) for part in parts)
    return BoxMeasure(size, float(size.prod()), area, sum(len(part.faces) for part in parts))


def upright(points: NDArray, T_up_scene: NDArray) -> NDArray[np.float64]:
    """Points (N, 3) of the scene in the frame `up`."""
    return np.asarray(points, np.float64) @ T_up_scene[:3, :3].T + T_up_scene[:3, 3]


def _inside(shown: SceneMesh, corners: NDArray, T_up_scene: NDArray) -> SceneMesh:
    points = upright(shown.mesh.vertices, T_up_scene)
    return shown.part(((points >= corners[0]) & (points <= corners[1])).all(axis=1))


def box_around(points: NDArray) -> NDArray[np.float64] | None:
    """A box (2, 3) around points (N, 3), some strays left out; None without a point."""
    if not len(points):
        return None
    low, high = np.percentile(points, (STRAY, 100 - STRAY), axis=0)
    return np.stack([low - MARGIN, high + MARGIN])


def write_part(path: Path, shown: SceneMesh, corners: NDArray, T_up_scene: NDArray) -> Mesh:
    """Write the triangles of a mesh inside a box (2, 3) up [m], in the mesh's own world, with all
    that its vertices carry; raises InputError where there is none, FileError.
    """
    mesh = _inside(shown, corners, T_up_scene).in_map()
    if not len(mesh.faces):
        raise InputError("the box holds no triangle; draw it around some surface")
    write_mesh(path, mesh)
    return mesh


def rectangle_camera(
    rectangle: NDArray, fov: float, aspect: float
) -> tuple[PinholeCamera, NDArray[np.bool_]]:
    """A camera of a view with a vertical field `fov` [rad] and `aspect` width / height, and the
    pixels (H, W) inside a `rectangle` (2, 2), lowest and highest corner (x, y) in 0..1 of the view.
    """
    low, high = np.clip(rectangle, 0, 1)
    longer = max(high[0] - low[0], (high[1] - low[1]) / aspect, 1e-3)
    width = int(np.clip(RECTANGLE_SIDE / longer, 64, 2048))
    height = max(int(round(width / aspect)), 1)
    focal = 0.5 * height / np.tan(0.5 * fov)
    camera = PinholeCamera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)
    u, v = (np.arange(width) + 0.5) / width, (np.arange(height)[:, None] + 0.5) / height
    mask = (u >= low[0]) & (u <= high[0]) & (v >= low[1]) & (v <= high[1])
    return camera, mask
