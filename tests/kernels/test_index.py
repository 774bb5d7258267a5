"""Voxel index and pools: slots, growth, what is given up, and the reuse of trees."""

from __future__ import annotations

import gc

import numpy as np
import pytest
import reference
from places import DEVICE
from scenes import moved, rough

from taichi_unifusion import runtime
from taichi_unifusion.errors import CapacityError, RuntimeStateError
from taichi_unifusion.kernels import index as kernels
from taichi_unifusion.maps import voxel_grid
from taichi_unifusion.maps.binner import Binner, patches_of
from taichi_unifusion.maps.voxel_data import EVIDENCE, MASKS, WEIGHTS, VoxelField, latents
from taichi_unifusion.maps.voxel_grid import VoxelGrid

VS = 0.05


@pytest.fixture(scope="module")
def cloud():
    return rough(0, 1200)


def a_grid(*fields: VoxelField) -> VoxelGrid:
    return VoxelGrid([WEIGHTS, MASKS, *(fields or (latents(1, 1),))])


def in_voxels(points) -> np.ndarray:
    """Positions [voxels] as the kernels compute them, so that no point changes its cell."""
    return (points * np.float32(1 / VS)).astype(float)


def touch(grid: VoxelGrid, points) -> np.ndarray:
    """Voxels (B, 3) that points touch in a new frame."""
    keys, counters = np.zeros((4000, 3), np.int32), np.zeros(2, np.int32)
    found, counts = np.ones(len(points), np.int32), np.ones(len(points), np.int32)
    stamp = grid.next_frame()
    kernels.touch_points(found, 1, points, counts, 1 / VS, stamp, False, grid.index, counters, keys)
    return keys[: counters[0]].copy()


def test_claim_gather_and_copy_equal_a_dict(cloud, monkeypatch):
    """Slots are given once, in any order; export is sorted; growth keeps everything."""
    monkeypatch.setattr(voxel_grid, "FIRST_CAPACITY", 4096)
    grid, kept, rng = a_grid(latents(2, 3)), {}, np.random.default_rng(4)
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
    values = rng.normal(size=(grid.capacity, 2, 3)).astype(np.float32)
    grid["latents"].from_numpy(values)
    grid["weights"].from_numpy(values[:, 0, 0].copy())
    grid["masks"].from_numpy(rng.integers(0, 2**32, (grid.capacity, 2), dtype=np.uint32))
    masks = grid["masks"].to_numpy()
    grid.reserve(grid.capacity)  # moves all to a larger pool
    data = grid.export()
    assert list(map(tuple, data.keys.tolist())) == sorted(kept)
    order = [kept[key] for key in sorted(kept)]
    for found, written in (
        (data.latents, values),
        (data.weights, values[:, 0, 0]),
        (data.masks, masks),
    ):
        np.testing.assert_array_equal(found, written[order])


def test_find_release_and_row_copies_equal_a_dict():
    """A voxel without weight is given up, the others stay; rows follow their slots into a larger
    pool and out of it.
    """
    grid, rng = (
        a_grid(latents(1, 1), EVIDENCE, VoxelField("sums", np.dtype(np.float32), (7,))),
        np.random.default_rng(5),
    )
    keys = np.unique(rng.integers(-9, 9, (500, 3)), axis=0).astype(np.int32)
    ones, slots = np.ones(len(keys), np.float32), np.empty(len(keys), np.int32)
    grid.claim(len(keys), keys, ones, slots)
    weights = rng.integers(0, 2, grid.capacity).astype(np.float32)
    evidence = rng.integers(-127, 128, (grid.capacity, 64), dtype=np.int8)
    sums = rng.normal(size=(grid.capacity, 7)).astype(np.float32)
    for pool, values in (
        (grid["weights"], weights),
        (grid["evidence"], evidence),
        (grid["sums"], sums),
    ):
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
    grid["weights"].from_numpy(weights)
    grid.reserve(grid.capacity)
    data = grid.export()
    assert list(map(tuple, data.keys.tolist())) == sorted(map(tuple, keys[~gone].tolist()))
    order = slots[~gone][np.lexsort(keys[~gone].T[::-1])]
    np.testing.assert_array_equal(data.evidence, evidence[order])
    np.testing.assert_array_equal(data.sums, sums[order])


@pytest.mark.parametrize("crowded", [False, True])
def test_voxels_that_are_kept_follow_each_other_and_others_are_gone(monkeypatch, crowded):
    """Whether the index is emptied, or only the others are taken out of it; both can come again."""
    gc.collect()
    monkeypatch.setattr(voxel_grid, "CROWDED", 0 if crowded else 1 << 40)
    grid, rng = a_grid(), np.random.default_rng(8)
    keys = np.unique(rng.integers(-9, 9, (500, 3)), axis=0).astype(np.int32)
    ones, slots = np.ones(len(keys), np.float32), np.empty(len(keys), np.int32)
    grid.claim(len(keys), keys, ones, slots)
    grid["weights"].from_numpy(np.arange(1, grid.capacity + 1, dtype=np.float32))
    kept = np.sort(rng.permutation(len(keys))[:200]).astype(np.int32)
    at = np.argsort(slots)[kept]  # the keys of these slots
    grid.retain(kept)
    wanted = np.full(len(keys), -1)
    wanted[at] = np.arange(200)
    np.testing.assert_array_equal(grid.slots_of(keys), wanted)
    np.testing.assert_array_equal(grid["weights"].to_numpy()[:200], kept + 1.0)
    assert len(grid) == 200 and not grid["weights"].to_numpy()[200 : len(keys)].any()
    points = ((keys + 0.5) * VS).astype(np.float32)
    assert len(touch(grid, points)) == len(keys)
    assert grid.claim(len(keys), keys, ones, slots) == grid.count == len(keys)


def test_clear_index_leaves_no_voxel(cloud):
    """Neither with a slot nor touched, whatever the stamp, and the leaves are there."""
    gc.collect()
    grid = a_grid()
    keys = touch(grid, cloud.points)
    kernels.assign_slots(keys, 0, grid.index)
    leaves, frame = kernels.count_leaves(grid.index), grid.frame
    kernels.clear_index(grid.index)
    assert (grid.slots_of(keys) == -1).all() and kernels.count_leaves(grid.index) == leaves > 0
    grid.frame = frame - 1  # the same stamp again
    assert set(map(tuple, touch(grid, cloud.points).tolist())) == set(map(tuple, keys.tolist()))


def test_remove_slots_equals_a_dict():
    grid, kept = a_grid(), {}
    keys = np.array([[0, 0, 0], [3, -3, 3], [4, 0, 0], [-1, 0, 8]], np.int32)
    for slot, key in enumerate(keys.tolist()):
        kept[tuple(key)] = slot
    kernels.assign_slots(keys, 0, grid.index)
    kernels.remove_slots(keys[1:3], grid.index)
    for key in keys[1:3].tolist():
        del kept[tuple(key)]
    assert grid.slots_of(keys).tolist() == [kept.get(tuple(key), -1) for key in keys.tolist()]


def test_count_leaves_counts_4x4x4_groups_of_voxels(monkeypatch):
    gc.collect()
    monkeypatch.setattr(voxel_grid, "CROWDED", 0)  # a tree that was used before gives nodes back
    grid = a_grid()
    before = grid.index.leaves  # those of maps before are used again
    assert kernels.count_leaves(grid.index) == 0
    keys = np.array([[0, 0, 0], [3, 3, 3], [4, 0, 0], [-1, 0, 0], [8191, -8192, 8191]])
    touch(grid, ((keys[:4] + 0.5) * VS).astype(np.float32))
    assert kernels.count_leaves(grid.index) == len(np.unique(keys[:4] // 4, axis=0)) == 3
    assert grid.index.leaves == max(before, 3)


def test_forty_maps_one_after_the_other_share_a_tree_that_starts_empty(cloud):
    gc.collect()
    grid = a_grid()
    tree, trees = grid.index, runtime.current().trees
    for n in range(40):
        assert grid.index is tree and grid.count == 0 == grid.memory_bytes
        here = moved(cloud, (n * VS, 0, 0))
        keys = touch(grid, here.points)
        assert set(map(tuple, keys.tolist())) == reference.touch_points(in_voxels(here.points))
        slots, ones = np.empty(len(keys), np.int32), np.ones(len(keys), np.float32)
        assert grid.claim(len(keys), keys, ones, slots) == len(keys) == grid.count
        grid = None  # gives its tree back before the next one asks
        grid = a_grid()
    assert runtime.current().trees == trees


def test_more_live_maps_than_taichi_bears_are_refused(monkeypatch):
    gc.collect()
    live = runtime.current()
    free = [a_grid() for _ in range(max(len(live.free_trees), 1))]
    monkeypatch.setattr(runtime, "MAX_TREES", live.trees)
    with pytest.raises(CapacityError, match="maps live at once: .*save"):
        a_grid()
    del free
    a_grid()


def test_a_map_that_only_a_cycle_holds_makes_room(monkeypatch):
    gc.collect()
    live = runtime.current()
    held = [a_grid() for _ in range(max(len(live.free_trees), voxel_grid.MAPS_OF_A_RUN))]
    monkeypatch.setattr(runtime, "MAX_TREES", live.trees)
    held[0].itself = held[0]  # as the traceback of an error holds what its frames name
    del held[0]
    a_grid()


def test_an_index_that_would_pass_safe_memory_is_refused(monkeypatch):
    grid = a_grid()
    keys = (
        np.stack(np.meshgrid(*[np.arange(0, 60, 4)] * 3), axis=-1).reshape(-1, 3).astype(np.int32)
    )
    ones, slots = np.ones(len(keys), np.float32), np.empty(len(keys), np.int32)
    assert grid.claim(len(keys), keys, ones, slots) == len(keys)
    leaves = grid.index.leaves  # that a map before took are used again
    monkeypatch.setattr(voxel_grid, "SPARSE_LIMIT", voxel_grid.BYTES_PER_LEAF * (leaves - 1))
    with pytest.raises(CapacityError, match="3,375 voxels .* larger voxels or save"):
        grid.claim(len(keys), keys + 400, ones, slots)
    assert grid.count == len(keys)


@pytest.mark.skipif(DEVICE != "cpu", reason="the CPU's pool; that of a GPU has a test of its own")
def test_c1_the_indices_of_all_maps_count_together(monkeypatch):
    """Each map alone is within its limit; what is touched again and again counts once."""
    gc.collect()
    grids, rng = [a_grid() for _ in range(3)], np.random.default_rng(8)
    live = runtime.current()
    before = live.trees * voxel_grid.BYTES_PER_TREE
    before += sum(live.leaves.values()) * voxel_grid.BYTES_PER_LEAF
    points = [rng.uniform(-200, 200, (1000, 3)).astype(np.float32) for _ in range(60)]

    def integrate(grid, part):
        keys = touch(grid, part)
        ones, slots = np.ones(len(keys), np.float32), np.empty(len(keys), np.int32)
        grid.claim(len(keys), keys, ones, slots)

    monkeypatch.setattr(voxel_grid, "SPARSE_POOL", before + 9000 * voxel_grid.BYTES_PER_LEAF)
    for _ in range(20):
        for grid in grids:
            integrate(grid, points[0])
    with pytest.raises(CapacityError, match="all maps of this process, .* new process"):
        for part in points:
            for grid in grids:
                integrate(grid, part)
    assert min(map(len, grids)) > 1000


def test_what_a_map_that_is_gone_touched_again_and_again_counts_once():
    """Its tree keeps the memory of the leaves that there were, not of all that was noted."""
    gc.collect()
    live = runtime.current()
    others = [a_grid() for _ in live.free_trees]  # so that its tree is the only free one
    grid = a_grid()
    index = grid.index
    points = np.random.default_rng(5).uniform(-200, 200, (1000, 3)).astype(np.float32)
    for _ in range(9):
        keys = touch(grid, points)
        grid.claim(len(keys), keys, np.ones(len(keys), np.float32), np.empty(len(keys), np.int32))
    counted = kernels.count_leaves(index)
    assert index.leaves == counted  # of a new tree, which never gave any back
    assert live.leaves[index] >= 8 * len(keys) + counted > counted
    del grid
    again = a_grid()
    assert again.index is index and live.leaves[index] == counted
    assert all(other.index is not index for other in others)


@pytest.fixture
def like_cuda(monkeypatch):
    """The live runtime as on a GPU: a pool of fixed size, and nodes that are never given back."""
    gc.collect()
    live = runtime.current()
    monkeypatch.setattr(live, "device", "cuda")
    monkeypatch.setattr(live, "sparse_pool", 1 << 40)
    return live


def test_the_pool_of_a_gpu_is_not_run_over(like_cuda, monkeypatch):
    """It is counted by whole chunks, and keeps room for what a frame adds before it is counted."""
    monkeypatch.setattr(like_cuda, "leaves", {})
    grid, rng = a_grid(), np.random.default_rng(21)  # other places than those of tests before
    grid.recount()  # a tree that was used before keeps its nodes
    monkeypatch.setattr(voxel_grid, "NODES_PER_CHUNK", 1000)
    chunks = sum(n // 1000 for n in like_cuda.leaves.values()) + 3
    pool = like_cuda.trees * voxel_grid.CUDA_TREE + chunks * voxel_grid.CUDA_CHUNK
    monkeypatch.setattr(like_cuda, "sparse_pool", pool + voxel_grid.CUDA_RESERVE)

    def integrate(grid):
        keys = touch(grid, rng.uniform(-200, 200, (500, 3)).astype(np.float32))
        ones, slots = np.ones(len(keys), np.float32), np.empty(len(keys), np.int32)
        grid.claim(len(keys), keys, ones, slots)

    with pytest.raises(CapacityError, match="larger device_memory_gb for uf.init"):
        for _ in range(9):
            integrate(grid)
    assert 2000 <= len(grid) <= 4000


def test_a_map_whose_index_does_not_fit_the_pool_of_a_gpu_is_refused(like_cuda, monkeypatch):
    free = [a_grid() for _ in range(max(len(like_cuda.free_trees), 1))]
    trees = like_cuda.trees
    monkeypatch.setattr(runtime, "MAX_TREES", trees + 1)
    monkeypatch.setattr(like_cuda, "sparse_pool", voxel_grid.CUDA_RESERVE)
    with pytest.raises(CapacityError, match="index of another map would not fit"):
        a_grid()
    assert like_cuda.trees == trees and free


def test_a_tree_is_used_again_on_a_gpu_without_giving_nodes_back(like_cuda, cloud):
    """Voxels, numbers and stamps of the map before are gone; its nodes stay."""
    gc.collect()
    grid = a_grid()
    for _ in range(3):  # frame stamps that a new map gives again
        keys = touch(grid, cloud.points)
    slots, ones = np.empty(len(keys), np.int32), np.ones(len(keys), np.float32)
    grid.claim(len(keys), keys, ones, slots)
    index, leaves = grid.index, kernels.count_leaves(grid.index)
    del grid
    again = a_grid()
    assert again.index is index and kernels.count_leaves(index) == leaves
    assert again.find(len(keys), keys, ones, slots) == 0
    near = rough(1, 500).points
    assert set(map(tuple, touch(again, near).tolist())) == reference.touch_points(in_voxels(near))


def test_lone_points_that_make_no_voxel_also_count_against_safe_memory(monkeypatch):
    """Every touched voxel takes sparse memory, also where too few points fell to encode it."""
    grid = a_grid()
    rng = np.random.default_rng(8)
    leaves = grid.index.leaves + 5000
    monkeypatch.setattr(voxel_grid, "SPARSE_LIMIT", voxel_grid.BYTES_PER_LEAF * leaves)
    with pytest.raises(CapacityError, match="larger voxels or save"):
        for _ in range(20):
            keys = touch(grid, rng.uniform(-200, 200, (1000, 3)).astype(np.float32))
            grid.claim(
                len(keys), keys, np.zeros(len(keys), np.float32), np.empty(len(keys), np.int32)
            )


def test_a_grid_of_another_runtime_is_refused(cloud, monkeypatch):
    grid = a_grid()
    monkeypatch.setattr(runtime, "_runtime", runtime.Runtime("cpu", "another one"))
    with pytest.raises(RuntimeStateError, match="before Taichi was started again"):
        grid.export()
    with pytest.raises(RuntimeStateError, match="before Taichi was started again"):
        patches = patches_of(cloud, "cpu")
        Binner(grid, VS, 1).bin(patches, [patches.attributes["one"]])
