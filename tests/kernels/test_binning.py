"""Binning of a frame, and of several: the kernels against their twins, and the index range."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import pytest
import reference
from scenes import cloud_of, moved, rough, taken

from taichi_unifusion import PointCloud
from taichi_unifusion.errors import OutOfRange
from taichi_unifusion.kernels import binning
from taichi_unifusion.kernels.index import block_of_points, forget_blocks, touch_points
from taichi_unifusion.kernels.patches import Patches, Values
from taichi_unifusion.kernels.regression import find_neighbors
from taichi_unifusion.maps.binner import FIRST_BLOCKS, Binner, SurfelBinner, patches_of
from taichi_unifusion.maps.voxel_data import MASKS, WEIGHTS, latents
from taichi_unifusion.maps.voxel_grid import VoxelGrid

VS = 0.05
FIXED = 1e-6  # 24 fractional bits, rounded once a run of points, and float32 sums within a run
POSITION = 5e-6  # [voxels] float32 positions some voxels from the origin
OFFSETS = np.array([-0.1, 0.0, 0.2], np.float32)  # not symmetric, so that a wrong sign shows
ROOM, SLOTS = 4000, 32


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


def in_runs(cloud: PointCloud, slots: int = SLOTS):
    """`found` (R,), points, counts and normals in runs of `slots` places: as many in each as it
    happens, and rubbish in the places behind them.
    """
    rng, n = np.random.default_rng(9), 0
    found = []
    while n < len(cloud):
        found.append(min(int(rng.integers(0, slots + 1)), len(cloud) - n))
        n += found[-1]
    filled = (np.arange(slots) < np.array(found)[:, None]).ravel()
    points, normals = np.full((2, len(filled), 3), np.nan, np.float32)
    counts = np.full(len(filled), 77, np.int32)
    points[filled], normals[filled], counts[filled] = cloud.points, cloud.normals, counts_of(cloud)
    return np.array(found, np.int32), points, counts, normals


def counts_of(cloud: PointCloud) -> np.ndarray:
    return np.ones(len(cloud), np.int32) if cloud.counts is None else cloud.counts


@dataclass
class Blocks:
    """The voxels that clouds touch, and sums in their cells, through the kernels alone."""

    grid: VoxelGrid
    stamp: int
    keys: np.ndarray  # (ROOM, 5)
    counters: np.ndarray

    @property
    def count(self) -> int:
        return int(self.counters[0])

    @property
    def voxels(self) -> list[tuple]:
        """Voxel of each block."""
        return list(map(tuple, self.keys[: self.count, :3].tolist()))

    def touch(self, cloud: PointCloud) -> None:
        found, points, counts, _ = in_runs(cloud)
        touch_points(
            found, SLOTS, points, counts, 1 / VS, self.stamp, False, self.grid.index, self.counters,
            self.keys,
        )  # fmt: skip

    @property
    def point_frames(self) -> list[int]:
        """Bits of the frames that have points in each block."""
        return self.keys[: self.count, binning.POINT_FRAMES].tolist()

    @property
    def sample_frames(self) -> list[int]:
        return self.keys[: self.count, binning.SAMPLE_FRAMES].tolist()

    def bin(
        self, *clouds: PointCloud, with_positions: bool = True, scale: float = 1.0
    ) -> np.ndarray:
        """Sums (ROOM, 64, 1 + 3 [+ 3]), counts first, of clouds one after the other."""
        sums = np.zeros((ROOM, 64, 7 if with_positions else 4), np.int64)
        for n, cloud in enumerate(clouds):
            found, points, counts, normals = in_runs(cloud)
            nothing, channels, index = [points] * 2, (3, 0, 0), self.grid.index
            scales = binning.Scales([1 / VS, scale, 1.0, 1.0])
            binning.bin_points(
                found, SLOTS, points, counts, normals, *nothing, channels, scales,
                int(np.int32(np.uint32(1 << n))), with_positions, index, self.keys, sums,
            )  # fmt: skip
        return sums


def touch(grid: VoxelGrid, *clouds: PointCloud) -> Blocks:
    blocks = Blocks(grid, grid.next_frame(), np.zeros((ROOM, 5), np.int32), np.zeros(2, np.int32))
    for cloud in clouds:
        blocks.touch(cloud)
    return blocks


def by_cell(voxels: list[tuple], sums) -> dict:
    """Lattice cell -> (count, mean sums)."""
    counts, sums = sums[: len(voxels), :, 0], sums[..., 1:] / binning.FIXED
    occupied = np.argwhere(counts)
    lattice = 4 * np.array(voxels)[occupied[:, 0]] + np.stack(
        np.unravel_index(occupied[:, 1], (4, 4, 4)), axis=1
    )
    return {
        tuple(at): (counts[b, cell], sums[b, cell] / counts[b, cell])
        for at, (b, cell) in zip(lattice.tolist(), occupied, strict=True)
    }


def bits_of(frames: set[int]) -> int:
    return sum(1 << n for n in frames)


def side_by_side(*clouds: PointCloud):
    """Positions [voxels], normals, counts and frame numbers of the points of several clouds."""
    return (
        in_voxels(np.vstack([cloud.points for cloud in clouds])),
        np.vstack([cloud.normals for cloud in clouds]).astype(float),
        np.concatenate([counts_of(cloud) for cloud in clouds]),
        np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds]),
    )


def test_touch_points_equals_its_twin(grid, cloud):
    """Points that stand for no pixel touch nothing; what a frame before touched keeps its number."""
    for part in (cloud, taken(cloud, slice(5))):  # a second stamp gives numbers anew
        blocks = touch(grid, part)
        voxels = blocks.voxels
        assert len(set(voxels)) == len(voxels) and blocks.counters[1] == 0
        assert set(voxels) == reference.touch_points(in_voxels(part.points))
    assert min(min(key) for key in voxels) < 0
    some = replace(cloud, counts=np.arange(len(cloud), dtype=np.int32) % 3)
    blocks = touch(grid, some)
    first = blocks.voxels
    assert set(first) == reference.touch_points(in_voxels(cloud.points[some.counts > 0]))
    blocks.touch(moved(cloud, (0.1, 0, 0)))
    assert blocks.voxels[: len(first)] == first and blocks.count > len(first)


def test_points_outside_are_counted_unless_they_stand_for_no_pixel(grid, cloud):
    cloud = replace(cloud, points=cloud.points.copy(), counts=counts_of(cloud))
    cloud.points[:3], cloud.counts[2] = np.nan, 0
    assert touch(grid, cloud).counters[1] == 2


def test_what_was_touched_in_vain_is_forgotten(grid, cloud):
    """Then it is touched anew under the same stamp, with the numbers that follow."""
    some, more = taken(cloud, slice(600)), moved(cloud, (0.3, 0.1, 0))
    blocks = touch(grid, some, more)
    known, all_of_them = touch(grid, some).count, blocks.voxels
    blocks = touch(grid, some, more)
    forget_blocks(known, blocks.count, blocks.keys, grid.index)
    found = np.empty((known, 27), np.int32)
    find_neighbors(grid.index, blocks.stamp, known, blocks.keys, found)
    np.testing.assert_array_equal(found, reference.find_neighbors(blocks.voxels[:known]))
    blocks.counters[0] = known
    blocks.touch(more)
    assert set(blocks.voxels) == set(all_of_them) and len(all_of_them) == blocks.count > known


def test_find_neighbors_equals_its_twin(grid, cloud):
    touch(grid, cloud)
    blocks = touch(grid, taken(cloud, slice(400)))  # those of the stamp before do not count
    found = np.empty((blocks.count, 27), np.int32)
    find_neighbors(grid.index, blocks.stamp, blocks.count, blocks.keys, found)
    twin = reference.find_neighbors(blocks.voxels)
    np.testing.assert_array_equal(found, twin)
    assert 0.2 < (twin >= 0).mean() < 0.8 and (twin[:, 13] == np.arange(blocks.count)).all()


def test_block_of_points_equals_its_twin(grid, cloud):
    blocks = touch(grid, cloud)
    found = np.empty(len(cloud), np.int32)
    block_of_points(cloud.points, 1 / VS, grid.index, found)
    np.testing.assert_array_equal(
        np.array(blocks.voxels)[found], reference.block_of_points(in_voxels(cloud.points))
    )


def test_bin_points_equals_its_twin(grid, cloud):
    """Two frames, whose points stand for 0 to 4 pixels."""
    clouds = [
        replace(each, counts=np.random.default_rng(n).integers(0, 5, len(each), dtype=np.int32))
        for n, each in enumerate((cloud, moved(taken(cloud, slice(500)), (0.07, 0, 0))))
    ]
    blocks = touch(grid, *clouds)
    sums = blocks.bin(*clouds)
    x, normals, counts, frame_of = side_by_side(*clouds)
    binned, twin = by_cell(blocks.voxels, sums), reference.bin_points(x, normals, counts)
    assert binned.keys() == twin.keys() and max(count for count, _, _ in twin.values()) > 9
    for cell, (count, normal, position) in twin.items():
        assert binned[cell][0] == count
        np.testing.assert_allclose(binned[cell][1][:3], normal, atol=FIXED)
        np.testing.assert_allclose(
            binned[cell][1][3:], position - (np.array(cell) + 0.5) / 4, atol=POSITION
        )
    seen = reference.frames_in(x[counts > 0], frame_of[counts > 0])
    wanted = [bits_of(seen[key]) for key in blocks.voxels]
    assert blocks.point_frames == wanted and set(wanted) == {1, 2, 3}


def test_the_order_of_points_does_not_change_the_sums(grid, cloud):
    order, sums = np.random.default_rng(1).permutation(len(cloud)), []
    for rows in (slice(None), order):
        blocks = touch(grid, taken(cloud, rows))
        sums.append(by_cell(blocks.voxels, blocks.bin(taken(cloud, rows))))
    assert sums[0].keys() == sums[1].keys()
    for cell, (count, mean) in sums[0].items():
        assert count == sums[1][cell][0]
        np.testing.assert_allclose(mean, sums[1][cell][1], atol=FIXED)


def surfel_samples(grid: VoxelGrid, *clouds: PointCloud):
    """Blocks of the points and of their samples, the surfels' sums, and those of the samples."""
    blocks = touch(grid, *clouds)
    sums = blocks.bin(*clouds)
    with_points = blocks.count
    binning.touch_surfel_samples(
        with_points, sums, OFFSETS, blocks.stamp, grid.index, blocks.keys, blocks.counters
    )
    samples = np.zeros((ROOM, 64, 5), np.int64)
    binning.bin_surfel_samples(with_points, OFFSETS, True, grid.index, blocks.keys, sums, samples)
    return with_points, blocks, sums, samples


def test_surfel_kernels_equal_their_twins(grid, cloud):
    clouds = cloud, moved(taken(cloud, slice(300)), (0.07, 0, 0))
    with_points, blocks, surfels, samples = surfel_samples(grid, *clouds)
    x, normals, counts, frame_of = side_by_side(*clouds)
    offsets, voxels = OFFSETS.astype(float), blocks.voxels
    assert len(set(voxels)) == len(voxels)
    assert set(voxels) == reference.touch_surfel_samples(x, normals, offsets)
    assert len(voxels) > with_points  # samples reach voxels without points
    binned = by_cell(voxels, samples)
    twin = reference.bin_surfel_samples(x, normals, offsets, counts)
    assert binned.keys() == twin.keys()
    for cell, (count, distance, normal) in twin.items():
        assert binned[cell][0] == count
        np.testing.assert_allclose(binned[cell][1], [*distance, *normal], atol=POSITION)
    assert not surfels.any()  # read last, left zero
    seen = reference.surfel_sample_frames(x, normals, offsets, frame_of)
    wanted = [bits_of(seen.get(key, set())) for key in voxels]
    assert blocks.sample_frames == wanted and {1, 2, 3} <= set(wanted)


def test_normals_that_cancel_give_no_samples(grid):
    cloud = cloud_of(np.full((2, 3), 0.006), [[0, 0, 1], [0, 0, -1]])
    _, blocks, surfels, samples = surfel_samples(grid, cloud)
    assert not samples.any() and not surfels.any() and blocks.sample_frames == [0]


@pytest.mark.parametrize("exponent", [0, -7, 30])
def test_mark_and_compact_cells_equal_their_twins(grid, cloud, exponent):
    clouds = cloud, moved(taken(cloud, slice(300)), (0.07, 0, 0))
    blocks = touch(grid, *clouds)
    unit = 2.0**exponent  # values are unit times the clouds' normals
    clouds = [copy(each) for each in clouds]
    for each in clouds:  # as values of any size, which a cloud takes as attributes only
        object.__setattr__(each, "normals", each.normals * np.float32(unit))
    sums = blocks.bin(*clouds, with_positions=False, scale=1 / unit)
    n, voxels = blocks.count, blocks.voxels
    blocks.keys[:, binning.SAMPLE_FRAMES] = np.arange(ROOM)
    bits = blocks.keys.copy()
    counts = sums[:n, :, 0].copy()
    averages = reference.compact_cells(counts, sums[:n, :, 1:] / binning.FIXED)
    lattice = {cell: value[0] for cell, value in by_cell(voxels, sums).items()}
    for minimum, column in ((1, binning.POINT_FRAMES), (3, binning.SAMPLE_FRAMES)):
        masks, support = np.zeros((n, 2), np.uint32), np.zeros((n, 2), np.uint32)
        rows, keys = np.zeros((n, 3), np.int32), bits.copy()
        binning.mark_cells(n, sums, minimum, column, keys, masks, support, rows)
        for found, least in ((masks, 1), (support, minimum)):
            twin = reference.mark_cells(lattice, least)
            np.testing.assert_array_equal(
                reference.unpack_masks(found), [twin[key] for key in voxels]
            )
        np.testing.assert_array_equal(rows[:, 0], (counts > 0).sum(axis=1))
        np.testing.assert_array_equal(rows[:, 1], counts.sum(axis=1))
        np.testing.assert_array_equal(rows[:, 2], bits[:n, column])
        assert not keys[:n, 3:].any() and len(np.unique(rows[:, 2])) >= 3
        np.testing.assert_array_equal(keys[:, :3], bits[:, :3])
    rows[:, 0] = np.cumsum(rows[:, 0]) - rows[:, 0]
    cells = np.zeros((len(averages), 4), np.float32)
    binning.compact_cells(n, rows, masks, 3, np.full(3, unit, np.float32), sums, cells)
    cells[:, 1:] /= unit
    np.testing.assert_allclose(cells, averages, rtol=FIXED, atol=FIXED)
    assert not sums.any()


def test_more_than_31_frames_have_bits_of_their_own(grid, cloud):
    """A window holds 32 frames at most; bit 31 is the sign of a whole number."""
    few = taken(cloud, slice(40))
    blocks = touch(grid, few)
    sums, n = blocks.bin(*[few] * 32), blocks.count
    assert blocks.point_frames == [-1] * n
    masks, support, rows = *np.zeros((2, n, 2), np.uint32), np.zeros((n, 3), np.int32)
    binning.mark_cells(n, sums, 1, binning.POINT_FRAMES, blocks.keys, masks, support, rows)
    assert (rows[:, 2] == -1).all()


def carrying(points, values) -> tuple[Patches, list[Values]]:
    """What `Binner.bin` takes: patches of a pixel each, and three values beside every point."""
    patches = patches_of(PointCloud(points), "cpu")
    return patches, [Values(values, patches.counts)]


def test_a_frame_of_more_voxels_than_expected_is_given_room(grid):
    """Also where only the samples beside the points are too many: what was begun leaves no trace."""
    rng = np.random.default_rng(2)
    scattered = rng.uniform(-1, 1, (3000, 3)).astype(np.float32)
    binned = Binner(grid, VS, 3).bin(*carrying(scattered, scattered))
    voxels = set(map(tuple, binned.keys.to_numpy()[: binned.count, :3].tolist()))
    assert binned.count > FIRST_BLOCKS
    assert voxels == reference.touch_points(in_voxels(scattered))
    assert binned.rows[:, 1].sum() == len(scattered)

    other = VoxelGrid([latents(2, 3), WEIGHTS, MASKS])
    points = rng.uniform(-1, 1, (2 * binned.keys.shape[0] - 1500, 3)).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))
    binner = SurfelBinner(other, VS, np.float32([-1, 0, 1]), support_points=1, with_normals=False)
    for _ in range(2):
        found = binner.bin(*carrying(points, normals))
        wanted = reference.touch_surfel_samples(
            in_voxels(points), normals.astype(float), [-1.0, 0.0, 1.0]
        )
        assert set(map(tuple, found.keys.to_numpy()[: found.count, :3].tolist())) == wanted
        assert found.rows[:, 1].sum() == 3 * len(points)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 410.0, -410.0, 1e30])
def test_points_outside_the_index_range_are_refused_and_counted(grid, cloud, bad):
    points = cloud.points.copy()
    points[[3, 77], [0, 2]] = bad
    with pytest.raises(OutOfRange, match="2 of 1200 points lie more than 410 m"):
        Binner(grid, VS, 3).bin(*carrying(points, cloud.normals))
