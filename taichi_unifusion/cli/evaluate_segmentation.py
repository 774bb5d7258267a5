"""`unifusion evaluate segmentation`: predicted and true labels -> IoU, accuracy."""

from __future__ import annotations

import logging
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from ..errors import InputError
from ..results.tables import format_table
from .options import ScoreOptions
from .scores import check_out, percent, show

if TYPE_CHECKING:
    from ..files.labels import LabelFile

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class EvaluateSegmentation:
    """Compare predicted labels of points with true ones: IoU and accuracy of every class, of seen
    and unseen ones.

    Example: unifusion evaluate segmentation labelled.ply truth.ply --names classes.txt

    Labels are whole numbers: a vertex property of a .ply, one number a line in a .txt, or an array
    in a .npy. Between two .ply of different vertices, each true point takes the label of the
    nearest predicted one.
    """

    predicted: Annotated[Positional[Path], arg(metavar="PREDICTED")]
    """File of predicted labels."""
    ground_truth: Annotated[Positional[Path], arg(metavar="TRUTH")]
    """File of true labels."""
    names: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")] = None
    """Text file of lines 'label name'; true labels without a name are left out."""
    ignore: Annotated[tuple[int, ...], arg(metavar="LABEL")] = (-1,)
    """True labels to leave out."""
    unseen: Annotated[tuple[str, ...], arg(metavar="CLASS")] = ()
    """Labels or names of the classes that a trained method has not seen."""
    attribute: Annotated[str, arg(metavar="NAME")] = "label"
    """Vertex property of a .ply that holds the labels."""
    max_distance: Annotated[float, arg(metavar="M")] = 0.1
    """How far, in metres, a label is carried from one .ply to the other."""
    scores: Annotated[ScoreOptions, arg(name="")] = field(default_factory=ScoreOptions)


def evaluate_segmentation(options: EvaluateSegmentation) -> int:
    """Labels -> table."""
    check_out(options.scores)
    from ..evaluation.segmentation import evaluate_segmentation as evaluate
    from ..files.labels import read_class_names, read_labels

    names = read_class_names(options.names) if options.names else None
    predicted, truth = (
        read_labels(path, options.attribute) for path in (options.predicted, options.ground_truth)
    )
    result = evaluate(
        _on_true_points(predicted, truth, options.max_distance),
        truth.labels,
        names=names,
        ignore=options.ignore,
        unseen=_labels_of(options.unseen, names),
    )
    rows = [["class", "IoU %", "accuracy %", "points"]]
    rows += [
        [
            score.name + ("" if score.seen else " *"),
            percent(score.iou),
            percent(score.accuracy),
            str(score.points),
        ]
        for score in result.classes
    ]
    means = [
        ["mean over", "IoU %", "accuracy %", "classes"],
        [
            "all classes",
            percent(result.mean_iou),
            percent(result.mean_accuracy),
            str(len(result.classes)),
        ],
    ]
    means += [
        [name, percent(group.mean_iou), percent(group.mean_accuracy), str(group.classes)]
        for name, group in (("seen classes", result.seen), ("unseen classes *", result.unseen))
        if group
    ]
    notes = (
        f"{percent(result.overall_accuracy)} % of {result.points:,} points are right; "
        f"{result.unlabelled:,} of them have no predicted label, {result.ignored:,} more were left out."
    )
    about = {
        "metric": "segmentation",
        "predicted": options.predicted,
        "ground_truth": options.ground_truth,
    }
    return show(options.scores, about, result, format_table(rows), format_table(means), notes)


def _on_true_points(predicted: LabelFile, truth: LabelFile, max_distance: float):
    """Predicted labels of the points that have true ones."""
    import numpy as np

    from ..evaluation.segmentation import transfer_labels

    if (
        predicted.points is None
        or truth.points is None
        or np.array_equal(predicted.points, truth.points)
    ):
        return predicted.labels
    logger.info(
        "the vertices differ: labels are carried to the nearest of them, over %g m at most",
        max_distance,
    )
    return transfer_labels(predicted.points, predicted.labels, truth.points, max_distance)


def _labels_of(classes: Collection[str], names: Mapping[int, str] | None) -> tuple[int, ...]:
    """The labels of classes given by label or by name."""
    by_name = {name: label for label, name in (names or {}).items()}
    labels = []
    for item in classes:
        if item not in by_name and not item.lstrip("-").isdecimal():
            known = f"names: {', '.join(by_name)}" if names else "give --names to use names"
            raise InputError(f"segmentation: unseen class '{item}' is unknown; {known}")
        labels.append(by_name.get(item) if item in by_name else int(item))
    return tuple(labels)
