"""The front end's kernels against their twins: what is clipped, put together and averaged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import reference
import reference_patches as twin
import taichi as ti
from viewpoints import pose, rays

from taichi_unifusion import PinholeCamera
from taichi_unifusion.kernels import patches as kernels
from taichi_unifusion.kernels.binning import FIXED
from taichi_unifusion.maps.voxel_grid import MASKS, WEIGHTS, VoxelGrid

UNIT = 1e-6  # float32 of numbers about 1
NORMAL = 1e-3  # float32 slopes of the inverse depth, differences of numbers 1 % apart
POSITION = 2e-6  # [m] float32 at some metres
T = pose((0.3, -1.2, 2.0), 0.4, -0.3, 1.0)
RADIUS, JUMP = 2, 0.03
STEEP = float(np.cos(np.radians(80)))
WRITE = kernels.Sinks(write=True)
ALL, NONE = 0.0, float("inf")  # `least` that puts all pixels of a quad together, or none


@dataclass(frozen=True)
class Found:
    """Patches as the kernel writes them, row by row."""

    found: np.ndarray  # (R,)
    points: np.ndarray  # (N, 3)
    normals: np.ndarray
    counts: np.ndarray  # (N,)
    places: np.ndarray
    totals: np.ndarray
    filled: np.ndarray  # (R slots,) which rows are patches
    rows: np.ndarray  # (R slots,) places of all rows


def camera_of(width: int, height: int) -> PinholeCamera:
    return PinholeCamera(width, height, 60.0, 62.0, 0.48 * width, 0.45 * height)


def nothing() -> tuple[np.ndarray, np.ndarray]:
    """Keys and sums of no map."""
    return np.zeros((1, 5), np.int32), np.zeros((1, 1, 1), np.int64)


def make(
    inverse,
    camera,
    *,
    T=T,
    radius=RADIUS,
    jump=JUMP,
    cos_max_angle=STEEP,
    least=ALL,
    color=None,
    sinks=WRITE,
    now=(1, 0, 0, 0, 0, 0),
    surface=None,
    colors=None,
    blocks=(0, 0),
) -> Found:
    """The patches of an image; `surface` and `colors` are keys and sums that they are added to."""
    runs, slots = kernels.runs_of(*inverse.shape), kernels.slots_of_run()
    totals = np.array([3, 4, *blocks], np.int32)  # totals are added to
    pack = {name: ti.ndarray(ti.i32, (runs * slots,)) for name in ("counts", "places")}
    pack |= {name: ti.ndarray(ti.f32, (runs * slots, 3)) for name in ("points", "normals")}
    pack["found"] = ti.ndarray(ti.i32, (runs,))
    pack["found"].fill(-1)
    kernels.make_patches(
        inverse.astype(np.float32),
        np.zeros((1, 1, 3), np.uint8) if color is None else color,
        camera.intrinsics,
        T[:3],
        radius,
        (jump, cos_max_angle, least),
        now,
        sinks,
        totals,
        *(surface or nothing()),
        *(colors or nothing()),
        kernels.PatchPack(**pack),
    )
    made = {name: array.to_numpy() for name, array in pack.items()}
    found = made.pop("found")
    filled = (np.arange(slots) < found[:, None]).ravel()
    rows = {name: array[filled] for name, array in made.items()}
    return Found(found, **rows, totals=totals - (3, 4, 0, 0), filled=filled, rows=made["places"])


def expected(inverse, camera, *, T=T, radius=RADIUS, jump=JUMP, cos_max_angle=STEEP, least=ALL):
    # as the kernel is given them, so that both compare the same numbers
    inverse = inverse.astype(np.float32).astype(float)
    return twin.make_patches(inverse, camera.intrinsics, T, radius, jump, cos_max_angle, least)


def assert_same(found: Found, wanted: list[twin.Patch], T=T) -> None:
    """The same pixels in the same patches, in the same order."""
    assert found.places.tolist() == [patch.place for patch in wanted]
    assert found.counts.tolist() == [len(patch.pixels) for patch in wanted]
    assert found.totals.tolist() == [len(wanted), found.counts.sum(), 0, 0]
    positions = [twin.position(patch, T) for patch in wanted]
    np.testing.assert_allclose(found.points, positions, atol=POSITION)
    np.testing.assert_allclose(found.normals, [patch.normal for patch in wanted], atol=NORMAL)


def steps(width: int, height: int) -> np.ndarray:
    """Inverse depths of a near wall on the left, a slanted one on the right whose edge runs through
    quads, with noise and holes, as real depth has.
    """
    camera, rng = camera_of(width, height), np.random.default_rng(width)
    normal = np.array([0.1, 0.6, -0.8])
    depth = np.array([0, 0, 2.0]) @ normal / (rays(camera) @ normal)
    v, u = np.mgrid[:height, :width]
    depth[u < width / 3 + v / 4] = 1.1
    depth *= 1 + 0.001 * rng.normal(size=depth.shape)
    depth[rng.uniform(size=depth.shape) < 0.05] = np.inf
    return np.where((depth > 0.2) & (depth < 20), 1 / depth, 0)


def normal_of(tilt: float) -> np.ndarray:
    """So many degrees off the optical axis, towards the camera."""
    return np.array([np.sin(np.radians(tilt)), 0, -np.cos(np.radians(tilt))])


def plane(tilt: float, width: int = 64, height: int = 48) -> np.ndarray:
    """Inverse depths of a plane through (0, 0, 2)."""
    normal = normal_of(tilt)
    return np.maximum(rays(camera_of(width, height)) @ normal / (2 * normal[2]), 0)


def test_clip_and_invert_equals_its_twin():
    rng = np.random.default_rng(1)
    depth = rng.uniform(-1, 8, (21, 33)).astype(np.float32)
    depth[:2] = [[np.nan], [65.535]]
    after = np.nextafter(np.float32(5), np.float32(6))
    depth[2, :8] = np.inf, -np.inf, -0.0, 0.0, 0.1, 5.0, after, 1e-30
    # a signalling and a negative NaN
    depth[3, :2] = np.array([0x7F800001, 0xFFC00000], np.uint32).view(np.float32)
    clipped, inverse = np.full((3, 21, 33), -1, np.float32), np.empty((21, 33), np.float32)
    kernels.clip_and_invert(depth, 0.1, 5.0, 7.0, 1, clipped, inverse)
    readings, inverses = twin.clip_and_invert(depth, 0.1, 5.0, 7.0)
    np.testing.assert_array_equal(clipped[1], readings)
    np.testing.assert_allclose(inverse, inverses, rtol=UNIT)
    assert (clipped[[0, 2]] == -1).all()  # other views stay as they are
    assert inverse[2, 4] > 0 and inverse[2, 5] == np.float32(0.2) and inverse[2, 6] == 0
    assert 0.1 < ((readings > 0) & (inverses == 0)).mean() < 0.5  # far, but free before it


@pytest.mark.parametrize("least", [ALL, 0.6, NONE], ids=["all", "far", "none"])
@pytest.mark.parametrize("size", [(64, 48), (63, 47), (85, 21)])
def test_make_patches_equals_its_twin(size, least):
    """Also where rows and columns are odd, and where a row has a run that is not full."""
    inverse, camera = steps(*size), camera_of(*size)
    found, wanted = make(inverse, camera, least=least), expected(inverse, camera, least=least)
    assert_same(found, wanted)
    sizes = np.bincount(found.counts, minlength=5)
    if least == NONE:
        assert sizes[2:].sum() == 0
    else:
        assert sizes[4] > 50 and sizes[1:4].min() > 2
    if least == 0.6:  # the near wall's pixels are fine, and put together; the far ones are not
        assert (sizes[1] > 100) and (inverse > 0.6).any()
    assert 0.3 < found.totals[1] / inverse.size < 0.95


@pytest.mark.parametrize("radius", [1, 3])
@pytest.mark.parametrize("max_angle", [45, 90])
def test_make_patches_equals_its_twin_with_other_settings(radius, max_angle):
    inverse, camera = steps(64, 48), camera_of(64, 48)
    settings = {"radius": radius, "cos_max_angle": float(np.cos(np.radians(max_angle)))}
    found = make(inverse, camera, **settings)
    assert_same(found, expected(inverse, camera, **settings))
    assert found.totals[0] > 50


def test_a_quad_may_give_four_patches():
    """Columns in turn on surfaces that are too far apart for a patch, though near enough for slopes:
    no pixel lies on the surface of the one before.
    """
    inverse = np.tile([1.0, 1.0 + 0.7 * JUMP], (48, 32))
    camera = camera_of(64, 48)
    found = make(inverse, camera)
    assert_same(found, expected(inverse, camera))
    inner = np.bincount(found.places // 16)
    assert (inner == 4).sum() == 22 * 30 and (found.counts == 1).all()


def test_an_edge_inside_a_quad_parts_its_pixels():
    """No patch lies on two surfaces, and no position between them."""
    depth = np.full((48, 64), 1.0)
    depth[:, 33:] = 1.5
    found = make(1 / depth, camera_of(64, 48), T=np.eye(4))
    z = found.points[:, 2]
    assert np.isclose(z, 1.0, atol=POSITION).sum() + np.isclose(z, 1.5, atol=POSITION).sum() == len(
        z
    )
    column = found.places // 16 % 32
    assert np.isclose(z[column < 16], 1.0).all() and np.isclose(z[column > 16], 1.5).all()
    assert {15, 17, 18} <= set(column.tolist())


def test_runs_lie_side_by_side_and_hold_neighbours():
    """Every run holds the patches of some neighbouring quads of one row, in their order."""
    inverse = steps(85, 21)
    found = make(inverse, camera_of(85, 21))
    across, quads = 43, kernels.quads_of_run()
    run_of_row = np.repeat(np.arange(len(found.found)), kernels.slots_of_run())[found.filled]
    quad = found.places // 16
    runs = -(-across // quads)
    np.testing.assert_array_equal(run_of_row, quad // across * runs + quad % across // quads)
    assert (np.diff(found.places) > 0).all() and found.found.max() <= kernels.slots_of_run()


@pytest.mark.parametrize("tilt", [0, 40, 70])
def test_patches_of_a_plane_lie_on_it_and_face_the_camera(tilt):
    camera, inverse = camera_of(64, 48), plane(tilt)
    found = make(inverse, camera, T=np.eye(4), jump=0.2)
    normal = normal_of(tilt)
    np.testing.assert_allclose(found.points @ normal, 2 * normal[2], atol=5 * POSITION)
    np.testing.assert_allclose(found.normals, np.tile(normal, (len(found.normals), 1)), atol=NORMAL)
    assert (found.counts == 4).mean() > 0.8 and found.totals[1] > 1000


def test_pixels_at_grazing_angles_give_no_patch():
    camera, inverse = camera_of(64, 48), plane(50)
    angles = np.degrees(
        np.arccos(-rays(camera) @ normal_of(50) / np.linalg.norm(rays(camera), axis=2))
    )
    limit = float(np.median(angles))
    settings = {"jump": 0.2, "cos_max_angle": float(np.cos(np.radians(limit))), "least": NONE}
    found = make(inverse, camera, **settings)
    assert_same(found, expected(inverse, camera, **settings))
    seen = np.zeros(inverse.shape, bool)
    for place in found.places:
        seen[tuple(np.transpose(twin.pixels_of(place, 64)))] = True
    inner = np.s_[RADIUS + 1 : -RADIUS - 1, RADIUS + 1 : -RADIUS - 1]
    clear = np.abs(angles - limit) > 0.1  # float32 says which side it is
    np.testing.assert_array_equal((seen == (angles < limit))[inner][clear[inner]], True)
    assert 0.3 < seen.mean() < 0.6


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (4, 4), (64, 2), (1, 50)])
def test_images_smaller_than_a_window_give_no_patch(size):
    found = make(np.ones(size[::-1]), camera_of(*size), least=NONE)
    assert not found.totals.any() and not found.found.any()


# ---- Summed up on the way ----

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
        self.sinks = kernels.Sinks(True, surface, color)
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


def test_average_color_and_image_equal_their_twins():
    """Values that are no numbers leave their pixel out; where none is left, the count is 0."""
    width, height = 63, 47
    found, rng = make(steps(width, height), camera_of(width, height)), np.random.default_rng(2)
    rows = len(found.rows)
    color = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    colors = np.full((rows, 3), -1, np.float32)
    kernels.average_color(found.found, found.rows, color, colors)
    np.testing.assert_allclose(
        colors[found.filled], twin.average_color(found.places, color), atol=UNIT
    )
    assert (colors[~found.filled] == -1).all()

    image = rng.normal(size=(height, width, 5)).astype(np.float32)
    spoilt = rng.uniform(size=(height, width)) < 0.4
    image[spoilt, rng.integers(0, 5, spoilt.sum())] = rng.choice(
        np.float32([np.nan, np.inf, -np.inf]), spoilt.sum()
    )
    image[:, : width // 2] = np.where(spoilt[:, : width // 2, None], np.nan, 1.0)
    values, counts = np.full((rows, 5), -1, np.float32), np.full(rows, -1, np.int32)
    kernels.average_image(found.found, found.rows, image, values, counts)
    wanted, known = twin.average_image(found.places, image)
    np.testing.assert_array_equal(counts[found.filled], known)
    np.testing.assert_allclose(values[found.filled], wanted, atol=3 * UNIT)
    assert (counts[~found.filled] == -1).all() and (values[~found.filled] == -1).all()
    assert np.bincount(known, minlength=5).min() > 5
