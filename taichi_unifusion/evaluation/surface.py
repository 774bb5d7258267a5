"""Surface metrics: how near a reconstruction lies to the truth and how much of the truth it covers
(Sec. VI-A, Table I).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.triangles import SurfaceDistance, sample_surface
from ..rendering.mesh_checks import check_mesh
from ..types import Mesh
from .viewpoints import Viewpoints, points_within_view

SAMPLES = 100_000
THRESHOLDS = (0.025, 0.01)  # [m] the paper's, and one that a 5 cm voxel has to earn
# [m] a true point counts as seen up to this far behind the surface of its pixel: rounding
OCCLUSION_TOLERANCE = 0.005
# [m] reconstructed surface counts up to this far behind the true one: 2.5 sigma of a Kinect at 5 m
BEHIND = 0.1
APART = 1.0  # [m] meshes farther apart than this cannot be of one place
POOL = 4  # times as many samples are drawn if a crop will remove some


@dataclass(frozen=True)
class ThresholdScore:
    """Shares, 0..1, within one distance. Table I calls precision Accuracy and recall Completeness."""

    threshold: float  # [m]
    precision: float  # of the reconstruction that lies within the threshold of the truth
    recall: float  # of the truth that lies within the threshold of the reconstruction
    f1: float  # their harmonic mean


@dataclass(frozen=True)
class SurfaceResult:
    """How a reconstructed surface compares with the true one."""

    accuracy_cm: float  # mean distance from the reconstruction to the truth
    completeness_cm: float  # mean distance from the truth to the reconstruction
    chamfer_cm: float  # mean of these two
    scores: tuple[ThresholdScore, ...]
    reconstruction_points: int  # that were counted
    ground_truth_points: int
    reconstruction_unseen: float  # share of the reconstruction, 0..1, that the crop leaves out
    ground_truth_unseen: float  # share of the truth that the crop leaves out


def evaluate_surface(
    reconstruction: Mesh,
    ground_truth: Mesh,
    *,
    views: Viewpoints | None = None,
    thresholds: Sequence[float] = THRESHOLDS,
    samples: int = SAMPLES,
    seed: int = 0,
    distance_to: Literal["surface", "samples"] = "surface",
) -> SurfaceResult:
    """Compare two meshes by `samples` points drawn evenly from each, both in world coordinates [m].

    Distances are to the other *surface*. "samples" measures to its samples instead, as published:
    the same where they lie dense, but 100,000 samples of 100 m^2 of surface are 3 cm apart, and
    even a perfect mesh fails a threshold of 1 cm.

    With `views`, only what those cameras could tell is compared:
    * a true point counts if a camera saw it: inside the image, in the depth range, nothing of the
      truth in front of it;
    * a reconstructed point counts if a camera looked at its place: inside the image, in the depth
      range, and in front of the true surface on that ray or at most 10 cm behind it. So surface
      invented in free space, beyond an edge or as a second wall is an error; what lies outside
      every image, or deeper behind what was seen, is neither right nor wrong;
    * its distance is to the *whole* true surface, so that correct surface is never counted as wrong
      because of the crop.

    Raises InputError for a mesh that is empty or not finite, for meshes that are nowhere near each
    other, or where the cameras saw nothing of the truth or looked at nothing of the reconstruction.
    """
    if samples < 1 or not len(thresholds) or not all(np.isfinite(t) and t > 0 for t in thresholds):
        raise InputError(
            f"surface: needs samples >= 1 and thresholds above 0 m, got {samples} and {list(thresholds)}"
        )
    if distance_to not in ("surface", "samples"):
        raise InputError(
            f"surface: distance_to '{distance_to}' is unknown, choose surface or samples"
        )
    reconstruction, ground_truth = (
        check_mesh(reconstruction, "reconstruction"),
        check_mesh(ground_truth, "ground truth"),
    )
    _check_overlap(reconstruction, ground_truth)
    rng = np.random.default_rng(seed)
    pool = samples * (POOL if views else 1)
    drawn = tuple(
        sample_surface(mesh.vertices, mesh.faces, pool, rng)
        for mesh in (reconstruction, ground_truth)
    )
    seen = tuple(np.ones(len(points), bool) for points in drawn)
    if views:
        seen = points_within_view(views, ground_truth, drawn, (BEHIND, OCCLUSION_TOLERANCE))
        _check_seen(*seen)
    of_reconstruction, of_truth = (
        _thin(points[mask], samples, rng) for points, mask in zip(drawn, seen, strict=True)
    )
    if distance_to == "surface":
        to_truth = SurfaceDistance(ground_truth.vertices, ground_truth.faces)(of_reconstruction)
        to_reconstruction = SurfaceDistance(reconstruction.vertices, reconstruction.faces)(of_truth)
    else:
        to_truth = _distance_to_samples(of_reconstruction, drawn[1][:: POOL if views else 1])
        to_reconstruction = _distance_to_samples(of_truth, drawn[0][:: POOL if views else 1])
    accuracy, completeness = 100 * float(to_truth.mean()), 100 * float(to_reconstruction.mean())
    return SurfaceResult(
        accuracy,
        completeness,
        (accuracy + completeness) / 2,
        tuple(_score(float(t), to_truth, to_reconstruction) for t in thresholds),
        len(of_reconstruction),
        len(of_truth),
        *(1 - float(mask.mean()) for mask in seen),
    )


def _score(threshold: float, to_truth: NDArray, to_reconstruction: NDArray) -> ThresholdScore:
    precision, recall = (
        float((to_truth < threshold).mean()),
        float((to_reconstruction < threshold).mean()),
    )
    return ThresholdScore(
        threshold, precision, recall, 2 * precision * recall / max(precision + recall, 1e-12)
    )


def _thin(points: NDArray, count: int, rng: np.random.Generator) -> NDArray:
    """At most `count` of the points."""
    return (
        points
        if len(points) <= count
        else points[np.sort(rng.choice(len(points), count, replace=False))]
    )


def _distance_to_samples(points: NDArray, samples: NDArray) -> NDArray[np.float64]:
    from scipy.spatial import KDTree

    return KDTree(samples).query(points)[0]


def _check_overlap(reconstruction: Mesh, ground_truth: Mesh) -> None:
    spans = [
        (
            mesh.vertices[mesh.faces].reshape(-1, 3).min(axis=0),
            mesh.vertices[mesh.faces].reshape(-1, 3).max(axis=0),
        )
        for mesh in (reconstruction, ground_truth)
    ]
    (low, high), (true_low, true_high) = spans
    if (low > true_high + APART).any() or (high < true_low - APART).any():

        def text(span):
            return " x ".join(f"{a:.4g}..{b:.4g}" for a, b in zip(*span, strict=True))

        raise InputError(
            f"surface: the meshes do not overlap, the reconstruction spans {text(spans[0])} and the ground truth "
            f"{text(spans[1])}; are both in metres and in the same frame of reference?"
        )


def _check_seen(reconstruction: NDArray, ground_truth: NDArray) -> None:
    if not ground_truth.any():
        raise InputError(
            "surface: the cameras see nothing of the ground truth; are poses and mesh in the same frame of "
            "reference?"
        )
    if not reconstruction.any():
        raise InputError(
            "surface: the cameras look at nothing of the reconstruction; are poses and mesh in the same frame of "
            "reference?"
        )
