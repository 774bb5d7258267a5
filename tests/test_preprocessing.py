"""Frame -> PointCloud: the image kernels against their twins, and what must and must not become a
point.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference
from viewpoints import FINE, rays

from taichi_unifusion import Frame, PinholeCamera, PointCloud, preprocess
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import FrameError, InputError, PoseError
from taichi_unifusion.kernels import images as kernels
from taichi_unifusion.preprocessing import PreprocessSettings

CAMERA = PinholeCamera(64, 48, 60.0, 62.0, 30.5, 22.0)
UNIT = 1e-6  # float32 of numbers about 1
# of normals from noise-free depth: what float32 depth and its inverse leave, with margin
DEGREE = 1.0
NORMAL = 1e-3  # float32 slopes of the inverse depth, differences of numbers 1 % apart
INTRINSICS = CAMERA.intrinsics
PIXELS = PreprocessSettings(patch_size=0.0)  # every pixel is a point


def plane_frame(normal, distance: float = 2.0, camera: PinholeCamera = CAMERA, **values) -> Frame:
    """A frame that sees only the plane through (0, 0, distance) with this normal."""
    depth = np.array([0, 0, distance]) @ normal / (rays(camera) @ normal)
    return Frame(
        np.where((depth > 0) & (depth < 20), depth, 0).astype(np.float32), camera, **values
    )


def tilted(degrees: float, about: float = 0.0) -> np.ndarray:
    """Unit normal towards the camera, tilted off the optical axis in the direction `about`
    [degrees].
    """
    tilt, turn = np.radians([degrees, about])
    return np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), -np.cos(tilt)])


def step_frame() -> Frame:
    """A near wall on the left, a slanted one on the right, and noise, as real depth has."""
    depth = plane_frame(tilted(40, 90)).depth.copy()
    depth[:, :25] = 1.1
    rng = np.random.default_rng(0)
    depth *= 1 + 0.002 * rng.normal(size=depth.shape).astype(np.float32)
    depth[rng.uniform(size=depth.shape) < 0.05] = 0
    return Frame(depth, CAMERA, rng.integers(0, 256, (*depth.shape, 3), dtype=np.uint8))


def assert_same_clouds(a: PointCloud, b: PointCloud) -> None:
    """Bit for bit."""
    assert a.points.tobytes() == b.points.tobytes() and a.normals.tobytes() == b.normals.tobytes()
    assert {k: v.tobytes() for k, v in a.attributes.items()} == {
        k: v.tobytes() for k, v in b.attributes.items()
    }


# ---- Kernels against their twins ----


def test_clip_depth_equals_its_twin():
    rng = np.random.default_rng(1)
    depth = rng.uniform(-1, 8, (20, 30)).astype(np.float32)
    depth[:2] = [[np.nan], [65.535]]
    depth[2, :8] = (
        np.inf,
        -np.inf,
        -0.0,
        0.0,
        0.1,
        5.0,
        np.nextafter(np.float32(5), np.float32(6)),
        1e-30,
    )
    # a signalling and a negative NaN
    depth[3, :2] = np.array([0x7F800001, 0xFFC00000], np.uint32).view(np.float32)
    clipped = np.empty_like(depth)
    kernels.clip_depth(depth, 0.1, 5.0, clipped)
    np.testing.assert_array_equal(clipped, reference.clip_depth(depth, 0.1, 5.0))
    assert (
        clipped[2, 4] == np.float32(0.1) and clipped[2, 5] == 5 and 0.3 < (clipped > 0).mean() < 0.9
    )


@pytest.mark.parametrize("support", [0, 3, 5, 8])
def test_drop_flying_pixels_equals_its_twin(support):
    depth, inverse = step_frame().depth, np.empty((48, 64), np.float32)
    kernels.drop_flying_pixels(depth, 0.03, support, inverse)
    twin = reference.drop_flying_pixels(depth, 0.03, support)
    np.testing.assert_allclose(inverse, twin, rtol=UNIT)
    assert support == 0 or np.count_nonzero(twin) < np.count_nonzero(depth)


@pytest.mark.parametrize(("radius", "max_angle"), [(3, 80), (1, 45)])
def test_estimate_normals_equals_its_twin(radius, max_angle):
    inverse = reference.drop_flying_pixels(step_frame().depth, 0.03, 3).astype(np.float32)
    normals = np.empty((48, 64, 3), np.float32)
    limit = float(np.cos(np.radians(max_angle)))
    kernels.estimate_normals(inverse, INTRINSICS, radius, 0.03, limit, normals)
    twin = reference.estimate_normals(inverse.astype(float), *INTRINSICS, radius, 0.03, limit)
    np.testing.assert_array_equal(normals[..., 2] != 0, twin[..., 2] != 0)
    assert 0.2 < (twin[..., 2] != 0).mean() < 0.95
    np.testing.assert_allclose(normals, twin, atol=NORMAL)


def test_transform_equals_its_twin():
    rng, T = np.random.default_rng(3), np.eye(4)
    T[:3, :3], T[:3, 3] = np.linalg.qr(rng.normal(size=(3, 3)))[0], (1, -2, 3)
    T[:3, :3] *= np.sign(np.linalg.det(T[:3, :3]))
    points, normals = rng.normal(size=(2, 50, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    moved = np.empty_like(points)
    kernels.transform(points, T[:3], moved)
    np.testing.assert_allclose(moved, reference.transform(points, T), atol=3 * UNIT)
    cloud = PointCloud(points, normals, {"x": points.copy()}).transformed(T)
    np.testing.assert_array_equal(cloud.points, moved)
    # turned, not shifted
    np.testing.assert_allclose(
        cloud.normals, reference.transform(normals, T) - T[:3, 3], atol=3 * UNIT
    )
    np.testing.assert_array_equal(cloud.attributes["x"], points)
    with pytest.raises(PoseError):
        cloud.transformed(2 * T)
    assert len(PointCloud(points[:0], normals[:0]).transformed(T)) == 0


# ---- Whole frames ----


@pytest.mark.parametrize("degrees", [0, 20, 45, 60, 70])
@pytest.mark.parametrize("about", [0, 130])
def test_normals_of_planes_are_right_and_point_to_the_camera(degrees, about):
    normal = tilted(degrees, about)
    frame = plane_frame(normal, camera=FINE)
    cloud = preprocess(frame)
    assert cloud.counts.sum() > 0.75 * frame.depth.size
    angle = np.degrees(np.arccos(np.clip(cloud.normals.astype(float) @ normal, -1, 1)))
    assert angle.max() < DEGREE
    assert (np.einsum("ni,ni->n", cloud.normals, cloud.points) < 0).all()
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=3 * UNIT)
    # the points lie on the plane: float32 at 4 m
    np.testing.assert_allclose(cloud.points @ normal, 2 * normal[2], atol=2e-5)


def placed_frame() -> Frame:
    """A slanted plane whose pixels carry their row and column, colour and seven more values."""
    rng, frame = np.random.default_rng(4), plane_frame(tilted(30))
    color = rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)
    place = np.moveaxis(np.mgrid[:48, :64], 0, -1).astype(np.float32)
    return (
        Frame(frame.depth, CAMERA, color)
        .with_image("place", place)
        .with_image("deep", rng.normal(size=(48, 64, 7)))
    )


def test_points_come_quad_by_quad_from_pixels_with_their_colour_and_images():
    frame = placed_frame()
    cloud = preprocess(frame, PIXELS)
    v, u = cloud.attributes["place"].astype(int).T
    order = np.lexsort((u % 2, v % 2, u // 2, v // 2))
    assert (np.diff(order) == 1).all() and len(np.unique(v * 64 + u)) == len(cloud) > 2000
    assert set(cloud.attributes) == {"color", "place", "deep"} and (cloud.counts == 1).all()
    seen = cloud.points.astype(float) / cloud.points[:, 2:]
    np.testing.assert_allclose(seen[:, 0] * CAMERA.fx + CAMERA.cx, u, atol=1e-4)
    np.testing.assert_allclose(seen[:, 1] * CAMERA.fy + CAMERA.cy, v, atol=1e-4)
    np.testing.assert_allclose(cloud.points[:, 2], frame.depth[v, u], rtol=3e-7)  # 1 / (1 / z)
    np.testing.assert_allclose(cloud.attributes["color"], frame.color[v, u] / 255, atol=UNIT)
    np.testing.assert_array_equal(cloud.attributes["deep"], frame.images["deep"][v, u])


def test_a_patch_is_the_mean_of_its_pixels_and_counts_them():
    frame = placed_frame()
    pixels, cloud = (
        preprocess(frame, settings) for settings in (PIXELS, PreprocessSettings(patch_size=1.0))
    )
    assert cloud.counts.sum() == len(pixels) and (cloud.counts == 4).mean() > 0.7
    quad = np.floor(cloud.attributes["place"] / 2)
    whole = np.flatnonzero(cloud.counts == 4)
    for n in whole[::37]:
        own = (np.floor(pixels.attributes["place"] / 2) == quad[n]).all(axis=1)
        assert own.sum() == 4
        np.testing.assert_allclose(cloud.points[n], pixels.points[own].mean(axis=0), atol=3 * UNIT)
        for name, values in cloud.attributes.items():
            wanted = pixels.attributes[name][own].mean(axis=0)
            np.testing.assert_allclose(values[n], wanted, rtol=UNIT, atol=UNIT)


def test_patches_are_no_larger_than_they_may_be():
    """Two pixels span their depth over the focal length: near ones are put together, far ones not."""
    frame, size = plane_frame(tilted(60), camera=FINE), 0.0095
    cloud = preprocess(frame, PreprocessSettings(patch_size=size))
    spans = 2 * cloud.points[:, 2] / FINE.fx
    assert (cloud.counts[spans > 1.01 * size] == 1).all()
    assert (cloud.counts[spans < 0.99 * size] == 4).mean() > 0.9
    assert 0.2 < (cloud.counts == 1).mean() < 0.9


def test_values_that_are_no_numbers_leave_their_pixels_out_of_a_patch():
    frame = plane_frame(tilted(30)).with_image("x", np.ones((48, 64)))
    frame.images["x"][::2, ::2], frame.images["x"][:, 40:] = np.nan, np.inf
    whole = Frame(frame.depth, CAMERA)
    cloud, plain = (preprocess(f, PreprocessSettings(patch_size=1.0)) for f in (frame, whole))
    np.testing.assert_array_equal(cloud.points, plain.points)  # points do not depend on it
    u = cloud.points[:, 0] / cloud.points[:, 2] * CAMERA.fx + CAMERA.cx
    values = cloud.attributes["x"][:, 0]
    assert np.isnan(values[u > 40]).all() and (values[(u < 39) & (cloud.counts == 4)] == 1).all()


def test_an_image_named_color_replaces_the_colour():
    frame = step_frame()
    gray = np.full((48, 64, 3), 0.25, np.float32)
    assert (preprocess(frame.with_image("color", gray)).attributes["color"] == 0.25).all()


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, -1.0, -0.0, 65.535, 1e30, 0.05])
def test_F2_F3_invalid_readings_equal_zeros_bit_for_bit(bad):
    frame = step_frame()
    spoilt = np.random.default_rng(5).uniform(size=frame.depth.shape) < 0.2
    clean, dirty = (
        preprocess(Frame(np.where(spoilt, np.float32(value), frame.depth), CAMERA, frame.color))
        for value in (0, bad)
    )
    assert len(clean) > 100
    assert_same_clouds(dirty, clean)


def test_F2_a_mix_of_invalid_readings_equals_zeros_bit_for_bit():
    frame, rng = step_frame(), np.random.default_rng(6)
    mix = rng.choice(
        np.array([np.nan, np.inf, -np.inf, -3, 0, 65.535], np.float32), frame.depth.shape
    )
    spoilt = rng.uniform(size=frame.depth.shape) < 0.3
    clean, dirty = (
        preprocess(Frame(np.where(spoilt, value, frame.depth).astype(np.float32), CAMERA))
        for value in (0, mix)
    )
    assert len(clean) > 100
    assert_same_clouds(dirty, clean)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0, 65.535])
def test_F1_F10_a_frame_without_usable_depth_gives_an_empty_cloud_with_its_attributes(value):
    frame = Frame(np.full((48, 64), value, np.float32), CAMERA, np.zeros((48, 64, 3), np.uint8))
    cloud = preprocess(frame.with_image("ir", np.zeros((48, 64))))
    assert len(cloud) == 0 and cloud.normals.shape == (0, 3)
    assert {name: values.shape for name, values in cloud.attributes.items()} == {
        "color": (0, 3),
        "ir": (0, 1),
    }


@pytest.mark.parametrize("at", [(20, 30), (0, 0), (47, 63)])
def test_F4_one_valid_pixel_gives_no_point(at):
    depth = np.zeros((48, 64), np.float32)
    depth[at] = 1
    assert len(preprocess(Frame(depth, CAMERA))) == 0


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (7, 7), (65, 1)])
def test_images_smaller_than_a_window_give_no_points(size):
    camera = PinholeCamera(*size, 50.0, 50.0, 0.5, 0.5)
    cloud = preprocess(
        Frame(np.ones(size[::-1], np.float32), camera), PreprocessSettings(normal_radius=3)
    )
    assert len(cloud) <= 4 and np.isfinite(cloud.points).all()


def test_depth_range_is_kept_inclusive_and_nothing_else():
    frame = plane_frame(tilted(60), 2.0, FINE)
    cloud = preprocess(frame, PreprocessSettings(depth_min=1.8, depth_max=2.2))
    assert 1.8 <= cloud.points[:, 2].min() < 1.85 and 2.15 < cloud.points[:, 2].max() <= 2.2
    flat = Frame(np.full((48, 64), 2.5, np.float32), CAMERA)
    assert len(preprocess(flat, PreprocessSettings(depth_max=2.5))) > 1500
    assert len(preprocess(flat, PreprocessSettings(depth_max=2.49))) == 0


def test_flying_pixels_are_dropped_and_a_slanted_plane_survives():
    depth = np.full((48, 64), 3.0, np.float32)
    depth[:, :30] = 1.0
    depth[:, 30] = 2.0  # smeared over the edge
    cloud = preprocess(Frame(depth, CAMERA))
    z = cloud.points[:, 2]
    assert ((z == 1) | (z == 3)).all() and (z == 1).sum() > 800 and (z == 3).sum() > 1000
    assert (cloud.normals[:, 2] < -0.999).all()  # also beside the edge
    slanted = plane_frame(tilted(65, 20), camera=FINE)
    assert preprocess(slanted).counts.sum() > 0.75 * slanted.depth.size


@pytest.mark.parametrize("limit", [41.5, 48])
def test_grazing_pixels_are_left_out(limit):
    frame = plane_frame(tilted(45), camera=FINE)
    cloud = preprocess(frame, replace(PIXELS, max_angle=limit))
    everything = preprocess(frame, replace(PIXELS, max_angle=90))

    def angles(c):
        return np.degrees(
            np.arccos(
                -np.einsum("ni,ni->n", c.points, c.normals) / np.linalg.norm(c.points, axis=1)
            )
        )

    assert 0 < len(cloud) < len(everything)
    assert angles(cloud).max() <= limit + 0.01
    assert len(cloud) == np.count_nonzero(angles(everything) <= limit)


def test_strided_images_are_read_as_they_are():
    frame = step_frame()
    turned = Frame(
        np.asfortranarray(frame.depth),
        CAMERA,
        np.ascontiguousarray(frame.color[..., ::-1])[..., ::-1],
    )
    assert_same_clouds(preprocess(turned), preprocess(frame))


@pytest.mark.parametrize(
    "wrong",
    [
        {"depth_min": 0.0},
        {"depth_min": 3.0, "depth_max": 2.0},
        {"edge_jump": 0.0},
        {"normal_radius": 0},
        {"max_angle": 0.0},
        {"max_angle": 91.0},
    ],
)
def test_settings_that_make_no_sense_are_refused(wrong):
    with pytest.raises(InputError, match="preprocess: need "):
        PreprocessSettings(**wrong)


@pytest.mark.parametrize("wrong", [-0.01, float("inf"), float("nan")])
def test_a_patch_size_that_is_no_length_is_refused(wrong):
    with pytest.raises(InputError, match="preprocess: patch_size must be a number from 0"):
        PreprocessSettings(patch_size=wrong)


def test_F3_a_real_frame_has_no_point_where_the_sensor_read_nothing(data):
    frame = open_dataset("7scenes", data("7scenes-redkitchen"))[0]
    cloud = preprocess(frame)
    assert 150_000 < cloud.counts.sum() < 290_000 and cloud.points[:, 2].max() <= 5.0
    assert (np.einsum("ni,ni->n", cloud.normals, cloud.points) < 0).all()


def test_pixels_count_by_their_weights():
    """Of a plane whose left half counts half the points are the same, there of half as many pixels."""
    frame, settings = plane_frame(tilted(20)), PreprocessSettings(patch_size=1.0)
    weights = np.full(frame.depth.shape, 2, np.uint8)
    weights[:, : CAMERA.width // 2] = 1
    plain, weighed = (
        preprocess(each, settings) for each in (frame, replace(frame, weights=weights))
    )
    np.testing.assert_array_equal(weighed.points, plain.points)
    left = CAMERA.project(plain.points)[:, 0] < CAMERA.width // 2 - 0.5
    quads = plain.counts == 4
    assert quads.mean() > 0.8 and 0.4 < left.mean() < 0.6
    np.testing.assert_array_equal(weighed.counts[~left], plain.counts[~left])
    np.testing.assert_array_equal(weighed.counts[left & quads], 2)
    for wrong in (weights.astype(int), weights[1:], np.zeros_like(weights)):
        with pytest.raises(FrameError, match="weights"):
            replace(frame, weights=wrong)
