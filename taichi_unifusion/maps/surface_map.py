"""SurfaceMap: the signed distance field of the scene as a LIM, from Gaussian process implicit
surfaces (Sec. IV-B).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import InputError
from ..kernels import visibility
from ..types import Mesh, PointCloud
from .base_map import BaseMap
from .frame_blocks import FrameBlocks
from .meshing import drop_small_parts, extract_mesh
from .settings import SurfaceSettings


class SurfaceMap(BaseMap):
    """A continuous signed distance field, fused from point clouds with normals.

        surface = SurfaceMap(voxel_size=0.05)
        surface.integrate(cloud)
        mesh = surface.extract_mesh(resolution=4)

    Keywords are those of `SurfaceSettings`. Internally targets are in voxels, positive in front of
    the surface.
    """

    kind = "surface"
    settings_type = SurfaceSettings

    def __init__(self, settings: SurfaceSettings | None = None, **overrides) -> None:
        settings = dataclasses.replace(settings or SurfaceSettings(), **overrides)
        derivatives = settings.gpis == "derivatives"
        super().__init__(
            "surface", 1, settings, centered=False, derivatives=derivatives, evidence=settings.carve
        )
        steps = (
            (0.0,) if derivatives else (-settings.sample_distance, 0.0, settings.sample_distance)
        )
        self._steps = np.array(steps, np.float32)  # of the samples along the normal [voxels]
        self._surfels = FrameBlocks(self._grid, 3, with_positions=True)
        self._samples = FrameBlocks(self._grid, 4 if derivatives else 1, with_positions=False)

    @classmethod
    def _restore(cls, name: str, channels: int, settings: SurfaceSettings) -> SurfaceMap:
        return cls(settings)

    def _observed(self, cloud: PointCloud) -> NDArray[np.float32]:
        if cloud.normals is None:
            raise InputError(
                "surface map: the cloud has no normals; `preprocess` computes them, or give your own"
            )
        return cloud.normals

    def _encode_cells(self, cloud: PointCloud) -> FrameBlocks:
        """Average points and normals in cells; each average is a surfel that gives samples at the
        cells along its normal.

        A sample is moved to its cell's centre, and its target is the centre's distance to the
        surfel's plane: exact to first order, and its features come from a table.
        """
        while True:
            self._surfels.touch(cloud.points, self.voxel_size)
            self._surfels.bin(cloud.points, [cloud.normals], self.voxel_size)
            if self._surfels.touch_samples(self._steps):
                break
        self._samples.bin_samples(self._surfels, self._steps)
        self._samples.compact(self.settings.support_points)
        self._regressor.encode_cells(self._samples)
        return self._samples

    def _encode_points(self, cloud: PointCloud) -> FrameBlocks:
        """Samples at every point and beside it, as published: x + a n -> a, x - a n -> -a, in
        voxels.
        """
        steps = np.repeat(self._steps, len(cloud))[:, None]
        samples = np.tile(cloud.points, (len(self._steps), 1)) + steps * np.float32(
            self.voxel_size
        ) * np.tile(cloud.normals, (len(self._steps), 1))
        targets = (
            np.hstack([steps, np.tile(cloud.normals, (len(self._steps), 1))])
            if self._regressor.derivatives
            else steps
        )
        self._encode_samples(self._samples, self._regressor, samples, targets)
        self._samples.bin_support(samples, self.voxel_size, self.settings.support_points)
        return self._samples

    def _vote(self, cloud: PointCloud, blocks: FrameBlocks, sign: int) -> None:
        """Let the frame's rays vote on what they saw and what they passed through; without rays,
        its points on what they are.
        """
        grid, view = self._grid, cloud.view
        if self.settings.carve and view is None:
            visibility.vote_support(
                blocks.count, blocks.keys, blocks.support, grid.slot, sign, grid.evidence
            )
        elif self.settings.carve:
            camera = view.camera
            visibility.vote_cells(
                self.settings.encoder.rank,
                grid.count,
                grid.keys,
                grid.masks,
                grid.latents,
                self._regressor.cell_gradients,
                self.voxel_size,
                view.values,
                camera.fx,
                camera.fy,
                camera.cx,
                camera.cy,
                np.ascontiguousarray(view.T_camera_cloud[:3], np.float32),
                sign,
                grid.evidence,
            )

    def sdf(self, points: NDArray) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Signed distance (N,) [m] at points (N, 3) world [m], positive in front of the surface,
        and where it is known (N,).
        """
        runtime.check_alive(self._grid.runtime)
        values, valid = self._regressor.query(points, blend=True, reach=0)
        return values[:, 0] * np.float32(self.voxel_size), valid

    def extract_mesh(self, resolution: int = 4, min_area: float = 0.0) -> Mesh:
        """The zero level by marching cubes on `resolution`^3 cells a voxel; an empty mesh where
        nothing was integrated.

        Connected parts of less than `min_area` square metres are left out.

        Raises InputError for a resolution outside 1..32.
        """
        runtime.check_alive(self._grid.runtime)
        if not 1 <= resolution <= 32:
            raise InputError(
                f"extract_mesh: resolution must lie in 1..32 cells a voxel, got {resolution}"
            )
        mesh = extract_mesh(
            self._grid,
            self._regressor.encoding,
            self.voxel_size,
            resolution,
            self.settings.support_closing,
            self.settings.min_evidence,
        )
        return drop_small_parts(mesh, min_area)
