"""Encoder: binned points -> the local LIM, by one small regression a voxel (Eq. 6, 17, 18); and
Decoder: latents -> values at points (Eq. 7).
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..device_arrays import Arena, DeviceArray
from ..errors import InputError
from ..geometry.checks import as_numbers
from ..kernels import query, regression, ti
from ..kernels.arrays import Lanes
from ..kernels.cells import CELLS
from ..kernels.gram import TILE, Scratch
from ..kernels.layout import LANES, Layout
from ..runtime import Runtime, compiled_sooner
from .encoding import position_encoding
from .local_lim import Binned, LocalLim, SortedSamples
from .settings import MapSettings
from .voxel_grid import VoxelGrid

CPU_WORKERS, GPU_WORKERS = 64, 8192
NODES = 33  # of the lattice of f_posi that decoding reads, along an edge of the doubled voxel
SPACES = NODES // 2  # between nodes, from the centre of a voxel to the next one's


class Encoder:
    """Tables of the position encoding on the device, and the regression that uses them.

    `layout` says how many targets a sample has, and whether F or the sums of the regression are
    wanted.
    """

    def __init__(self, runtime: Runtime, settings: MapSettings, layout: Layout) -> None:
        self.layout = layout
        self.min_points, self.noise = settings.min_points, settings.noise
        self.tables = PositionTables(settings, runtime.arena)
        self.window = window_masks(settings.margin)
        self.cell_features = self._cell_features()
        self.scratch = _scratch(runtime, layout)

    def _cell_features(self) -> DeviceArray:
        """(8^3, 1 or 4, V vectors): f_posi, and its gradient by voxel units, at the cell centres of a
        doubled voxel.
        """
        encoding, rank = self.tables.encoding, self.layout.rank
        t = encoding.nodes(2 * CELLS)
        vectors = self.layout.feature_vectors
        table = np.zeros((len(t), 4 if self.layout.derivatives else 1, vectors * LANES), np.float32)
        table[:, 0, :rank] = encoding(t)
        if self.layout.derivatives:
            table[:, 1:, :rank] = 0.5 * encoding.gradient(t)  # t moves by 1/2 a voxel
        on_device: DeviceArray = ti.ndarray(Lanes, (*table.shape[:2], vectors))
        on_device.from_numpy(table.reshape(*table.shape[:2], vectors, LANES))
        return on_device

    def encode(self, binned: Binned) -> LocalLim:
        """Encode the averages in cells."""
        local = self.room(binned)
        self.encode_blocks(binned, 0, binned.count, local)
        return local

    @compiled_sooner()
    def encode_blocks(self, binned: Binned, begin: int, end: int, local: LocalLim) -> None:
        """Encode the averages in cells of blocks `begin` to `end` into a local LIM."""
        binned.loan.check()
        regression.encode_cells(
            self.layout,
            begin,
            end,
            binned.neighbors,
            binned.masks,
            self.window,
            binned.rows,
            binned.cells,
            self.cell_features,
            self.min_points,
            self.noise,
            self.scratch,
            local.weights,
            local.encoded,
        )

    @compiled_sooner()
    def encode_samples(self, samples: SortedSamples) -> LocalLim:
        """Encode every sample as it is, as published."""
        samples.loan.check()
        local = self.room(samples)
        regression.encode_points(
            self.layout,
            samples.keys,
            samples.neighbors,
            samples.starts,
            samples.samples,
            samples.targets,
            self.tables.anchors,
            self.tables.projection,
            self.tables.scale,
            self.min_points,
            self.noise,
            self.scratch,
            local.weights,
            local.encoded,
        )
        return local

    def room(self, source: Binned | SortedSamples) -> LocalLim:
        """Arrays for what is encoded, (B, r, c) or (B, q, 1), and the weights (B,)."""
        layout, arena = self.layout, source.loan.arena
        row = (layout.sums, 1) if layout.information else (layout.latent_rows, layout.channels)
        return LocalLim(
            source.loan,
            source.count,
            source.keys,
            arena.borrow("encoded", ti.f32, (max(source.count, 1), *row)),
            arena.borrow("weights", ti.f32, (max(source.count, 1),)),
            source.support,
            layout.channels,
        )


class PositionTables:
    """What kernels need of f_posi: for samples exactly, for decoding on a lattice."""

    def __init__(self, settings: MapSettings, arena: Arena) -> None:
        self.encoding, self.arena = position_encoding(settings.encoder), arena
        self.scale = float(np.sqrt(7.0) / settings.encoder.length_scale)
        self.anchors = to_device((self.encoding.anchors * self.scale).T)  # (3, A)
        self.projection = to_device(self.encoding.projection.T)  # (l, A)

    @property
    def lattice(self) -> DeviceArray:
        """((SPACES + 1)^3 x 8 x size,) f_posi of the eight voxels around a lattice corner, on nodes
        between their centres; made at the first query and shared by all maps of these settings.
        """
        settings, shape = self.encoding.settings, (NODES, NODES, NODES)
        return self.arena.exact(
            f"lattice of {settings}",
            lambda: to_device(between_centers(self.encoding.lattice(NODES)).reshape(-1)),
            shape,
        )


def between_centers(lattice: NDArray[np.float32]) -> NDArray[np.float32]:
    """((SPACES + 1)^3, 8, size): what each of the eight voxels around a lattice corner has at the
    nodes between their centres, an eighth of its `lattice` (NODES^3, l); zeros fill up the size.
    """
    rank, edge = lattice.shape[1], SPACES + 1
    cube = lattice.reshape(NODES, NODES, NODES, rank)
    between = np.zeros((edge, edge, edge, 8, Layout(rank, 1).size), np.float32)
    for o, steps in enumerate(product((0, 1), repeat=3)):
        eighth = tuple(slice(SPACES * (1 - up), SPACES * (1 - up) + edge) for up in steps)
        between[..., o, :rank] = cube[eighth]
    return between.reshape(edge**3, 8, -1)


class Decoder:
    """Values of a grid's latents at points: f_dec(x, F) = f_posi(t) F."""

    def __init__(self, tables: PositionTables, layout: Layout, voxel_size: float) -> None:
        self.tables, self.layout, self.voxel_size = tables, layout, voxel_size

    def decode(
        self, grid: VoxelGrid, points: NDArray, blend: bool, reach: int
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Decoded values (N, c) and where a voxel covers (N,), at points (N, 3) world [m].

        `blend` and `reach` are those of `kernels.query.query_points`.
        """
        points = check_points(points)
        values = np.empty((len(points), self.layout.channels), np.float32)
        valid = np.empty(len(points), np.uint8)
        if len(points):
            query.query_points(
                self.layout,
                blend,
                points,
                1.0 / self.voxel_size,
                grid.index,
                grid["latents"],
                self.tables.lattice,
                SPACES,
                reach,
                values,
                valid,
            )
        return values, valid.astype(bool)


def check_points(points: NDArray) -> NDArray[np.float32]:
    """Points (N, 3) as kernels take them; raises InputError for another shape."""
    points = as_numbers("points", points)
    if points.ndim != 2 or points.shape[1] != 3:
        raise InputError(f"query: points must be (N, 3), got {points.shape}")
    return points


def window_masks(margin: int) -> DeviceArray:
    """(27, 2): the cells of each of the 27 neighbours within `margin` cells of a voxel, as bits."""
    halves = {-1: range(CELLS - margin, CELLS), 0: range(CELLS), 1: range(margin)}
    masks = np.zeros((27, 2), np.uint32)
    for o, steps in enumerate(product((-1, 0, 1), repeat=3)):
        for i, j, k in product(*(halves[step] for step in steps)):
            cell = (i * CELLS + j) * CELLS + k
            masks[o, cell // 32] |= np.uint32(1 << (31 - cell % 32))
    on_device = ti.ndarray(ti.u32, masks.shape)
    on_device.from_numpy(masks)
    return on_device


def workers(runtime: Runtime, on_gpu: int = GPU_WORKERS) -> int:
    """How many workers share the voxels of a frame; `on_gpu` where each needs more scratch."""
    return CPU_WORKERS if runtime.device == "cpu" else on_gpu


def _scratch(runtime: Runtime, layout: Layout) -> Scratch:
    """Scratch of the workers, one for all maps of a runtime whose samples are as long."""
    count, vectors = workers(runtime), layout.vectors

    def make() -> Scratch:
        return Scratch(
            tiles=ti.Vector.field(LANES, ti.f32, (count, TILE, vectors)),
            products=ti.Vector.field(LANES, ti.f32, (count, vectors * LANES, vectors)),
        )

    return runtime.arena.exact("samples", make, (count, vectors))


def to_device(array: NDArray) -> DeviceArray:
    """A float32 copy of an array on the device."""
    array = np.ascontiguousarray(array, dtype=np.float32)
    on_device = ti.ndarray(ti.f32, array.shape)
    on_device.from_numpy(array)
    return on_device
