"""Trajectory metrics against cases with known answers, laws, and evo."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from meshes import random_rigid

from taichi_unifusion import Trajectory
from taichi_unifusion.errors import InputError, PoseError
from taichi_unifusion.evaluation import evaluate_trajectory
from taichi_unifusion.evaluation.trajectory import align, align_poses, rotation_angle

ROUNDING = 1e-6  # [cm] float64 over a few metres
SAME = 1e-9  # relative to another float64 implementation


def turn(axis: int, degrees: float) -> np.ndarray:
    """4x4 rotation about a coordinate axis."""
    a, T = math.radians(degrees), np.eye(4)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    T[i, i], T[i, j], T[j, i], T[j, j] = math.cos(a), -math.sin(a), math.sin(a), math.cos(a)
    return T


def shift(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def curve(count: int = 40, seed: int = 0) -> Trajectory:
    """A winding path with turning cameras, ten poses a second."""
    rng, T = np.random.default_rng(seed), np.eye(4)
    poses = []
    for step in rng.normal(0, 1, (count, 4)):
        T = (
            T
            @ shift(0.05 + 0.01 * step[0], 0.01 * step[1])
            @ turn(2, 3 + 2 * step[2])
            @ turn(0, step[3])
        )
        poses.append(T)
    return Trajectory(np.arange(count) / 10, np.stack(poses))


def noisy(trajectory: Trajectory, seed: int = 1, size: float = 0.01) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [
        T @ shift(*rng.normal(0, size, 3)) @ turn(int(rng.integers(3)), rng.normal(0, 1))
        for T in trajectory.T_world_camera
    ]
    return Trajectory(trajectory.timestamps, np.stack(poses))


def line(count: int) -> Trajectory:
    return Trajectory(np.arange(count) / 10, np.stack([shift(0.1 * i) for i in range(count)]))


# --- Known answers --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("truth", [curve(), line(10)], ids=["curve", "line"])
def test_the_same_path_in_another_frame_has_no_error_once_aligned(truth):
    T = random_rigid(3)
    estimate = Trajectory(truth.timestamps, T @ truth.T_world_camera)
    result = evaluate_trajectory(estimate, truth)
    assert result.ate_cm.max == pytest.approx(
        0, abs=ROUNDING
    ) and result.ate_sim3_cm.max == pytest.approx(0, abs=ROUNDING)
    assert result.scale == pytest.approx(1) and result.ate_unaligned_cm.rmse > 10
    assert result.rpe_translation_cm.max == pytest.approx(0, abs=ROUNDING)
    assert result.rpe_rotation_deg.max == pytest.approx(0, abs=ROUNDING)
    moved = np.array(result.T_truth_estimate) @ estimate.T_world_camera
    np.testing.assert_allclose(moved[:, :3, 3], truth.T_world_camera[:, :3, 3], atol=1e-9)
    assert result.unique == (truth.T_world_camera[5, 1, 3] != 0)


def test_a_scaled_path_is_right_after_sim3_only():
    truth = curve()
    poses = truth.T_world_camera.copy()
    poses[:, :3, 3] *= 0.5
    result = evaluate_trajectory(Trajectory(truth.timestamps, poses), truth)
    assert result.scale == pytest.approx(2) and result.ate_sim3_cm.max == pytest.approx(
        0, abs=ROUNDING
    )
    assert result.ate_cm.rmse > 1


def test_errors_across_the_path_are_read_off():
    """Beside a long line, positions off by +-3 cm in turn, sideways: no alignment helps much."""
    truth = line(201)
    poses = truth.T_world_camera.copy()
    poses[:, 1, 3] += 0.03 * (-1.0) ** np.arange(201)
    poses[100, 1, 3] = 0.09
    result = evaluate_trajectory(Trajectory(truth.timestamps, poses), truth)
    unaligned = result.ate_unaligned_cm
    assert (unaligned.mean, unaligned.median, unaligned.max) == pytest.approx((3 + 6 / 201, 3, 9))
    assert unaligned.rmse == pytest.approx(math.sqrt(9 + (81 - 9) / 201))
    assert (
        result.ate_cm.rmse == pytest.approx(unaligned.rmse, rel=1e-2)
        and result.ate_cm.rmse <= unaligned.rmse
    )


def test_rpe_is_the_error_of_each_motion():
    """A camera on a line that the estimate turns by 2 degrees and shifts by 1 cm too far at every
    step.
    """
    truth, T, poses = line(6), np.eye(4), []
    for _ in range(6):
        poses.append(T)
        T = T @ shift(0.11) @ turn(2, 2)
    estimate = Trajectory(truth.timestamps, np.stack(poses))
    one = evaluate_trajectory(estimate, truth)
    for found, known in ((one.rpe_translation_cm, 1), (one.rpe_rotation_deg, 2)):
        assert (found.rmse, found.mean, found.median, found.max) == pytest.approx((known,) * 4)
    three = evaluate_trajectory(estimate, truth, rpe_delta=3)
    assert three.rpe_rotation_deg.max == pytest.approx(6) and (three.rpe_delta, three.rpe_unit) == (
        3,
        "frames",
    )
    # three steps of the true path
    per_metre = evaluate_trajectory(estimate, truth, rpe_delta=0.3, rpe_unit="metres")
    assert per_metre.rpe_rotation_deg == three.rpe_rotation_deg and per_metre.rpe_unit == "metres"
    assert evaluate_trajectory(
        estimate, truth, rpe_delta=0.25, rpe_unit="metres"
    ).rpe_rotation_deg.max == pytest.approx(6)


def test_a_delta_in_metres_is_not_lost_to_rounding():
    """Ten centimetres a step, one degree too far at each: three steps are 0.3 m, wherever on the
    path they begin.
    """
    truth, T, poses = line(80), np.eye(4), []
    for _ in range(80):
        poses.append(T)
        T = T @ shift(0.1) @ turn(2, 1)
    found = evaluate_trajectory(
        Trajectory(truth.timestamps, np.stack(poses)), truth, rpe_delta=0.3, rpe_unit="metres"
    )
    assert found.rpe_rotation_deg.max == pytest.approx(3)


def test_a_path_in_a_plane_leaves_no_rotation_open():
    poses = curve().T_world_camera.copy()
    poses[:, 2, 3] = 0
    flat = Trajectory(curve().timestamps, poses)
    assert evaluate_trajectory(flat, flat).unique


def test_the_order_of_the_poses_does_not_matter():
    truth, estimate = curve(), noisy(curve())
    mixed = [
        Trajectory(t.timestamps[order], t.T_world_camera[order])
        for t, order in (
            (estimate, np.random.default_rng(1).permutation(40)),
            (truth, np.random.default_rng(2).permutation(40)),
        )
    ]
    assert evaluate_trajectory(*mixed) == evaluate_trajectory(estimate, truth)


def test_a_delta_longer_than_the_path_leaves_rpe_out():
    for options in ({"rpe_delta": 40}, {"rpe_delta": 50.0, "rpe_unit": "metres"}):
        result = evaluate_trajectory(curve(), curve(), **options)
        assert (result.rpe_translation_cm, result.rpe_rotation_deg) == (
            None,
            None,
        ) and result.matches == 40
    assert evaluate_trajectory(curve(), curve(), rpe_delta=39).rpe_rotation_deg is not None


def test_an_estimate_that_stands_still_has_no_scale():
    truth = curve()
    still = Trajectory(truth.timestamps, np.tile(np.eye(4), (len(truth), 1, 1)))
    result = evaluate_trajectory(still, truth)
    assert (result.scale, result.ate_sim3_cm, result.unique) == (None, None, False)
    spread = truth.T_world_camera[:, :3, 3] - truth.T_world_camera[:, :3, 3].mean(axis=0)
    assert result.ate_cm.rmse == pytest.approx(100 * np.sqrt((spread**2).sum(axis=1).mean()))


def test_poses_are_matched_by_time_whatever_their_order():
    truth = curve()
    chosen = np.random.default_rng(0).permutation(40)[:25]
    estimate = Trajectory(truth.timestamps[chosen] + 0.015, truth.T_world_camera[chosen])
    result = evaluate_trajectory(estimate, truth)
    assert (result.matches, result.estimated_poses, result.true_poses) == (25, 25, 40)
    assert result.ate_unaligned_cm.max == 0
    late = Trajectory(
        np.append(estimate.timestamps, 99.0),
        np.concatenate([estimate.T_world_camera, np.eye(4)[None]]),
    )
    assert evaluate_trajectory(late, truth).matches == 25


# --- Laws -----------------------------------------------------------------------------------------------------------


def test_alignment_is_the_best():
    x, y = (noisy(curve(), seed, 0.1).T_world_camera[:, :3, 3] for seed in (1, 2))
    best = align(x, y, with_scale=False)
    cost = np.square(best(x) - y).sum()
    rng = np.random.default_rng(0)
    for size in (1e-4, 1e-2, 1):
        for _ in range(20):
            R = best.R @ turn(int(rng.integers(3)), math.degrees(rng.normal(0, size)))[:3, :3]
            assert np.square(x @ R.T + best.t + rng.normal(0, size, 3) - y).sum() > cost
    assert np.linalg.det(best.R) == pytest.approx(1)
    assert np.square(align(x, y, with_scale=True)(x) - y).sum() <= cost


def test_poses_are_aligned_by_their_orientations():
    truth, T = line(10).T_world_camera, random_rigid(8)
    # a line: positions leave it open
    np.testing.assert_allclose(align_poses(T @ truth, truth), np.linalg.inv(T), atol=1e-12)
    rough = noisy(line(400), 2, 0.01).T_world_camera
    # one degree and one centimetre of noise, in 400 poses
    found = align_poses(T @ rough, line(400).T_world_camera) @ T
    assert (
        np.degrees(rotation_angle(found[None, :3, :3]))[0] < 0.3
        and np.linalg.norm(found[:3, 3]) < 0.3
    )
    assert np.linalg.det(found) == pytest.approx(1)


def test_a_mirrored_path_is_not_aligned_by_a_mirror():
    points = curve().T_world_camera[:, :3, 3]
    assert np.linalg.det(align(points * (1, 1, -1), points, with_scale=True).R) == pytest.approx(1)


def test_sim3_is_at_least_as_good_as_se3_and_that_as_none():
    for seed in range(5):
        result = evaluate_trajectory(noisy(curve(), seed, 0.05), curve())
        assert result.ate_sim3_cm.rmse <= result.ate_cm.rmse <= result.ate_unaligned_cm.rmse


@pytest.mark.parametrize("degrees", [0, 1e-7, 1e-3, 30, 90, 179.9999, 180])
def test_rotation_angles_of_any_size(degrees):
    R = random_rigid(1)[:3, :3]
    found = np.degrees(rotation_angle((R @ turn(0, degrees)[:3, :3] @ R.T)[None]))
    assert found == pytest.approx(degrees, rel=1e-6, abs=1e-9)


# --- A second implementation ----------------------------------------------------------------------------------------


def test_numbers_are_those_of_evo():
    pytest.importorskip("evo", reason="evo is not installed: pip install evo")
    from evo.core import metrics, sync
    from evo.core.trajectory import PoseTrajectory3D

    truth = curve(120)
    drifting = [random_rigid(5) @ T for T in noisy(truth, 3, 0.02).T_world_camera]
    estimate = Trajectory(truth.timestamps[::2] + 0.004, np.stack(drifting[::2]))
    pair = [
        PoseTrajectory3D(poses_se3=list(t.T_world_camera), timestamps=t.timestamps)
        for t in (truth, estimate)
    ]
    result = evaluate_trajectory(estimate, truth, rpe_delta=2)
    for scaled, found in ((False, result.ate_cm), (True, result.ate_sim3_cm)):
        reference, aligned = sync.associate_trajectories(*pair, max_diff=0.01)
        scale = aligned.align(reference, correct_scale=scaled)[2]
        ape = metrics.APE(metrics.PoseRelation.translation_part)
        ape.process_data((reference, aligned))
        known = ape.get_all_statistics()
        assert [100 * known[name] for name in ("rmse", "mean", "median", "max")] == pytest.approx(
            dataclasses.astuple(found), rel=SAME
        )
        assert scale == pytest.approx(result.scale if scaled else 1, rel=SAME)
    reference, plain = sync.associate_trajectories(*pair, max_diff=0.01)
    for relation, found, unit in (
        (metrics.PoseRelation.translation_part, result.rpe_translation_cm, 100),
        (metrics.PoseRelation.rotation_angle_deg, result.rpe_rotation_deg, 1),
    ):
        rpe = metrics.RPE(relation, delta=2, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((reference, plain))
        known = rpe.get_all_statistics()
        assert [unit * known[name] for name in ("rmse", "mean", "median", "max")] == pytest.approx(
            dataclasses.astuple(found), rel=SAME
        )


# --- Bad input ------------------------------------------------------------------------------------------------------


def with_pose(matrix) -> Trajectory:
    poses = curve().T_world_camera.copy()
    poses[7] = matrix
    return Trajectory(curve().timestamps, poses)


def later(seconds: float, count: int = 40) -> Trajectory:
    return Trajectory(curve().timestamps[:count] + seconds, curve().T_world_camera[:count])


@pytest.mark.parametrize(
    ("estimate", "options", "error", "told"),
    [
        (with_pose(np.nan), {}, PoseError, "estimate: pose 7: holds NaN"),
        (with_pose(2 * np.eye(4)), {}, PoseError, "estimate: pose 7"),
        (
            Trajectory(np.array([0, np.inf, 1]), np.tile(np.eye(4), (3, 1, 1))),
            {},
            InputError,
            "time stamp 1 is not a finite",
        ),
        (
            later(1000),
            {},
            InputError,
            "0 of 40 estimated poses lie within 0.02 s .* covers 1000 to 1003.9 s .* 0 to 3.9 s",
        ),
        (later(0, 2), {}, InputError, "2 of 2 estimated poses .* 3 are needed"),
        (later(0, 0), {}, InputError, "0 of 0 estimated poses .* covers nothing"),
        (curve(), {"max_difference": 0.0}, InputError, "max_difference"),
        (curve(), {"rpe_delta": 0}, InputError, "rpe_delta"),
        (curve(), {"rpe_delta": float("nan")}, InputError, "rpe_delta"),
        (curve(), {"rpe_delta": 1.5}, InputError, "whole for frames"),
        (curve(), {"rpe_unit": "feet"}, InputError, "choose frames or metres"),
    ],
)
def test_bad_trajectories_are_told_in_one_sentence(estimate, options, error, told):
    with pytest.raises(error, match=told):
        evaluate_trajectory(estimate, curve(), **options)


def test_where_there_are_no_time_stamps_frames_are_counted_and_not_seconds():
    few = Trajectory(np.array([0.0, 10.0, 20.0]), curve().T_world_camera[:3])
    other = Trajectory(np.array([1.0, 11.0, 21.0]), curve().T_world_camera[:3])
    with pytest.raises(InputError) as error:
        evaluate_trajectory(few, other, max_difference=0.5)
    assert "within 0.5 frames of a true one" in str(error.value)
    assert "covers 0 to 20 frames and the ground truth 1 to 21 frames" in str(error.value)
    with pytest.raises(InputError, match=r"within 0\.5 s of .* covers 0\.25 to 20\.25 s"):
        evaluate_trajectory(
            Trajectory(few.timestamps + 0.25, few.T_world_camera), other, max_difference=0.5
        )
