"""Device side of the position encoding and the per-voxel regression: constant tables, scratch, and
the launches.
"""

from __future__ import annotations

from functools import cached_property
from itertools import product

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ..errors import InputError
from ..kernels import fusion, query
from ..kernels import regression as kernels
from ..kernels.voxels import CELLS
from .encoding import position_encoding
from .frame_blocks import FrameBlocks
from .settings import MapSettings
from .voxel_grid import VoxelGrid

# Taichi cuts a CPU loop into chunks of at least 512 iterations: a worker per chunk
CPU_WORKERS, CPU_STRIDE = 64, 512
GPU_WORKERS, GPU_STRIDE = 8192, 1


class Regressor:
    """Encodes the blocks of a frame: F, w for every voxel with enough samples in it."""

    def __init__(
        self,
        grid: VoxelGrid,
        settings: MapSettings,
        *,
        channels: int,
        centered: bool,
        derivatives: bool,
    ) -> None:
        self.grid = grid
        self.encoding = encoding = position_encoding(settings.encoder)
        self.channels, self.centered, self.derivatives = channels, centered, derivatives
        self.voxel_size, self.noise, self.min_points = (
            settings.voxel_size,
            settings.noise,
            settings.min_points,
        )
        self.rank = encoding.settings.rank
        self.size = _round_up(self.rank)
        self.rows = self.size + _round_up(channels + centered)
        self.information = settings.fusion == "information"
        self.scale = float(np.sqrt(7.0) / encoding.settings.length_scale)
        self.anchors = _to_device((encoding.anchors * self.scale).T)
        self.projection = _to_device(encoding.projection.T)
        self.cell_features = _to_device(self._cell_features())
        on_cpu = grid.runtime.device == "cpu"
        self.workers, self.stride = (
            (CPU_WORKERS, CPU_STRIDE) if on_cpu else (GPU_WORKERS, GPU_STRIDE)
        )
        self.window = ti.ndarray(ti.u32, (27, 2))
        self.window.from_numpy(_window_masks(settings.margin))
        self.tiles = self._shared_tiles()
        self.neighbors = ti.ndarray(ti.i32, (1, 27))
        self.latents = ti.ndarray(ti.f32, (1, 1, 1))
        self.weights = ti.ndarray(ti.f32, (1,))
        self.slots = ti.ndarray(ti.i32, (1,))
        self.sum_count = sum_count(self.rank, channels, centered) if self.information else 1
        self.sums = ti.ndarray(ti.f32, (1, self.sum_count))

    def _shared_tiles(self):
        """Scratch for the workers, one for all maps of a runtime; a field, because its strides are
        known when compiling.
        """
        shape = (self.workers, self.rows, kernels.TILE)
        scratch = self.grid.runtime.scratch
        if shape not in scratch:
            scratch[shape] = ti.field(ti.f32, shape)
        return scratch[shape]

    def _cell_features(self) -> NDArray[np.float64]:
        """(8^3, 1 or 4, size): f_posi, and its gradient by voxel units, at the cell centres of a
        doubled voxel.
        """
        t = self.encoding.nodes(2 * CELLS)
        table = np.zeros((len(t), 4 if self.derivatives else 1, self.size))
        table[:, 0, : self.rank] = self.encoding(t)
        if self.derivatives:
            table[:, 1:, : self.rank] = 0.5 * self.encoding.gradient(t)  # t moves by 1/2 a voxel
        return table

    @cached_property
    def cell_gradients(self) -> ti.Ndarray:
        """(4^3, 4, l): f_posi and its gradient by voxel units at the centres of a voxel's own
        cells.
        """
        t = self.encoding.nodes(CELLS) / 2  # a voxel is the inner half of its doubled voxel
        return _to_device(
            np.concatenate([self.encoding(t)[:, None], 0.5 * self.encoding.gradient(t)], axis=1)
        )

    def _begin(self, blocks: FrameBlocks) -> None:
        """Make room for the results of a frame and look up the neighbours of its blocks."""
        if blocks.count > self.weights.shape[0]:
            room = blocks.count * 5 // 4
            self.neighbors = ti.ndarray(ti.i32, (room, 27))
            if self.information:
                self.sums = ti.ndarray(ti.f32, (room, self.sum_count))
            else:
                self.latents = ti.ndarray(ti.f32, (room, self.grid.rows, self.channels))
            self.weights = ti.ndarray(ti.f32, (room,))
            self.slots = ti.ndarray(ti.i32, (room,))
        kernels.find_neighbors(
            self.grid.stamp,
            self.grid.block,
            blocks.frame,
            blocks.count,
            blocks.keys,
            self.neighbors,
        )

    def encode_cells(self, blocks: FrameBlocks) -> None:
        """Encode from the blocks' compacted cells."""
        self._begin(blocks)
        kernels.encode_cells(
            self.rank,
            self.size,
            self.rows,
            self.channels,
            self.centered,
            self.derivatives,
            not self.information,
            blocks.count,
            self.neighbors,
            blocks.masks,
            self.window,
            blocks.totals,
            blocks.starts,
            blocks.cells,
            self.cell_features,
            self.min_points,
            self.noise,
            self.workers,
            self.stride,
            self.tiles,
            self.latents,
            self.weights,
            self.sums,
        )

    def encode_points(
        self,
        blocks: FrameBlocks,
        starts: NDArray[np.int32],
        samples: NDArray[np.float32],
        targets: NDArray[np.float32],
    ) -> None:
        """Encode from single samples (N, 3) [voxels] with targets (N, c), both sorted by block;
        block b has starts[b:b+2].
        """
        self._begin(blocks)
        kernels.encode_points(
            self.rank,
            self.size,
            self.rows,
            self.channels,
            self.centered,
            self.derivatives,
            not self.information,
            blocks.count,
            blocks.keys,
            self.neighbors,
            starts,
            samples,
            targets,
            self.anchors,
            self.projection,
            self.scale,
            self.min_points,
            self.noise,
            self.workers,
            self.stride,
            self.tiles,
            self.latents,
            self.weights,
            self.sums,
        )

    def query(
        self, points: NDArray, blend: bool, reach: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Decoded values (N, c) and where a voxel covers (N,), at points (N, 3) world [m] (Eq. 7);
        `reach` as in the kernel.
        """
        points = np.ascontiguousarray(points, dtype=np.float32)
        if points.ndim != 2 or points.shape[1] != 3:
            raise InputError(f"query: points must be (N, 3), got {points.shape}")
        values, valid = (
            np.zeros((len(points), self.channels), np.float32),
            np.zeros(len(points), np.uint8),
        )
        if len(points):
            query.query_points(
                self.rank,
                self.channels,
                self.centered,
                blend,
                points,
                1.0 / self.voxel_size,
                self.grid.slot,
                self.grid.latents,
                self.anchors,
                self.projection,
                self.scale,
                reach,
                values,
                valid,
            )
        return values, valid.astype(bool)

    def fuse(self, blocks: FrameBlocks, encoder: Regressor | None = None, first: int = 0) -> int:
        """Fuse what was encoded into the map, with the blocks' support; returns the number of
        voxels encoded.

        With an `encoder`, that which it encoded, of its channels those from `first` on.
        """
        source = encoder or self
        encoded = self.grid.claim(blocks.count, blocks.keys, source.weights, source.slots)
        self.fuse_rows(
            blocks.count,
            source.slots,
            source.latents,
            source.sums,
            source.weights,
            blocks.support,
            1.0,
            first,
            source.channels,
        )
        return encoded

    def take_out(self, blocks: FrameBlocks) -> int:
        """Undo the fusion of what was encoded; returns the number of voxels that it touched."""
        known = self.grid.find(blocks.count, blocks.keys, self.weights, self.slots)
        self.fuse_rows(
            blocks.count,
            self.slots,
            self.latents,
            self.sums,
            self.weights,
            self._no_support(blocks),
            -1.0,
        )
        self.grid.release(blocks.count, blocks.keys, self.slots)
        return known

    def _no_support(self, blocks: FrameBlocks):
        """Masks without a bit: what other frames support is not known, so that support is never
        taken back.
        """
        blocks.support.fill(0)
        return blocks.support

    def fuse_rows(
        self,
        count: int,
        slots,
        latents,
        sums,
        weights,
        masks,
        sign: float,
        first: int = 0,
        encoded: int | None = None,
    ) -> None:
        """Fuse `count` voxels into the slots of the map: by Eq. 19, or as sums of one regression
        over all frames.

        The rows may hold `encoded` channels, of which the map's are those from `first` on.
        """
        if self.information:
            fusion.fuse_information(
                self.rank,
                self.size,
                self.rows,
                self.channels,
                self.centered,
                first,
                encoded or self.channels,
                count,
                slots,
                sums,
                weights,
                masks,
                sign,
                self.noise,
                self.grid.sums,
                self.grid.latents,
                self.grid.weights,
                self.grid.masks,
            )
        else:
            fusion.fuse(
                self.grid.rows,
                self.channels,
                first,
                count,
                slots,
                latents,
                weights,
                masks,
                sign,
                self.grid.latents,
                self.grid.weights,
                self.grid.masks,
            )


def sum_count(rank: int, channels: int, centered: bool) -> int:
    """How many numbers the regression sums up for a voxel, as `keep_sums` lays them out."""
    size = _round_up(rank)
    return size * (size + 1) // 2 + size * (channels + centered) + channels


def _window_masks(margin: int) -> NDArray[np.uint32]:
    """(27, 2): the cells of each of the 27 neighbours within `margin` cells of a voxel, as bits as
    `mark_cells` has them.
    """
    halves = {-1: range(CELLS - margin, CELLS), 0: range(CELLS), 1: range(margin)}
    masks = np.zeros((27, 2), np.uint32)
    for o, steps in enumerate(product((-1, 0, 1), repeat=3)):
        for i, j, k in product(*(halves[step] for step in steps)):
            cell = (i * CELLS + j) * CELLS + k
            masks[o, cell // 32] |= np.uint32(1 << (31 - cell % 32))
    return masks


def _round_up(n: int) -> int:
    return -(-n // kernels.PATCH) * kernels.PATCH


def _to_device(array: NDArray) -> ti.Ndarray:
    array = np.ascontiguousarray(array, dtype=np.float32)
    on_device = ti.ndarray(ti.f32, array.shape)
    on_device.from_numpy(array)
    return on_device
