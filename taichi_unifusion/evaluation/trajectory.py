"""Trajectory metrics: how far estimated camera poses are from the true ones (Sec. VI-A, Table II;
Sturm et al. 2012).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.time_stamps import associate
from ..types import Trajectory, check_rigid

MAX_DIFFERENCE = 0.02  # [s] of two matched time stamps, as in TUM's benchmark
FEWEST = 3  # matches; with fewer any alignment fits
# singular values below this share of the largest count as 0: positions on a line or in one point
RELATIVE_RANK = 1e-6


@dataclass(frozen=True)
class ErrorStatistics:
    """Of one error over all matched poses or pairs of poses."""

    rmse: float
    mean: float
    median: float
    max: float


@dataclass(frozen=True)
class TrajectoryResult:
    """How an estimated trajectory compares with the true one."""

    # distance of positions after the best rotation and translation (Table II: its RMSE)
    ate_cm: ErrorStatistics
    # after the best rotation, translation and scale; None where the estimate stands still
    ate_sim3_cm: ErrorStatistics | None
    ate_unaligned_cm: ErrorStatistics  # without any alignment
    scale: float | None  # the factor of the estimate in ate_sim3_cm
    # error of the motion over `rpe_delta`; None where the trajectory is shorter
    rpe_translation_cm: ErrorStatistics | None
    rpe_rotation_deg: ErrorStatistics | None
    rpe_delta: float
    rpe_unit: str  # "frames" or "metres"
    matches: int  # poses compared
    estimated_poses: int
    true_poses: int
    T_truth_estimate: tuple[tuple[float, ...], ...]  # 4x4, the alignment of ate_cm
    unique: bool  # whether that alignment is the only one: False for positions on a line


@dataclass(frozen=True)
class Alignment:
    """A similarity transform x -> scale R x + t."""

    R: NDArray[np.float64]  # (3, 3)
    t: NDArray[np.float64]  # (3,)
    scale: float
    unique: bool  # whether no other rotation fits as well

    def __call__(self, points: NDArray) -> NDArray[np.float64]:
        """Points (N, 3) transformed."""
        return self.scale * points @ self.R.T + self.t


def evaluate_trajectory(
    estimate: Trajectory,
    ground_truth: Trajectory,
    *,
    max_difference: float = MAX_DIFFERENCE,
    rpe_delta: float = 1,
    rpe_unit: Literal["frames", "metres"] = "frames",
) -> TrajectoryResult:
    """Compare two trajectories, camera to world, pose by pose.

    Poses are matched by time stamp, the nearest first, within `max_difference` [s]; each counts
    once. ATE is the distance between matched positions, RPE the error of the motion from a matched
    pose to the one `rpe_delta` matched poses later, or to the first that is `rpe_delta` metres of
    the true path farther on.

    Raises PoseError for a matrix that is no rigid transform, InputError for time stamps that are
    not finite, fewer than three matches or a `rpe_delta` that makes no sense.
    """
    estimate, ground_truth = _checked(estimate, "estimate"), _checked(ground_truth, "ground truth")
    if rpe_unit not in ("frames", "metres"):
        raise InputError(f"trajectory: rpe_unit '{rpe_unit}' is unknown, choose frames or metres")
    if not (math.isfinite(rpe_delta) and rpe_delta > 0) or (rpe_unit == "frames" and rpe_delta % 1):
        raise InputError(
            f"trajectory: rpe_delta must be a positive number, whole for frames, got {rpe_delta:g} {rpe_unit}"
        )
    P, Q = match_poses(estimate, ground_truth, max_difference)
    x, y = P[:, :3, 3], Q[:, :3, 3]
    rigid, similar = align(x, y, with_scale=False), align(x, y, with_scale=True)
    moves = np.ptp(x, axis=0).max() > 0
    T_truth_estimate = np.vstack([np.hstack([rigid.R, rigid.t[:, None]]), [0, 0, 0, 1]])
    first, second = _pairs(y, rpe_delta, rpe_unit)
    error = np.linalg.inv(np.linalg.inv(Q[first]) @ Q[second]) @ np.linalg.inv(P[first]) @ P[second]
    return TrajectoryResult(
        ate_cm=_distances(rigid(x), y),
        ate_sim3_cm=_distances(similar(x), y) if moves else None,
        ate_unaligned_cm=_distances(x, y),
        scale=similar.scale if moves else None,
        rpe_translation_cm=_statistics(100 * np.linalg.norm(error[:, :3, 3], axis=1))
        if len(first)
        else None,
        rpe_rotation_deg=_statistics(np.degrees(rotation_angle(error[:, :3, :3])))
        if len(first)
        else None,
        rpe_delta=float(rpe_delta),
        rpe_unit=rpe_unit,
        matches=len(x),
        estimated_poses=len(estimate),
        true_poses=len(ground_truth),
        T_truth_estimate=tuple(tuple(map(float, row)) for row in T_truth_estimate),
        unique=rigid.unique,
    )


def align(source: NDArray, target: NDArray, *, with_scale: bool) -> Alignment:
    """The rotation, translation and, if asked for, scale that take points (N, 3) nearest to others
    (N, 3) in least squares.

    Umeyama 1991. Where the points lie on a line, one of the rotations that do so.
    """
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    a, b = source - source_mean, target - target_mean
    U, spread, Vt = np.linalg.svd(b.T @ a / len(a))
    # a rotation, not a reflection
    flip = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * flip) @ Vt
    variance = float((a**2).sum() / len(a))
    scale = float(spread @ flip / variance) if with_scale and variance > 0 else 1.0
    return Alignment(
        R, target_mean - scale * R @ source_mean, scale, bool(spread[1] > RELATIVE_RANK * spread[0])
    )


def align_poses(source: NDArray, target: NDArray) -> NDArray[np.float64]:
    """The rigid transform (4, 4) that takes poses (N, 4, 4) nearest to others: the mean rotation,
    then the mean translation.

    Orientations count, positions do not turn it: unlike `align` it is well-determined for a camera
    that moves little.
    """
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", target[:, :3, :3], source[:, :3, :3]))
    T = np.eye(4)
    T[:3, :3] = (U * np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])) @ Vt
    T[:3, 3] = (target[:, :3, 3] - source[:, :3, 3] @ T[:3, :3].T).mean(axis=0)
    return T


def rotation_angle(R: NDArray) -> NDArray[np.float64]:
    """Angles (N,) [rad] of rotation matrices (N, 3, 3); exact for small ones too, where the trace
    alone is not.
    """
    sine = 0.5 * np.linalg.norm(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=0
    )
    return np.arctan2(sine, 0.5 * (np.trace(R, axis1=1, axis2=2) - 1))


def _checked(trajectory: Trajectory, name: str) -> Trajectory:
    """The trajectory in time order, every pose and stamp looked at."""
    stamps = np.asarray(trajectory.timestamps, np.float64)
    if not np.isfinite(stamps).all():
        raise InputError(
            f"{name}: time stamp {int(np.argmin(np.isfinite(stamps)))} is not a finite number"
        )
    poses = np.array(
        [check_rigid(T, f"{name}: pose {i}") for i, T in enumerate(trajectory.T_world_camera)]
    ).reshape(-1, 4, 4)
    order = np.argsort(stamps, kind="stable")
    return Trajectory(stamps[order], poses[order])


def match_poses(
    estimate: Trajectory, ground_truth: Trajectory, max_difference: float = MAX_DIFFERENCE
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Poses (N, 4, 4) of both, both in time order, whose stamps belong together; raises InputError
    for fewer than three.
    """
    pairs = match(estimate, ground_truth, max_difference)
    return estimate.T_world_camera[pairs[:, 0]], ground_truth.T_world_camera[pairs[:, 1]]


def match(
    estimate: Trajectory, ground_truth: Trajectory, max_difference: float = MAX_DIFFERENCE
) -> NDArray[np.int64]:
    """Which poses (N, 2) of both belong together, as in `match_poses`."""
    pairs = associate(estimate.timestamps, ground_truth.timestamps, max_difference)
    if len(pairs) < FEWEST:
        both = (estimate, ground_truth)
        # numbers of frames stand in for time stamps where a recording has none
        unit = "frames" if all((t.timestamps % 1 == 0).all() for t in both) else "s"
        spans = [
            f"{t.timestamps[0]:.12g} to {t.timestamps[-1]:.12g} {unit}" if len(t) else "nothing"
            for t in both
        ]
        raise InputError(
            f"trajectory: {len(pairs)} of {len(estimate)} estimated poses lie within {max_difference:g} {unit} of a "
            f"true one, {FEWEST} are needed; the estimate covers {spans[0]} and the ground truth {spans[1]}"
        )
    return pairs


def _pairs(
    positions: NDArray, delta: float, unit: str
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """First and second pose of every pair that is `delta` apart along the true positions (N, 3)."""
    count = len(positions)
    if unit == "frames":
        first = np.arange(max(count - int(delta), 0))
        return first, first + int(delta)
    walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    # rounding must not cost the pair that is exactly delta apart
    second = np.searchsorted(walked, walked + delta * (1 - 1e-9))
    first = np.nonzero(second < count)[0]
    return first, second[first]


def _distances(x: NDArray, y: NDArray) -> ErrorStatistics:
    return _statistics(100 * np.linalg.norm(x - y, axis=1))


def _statistics(errors: NDArray) -> ErrorStatistics:
    return ErrorStatistics(
        float(np.sqrt(np.mean(errors**2))),
        float(errors.mean()),
        float(np.median(errors)),
        float(errors.max()),
    )
