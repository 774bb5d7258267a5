"""Coarse-to-fine colored ICP of a frame against one or several others (Sec. V-A.1; Park et al.
2017).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from .pyramid import SurfelPyramid

ITERATIONS = (8, 10, 12)  # at most, by level, finest first
GATES = (0.04, 0.08, 0.16)  # [m] farthest distance of an inlier from the other's plane
USED_WIDTH = 160  # [px] a wider source image is thinned to at least this many pixels a row
MAX_ANGLE = 25.0  # [degrees] between the normals of inliers
ROBUST_WIDTH = 1.0  # [standard deviations] a distance that counts half
# [m, rad] a step below it ends a level, finest first: coarse ones only have to lead into the next
CONVERGED = (1e-4, 1e-3, 2e-3)
FIRST_SIGMA, LEAST_SIGMA = 0.05, 0.005  # of intensities in [0, 1]
DAMPING = 1e-9  # times the trace: keeps the equations solvable where a direction is open
MAX_UNCERTAINTY = 0.05  # [m] of the translation in its weakest direction
# largest ratio of the translation's uncertainty in its weakest and its best direction; rooms have 2
# to 6, near and low reliefs up to 11.3, blank walls 14 to 66
MAX_AMBIGUITY = 12.0
# errors of neighbouring pixels are correlated: an image counts as this many independent
# measurements, whatever its size
INDEPENDENT = 192.0


@dataclass(frozen=True)
class Registration:
    """Where a source frame lies relative to a target frame, and how well it fits there."""

    T_target_source: NDArray[np.float64]  # (4, 4)
    fitness: float  # share of the source's surfels that are inliers
    rmse: float  # of the inliers' distances from the target's planes [m]
    overlap: float  # share of the source's surfels that meet surfels of the target
    information: NDArray[np.float64]  # (6, 6) of a twist on the left of T_target_source

    @property
    def agreement(self) -> float:
        """Share of the surfels in view that are inliers."""
        return self.fitness / self.overlap if self.overlap > 0 else 0.0

    @property
    def uncertainty(self) -> NDArray[np.float64]:
        """Standard deviations (3,) [m] of the translation along its principal axes, best first;
        infinite where it is open.
        """
        values, vectors = np.linalg.eigh(self.information)
        if values[0] <= 0:
            return np.full(3, np.inf)
        covariance = (vectors / values) @ vectors.T
        return np.sqrt(np.linalg.eigvalsh(covariance[:3, :3]))

    @property
    def determined(self) -> bool:
        """Whether the frame fixes the camera's position; along a blank wall only the noise of its
        normals would.
        """
        best, _, weakest = self.uncertainty
        return bool(weakest < MAX_UNCERTAINTY and weakest < MAX_AMBIGUITY * best)


@dataclass(frozen=True, eq=False)
class Target:
    """A frame to align to, and where it lies in the frame of reference of the result."""

    pyramid: SurfelPyramid
    T_target_reference: NDArray[np.float64]


def register(
    source: SurfelPyramid,
    targets: SurfelPyramid | Sequence[Target],
    T_reference_source: NDArray,
    photometric_weight: float = 0.1,
) -> Registration:
    """Align `source` to the targets together, from the guess `T_reference_source`, by Gauss-Newton
    on SE(3).

    Minimises point-to-plane distances, weighted by a Kinect's noise, and intensity differences,
    weighted by a t distribution whose scale is estimated on the way. A single pyramid is its own
    reference.
    """
    targets = [Target(targets, np.eye(4))] if isinstance(targets, SurfelPyramid) else targets
    T, sigma = np.array(T_reference_source, np.float64), FIRST_SIGMA
    for level in reversed(range(len(source.levels))):
        for _ in range(ITERATIONS[level]):
            equations = _sum(source, targets, T, level, sigma, photometric_weight)
            sigma = equations.sigma
            damping = DAMPING * np.trace(equations.H) + 1e-6
            twist = -np.linalg.solve(equations.H + damping * np.eye(6), equations.b)
            T = se3.normalized(se3.exp(twist) @ T)
            if np.abs(twist).max() < CONVERGED[level]:
                break
    return _result(T, _sum(source, targets, T, 0, sigma, photometric_weight))


def evaluate(
    source: SurfelPyramid, target: SurfelPyramid, T_target_source: NDArray, level: int = 0
) -> Registration:
    """How well `source` fits at a given pose."""
    return _result(
        T_target_source,
        _sum(source, [Target(target, np.eye(4))], T_target_source, level, FIRST_SIGMA, 0.0),
    )


@dataclass(frozen=True)
class _Equations:
    """H twist = -b of one Gauss-Newton step, and the counts summed with it."""

    H: NDArray[np.float64]  # (6, 6)
    b: NDArray[np.float64]  # (6,)
    counts: NDArray[np.float64]  # (SUMS,) columns as in kernels/registration.py
    sigma: float  # of intensity residuals
    pixels: float  # used pixels of the source, with or without a reading


def _sum(
    source: SurfelPyramid,
    targets: Sequence[Target],
    T_reference_source: NDArray,
    level: int,
    sigma: float,
    weight: float,
) -> _Equations:
    from ..kernels import registration as kernels

    H, b, counts = np.zeros((6, 6)), np.zeros(6), np.zeros(kernels.SUMS)
    image = source.levels[level]
    # use every `step`-th pixel of every `step`-th row
    step = max(1, image.camera.width // USED_WIDTH)
    for target in targets:
        other = target.pyramid.levels[level]
        rows = -(-image.camera.height // step)
        sums = np.empty((-(-rows // kernels.BLOCK_ROWS), kernels.SUMS), np.float32)
        kernels.sum_normal_equations(
            image.surfels,
            other.surfels,
            image.camera.intrinsics,
            other.camera.intrinsics,
            (target.T_target_reference @ T_reference_source)[:3],
            step,
            GATES[level],
            float(np.cos(np.radians(MAX_ANGLE))),
            ROBUST_WIDTH,
            sigma,
            weight if source.colored and target.pyramid.colored else 0.0,
            sums,
        )
        total = sums.sum(axis=0, dtype=np.float64)
        A = se3.adjoint(target.T_target_reference)
        H += A.T @ _symmetric(total[: kernels.H_SIZE]) @ A
        b += A.T @ total[kernels.H_SIZE : kernels.SOURCE]
        counts += total
    if counts[kernels.COLORED] > 0:
        sigma = max(
            float(np.sqrt(counts[kernels.PHOTOMETRIC_SCALE] / counts[kernels.COLORED])), LEAST_SIGMA
        )
    return _Equations(H, b, counts, sigma, image.camera.width * image.camera.height / step**2)


def _result(T: NDArray, equations: _Equations) -> Registration:
    from ..kernels import registration as kernels

    of, inliers = max(equations.counts[kernels.SOURCE], 1.0), equations.counts[kernels.INLIERS]
    rmse = (
        float(np.sqrt(equations.counts[kernels.SQUARED_DISTANCE] / inliers))
        if inliers
        else float("inf")
    )
    return Registration(
        np.asarray(T, np.float64),
        inliers / of,
        rmse,
        equations.counts[kernels.IN_VIEW] / of,
        equations.H * (INDEPENDENT / equations.pixels),
    )


def _symmetric(upper: NDArray) -> NDArray[np.float64]:
    """The (6, 6) matrix of its upper triangle, row by row."""
    H = np.zeros((6, 6))
    H[np.triu_indices(6)] = upper
    return H + np.triu(H, 1).T
