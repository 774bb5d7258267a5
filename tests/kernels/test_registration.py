"""Colored ICP: its kernels against their twins, its laws, and how far it finds back."""

from __future__ import annotations

from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
import reference_registration as reference

from taichi_unifusion import Frame, PinholeCamera
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.geometry import se3
from taichi_unifusion.kernels import registration as kernels
from taichi_unifusion.tracking.pyramid import (
    SurfelImage,
    SurfelPyramid,
    build_pyramid,
    reduce_frame,
)
from taichi_unifusion.tracking.registration import Target, evaluate, register

UNIT = 1e-6  # float32 of numbers about 1
SUMS = 2e-4  # float32 sums of some thousand terms of both signs, relative to the largest entry
EXACT_MM, EXACT_DEGREES = 2.0, 0.1  # synthetic frames with a Kinect's noise, 10 cm apart
# what the project promises after a disturbance of 3 cm and 2 degrees
BACK_MM, BACK_DEGREES = 3.0, 0.2
DEPTH_RANGE = 0.3, 6.0


@pytest.fixture(scope="module")
def room():
    return SyntheticRoom(frames=60)


@pytest.fixture(scope="module")
def pair(room):
    """Two pyramids and the true pose of the second in the first."""
    first, second = room[0], room[1]
    return (
        pyramid(first),
        pyramid(second),
        se3.inverse(first.T_world_camera) @ second.T_world_camera,
    )


def pyramid(frame) -> SurfelPyramid:
    return build_pyramid(reduce_frame(frame, *DEPTH_RANGE))


def apart(T_a, T_b) -> tuple[float, float]:
    """Millimetres and degrees between two poses."""
    distance, angle = se3.distance(T_a, T_b)
    return 1e3 * distance, float(np.degrees(angle))


def surfels(seed: int, height: int = 12, width: int = 16) -> np.ndarray:
    """A rough surface about 2 m away with some holes."""
    rng = np.random.default_rng(seed)
    image = np.zeros((height, width, kernels.CHANNELS), np.float32)
    image[..., 0] = 2 + rng.normal(0, 0.01, (height, width))
    image[rng.uniform(size=(height, width)) < 0.1, 0] = 0
    normals = np.array([0.1, -0.2, -1]) + rng.normal(0, 0.15, (height, width, 3))
    image[..., 1:4] = normals / np.linalg.norm(normals, axis=2, keepdims=True)
    image[..., 4] = rng.uniform(size=(height, width))
    image[..., 5:7] = rng.normal(0, 0.03, (height, width, 2))
    return image


def test_every_kernel_has_a_twin_of_its_name():
    loaded = import_module("taichi_unifusion.kernels.registration")
    names = {
        name for name, value in vars(loaded).items() if getattr(value, "_is_wrapped_kernel", False)
    }
    assert names and {name for name in names if not hasattr(reference, name)} == set()


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_average_inverse_depth_keeps_to_the_nearest_surface(factor):
    rng = np.random.default_rng(0)
    inverse = np.where(rng.uniform(size=(13, 17)) < 0.5, 0.5, 0.4) * rng.uniform(
        0.99, 1.01, (13, 17)
    )
    inverse = np.where(rng.uniform(size=inverse.shape) < 0.3, 0, inverse).astype(np.float32)
    averaged = np.empty((13 // factor, 17 // factor), np.float32)
    kernels.average_inverse_depth(inverse, factor, 0.03, averaged)
    expected = reference.average_inverse_depth(inverse, factor, 0.03)
    np.testing.assert_allclose(averaged, expected, atol=UNIT)
    assert np.count_nonzero(expected) > 0 and (factor == 1 or np.count_nonzero(expected == 0))


def test_averages_of_images():
    rng = np.random.default_rng(1)
    color = rng.integers(0, 256, (9, 14, 3), dtype=np.uint8)
    intensity, averaged = np.empty((4, 7), np.float32), np.empty((2, 3), np.float32)
    kernels.average_color(color, 2, intensity)
    kernels.average_intensity(intensity, averaged)
    np.testing.assert_allclose(intensity, reference.average_color(color, 2), atol=UNIT)
    np.testing.assert_allclose(averaged, reference.average_intensity(intensity), atol=UNIT)


def test_pack_surfels():
    rng = np.random.default_rng(2)
    inverse = rng.uniform(0.2, 2, (8, 9)).astype(np.float32) * (rng.uniform(size=(8, 9)) < 0.8)
    normals = rng.normal(size=(8, 9, 3)).astype(np.float32) * (rng.uniform(size=(8, 9, 1)) < 0.8)
    intensity, packed = (
        rng.uniform(size=(8, 9)).astype(np.float32),
        np.empty((8, 9, kernels.CHANNELS), np.float32),
    )
    kernels.pack_surfels(inverse.astype(np.float32), normals.astype(np.float32), intensity, packed)
    np.testing.assert_allclose(
        packed, reference.pack_surfels(inverse, normals, intensity), rtol=UNIT, atol=UNIT
    )


@pytest.mark.parametrize(("step", "weight"), [(1, 0.3), (2, 0.3), (1, 0.0)])
def test_sum_normal_equations(step, weight):
    source, target = surfels(3), surfels(4, 14, 18)
    K = np.array([(20, 21, 7.5, 5.5), (20, 20, 8.5, 6.5)], np.float32)
    T = se3.exp(np.array([0.01, -0.02, 0.005, 0.02, 0.01, -0.03]))
    limits = np.array([0.04, 0.9, 1.0, 0.05, weight], np.float32).astype(float).tolist()
    rows = -(-source.shape[0] // step)
    sums = np.empty((-(-rows // kernels.BLOCK_ROWS), kernels.SUMS), np.float32)
    kernels.sum_normal_equations(source, target, *K, T[:3], step, *limits, sums)
    H, b, counts = reference.sum_normal_equations(
        source.astype(float), target.astype(float), *K.astype(float), T, step, *limits
    )
    total = sums.sum(axis=0, dtype=np.float64)
    np.testing.assert_allclose(
        total[: kernels.H_SIZE], H[np.triu_indices(6)], atol=SUMS * np.abs(H).max()
    )
    np.testing.assert_allclose(
        total[kernels.H_SIZE : kernels.SOURCE], b, atol=SUMS * np.abs(b).max()
    )
    np.testing.assert_allclose(total[kernels.SOURCE :], counts, rtol=SUMS)
    assert (
        (counts[[0, 1, 2]] > 20).all()
        and counts[0] > counts[1] > counts[2]
        and (counts[4] > 20) == (weight > 0)
    )


def test_leave_out():
    """What is left out has a depth below 0, and comes back."""
    packed = surfels(7)
    moving = (np.random.default_rng(7).uniform(size=(5, 4)) < 0.4).astype(np.uint8)
    changed = packed.copy()
    kernels.leave_out(moving, changed)
    np.testing.assert_array_equal(changed, reference.leave_out(moving, packed))
    assert (changed[..., 0] < 0).any()
    kernels.leave_out(np.zeros_like(moving), changed)
    np.testing.assert_array_equal(changed, packed)


@pytest.mark.parametrize(("step", "channels"), [(1, 1), (3, 4), (2, kernels.CHANNELS)])
def test_read_surfels(step, channels):
    packed = surfels(3)
    expected = reference.read_surfels(packed, step, channels)
    read = np.full(expected.shape, np.nan, np.float32)
    kernels.read_surfels(packed, step, read)
    np.testing.assert_array_equal(read, expected)


@pytest.mark.parametrize("step", [1, 2])
def test_compare_surfels(step):
    source, target = surfels(8), surfels(9, 14, 18)
    source[::3, ::2, 0] *= -1  # what is left out of the source is compared, of the target it is not
    target[::5, ::4, 0] *= -1
    K = np.array([(20, 21, 7.5, 5.5), (20, 20, 8.5, 6.5)], np.float32)
    T = se3.exp(np.array([0.01, -0.02, 0.005, 0.02, 0.01, -0.03]))
    size = [-(-n // step) for n in source.shape[:2]]
    compared = np.empty((*size, kernels.COMPARED), np.float32)
    kernels.compare_surfels(source, target, *K, T[:3], step, compared)
    expected = reference.compare_surfels(
        source.astype(float), target.astype(float), *K.astype(float), T, step
    )
    np.testing.assert_allclose(compared, expected, rtol=1e-3, atol=1e-4)
    assert 5 < (compared[..., 0] < kernels.UNSEEN).sum() < compared[..., 0].size


def test_the_gradient_is_that_of_the_cost():
    """b is half the derivative of the weighted squares while weights and associations stand still:
    of the geometric part.
    """
    # with a margin for rounding
    source, target = surfels(5, 24, 32).astype(float), surfels(6, 26, 34).astype(float)
    # one plane: moving does not change what a point is compared with
    target[..., 0], target[..., 1:4] = 2.0, (0, 0, -1.0)
    K, K_target = (40.0, 40.0, 15.5, 11.5), (40.0, 40.0, 16.5, 12.5)
    arguments = (1, 1.0, -1.0, 1e6, 0.05, 0.0)  # no gate, no robust weights, no colour
    H, b, _ = reference.sum_normal_equations(source, target, K, K_target, np.eye(4), *arguments)

    def cost(twist):
        total = 0.0
        for v in range(24):
            for u in range(32):
                if source[v, u, 0] > 0:
                    p = se3.exp(twist)[:3] @ [*reference.unprojected(u, v, source[v, u, 0], K), 1]
                    variance = reference.axial_variance(2.0) + reference.axial_variance(
                        source[v, u, 0]
                    )
                    total += (2.0 - p[2]) ** 2 / variance
        return total

    step = 1e-6
    slope = [(cost(step * e) - cost(-step * e)) / (4 * step) for e in np.eye(6)]
    np.testing.assert_allclose(b, slope, rtol=1e-4, atol=1e-3 * np.abs(slope).max())


def test_registration_finds_the_true_pose(pair):
    first, second, truth = pair
    found = register(second, first, np.eye(4))
    distance, angle = apart(found.T_target_source, truth)
    assert distance < EXACT_MM and angle < EXACT_DEGREES
    assert found.agreement > 0.9 and found.rmse < 0.02 and found.determined


def test_registration_is_the_same_bit_for_bit(pair):
    first, second, _ = pair
    results = [register(second, first, np.eye(4)).T_target_source for _ in range(3)]
    assert results[0].tobytes() == results[1].tobytes() == results[2].tobytes()


def test_there_and_back_is_nowhere(pair):
    first, second, _ = pair
    there, back = register(second, first, np.eye(4)), register(first, second, np.eye(4))
    distance, angle = apart(there.T_target_source @ back.T_target_source, np.eye(4))
    assert distance < 2 * EXACT_MM and angle < 2 * EXACT_DEGREES


def test_a_frame_lies_on_itself(pair):
    first, _, _ = pair
    assert apart(register(first, first, np.eye(4)).T_target_source, np.eye(4)) == pytest.approx(
        (0, 0), abs=1e-3
    )
    itself = evaluate(first, first, np.eye(4))
    assert itself.fitness == itself.overlap == 1 and itself.rmse < UNIT


@pytest.mark.parametrize("weight", [0.0, 0.1])
def test_disturbed_guesses_come_back_to_one_place(pair, weight):
    """Up to 3 cm and 2 degrees off in any direction."""
    first, second, truth = pair
    optimum = register(second, first, truth, weight).T_target_source
    rng = np.random.default_rng(7)
    for _ in range(10):
        twist = rng.normal(size=6)
        twist *= np.repeat(
            [0.03 / np.linalg.norm(twist[:3]), np.radians(2) / np.linalg.norm(twist[3:])], 3
        )
        distance, angle = apart(
            register(second, first, se3.exp(twist) @ optimum, weight).T_target_source, optimum
        )
        assert distance < BACK_MM and angle < BACK_DEGREES


def test_several_targets_have_one_frame_of_reference(room):
    """Two keyframes whose relative pose is known give what one of them gives."""
    frames = [room[i] for i in (0, 1, 2)]
    a, b, c = (pyramid(frame) for frame in frames)
    T_a_b, T_a_c = (
        se3.inverse(frames[0].T_world_camera) @ frame.T_world_camera for frame in frames[1:]
    )
    found = register(c, [Target(a, np.eye(4)), Target(b, se3.inverse(T_a_b))], T_a_b)
    distance, angle = apart(found.T_target_source, T_a_c)
    assert distance < EXACT_MM and angle < EXACT_DEGREES


def test_a_flat_wall_fixes_nothing_along_it():
    """Geometry alone leaves three motions of a plane open, and the uncertainty says so."""
    camera = SyntheticRoom(frames=1).camera.shrunk(2)
    wall = np.zeros((camera.height, camera.width, kernels.CHANNELS), np.float32)
    wall[..., 0], wall[..., 3] = 2.0, -1.0
    import taichi as ti

    surfel_image = ti.ndarray(ti.f32, wall.shape)
    surfel_image.from_numpy(wall)
    flat = SurfelPyramid((SurfelImage(surfel_image, camera),))
    found = register(flat, flat, np.eye(4))
    assert found.uncertainty[-1] > 1.0 and not found.determined


@pytest.mark.parametrize("distance", [1.0, 2.0, 3.5])
def test_a_blank_wall_does_not_tell_where_the_camera_is(room, distance):
    rng, frame = np.random.default_rng(0), room[0]
    sigma = np.sqrt(reference.axial_variance(distance))
    walls = [
        replace(
            frame,
            depth=(distance + rng.normal(0, sigma, frame.depth.shape)).astype(np.float32),
            color=rng.normal(200, 2, frame.color.shape).astype(np.uint8),
        )
        for _ in range(2)
    ]
    first, second = (pyramid(wall) for wall in walls)
    found = register(second, first, np.eye(4))
    assert found.agreement > 0.9 and not found.determined  # it fits, anywhere along the wall


def test_uncertainty_is_that_of_the_scene_and_not_of_the_number_of_pixels():
    weakest = []
    for width in (160, 320, 640):
        frames = SyntheticRoom(frames=60, width=width, height=3 * width // 4, noise=False)
        first, second = pyramid(frames[0]), pyramid(frames[1])
        weakest.append(register(second, first, np.eye(4)).uncertainty[-1])
    assert max(weakest) < 1.5 * min(weakest)


def test_a_frame_without_colour_is_aligned_by_its_geometry(room, pair):
    _, _, truth = pair
    first, second = (pyramid(replace(room[i], color=None)) for i in (0, 1))
    distance, angle = apart(register(second, first, np.eye(4)).T_target_source, truth)
    assert distance < 2 * EXACT_MM and angle < 2 * EXACT_DEGREES


def test_F2_readings_that_are_no_numbers_change_nothing(room):
    frame = room[0]
    spoiled = frame.depth.copy()
    rng = np.random.default_rng(8)
    at = rng.uniform(size=spoiled.shape) < 0.05
    clean = np.where(at, 0, spoiled).astype(np.float32)
    spoiled[at] = rng.choice(np.array([np.nan, np.inf, -np.inf, -1, 65.535], np.float32), at.sum())
    a, b = (reduce_frame(replace(frame, depth=depth), *DEPTH_RANGE) for depth in (spoiled, clean))
    assert a.inverse.tobytes() == b.inverse.tobytes()


def test_levels_halve_and_end_before_they_are_too_small():
    frame = SyntheticRoom(frames=1, width=100, height=75)[0]
    sizes = [level.camera.size for level in pyramid(frame).levels]
    assert sizes == [(100, 75), (50, 37)]
    wide = SyntheticRoom(frames=1, width=1200, height=680)[0]
    assert [level.camera.size for level in pyramid(wide).levels] == [
        (400, 226),
        (200, 113),
        (100, 56),
    ]


def test_open3d_finds_the_same(pair, room):
    """Its colored ICP as the oracle, on the same two frames."""
    o3d = pytest.importorskip("open3d", reason="open3d is not installed")
    first, second, truth = pair

    def cloud(frame):
        from taichi_unifusion import preprocess

        points = preprocess(frame)
        made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points.points.astype(float)))
        made.normals = o3d.utility.Vector3dVector(points.normals.astype(float))
        made.colors = o3d.utility.Vector3dVector(points.attributes["color"].astype(float))
        return made.voxel_down_sample(0.03)

    theirs = o3d.pipelines.registration.registration_colored_icp(
        cloud(room[1]), cloud(room[0]), 0.06, truth
    ).transformation
    ours = register(second, first, np.eye(4)).T_target_source
    # they err by as much themselves, and more than ours
    assert apart(ours, theirs)[0] < 15 and apart(ours, theirs)[1] < 0.5
    assert apart(ours, truth)[0] <= apart(theirs, truth)[0]


def test_real_frames_come_back_too(data):
    frames = open_dataset("7scenes", data("7scenes-redkitchen"))
    first, second = pyramid(frames[0]), pyramid(frames[8])
    optimum = register(second, first, np.eye(4)).T_target_source
    rng = np.random.default_rng(9)
    for _ in range(5):
        twist = rng.normal(size=6)
        twist *= np.repeat(
            [0.03 / np.linalg.norm(twist[:3]), np.radians(2) / np.linalg.norm(twist[3:])], 3
        )
        distance, angle = apart(
            register(second, first, se3.exp(twist) @ optimum).T_target_source, optimum
        )
        assert distance < BACK_MM and angle < BACK_DEGREES


def test_a_low_relief_tells_where_the_camera_is():
    """Smooth waves of 5 cm, 1.5 m away, of which no noise tells otherwise: more than a blank wall does."""
    camera = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5)
    v, u = np.mgrid[:120, :160]
    relief = 1.5 + 0.05 * np.sin(u / 25) * np.cos(v / 20)
    far, near = (
        pyramid(
            Frame((relief + step).astype(np.float32), camera, np.full((120, 160, 3), 99, np.uint8))
        )
        for step in (0.01, 0.0)
    )
    found = register(far, near, np.eye(4))
    assert found.determined
    np.testing.assert_allclose(found.T_target_source[:3, 3], (0, 0, -0.01), atol=0.0015)
