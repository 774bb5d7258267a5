"""Features of points, computed before by any program, as images of what frames see of the points:
OpenScene's features of several views, fused at the vertices of a scan.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from ..files.arrays import read_point_features
from ..files.mesh_reading import read_mesh
from ..networks.encoders import unit_length
from ..types import Frame
from .folder import LONGEST_SIDE

if TYPE_CHECKING:
    from scipy.spatial import KDTree

REACH = 0.05  # [m] from what a pixel sees to the point whose feature it takes


@dataclass(frozen=True)
class PointFeatures:
    """Features (M, c) of points (M, 3) world [m], which frames need poses in."""

    name: str
    points: NDArray[np.float32]
    features: NDArray[np.floating]

    @cached_property
    def _tree(self) -> KDTree:
        from scipy.spatial import KDTree

        return KDTree(self.points)

    def image_features(self, frame: Frame) -> NDArray[np.float32]:
        """(h, w, c) unit length, no larger than LONGEST_SIDE: of the point nearest to what a pixel
        sees, NaN where none is near. Raises FrameError where that holds for all pixels.
        """
        camera, T_world_camera = frame.camera, frame.require_pose()
        block = -(-max(camera.width, camera.height) // LONGEST_SIDE)
        h, w = max(camera.height // block, 1), max(camera.width // block, 1)
        v = ((np.arange(h) + 0.5) * camera.height / h).astype(int)[:, None]
        u = ((np.arange(w) + 0.5) * camera.width / w).astype(int)[None]
        z = frame.depth[v, u].astype(np.float64)
        with np.errstate(invalid="ignore"):
            read = np.isfinite(z) & (z > 0)
        x, y = (u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z
        seen = np.stack([x[read], y[read], z[read]], axis=1)
        seen = seen @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        values = np.full((h, w, self.features.shape[1]), np.nan, np.float32)
        if len(seen):
            away, nearest = self._tree.query(seen, distance_upper_bound=REACH)
            near = np.isfinite(away)
            found = np.full((len(seen), values.shape[2]), np.nan, np.float32)
            found[near] = unit_length(self.features[np.asarray(nearest)[near]])
            values[read] = found
        if not np.isfinite(values).any():
            raise FrameError(
                f"{self.name}: has no features within {100 * REACH:g} cm of what {frame.label} sees; are "
                "the points in the world of the poses?"
            )
        return values


def point_features(files: str) -> PointFeatures:
    """The features in a .pt, .npz or .npy file at the points of a PLY file, as "FEATURES,POINTS".

    Raises FileError where one is missing or damaged, InputError where they do not fit.
    """
    stored, comma, cloud = files.partition(",")
    if not comma:
        raise InputError(
            f"features: 'points' needs two files, as in points:{files},scene0568_00_vh_clean_2.ply"
        )
    features, mask = read_point_features(Path(stored))
    points = read_mesh(Path(cloud)).vertices
    count = len(features) if mask is None else len(mask)
    if len(points) != count:
        raise InputError(f"{stored}: is of {count} points, but {cloud} has {len(points)}")
    return PointFeatures(stored, points if mask is None else points[mask], features)
