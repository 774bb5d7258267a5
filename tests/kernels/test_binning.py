"""Per-frame binning: the kernels against their twins, and the index range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import reference
from scenes import rough, taken

from taichi_unifusion.errors import OutOfRange
from taichi_unifusion.kernels import binning
from taichi_unifusion.kernels.index import block_of_points, touch_points
from taichi_unifusion.kernels.regression import find_neighbors
from taichi_unifusion.maps.binner import FIRST_BLOCKS, Binner, SurfelBinner
from taichi_unifusion.maps.voxel_grid import MASKS, WEIGHTS, VoxelGrid, latents

VS = 0.05
FIXED = 1e-6  # 24 fractional bits, rounded once a run of points, and float32 sums within a run
POSITION = 5e-6  # [voxels] float32 positions some voxels from the origin
OFFSETS = np.array([-0.1, 0.0, 0.2], np.float32)  # not symmetric, so that a wrong sign shows
ROOM = 4000


@pytest.fixture(scope="module")
def grid() -> VoxelGrid:
    return VoxelGrid([latents(2, 3), WEIGHTS, MASKS])


@pytest.fixture(scope="module")
def cloud():
    """Points about the origin, so that indices of both signs occur, with runs in one cell and lone
    points.
    """
    return rough(0, 1200)


def in_voxels(points) -> np.ndarray:
    """Positions [voxels] as the kernels compute them, so that no point changes its cell."""
    return (points * np.float32(1 / VS)).astype(float)


@dataclass
class Blocks:
    """The voxels that a frame touches, and sums in their cells, through the kernels alone."""

    grid: VoxelGrid
    frame: int
    keys: np.ndarray  # (ROOM, 3)
    counters: np.ndarray

    @property
    def count(self) -> int:
        return int(self.counters[0])

    @property
    def voxels(self) -> list[tuple]:
        """Voxel of each block."""
        return list(map(tuple, self.keys[: self.count].tolist()))

    def bin(self, points, values, with_positions):
        """Counts (ROOM, 64) and sums (ROOM, 64, c)."""
        width = values.shape[1] + 3 * with_positions
        counts, sums = np.zeros((ROOM, 64), np.int32), np.zeros((ROOM, 64, width), np.int64)
        nothing, channels = [points] * 3, (values.shape[1], 0, 0, 0)
        index = self.grid.index
        binning.bin_points(
            points, values, *nothing, channels, 1 / VS, 32, with_positions, index, counts, sums
        )
        return counts, sums


def touch(grid: VoxelGrid, points) -> Blocks:
    keys, counters = np.zeros((ROOM, 3), np.int32), np.zeros(2, np.int32)
    frame = grid.next_frame()
    touch_points(points, 1 / VS, frame, 32, False, grid.index, counters, keys)
    return Blocks(grid, frame, keys, counters)


def by_cell(voxels: list[tuple], counts, sums) -> dict:
    """Lattice cell -> (count, mean sums)."""
    sums = sums / binning.FIXED
    occupied = np.argwhere(counts[: len(voxels)])
    lattice = 4 * np.array(voxels)[occupied[:, 0]] + np.stack(
        np.unravel_index(occupied[:, 1], (4, 4, 4)), axis=1
    )
    return {
        tuple(at): (counts[b, cell], sums[b, cell] / counts[b, cell])
        for at, (b, cell) in zip(lattice.tolist(), occupied, strict=True)
    }


def test_touch_points_equals_its_twin(grid, cloud):
    for part in (cloud, taken(cloud, slice(5))):  # a second frame gives numbers anew
        blocks = touch(grid, part.points)
        voxels = blocks.voxels
        assert len(set(voxels)) == len(voxels)
        assert set(voxels) == reference.touch_points(in_voxels(part.points))
    assert min(min(key) for key in voxels) < 0


def test_find_neighbors_equals_its_twin(grid, cloud):
    touch(grid, cloud.points)
    blocks = touch(grid, taken(cloud, slice(400)).points)  # those of the frame before do not count
    found = np.empty((blocks.count, 27), np.int32)
    find_neighbors(grid.index, blocks.frame, blocks.count, blocks.keys, found)
    twin = reference.find_neighbors(blocks.voxels)
    np.testing.assert_array_equal(found, twin)
    assert 0.2 < (twin >= 0).mean() < 0.8 and (twin[:, 13] == np.arange(blocks.count)).all()


def test_block_of_points_equals_its_twin(grid, cloud):
    blocks = touch(grid, cloud.points)
    found = np.empty(len(cloud), np.int32)
    block_of_points(cloud.points, 1 / VS, grid.index, found)
    np.testing.assert_array_equal(
        np.array(blocks.voxels)[found], reference.block_of_points(in_voxels(cloud.points))
    )


def test_bin_points_equals_its_twin(grid, cloud):
    blocks = touch(grid, cloud.points)
    binned = by_cell(blocks.voxels, *blocks.bin(cloud.points, cloud.normals, True))
    twin = reference.bin_points(in_voxels(cloud.points), cloud.normals.astype(float))
    assert binned.keys() == twin.keys() and max(count for count, _, _ in twin.values()) > 3
    for cell, (count, normal, position) in twin.items():
        assert binned[cell][0] == count
        np.testing.assert_allclose(binned[cell][1][:3], normal, atol=FIXED)
        np.testing.assert_allclose(
            binned[cell][1][3:], position - (np.array(cell) + 0.5) / 4, atol=POSITION
        )


def test_the_order_of_points_does_not_change_the_sums(grid, cloud):
    order, sums = np.random.default_rng(1).permutation(len(cloud)), []
    for rows in (slice(None), order):
        points, normals = cloud.points[rows], cloud.normals[rows]
        blocks = touch(grid, points)
        sums.append(by_cell(blocks.voxels, *blocks.bin(points, normals, True)))
    assert sums[0].keys() == sums[1].keys()
    for cell, (count, mean) in sums[0].items():
        assert count == sums[1][cell][0]
        np.testing.assert_allclose(mean, sums[1][cell][1], atol=FIXED)


def surfel_samples(grid: VoxelGrid, points, normals):
    """Blocks of the points and of their samples, the surfels' sums, and those of the samples."""
    blocks = touch(grid, points)
    surfels = blocks.bin(points, normals, True)
    with_points = blocks.count
    binning.touch_surfel_samples(
        with_points, *surfels, OFFSETS, blocks.frame, grid.index, blocks.keys, blocks.counters
    )
    samples = np.zeros((ROOM, 64), np.int32), np.zeros((ROOM, 64, 4), np.int64)
    binning.bin_surfel_samples(
        with_points, blocks.keys, OFFSETS, True, grid.index, *surfels, *samples
    )
    return with_points, blocks, surfels, samples


def test_surfel_kernels_equal_their_twins(grid, cloud):
    with_points, blocks, surfels, samples = surfel_samples(grid, cloud.points, cloud.normals)
    x, normals, offsets = (a.astype(float) for a in (cloud.points, cloud.normals, OFFSETS))
    x, voxels = in_voxels(cloud.points), blocks.voxels
    assert len(set(voxels)) == len(voxels)
    assert set(voxels) == reference.touch_surfel_samples(x, normals, offsets)
    assert len(voxels) > with_points  # samples reach voxels without points
    binned, twin = by_cell(voxels, *samples), reference.bin_surfel_samples(x, normals, offsets)
    assert binned.keys() == twin.keys()
    for cell, (count, distance, normal) in twin.items():
        assert binned[cell][0] == count
        np.testing.assert_allclose(binned[cell][1], [*distance, *normal], atol=POSITION)
    assert not surfels[0].any() and not surfels[1].any()  # read last, left zero


def test_normals_that_cancel_give_no_samples(grid):
    points = np.full((2, 3), 0.006, np.float32)
    normals = np.array([[0, 0, 1], [0, 0, -1]], np.float32)
    *_, surfels, samples = surfel_samples(grid, points, normals)
    assert not samples[0].any() and not surfels[0].any()


def test_mark_and_compact_cells_equal_their_twins(grid, cloud):
    blocks = touch(grid, cloud.points)
    counts, sums = blocks.bin(cloud.points, cloud.normals, False)
    n, voxels = blocks.count, blocks.voxels
    rows = reference.compact_cells(counts[:n], sums[:n] / binning.FIXED)
    lattice = {cell: value[0] for cell, value in by_cell(voxels, counts, sums).items()}
    occupied_before = counts[:n] > 0
    points_before = counts[:n].sum(axis=1)
    for minimum in (1, 3):
        masks, support = np.zeros((n, 2), np.uint32), np.zeros((n, 2), np.uint32)
        totals, occupied = np.zeros(n, np.int32), np.zeros(n, np.int32)
        binning.mark_cells(n, counts, minimum, masks, support, totals, occupied)
        for found, least in ((masks, 1), (support, minimum)):
            twin = reference.mark_cells(lattice, least)
            np.testing.assert_array_equal(
                reference.unpack_masks(found), [twin[key] for key in voxels]
            )
        np.testing.assert_array_equal(totals, points_before)
        np.testing.assert_array_equal(occupied, occupied_before.sum(axis=1))
    starts, cells = (np.cumsum(occupied) - occupied).astype(np.int32), np.zeros((len(rows), 4))
    cells = cells.astype(np.float32)
    binning.compact_cells(n, starts, masks, 3, counts, sums, cells)
    np.testing.assert_allclose(cells, rows, rtol=FIXED, atol=FIXED)
    assert not counts.any() and not sums.any()


def test_a_frame_of_more_voxels_than_expected_is_given_room(grid):
    """Also where only the samples beside the points are too many: what was begun leaves no trace."""
    rng = np.random.default_rng(2)
    scattered = rng.uniform(-1, 1, (3000, 3)).astype(np.float32)
    binned = Binner(grid, VS, 3).bin(scattered, [scattered])
    voxels = set(map(tuple, binned.keys.to_numpy()[: binned.count].tolist()))
    assert binned.count > FIRST_BLOCKS
    assert voxels == reference.touch_points(in_voxels(scattered))
    assert binned.totals.to_numpy()[: binned.count].sum() == len(scattered)

    other = VoxelGrid([latents(2, 3), WEIGHTS, MASKS])
    points = rng.uniform(-1, 1, (2 * binned.keys.shape[0] - 1500, 3)).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    binner = SurfelBinner(other, VS, np.float32([-1, 0, 1]), support_points=1, with_normals=False)
    for _ in range(2):
        found = binner.bin(points, [normals])
        wanted = reference.touch_surfel_samples(
            in_voxels(points), normals.astype(float), [-1.0, 0.0, 1.0]
        )
        assert set(map(tuple, found.keys.to_numpy()[: found.count].tolist())) == wanted
        assert found.totals.to_numpy()[: found.count].sum() == 3 * len(points)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 410.0, -410.0, 1e30])
def test_points_outside_the_index_range_are_refused_and_counted(grid, cloud, bad):
    points = cloud.points.copy()
    points[[3, 77], [0, 2]] = bad
    with pytest.raises(OutOfRange, match="2 of 1200 points lie more than 410 m"):
        Binner(grid, VS, 3).bin(points, [cloud.normals])
