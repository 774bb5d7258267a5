"""The kernels that keep windows, and those of exact sums, against their twins."""

from __future__ import annotations

import numpy as np
import pytest
import reference_keeping as twin
from scenes import rough

from taichi_unifusion.kernels import fusion, keeping
from taichi_unifusion.kernels.index import forget_blocks, touch_points
from taichi_unifusion.kernels.layout import Layout
from taichi_unifusion.maps.voxel_data import MASKS, WEIGHTS, latents
from taichi_unifusion.maps.voxel_grid import VoxelGrid

MEAN = 1e-6  # float32 of values about 1
VS = 0.05


@pytest.fixture(scope="module")
def grid() -> VoxelGrid:
    return VoxelGrid([latents(2, 3), WEIGHTS, MASKS])


@pytest.fixture(scope="module")
def sums() -> np.ndarray:
    """Sums of two values in some cells of 40 blocks."""
    rng = np.random.default_rng(0)
    counts = rng.integers(1, 900, (40, 64, 1)) * (rng.uniform(size=(40, 64, 1)) < 0.3)
    values = np.rint(rng.uniform(-1, 1, (40, 64, 2)) * counts * twin.FIXED)
    return np.concatenate([counts, values], axis=2).astype(np.int64)


def test_cells_are_counted_gathered_and_put_back(grid, sums):
    occupied = np.empty(40, np.int32)
    keeping.count_cells(40, sums, occupied)
    np.testing.assert_array_equal(occupied, twin.count_cells(sums))
    starts = (np.cumsum(occupied) - occupied).astype(np.int32)
    total = int(occupied.sum())
    places, counts = np.empty(total, np.int32), np.empty(total, np.int32)
    means = np.empty((total, 2), np.float32)
    keeping.gather_cells(40, starts, sums, places, counts, means)
    for found, wanted in zip((places, counts, means), twin.gather_cells(sums), strict=True):
        np.testing.assert_allclose(found, wanted, atol=MEAN)
    blocks, rows = np.repeat(np.arange(40, dtype=np.int32), occupied), np.ones((total, 3), np.int64)
    wanted = twin.scatter_cells(sums, blocks, places, rows)
    keeping.scatter_cells(blocks, places, rows, after := sums.copy())
    np.testing.assert_array_equal(after, wanted)


def test_points_mark_their_voxels(grid):
    points = rough(0, 500).points
    bits = np.random.default_rng(1).integers(1, 1 << 10, 500).astype(np.int32)
    keys, counters = np.zeros((4000, 5), np.int32), np.zeros(2, np.int32)
    keys[:, 3] = 1 << 20  # of another time
    runs, ones = np.full(500, 1, np.int32), np.ones(500, np.int32)
    touch_points(
        runs, 1, points, ones, 1 / VS, grid.next_frame(), False, grid.index, counters, keys
    )
    keeping.mark_points(int(counters[0]), points, bits, 1 / VS, grid.index, keys)
    found = keys[: counters[0]]
    scaled = (points * np.float32(1 / VS)).astype(float)
    np.testing.assert_array_equal(found[:, 3], twin.mark_points(found[:, :3], scaled, bits, 1.0))
    forget_blocks(0, int(counters[0]), keys, grid.index)


def test_depth_is_shrunk(grid):
    images = np.random.default_rng(2).uniform(-1, 8, (3, 7, 9)).astype(np.float32)
    images[0, 0, 0], images[1, 2, 2], images[2, 4, 4] = 1e-5, 70.0, 0.0
    small = np.zeros((2, 4, 5), np.uint16)
    keeping.shrink_depth(images, 2, 1000.0, small)
    wanted = twin.shrink_depth(images, 2, 1000.0)[:2]
    assert (np.abs(small.astype(int) - wanted) <= (wanted % 1 == 0)).all()  # at halves
    np.testing.assert_array_equal(small == 0, wanted == 0)
    assert small[0, 0, 0] == 1 and small[1, 1, 1] == 65535


def test_rows_are_rounded(grid):
    rows = np.random.default_rng(3).uniform(-3, 3, (5, 4, 2)).astype(np.float32)
    weights = np.array([3, 4.999999, 1.000001, 7, 8.5], np.float32)
    wanted, whole = twin.round_rows(rows, weights, 2.0**10)
    keeping.round_rows(4, 2.0**10, rows, weights)
    np.testing.assert_array_equal(weights[:4], whole[:4])
    np.testing.assert_array_equal(rows[:4], wanted[:4])
    assert (rows[4] != wanted[4]).any()


def test_local_lims_are_summed_exactly_and_taken_out_again(grid):
    """Three local LIMs in one slot; one of them is taken out, then all."""
    rng, layout = np.random.default_rng(4), Layout(3, 2, True)
    parts = [
        (np.rint(rng.uniform(-2, 2, (4, 2)) * 2**20) / 2**20, float(rng.integers(1, 99)))
        for _ in range(3)
    ]
    supports = rng.uniform(size=(3, 64)) < 0.4
    totals, F = np.zeros((2, 9)), np.zeros((2, 4, 2), np.float32)
    w, counts = np.zeros(2, np.float32), np.zeros((2, 64), np.uint16)
    masks, slots = np.zeros((2, 2), np.uint32), np.array([1], np.int32)
    done: list[int] = []
    for k, sign in ((0, 1), (1, 1), (2, 1), (1, -1), (0, -1), (2, -1)):
        latent = np.zeros((1, 4, 3), np.float32)
        latent[0, :, 1:] = parts[k][0]  # the map's columns begin at 1
        weight = np.array([parts[k][1]], np.float32)
        words = np.packbits(supports[k]).view(">u4").astype(np.uint32)[None]
        fusion.fuse_exactly(layout, 1, 1, slots, latent, weight, sign, totals, F, w)
        fusion.count_support(1, slots, words, sign, counts, masks)
        done = [*done, k] if sign > 0 else [n for n in done if n != k]
        wanted, total = twin.fuse_exactly(
            [parts[n] for n in done] or [parts[0]], [1] * len(done) or [0]
        )
        assert w[1] == total
        np.testing.assert_array_equal(F[1], wanted.astype(np.float32))
        found = np.unpackbits(masks[1].astype(">u4").view(np.uint8)).astype(bool)
        seen = twin.count_support(
            [supports[n] for n in done] or [supports[0]], [1] * len(done) or [0]
        )
        np.testing.assert_array_equal(found, seen)
    assert not totals.any() and not w[0]
