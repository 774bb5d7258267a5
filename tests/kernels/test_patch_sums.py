"""Patches that are summed up in the cells of maps while they are made: as if they were binned."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import reference_patches as twin
from patch_frames import RADIUS, Found, T, camera_of, make, steps
from viewpoints import pose

from taichi_unifusion.kernels import patches as kernels
from taichi_unifusion.kernels.binning import FIXED
from taichi_unifusion.maps.voxel_data import MASKS, WEIGHTS
from taichi_unifusion.maps.voxel_grid import VoxelGrid

FRAME = 5  # of its window
SUM = 2e-6  # fixed point, rounded once a run, and float32 sums of patches of up to four pixels
VOXELS = 0.1, 0.05  # [m] of the surface, and of the colours
ROOM = 6000
T_BESIDE = pose((0.33, -1.21, 2.0), 0.4, -0.3, 1.0)  # some voxels are those of T, some are new


def by_cell(keys, sums, blocks: int) -> dict:
    """Lattice cell -> (count, mean sums)."""
    found = {}
    for b, cell in np.argwhere(sums[:blocks, :, 0]):
        at = 4 * keys[b, :3] + np.unravel_index(cell, (4, 4, 4))
        count = sums[b, cell, 0]
        found[tuple(at.tolist())] = count, sums[b, cell, 1:] / FIXED / count
    return found


class Cells:
    """The cells of a surface map and of a colour map, in so much room."""

    def __init__(self, room: int = ROOM) -> None:
        self.grids = [VoxelGrid([WEIGHTS, MASKS]) for _ in VOXELS]
        self.stamps = [grid.next_frame() for grid in self.grids]
        self.surface, self.colors = (
            (np.zeros((room, 5), np.int32), np.zeros((room, 64, 1 + width), np.int64))
            for width in (6, 3)
        )
        surface, color = (
            kernels.Sink(grid.index, 1 / size)
            for grid, size in zip(self.grids, VOXELS, strict=True)
        )
        self.sinks = kernels.Sinks(True, RADIUS, surface, color)
        self.blocks = (0, 0)

    def add(self, inverse, camera, color, *, frame=FRAME, sign=1, first=(0, 0), T=T) -> Found:
        now = (sign, frame, *self.stamps, *first)
        where = {"surface": self.surface, "colors": self.colors, "blocks": self.blocks}
        found = make(
            inverse, camera, T=T, color=color, sinks=self.sinks, now=now, least=0.6, **where
        )
        self.blocks = tuple(found.totals[2:].tolist())
        return found


@pytest.fixture(scope="module")
def seen():
    """A frame with colours: steps, so that neighbours lie in other voxels and cells."""
    color = np.random.default_rng(7).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    return steps(64, 48), camera_of(64, 48), color


def assert_sums(cells: Cells, frames: list[Found], colors: list[np.ndarray]) -> None:
    """The cells hold the patches of some frames."""
    points = np.vstack([found.points for found in frames])
    counts = np.concatenate([found.counts for found in frames])
    normals = np.vstack([found.normals for found in frames])
    values = np.vstack(
        [
            twin.average_color(found.places, color)
            for found, color in zip(frames, colors, strict=True)
        ]
    )
    for size, carried, (keys, sums), blocks in zip(
        VOXELS, (normals, values), (cells.surface, cells.colors), cells.blocks, strict=True
    ):
        x = (points * np.float32(1 / size)).astype(float)
        wanted, binned = reference.bin_points(x, carried, counts), by_cell(keys, sums, blocks)
        assert binned.keys() == wanted.keys()
        voxels = list(map(tuple, keys[:blocks, :3].tolist()))
        assert len(set(voxels)) == len(voxels) and set(voxels) == reference.touch_points(x)
        for cell, (count, value, position) in wanted.items():
            rest = position - (np.array(cell) + 0.5) / 4
            mean = np.concatenate([value, rest]) if size == VOXELS[0] else value
            assert binned[cell][0] == count
            np.testing.assert_allclose(binned[cell][1], mean, atol=10 * SUM)


def test_patches_are_summed_up_in_cells_as_they_are_made(seen):
    """As `bin_points` would do with them; two frames, each with its bit."""
    cells = Cells()
    inverse, camera, color = seen
    other = color[::-1].copy()
    first = cells.add(inverse, camera, color)
    known = cells.blocks
    second = cells.add(inverse, camera, other, frame=31, T=T_BESIDE)
    assert_sums(cells, [first, second], [color, other])
    for size, (keys, _), blocks, before in zip(
        VOXELS, (cells.surface, cells.colors), cells.blocks, known, strict=True
    ):
        assert blocks > before > 100
        bits = np.zeros(blocks, np.int64)
        voxels = list(map(tuple, keys[:blocks, :3].tolist()))
        for found, bit in ((first, 1 << FRAME), (second, -1 << 31)):
            touched = reference.touch_points((found.points * np.float32(1 / size)).astype(float))
            bits += [bit * (voxel in touched) for voxel in voxels]
        np.testing.assert_array_equal(keys[:blocks, 3], bits)
        assert len(np.unique(bits)) == 3 and not keys[:, 4].any()


def test_what_a_frame_added_is_taken_back_to_the_bit(seen):
    cells = Cells()
    inverse, camera, color = seen
    cells.add(inverse, camera, color)
    before = [array.copy() for pair in (cells.surface, cells.colors) for array in pair]
    known = cells.blocks
    cells.add(inverse, camera, color, frame=6, T=T_BESIDE)
    added = cells.blocks
    cells.add(inverse, camera, color, frame=6, T=T_BESIDE, sign=-1)
    assert cells.blocks == added > known
    for pair, n in zip((cells.surface, cells.colors), known, strict=True):
        assert not pair[1][n:].any() and not pair[0][n:, 3].any()
        pair[0][n:] = 0  # keys of blocks that are forgotten
    for array, old in zip((*cells.surface, *cells.colors), before, strict=True):
        np.testing.assert_array_equal(array, old)


def test_blocks_beyond_the_room_are_added_in_a_second_round(seen):
    """What the first round had room for is not added twice."""
    whole, small = Cells(), Cells(room=50)
    inverse, camera, color = seen
    found = whole.add(inverse, camera, color)
    small.add(inverse, camera, color)
    assert small.blocks == whole.blocks and min(small.blocks) > 60
    small.surface, small.colors = (
        tuple(np.vstack([a, np.zeros((ROOM - 50, *a.shape[1:]), a.dtype)]) for a in pair)
        for pair in (small.surface, small.colors)
    )
    small.add(inverse, camera, color, first=(50, 50))
    assert small.blocks == whole.blocks
    assert_sums(small, [found], [color])
