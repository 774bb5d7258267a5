"""The front end's kernels against their twins: what is clipped, put together and averaged."""

from __future__ import annotations

import numpy as np
import pytest
import reference_patches as twin
from patch_frames import ALL, JUMP, NONE, RADIUS, Found, T, camera_of, expected, make, steps
from viewpoints import rays

from taichi_unifusion.kernels import patches as kernels

UNIT = 1e-6  # float32 of numbers about 1
NORMAL = 1e-3  # float32 slopes of the inverse depth, differences of numbers 1 % apart
POSITION = 2e-6  # [m] float32 at some metres


def assert_same(found: Found, wanted: list[twin.Patch], T=T) -> None:
    """The same pixels in the same patches, in the same order."""
    assert found.places.tolist() == [patch.place for patch in wanted]
    assert found.counts.tolist() == [patch.count for patch in wanted]
    assert found.totals.tolist() == [len(wanted), found.counts.sum(), 0, 0]
    positions = [twin.position(patch, T) for patch in wanted]
    np.testing.assert_allclose(found.points, positions, atol=POSITION)
    np.testing.assert_allclose(found.normals, [patch.normal for patch in wanted], atol=NORMAL)


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


@pytest.mark.parametrize("least", [ALL, NONE], ids=["all", "none"])
def test_make_patches_equals_its_twin_with_weights(least):
    inverse, camera = steps(63, 47), camera_of(63, 47)
    weights = np.random.default_rng(4).integers(1, 4, inverse.shape, dtype=np.uint8)
    found = make(inverse, camera, least=least, weights=weights)
    assert_same(found, expected(inverse, camera, least=least, weights=weights))
    assert len(set(found.counts)) > (1 if least == NONE else 4)


def test_whole_pixels_are_half_of_the_halves():
    """What is left over counts in every other patch: all of those that have half a pixel lie on one
    colour of a chessboard, and the sums of many are right.
    """
    inverse, camera = np.full((48, 64), 0.5), camera_of(64, 48)
    ones = np.ones(inverse.shape, np.uint8)
    for least in (ALL, NONE):
        whole, half = (make(inverse, camera, least=least, weights=w) for w in (2 * ones, ones))
        plain = make(inverse, camera, least=least)
        np.testing.assert_array_equal(whole.counts, plain.counts)
        assert 2 * half.counts.sum() == whole.counts.sum() > 1000
    v, u = np.transpose([twin.pixels_of(place, 64)[0] for place in half.places])
    black = (v // 2 + u // 2 + v % 2 + u % 2) % 2 == 1
    assert black.all() and (half.counts == 1).all()


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
    sizes = np.zeros(rows, np.int32)
    sizes[found.filled] = found.counts
    kernels.average_image(found.found, found.rows, sizes, image, values, counts)
    wanted, known = twin.average_image(found.places, found.counts, image)
    np.testing.assert_array_equal(counts[found.filled], known)
    np.testing.assert_allclose(values[found.filled], wanted, atol=3 * UNIT)
    assert (counts[~found.filled] == -1).all() and (values[~found.filled] == -1).all()
    assert np.bincount(known, minlength=5).min() > 5
