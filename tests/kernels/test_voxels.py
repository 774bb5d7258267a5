"""Voxel index and per-frame binning: the kernels against their twins, and the index range, growth
and reuse of trees.
"""

from __future__ import annotations

import gc

import numpy as np
import pytest
import reference
from scenes import moved, rough, taken

from taichi_unifusion import runtime
from taichi_unifusion.errors import CapacityError, OutOfRange, RuntimeStateError
from taichi_unifusion.kernels import cells as cell_kernels
from taichi_unifusion.kernels import voxels as kernels
from taichi_unifusion.kernels.regression import find_neighbors
from taichi_unifusion.maps import voxel_grid
from taichi_unifusion.maps.frame_blocks import FrameBlocks
from taichi_unifusion.maps.voxel_grid import VoxelGrid

VS = 0.05
FIXED = 1e-6  # 24 fractional bits, rounded once a run of points, and float32 sums within a run
POSITION = 5e-6  # [voxels] float32 positions some voxels from the origin
OFFSETS = np.array([-0.1, 0.0, 0.2], np.float32)  # not symmetric, so that a wrong sign shows


@pytest.fixture(scope="module")
def grid() -> VoxelGrid:
    return VoxelGrid(rows=2, channels=3)


@pytest.fixture(scope="module")
def cloud():
    """Points about the origin, so that indices of both signs occur, with runs in one cell and lone
    points.
    """
    return rough(0, 1200)


def in_voxels(points) -> np.ndarray:
    """Positions [voxels] as the kernels compute them, so that no point changes its cell."""
    return (points * np.float32(1 / VS)).astype(float)


def keys_of(blocks: FrameBlocks) -> list[tuple]:
    """Voxel of each block."""
    return list(map(tuple, blocks.keys.to_numpy()[: blocks.count].tolist()))


def by_cell(blocks: FrameBlocks, keys: list[tuple]) -> dict:
    """Lattice cell -> (count, mean sums)."""
    counts, sums = blocks.counts.to_numpy(), blocks.sums.to_numpy() / cell_kernels.FIXED
    occupied = np.argwhere(counts[: len(keys)])
    lattice = 4 * np.array(keys)[occupied[:, 0]] + np.stack(
        np.unravel_index(occupied[:, 1], (4, 4, 4)), axis=1
    )
    return {
        tuple(at): (counts[b, cell], sums[b, cell] / counts[b, cell])
        for at, (b, cell) in zip(lattice.tolist(), occupied, strict=True)
    }


def test_touch_points_equals_its_twin(grid, cloud):
    blocks = FrameBlocks(grid, 3, with_positions=True)
    for part in (cloud, taken(cloud, slice(5))):  # a second frame gives numbers anew
        blocks.touch(part.points, VS)
        keys = keys_of(blocks)
        assert len(set(keys)) == len(keys) and set(keys) == reference.touch_points(
            in_voxels(part.points)
        )
    assert min(min(key) for key in keys_of(blocks)) < 0


def test_find_neighbors_equals_its_twin(grid, cloud):
    blocks = FrameBlocks(grid, 3, with_positions=True)
    blocks.touch(cloud.points, VS)
    blocks.touch(taken(cloud, slice(400)).points, VS)  # neighbours of the frame before do not count
    found = np.empty((blocks.count, 27), np.int32)
    find_neighbors(grid.stamp, grid.block, blocks.frame, blocks.count, blocks.keys, found)
    twin = reference.find_neighbors(keys_of(blocks))
    np.testing.assert_array_equal(found, twin)
    assert 0.2 < (twin >= 0).mean() < 0.8 and (twin[:, 13] == np.arange(blocks.count)).all()


def test_block_of_points_equals_its_twin(grid, cloud):
    blocks = FrameBlocks(grid, 3, with_positions=True)
    blocks.touch(cloud.points, VS)
    found = np.empty(len(cloud), np.int32)
    kernels.block_of_points(cloud.points, 1 / VS, grid.block, found)
    np.testing.assert_array_equal(
        np.array(keys_of(blocks))[found], reference.block_of_points(in_voxels(cloud.points))
    )


def test_bin_points_equals_its_twin(grid, cloud):
    blocks = FrameBlocks(grid, 3, with_positions=True)
    blocks.touch(cloud.points, VS)
    blocks.bin(cloud.points, [cloud.normals], VS)
    binned, twin = (
        by_cell(blocks, keys_of(blocks)),
        reference.bin_points(in_voxels(cloud.points), cloud.normals.astype(float)),
    )
    assert binned.keys() == twin.keys() and max(count for count, _, _ in twin.values()) > 3
    for cell, (count, normal, position) in twin.items():
        assert binned[cell][0] == count
        np.testing.assert_allclose(binned[cell][1][:3], normal, atol=FIXED)
        np.testing.assert_allclose(
            binned[cell][1][3:], position - (np.array(cell) + 0.5) / 4, atol=POSITION
        )


def test_the_order_of_points_does_not_change_the_sums(grid, cloud):
    order, sums = np.random.default_rng(1).permutation(len(cloud)), []
    for points, normals in (
        (cloud.points, cloud.normals),
        (cloud.points[order], cloud.normals[order]),
    ):
        blocks = FrameBlocks(grid, 3, with_positions=True)
        blocks.touch(points, VS)
        blocks.bin(points, [normals], VS)
        sums.append(by_cell(blocks, keys_of(blocks)))
    assert sums[0].keys() == sums[1].keys()
    for cell, (count, mean) in sums[0].items():
        assert count == sums[1][cell][0]
        np.testing.assert_allclose(mean, sums[1][cell][1], atol=FIXED)


def test_surfel_kernels_equal_their_twins(grid, cloud):
    surfels, samples = (
        FrameBlocks(grid, 3, with_positions=True),
        FrameBlocks(grid, 4, with_positions=False),
    )
    surfels.touch(cloud.points, VS)
    surfels.bin(cloud.points, [cloud.normals], VS)
    assert surfels.touch_samples(OFFSETS)
    samples.bin_samples(surfels, OFFSETS)
    x, normals = in_voxels(cloud.points), cloud.normals.astype(float)
    keys = keys_of(samples)
    assert len(set(keys)) == len(keys) and set(keys) == reference.touch_surfel_samples(
        x, normals, OFFSETS.astype(float)
    )
    assert len(keys) > surfels.count  # samples reach voxels without points
    binned, twin = (
        by_cell(samples, keys),
        reference.bin_surfel_samples(x, normals, OFFSETS.astype(float)),
    )
    assert binned.keys() == twin.keys()
    for cell, (count, distance, normal) in twin.items():
        assert binned[cell][0] == count
        np.testing.assert_allclose(binned[cell][1], [*distance, *normal], atol=POSITION)
    # read last, left zero
    assert not surfels.counts.to_numpy().any() and not surfels.sums.to_numpy().any()


def test_normals_that_cancel_give_no_samples(grid):
    points = np.full((2, 3), 0.006, np.float32)
    normals = np.array([[0, 0, 1], [0, 0, -1]], np.float32)
    surfels, samples = (
        FrameBlocks(grid, 3, with_positions=True),
        FrameBlocks(grid, 4, with_positions=False),
    )
    surfels.touch(points, VS)
    surfels.bin(points, [normals], VS)
    assert surfels.touch_samples(OFFSETS)
    samples.bin_samples(surfels, OFFSETS)
    assert not samples.counts.to_numpy().any() and not surfels.counts.to_numpy().any()


def test_mark_and_compact_cells_equal_their_twins(grid, cloud):
    blocks = FrameBlocks(grid, 3, with_positions=False)
    blocks.touch(cloud.points, VS)
    blocks.bin(cloud.points, [cloud.normals], VS)
    keys, counts = keys_of(blocks), blocks.counts.to_numpy()[: blocks.count]
    rows = reference.compact_cells(
        counts, blocks.sums.to_numpy()[: blocks.count] / cell_kernels.FIXED
    )
    lattice = {cell: value[0] for cell, value in by_cell(blocks, keys).items()}
    blocks.compact(3)
    for minimum, masks in ((1, blocks.masks), (3, blocks.support)):
        twin = reference.mark_cells(lattice, minimum)
        np.testing.assert_array_equal(
            reference.unpack_masks(masks.to_numpy()[: blocks.count]), [twin[key] for key in keys]
        )
    np.testing.assert_array_equal(blocks.totals.to_numpy()[: blocks.count], counts.sum(axis=1))
    np.testing.assert_array_equal(np.diff([*blocks.starts, len(rows)]), (counts > 0).sum(axis=1))
    np.testing.assert_allclose(blocks.cells.to_numpy()[: len(rows)], rows, rtol=FIXED, atol=FIXED)
    assert not blocks.counts.to_numpy().any() and not blocks.sums.to_numpy().any()


def test_a_frame_of_more_voxels_than_expected_is_given_room(grid):
    scattered = np.random.default_rng(2).uniform(-1, 1, (3000, 3)).astype(np.float32)
    blocks = FrameBlocks(grid, 3, with_positions=True)
    before = blocks.capacity
    blocks.touch(scattered, VS)
    assert blocks.count > before and set(keys_of(blocks)) == reference.touch_points(
        in_voxels(scattered)
    )
    blocks.bin(scattered, [scattered], VS)
    assert blocks.counts.to_numpy().sum() == len(scattered)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 410.0, -410.0, 1e30])
def test_points_outside_the_index_range_are_refused_and_counted(grid, cloud, bad):
    points = cloud.points.copy()
    points[[3, 77], [0, 2]] = bad
    with pytest.raises(OutOfRange, match="2 of 1200 points lie more than 410 m"):
        FrameBlocks(grid, 3, with_positions=True).touch(points, VS)


def test_claim_gather_and_copy_equal_a_dict(cloud):
    """Slots are given once, in any order; export is sorted; growth keeps everything."""
    grid, kept, rng = VoxelGrid(rows=2, channels=3), {}, np.random.default_rng(4)
    for _ in range(3):
        # more than the first room in total
        keys = np.unique(rng.integers(-20, 20, (3000, 3)), axis=0).astype(np.int32)
        weights = rng.integers(0, 3, len(keys)).astype(np.float32)
        slots = np.empty(len(keys), np.int32)
        wanted = grid.claim(len(keys), keys, weights, slots)
        assert wanted == np.count_nonzero(weights) and ((slots >= 0) == (weights > 0)).all()
        for key, slot in zip(map(tuple, keys.tolist()), slots.tolist(), strict=True):
            if slot >= 0:
                assert kept.setdefault(key, slot) == slot
    assert grid.count == len(kept) > voxel_grid.FIRST_CAPACITY and sorted(kept.values()) == list(
        range(len(kept))
    )
    latents = rng.normal(size=(grid.capacity, 2, 3)).astype(np.float32)
    grid.latents.from_numpy(latents)
    grid.weights.from_numpy(latents[:, 0, 0].copy())
    grid.masks.from_numpy(rng.integers(0, 2**32, (grid.capacity, 2), dtype=np.uint32))
    masks = grid.masks.to_numpy()
    grid.reserve(grid.capacity)  # moves all to a larger pool
    data = grid.export()
    assert list(map(tuple, data.keys.tolist())) == sorted(kept)
    order = [kept[key] for key in sorted(kept)]
    for found, written in (
        (data.latents, latents),
        (data.weights, latents[:, 0, 0]),
        (data.masks, masks),
    ):
        np.testing.assert_array_equal(found, written[order])


def test_find_release_and_row_copies_equal_a_dict():
    """A voxel without weight is given up, the others stay; rows follow their slots into a larger
    pool and out of it.
    """
    grid, rng = VoxelGrid(rows=1, channels=1, evidence=True, sums=7), np.random.default_rng(5)
    keys = np.unique(rng.integers(-9, 9, (500, 3)), axis=0).astype(np.int32)
    ones, slots = np.ones(len(keys), np.float32), np.empty(len(keys), np.int32)
    grid.claim(len(keys), keys, ones, slots)
    weights = rng.integers(0, 2, grid.capacity).astype(np.float32)
    evidence = rng.integers(-127, 128, (grid.capacity, 64), dtype=np.int8)
    sums = rng.normal(size=(grid.capacity, 7)).astype(np.float32)
    for pool, values in ((grid.weights, weights), (grid.evidence, evidence), (grid.sums, sums)):
        pool.from_numpy(values)
    given = np.where(np.arange(len(keys)) % 3 == 0, -1, slots).astype(np.int32)  # -1: not asked for
    grid.release(len(keys), keys, given)
    gone = (given >= 0) & (weights[slots] == 0)
    assert 0 < gone.sum() == grid.empty and len(grid) == len(keys) - gone.sum()
    found, wanted = np.empty(len(keys), np.int32), (np.arange(len(keys)) % 2).astype(np.float32)
    absent = keys + np.int32(100)
    assert grid.find(len(keys), keys, wanted, found) == (~gone & (wanted > 0)).sum()
    np.testing.assert_array_equal(found, np.where(~gone & (wanted > 0), slots, -1))
    assert grid.find(len(keys), absent, ones, found) == 0 and (found == -1).all()
    weights[slots[(weights[slots] == 0) & ~gone]] = 1  # a map holds no voxel without weight
    grid.weights.from_numpy(weights)
    grid.reserve(grid.capacity)
    data = grid.export()
    assert list(map(tuple, data.keys.tolist())) == sorted(map(tuple, keys[~gone].tolist()))
    order = slots[~gone][np.lexsort(keys[~gone].T[::-1])]
    np.testing.assert_array_equal(data.evidence, evidence[order])
    np.testing.assert_array_equal(data.sums, sums[order])


def test_count_leaves_counts_4x4x4_groups_of_voxels():
    grid = VoxelGrid(rows=1, channels=1)
    assert kernels.count_leaves(grid.leaf_parent) == 0
    keys = np.array([[0, 0, 0], [3, 3, 3], [4, 0, 0], [-1, 0, 0], [8191, -8192, 8191]])
    FrameBlocks(grid, 1, with_positions=False).touch(((keys[:4] + 0.5) * VS).astype(np.float32), VS)
    assert kernels.count_leaves(grid.leaf_parent) == len(np.unique(keys[:4] // 4, axis=0)) == 3


def test_forty_maps_one_after_the_other_share_a_tree_that_starts_empty(cloud):
    gc.collect()
    grid = VoxelGrid(rows=1, channels=1)
    tree, trees = grid._tree, runtime.current().trees[0]
    for n in range(40):
        assert (
            grid._tree is tree and grid.count == 0 and kernels.count_leaves(grid.leaf_parent) == 0
        )
        blocks = FrameBlocks(grid, 1, with_positions=False)
        here = moved(cloud, (n * VS, 0, 0))
        blocks.touch(here.points, VS)
        assert set(keys_of(blocks)) == reference.touch_points(in_voxels(here.points))
        slots = np.empty(blocks.count, np.int32)
        assert (
            grid.claim(blocks.count, blocks.keys, np.ones(blocks.count, np.float32), slots)
            == blocks.count
            == grid.count
        )
        del blocks, grid
        grid = VoxelGrid(rows=1, channels=1)
    assert runtime.current().trees[0] == trees


def test_more_live_maps_than_taichi_bears_are_refused(monkeypatch):
    live = runtime.current()
    monkeypatch.setattr(runtime, "MAX_TREES", live.trees[0])
    free = [VoxelGrid(rows=1, channels=1) for _ in live.free_trees.copy()]
    with pytest.raises(CapacityError, match="maps live at once: .*save"):
        VoxelGrid(rows=1, channels=1)
    del free
    VoxelGrid(rows=1, channels=1)


def test_an_index_that_would_pass_safe_memory_is_refused(monkeypatch):
    grid = VoxelGrid(rows=1, channels=1)
    keys = (
        np.stack(np.meshgrid(*[np.arange(0, 60, 4)] * 3), axis=-1).reshape(-1, 3).astype(np.int32)
    )
    ones, slots = np.ones(len(keys), np.float32), np.empty(len(keys), np.int32)
    assert grid.claim(len(keys), keys, ones, slots) == len(keys)
    monkeypatch.setattr(voxel_grid, "SPARSE_LIMIT", voxel_grid.BYTES_PER_LEAF * (len(keys) - 1))
    monkeypatch.setattr(voxel_grid, "CHECK_EVERY", 0)
    with pytest.raises(CapacityError, match="3,375 voxels .* larger voxels or save"):
        grid.claim(len(keys), keys + 400, ones, slots)
    assert grid.count == len(keys)


def test_lone_points_that_make_no_voxel_also_count_against_safe_memory(monkeypatch):
    """Every touched voxel takes sparse memory, also where too few points fell to encode it."""
    grid = VoxelGrid(rows=1, channels=1)
    blocks, rng = FrameBlocks(grid, 1, with_positions=False), np.random.default_rng(8)
    monkeypatch.setattr(voxel_grid, "SPARSE_LIMIT", voxel_grid.BYTES_PER_LEAF * 5000)
    monkeypatch.setattr(voxel_grid, "CHECK_EVERY", 2000)
    with pytest.raises(CapacityError, match="larger voxels or save"):
        for _ in range(20):
            blocks.touch(rng.uniform(-200, 200, (1000, 3)).astype(np.float32), VS)
            grid.claim(
                blocks.count,
                blocks.keys,
                np.zeros(blocks.count, np.float32),
                np.empty(blocks.count, np.int32),
            )


def test_a_grid_of_another_runtime_is_refused(grid, cloud, monkeypatch):
    monkeypatch.setattr(runtime, "_runtime", runtime.Runtime("cpu", "another one"))
    with pytest.raises(RuntimeStateError, match="before Taichi was started again"):
        grid.export()
    with pytest.raises(RuntimeStateError, match="before Taichi was started again"):
        FrameBlocks(grid, 1, with_positions=False).touch(cloud.points, VS)
