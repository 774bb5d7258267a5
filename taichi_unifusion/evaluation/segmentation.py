"""Segmentation metrics: IoU and accuracy of labels, by class and over seen and unseen classes (Sec.
VI-A, Tables V-VII).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

UNLABELLED = -1  # of a point without a label
MAX_CLASSES = 10_000


@dataclass(frozen=True)
class ClassScore:
    """One class that occurs in the truth."""

    label: int
    name: str
    iou: float  # right / (right + missed + wrongly given), 0..1
    accuracy: float  # right / (right + missed), 0..1
    points: int  # of the truth
    seen: bool  # whether a method was trained with it


@dataclass(frozen=True)
class GroupScore:
    """Means over some classes, each counting once."""

    classes: int
    mean_iou: float
    mean_accuracy: float


@dataclass(frozen=True)
class SegmentationResult:
    """How predicted labels compare with the true ones."""

    mean_iou: float
    mean_accuracy: float  # over classes
    overall_accuracy: float  # over points
    seen: GroupScore | None  # None where no class was said to be unseen, or none of the kind occurs
    unseen: GroupScore | None
    classes: tuple[ClassScore, ...]
    points: int  # compared
    ignored: int  # left out for their true label
    unlabelled: int  # compared, without a predicted label: these count as missed
    labels: tuple[
        int, ...
    ]  # of the rows of `confusion`: all classes with names, if names were given
    confusion: tuple[
        tuple[int, ...], ...
    ]  # points by true and given label; the last column is others


def evaluate_segmentation(
    predicted: NDArray,
    truth: NDArray,
    *,
    names: Mapping[int, str] | None = None,
    ignore: Collection[int] = (UNLABELLED,),
    unseen: Collection[int] = (),
) -> SegmentationResult:
    """Compare labels (N,) of the same points, whole numbers.

    Points whose true label is in `ignore` are left out; where `names` (label -> name) are given, so
    are true labels that have none. Means are over the classes that occur in the truth. A predicted
    label of any other class, -1 among them, makes a point missed, never left out. `unseen` are the
    classes that a trained method did not train with.

    Raises InputError for labels that are no whole numbers or not as many, or where nothing is left
    to compare.
    """
    predicted, truth = _labels(predicted, "predicted labels"), _labels(truth, "true labels")
    if len(predicted) != len(truth):
        raise InputError(
            f"segmentation: {len(predicted)} predicted labels but {len(truth)} true ones; both must be of the "
            "same points"
        )
    labels = _compared_labels(truth, names, ignore, unseen)
    kept = np.isin(truth, labels)
    predicted, truth = predicted[kept], truth[kept]
    return score_confusion(
        confusion_matrix(predicted, truth, labels),
        labels,
        names=names,
        unseen=unseen,
        ignored=int((~kept).sum()),
        unlabelled=int((predicted == UNLABELLED).sum()),
    )


def score_confusion(
    matrix: NDArray[np.int64],
    labels: NDArray[np.int64],
    *,
    names: Mapping[int, str] | None = None,
    unseen: Collection[int] = (),
    ignored: int = 0,
    unlabelled: int = 0,
) -> SegmentationResult:
    """The scores of counts (C, C + 1) as `confusion_matrix` gives them for `labels` (C,).

    Counts of several scenes may be added up first: the scores are then those of all their points
    together. Raises InputError where there is no point.
    """
    of_truth = matrix.sum(axis=1)
    occurs = np.flatnonzero(of_truth)
    if not len(occurs):
        raise InputError("segmentation: there is no point to score")
    right, given = np.diag(matrix), matrix[:, :-1].sum(axis=0)
    classes = tuple(
        ClassScore(
            label := int(labels[i]),
            names[label] if names else str(label),
            float(right[i] / (of_truth[i] + given[i] - right[i])),
            float(right[i] / of_truth[i]),
            int(of_truth[i]),
            label not in unseen,
        )
        for i in occurs
    )
    mean_iou, mean_accuracy = _means(classes)
    return SegmentationResult(
        mean_iou,
        mean_accuracy,
        float(right.sum() / of_truth.sum()),
        _group([score for score in classes if score.seen]) if unseen else None,
        _group([score for score in classes if not score.seen]),
        classes,
        int(of_truth.sum()),
        ignored,
        unlabelled,
        tuple(labels.tolist()),
        tuple(map(tuple, matrix.tolist())),
    )


def _compared_labels(
    truth: NDArray,
    names: Mapping[int, str] | None,
    ignore: Collection[int],
    unseen: Collection[int],
) -> NDArray[np.int64]:
    """The classes (C,) that are compared, sorted: those with names, else those of the truth."""
    known = np.unique(truth)
    labels = known if names is None else np.array(sorted(names), np.int64)
    labels = labels[~np.isin(labels, list(ignore))]
    if not np.isin(known, labels).any():
        raise InputError(
            f"segmentation: no point is left of {len(truth)}; every true label is ignored or has no name"
        )
    if len(labels) > MAX_CLASSES:
        raise InputError(
            f"segmentation: {len(labels)} different true labels; are these labels of classes?"
        )
    for label in unseen:
        if names is not None and label not in names:
            raise InputError(f"segmentation: unseen class {label} is not among the names")
    return labels


def confusion_matrix(predicted: NDArray, truth: NDArray, labels: NDArray) -> NDArray[np.int64]:
    """Counts (C, C + 1): row for the true class, column for the predicted one, the last for labels
    that are none of `labels`.

    `labels` (C,) are sorted, and every true label is one of them.
    """
    count = len(labels)
    row, column = (
        np.searchsorted(labels, truth),
        np.minimum(np.searchsorted(labels, predicted), count - 1),
    )
    column = np.where(labels[column] == predicted, column, count)
    return np.bincount(row * (count + 1) + column, minlength=count * (count + 1)).reshape(
        count, count + 1
    )


def transfer_labels(
    points: NDArray, labels: NDArray, targets: NDArray, max_distance: float = 0.1
) -> NDArray[np.int64]:
    """The label (M,) that each of `targets` (M, 3) takes from the nearest of labelled `points` (N,
    3), all in world [m].

    -1 where none lies within `max_distance` [m]. Raises InputError for points that are not finite
    or not as many as labels.
    """
    from scipy.spatial import KDTree

    labels = _labels(labels, "labels")
    points, targets = _points(points, "labelled points"), _points(targets, "points to label")
    if len(points) != len(labels):
        raise InputError(f"segmentation: {len(points)} points but {len(labels)} labels")
    if not max_distance > 0:
        raise InputError(f"segmentation: max_distance must be above 0 m, got {max_distance}")
    distance, nearest = KDTree(points).query(targets, distance_upper_bound=max_distance)
    return np.where(np.isfinite(distance), labels[np.minimum(nearest, len(labels) - 1)], UNLABELLED)


def _group(scores: Collection[ClassScore]) -> GroupScore | None:
    if not scores:
        return None
    return GroupScore(len(scores), *_means(scores))


def _means(scores: Collection[ClassScore]) -> tuple[float, float]:
    """IoU and accuracy, each class counting once."""
    return float(np.mean([s.iou for s in scores])), float(np.mean([s.accuracy for s in scores]))


def _labels(labels: NDArray, name: str) -> NDArray[np.int64]:
    labels = np.asarray(labels)
    if labels.ndim == 2 and labels.shape[1] == 1:  # as a mesh carries them
        labels = labels[:, 0]
    if labels.ndim != 1 or not len(labels) or labels.dtype.kind not in "iufb":
        raise InputError(
            f"segmentation: {name} must be (N,) whole numbers, got {labels.shape} {labels.dtype}"
        )
    whole = np.rint(labels.astype(np.float64))
    if not (np.isfinite(whole).all() and (np.abs(whole) < 2**53).all() and (whole == labels).all()):
        raise InputError(f"segmentation: {name} hold numbers that are not whole")
    return whole.astype(np.int64)


def _points(points: NDArray, name: str) -> NDArray[np.float64]:
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise InputError(
            f"segmentation: {name} must be (N, 3) finite numbers, at least one, got {points.shape}"
        )
    return points
