"""SurfaceMap: the signed distance field of the scene as a LIM, from Gaussian process implicit
surfaces (Sec. IV-B).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Self, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import runtime
from ..device_arrays import DeviceArray
from ..errors import InputError, check_box, check_range, check_whole, shortened
from ..geometry.checks import as_numbers
from ..kernels import visibility
from ..kernels.cells import CELLS
from ..kernels.patches import Patches, Values
from ..types import Frame, Mesh, PinholeCamera, PointCloud
from .binner import SurfelBinner, patches_of
from .distance import distances
from .encoder import check_points, to_device
from .keywords import SurfaceKeywords, settings_of, shows_keywords
from .local_lim import LocalLim
from .meshing import blocks_in, drop_small_parts, extract_mesh, slots_near
from .regression_map import RegressionMap
from .settings import MAX_RESOLUTION, SurfaceSettings
from .sheets import FRONT, Sheet, sheets_of, whole
from .voxel_data import VoxelData, surface_extras, surface_layout


class SurfaceMap(RegressionMap[SurfaceSettings]):
    """A continuous signed distance field, fused from point clouds with normals.

        surface = SurfaceMap(voxel_size=0.05)
        surface.integrate(cloud)
        mesh = surface.extract_mesh(resolution=4)

    Keywords are those of `SurfaceSettings`. Internally targets are in voxels, positive in front of
    the surface.
    """

    kind = "surface"
    settings_type = SurfaceSettings

    @shows_keywords(SurfaceSettings)
    def __init__(
        self, settings: SurfaceSettings | None = None, **keywords: Unpack[SurfaceKeywords]
    ) -> None:
        settings = settings_of(SurfaceSettings, settings, dict(keywords), "SurfaceMap")
        layout = surface_layout(settings)
        super().__init__("surface", 1, settings, layout, surface_extras(settings))
        if self.two_sides:
            self.grid.lean = to_device(FRONT @ self._cell_features[CELLS**3, 1:])
        beside = settings.sample_distance
        steps = (0.0,) if settings.gpis == "derivatives" else (-beside, 0.0, beside)
        self.steps = np.array(steps, np.float32)  # of samples along a normal [voxels]
        self.binner = SurfelBinner(
            self.grid,
            settings.voxel_size,
            self.steps,
            support_points=settings.support_points,
            with_normals=layout.derivatives,
        )

    @classmethod
    def _empty(cls, name: str, channels: int, settings: SurfaceSettings) -> Self:
        return cls(settings)

    def wants(self, cloud: PointCloud | Frame) -> bool:
        return True

    def observed(self, cloud: PointCloud) -> NDArray[np.float32]:
        if cloud.normals is None:
            raise InputError(
                "surface map: the cloud has no normals; `preprocess` computes them, or give your own"
            )
        return cloud.normals

    def encode(self, cloud: PointCloud) -> LocalLim:
        normals = self.observed(cloud)
        if self.settings.sampling == "cells":
            patches = patches_of(cloud, self.grid.runtime.device)
            return self.encoder.encode(self.binner.bin(patches, [self.carried(patches)]))
        return self.encoder.encode_samples(self.binner.sort(*self._samples(cloud.points, normals)))

    def carried(self, patches: Patches) -> Values:
        return Values(patches.normals, patches.counts)

    def _samples(
        self, points: NDArray[np.float32], normals: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Samples at every point and beside it, as published, and their targets: x + a n -> a,
        x - a n -> -a, in voxels; with derivatives also the normals, 0 beside the surface.
        """
        count = len(self.steps)
        steps = np.repeat(self.steps, len(points))[:, None]
        repeated = np.tile(normals, (count, 1))
        samples = np.tile(points, (count, 1)) + steps * np.float32(self.voxel_size) * repeated
        targets = np.hstack([steps, repeated * (steps == 0)]) if self.layout.derivatives else steps
        return samples.astype(np.float32, copy=False), targets

    def learn_visibility(self, cloud: PointCloud, local: LocalLim, sign: int) -> None:
        """Per cell: +1 if the depth image saw its surface, -1 if it saw through it. Without a depth
        image: +1 for supported cells.
        """
        grid, view = self.grid, cloud.view
        if not self.settings.carve:
            return
        if view is None:
            visibility.vote_support(
                local.count, local.keys, local.support, grid.index, sign, grid["evidence"]
            )
            return
        T_camera_world = np.ascontiguousarray(view.T_camera_cloud[None, :3], dtype=np.float32)
        self.vote(view.values[None], view.camera, T_camera_world, (0, grid.count), sign)

    @runtime.compiled_sooner()
    def vote(
        self,
        depth: DeviceArray,
        camera: PinholeCamera,
        T_camera_world: NDArray[np.float32],
        slots: tuple[int, int],
        sign: int = 1,
    ) -> None:
        """Let the depth images (K, H, W) of K views, taken from poses (K, 3, 4), vote in the voxels
        of a range of slots; with sign -1 they take their votes back.
        """
        grid, none = self.grid, (np.zeros((1, 1), np.float16), np.zeros((1, 2), np.float32))
        backs = (grid["backs"], grid["side_weights"]) if self.two_sides else none
        visibility.vote_cells(
            self.layout.rank,
            slots,
            grid["keys"],
            grid["masks"],
            grid["latents"],
            *backs,
            self.cell_gradients,
            self.voxel_size,
            depth,
            camera.intrinsics,
            T_camera_world,
            sign,
            grid["evidence"],
        )

    @property
    def two_sides(self) -> bool:
        """Whether opposite sides are kept apart."""
        return "side_weights" in self.grid

    def _sheets(self, slots: NDArray[np.int32]) -> Sequence[Sheet]:
        if not self.two_sides:
            return (whole(self.grid),)
        return sheets_of(self.grid, self._cell_features, slots)

    @cached_property
    def cell_gradients(self) -> DeviceArray:
        """(4^3 + 1, 4, l): f_posi and its gradient by voxel units at the centres of a voxel's own
        cells, and their mean.
        """
        return to_device(self._cell_features)

    @cached_property
    def _cell_features(self) -> NDArray[np.float32]:
        encoding = self.encoder.tables.encoding
        t = encoding.nodes(CELLS) / 2  # a voxel is the inner half of its doubled voxel
        cells = np.concatenate([encoding(t)[:, None], 0.5 * encoding.gradient(t)], axis=1)
        return np.concatenate([cells, cells.mean(axis=0, keepdims=True)]).astype(np.float32)

    def fuse_voxels(self, data: VoxelData) -> None:
        super().fuse_voxels(data)
        if data.evidence is not None and len(data):
            self.add_evidence(self.grid.slots_of(data.keys), data.evidence)

    def add_evidence(self, slots: NDArray[np.int32], votes: NDArray[np.int8]) -> None:
        """Add votes (N, 64) for the cells of the voxels in slots (N,)."""
        visibility.add_evidence(slots, votes, self.grid["evidence"])

    def sdf(self, points: NDArray) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Signed distance (N,) [m] to the surface at points (N, 3) world [m], positive in front of
        it, and where it is known (N,): within about a voxel of the surface, to some per cent.

        Elsewhere the value has the field's sign, where a voxel is, and says no distance; 0 where there
        is none. At boards thinner than a voxel, whose sides only meshes keep apart, it is the mean of
        both sides' fields.
        """
        self.flush()
        runtime.check_alive(self.grid.runtime)
        scale = np.float32(self.voxel_size)

        def field(x: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
            values, valid = self.decoder.decode(self.grid, x * scale, blend=True, reach=0)
            return values[:, 0], valid

        values, known = distances(field, check_points(points) / scale)
        return values * scale, known

    def extract_mesh(
        self,
        resolution: int = 4,
        min_area: float = 0.0,
        *,
        bounds: ArrayLike | None = None,
        blocks: NDArray[np.int32] | None = None,
        flush: bool = True,
    ) -> Mesh:
        """The zero level by marching cubes on `resolution`^3 cells a voxel; an empty mesh where
        nothing was integrated.

        With `bounds` ((x, y, z), (x, y, z)) world [m], lowest and highest corner, only the triangles that
        lie in that box.

        Connected parts of less than `min_area` square metres are left out. With `blocks` (M, 3), only
        what lies in these, cubes of 16 voxels' edge, as `changed_blocks` gives them; all blocks
        together are the whole mesh, vertices on their borders and normals there included. Without
        `flush`, frames that wait to be fused are left out.

        Raises InputError for a resolution outside 1..32, a box that is none, and where both `min_area`
        and `blocks` are given.
        """
        if flush:
            self.flush()
        runtime.check_alive(self.grid.runtime)
        check_whole("extract_mesh: resolution", resolution, 1, MAX_RESOLUTION, "cells a voxel")
        check_range("extract_mesh: min_area", min_area, 0, 1e6, "square metres")
        if blocks is not None and min_area > 0:
            raise InputError(
                "extract_mesh: min_area needs the whole mesh, since blocks cut parts in pieces: leave "
                "one of min_area and blocks out"
            )
        if blocks is not None:
            blocks = as_numbers("extract_mesh: blocks", blocks, np.int32).reshape(-1, 3)
        box = None if bounds is None else box_of(bounds)
        if box is not None and blocks is None:
            blocks = blocks_in(self.grid.voxel_keys(), box / self.voxel_size)
        slots = slots_near(self.grid, blocks)
        mesh = extract_mesh(
            self.grid,
            self.encoder.tables.encoding,
            self.voxel_size,
            resolution,
            self.settings.support_closing,
            self.settings.min_evidence,
            self._sheets(slots),
            slots,
            blocks,
        )
        if box is not None:
            inside = ((mesh.vertices >= box[0]) & (mesh.vertices <= box[1])).all(axis=1)
            mesh = mesh.part(inside[mesh.faces].all(axis=1))[0]
        return drop_small_parts(mesh, min_area)


def box_of(bounds: ArrayLike) -> NDArray[np.float64]:
    """Two corners (2, 3) [m] of a box, lowest first; six numbers in a row are such too. Raises
    InputError for anything else.
    """
    try:
        box = np.asarray(bounds, np.float64).reshape(2, 3)
    except (TypeError, ValueError):
        raise InputError(
            f"bounds: expected two corners, as ((0, 0, 0), (2, 2, 1)) in metres, got {shortened(bounds)}"
        ) from None
    check_box(box[0].tolist(), box[1].tolist())
    return box
