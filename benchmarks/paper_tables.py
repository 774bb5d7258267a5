"""The paper's tables: its own rows, from `paper/table_N.csv`, and ours below them."""

from __future__ import annotations

import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from paper_experiments import (
    RENDERING,
    S3DIS13,
    S3DIS_CLASSES,
    SCANNET20,
    SCANNET_CLASSES,
    SURFACE,
    TRACKING,
    Classes,
    Experiment,
)
from paper_runs import Results, column, mean
from paper_scenes import LISTS, read_list

from taichi_unifusion.evaluation.segmentation import SegmentationResult, score_confusion

NOTHING = "-"  # a cell where nothing was measured
COUNTS = ("poses", "of frames")  # numbers of things
# of an experiment's name, for one method
ByExperiment = Mapping[str, Results]


@dataclass(frozen=True)
class Table:
    """A table of the paper, and what fills ours in."""

    number: str
    title: str
    experiments: tuple[Experiment, ...]
    # name of a method, results by experiment, the paper's header -> rows
    rows: Callable[[str, ByExperiment, Sequence[str]], list[list[str]]]
    # further numbers of ours that the paper does not print, means over scenes
    more: tuple[str, ...] = ()


def paper_rows(number: str) -> list[list[str]]:
    """Header and rows as the paper prints them."""
    return list(csv.reader(read_list(LISTS / f"table_{number}.csv")))


def cell(value: float | None, digits: int = 2) -> str:
    return NOTHING if value is None else f"{value:.{digits}f}"


def _surface_rows(method: str, results: ByExperiment, header: Sequence[str]) -> list[list[str]]:
    found = results[SURFACE.name]
    return [[method, *(cell(mean(column(found, name))) for name in header[1:])]]


def _tracking_rows(method: str, results: ByExperiment, header: Sequence[str]) -> list[list[str]]:
    found = results[TRACKING.name].done
    errors = (found.get(name, {}).get("ATE RMSE cm") for name in header[1:])
    return [[method, *(cell(error, 1) for error in errors)]]


def _rendering_rows(method: str, results: ByExperiment, header: Sequence[str]) -> list[list[str]]:
    found = results[RENDERING.name]
    return [
        [
            method,
            metric,
            *(cell(found.done.get(name, {}).get(metric)) for name in header[2:-1]),
            # comparable with the paper's if it is of the same scenes
            cell(mean(column(found, metric)) if set(header[2:-1]) <= set(found.done) else None),
        ]
        for metric in ("Depth L1 cm", "PSNR dB")
    ]


def pooled(results: Results | None, classes: Classes) -> SegmentationResult | None:
    """The scores of all points of all scenes together; None where none is done."""
    if results is None or not results.done:
        return None
    counts = [numbers["confusion"]["counts"] for numbers in results.done.values()]
    labels = np.array(next(iter(results.done.values()))["confusion"]["labels"])
    return score_confusion(
        np.sum(counts, axis=0), labels, names=classes.names, unseen=classes.unseen
    )


def _mean_iou_rows(method: str, results: ByExperiment, header: Sequence[str]) -> list[list[str]]:
    cells = []
    for experiment, classes in ((SCANNET_CLASSES, SCANNET20), (S3DIS_CLASSES, S3DIS13)):
        scores = pooled(results.get(experiment.name), classes)
        for group in (scores and scores.seen, scores and scores.unseen, scores):
            cells.append(cell(100 * group.mean_iou if group else None, 1))
    return [[method, *cells]]


def _class_rows(
    experiment: Experiment, classes: Classes
) -> Callable[[str, ByExperiment, Sequence[str]], list[list[str]]]:
    def rows(method: str, results: ByExperiment, header: Sequence[str]) -> list[list[str]]:
        scores = pooled(results.get(experiment.name), classes)
        by_name = {score.name: score for score in scores.classes} if scores else {}
        unseen = scores.unseen if scores else None
        lines = []
        for metric, of_class, of_group in (
            ("IoU %", "iou", "mean_iou"),
            ("accuracy %", "accuracy", "mean_accuracy"),
        ):
            shares = [
                getattr(by_name[name], of_class) if name in by_name else None
                for name in header[2:-1]
            ]
            shares.append(getattr(unseen, of_group) if unseen else None)
            cells = [cell(None if share is None else 100 * share, 1) for share in shares]
            lines.append([method, metric, *cells])
        return lines

    return rows


TABLES: dict[str, Table] = {
    table.number: table
    for table in (
        Table(
            "I",
            "surface of the 312 validation scans of ScanNet: accuracy, completeness, F1 within 2.5 cm",
            (SURFACE,),
            _surface_rows,
            (
                "of what was seen: accuracy %",
                "completeness %",
                "F1 2.5 cm %",
                "F1 1 cm %",
                "surface map MB",
                "mesh MB",
                "ms a frame",
            ),
        ),
        Table(
            "II",
            "camera tracking on three sequences of TUM RGB-D: ATE RMSE [cm]",
            (TRACKING,),
            _tracking_rows,
            ("poses", "of frames", "tracking s"),
        ),
        Table(
            "III",
            "rendered depth and colour of the eight scenes of Replica: depth L1, PSNR",
            (RENDERING,),
            _rendering_rows,
            (
                "Depth L1 cm",
                "PSNR dB",
                "SSIM",
                "coverage %",
                "F1 1 cm %",
                "surface map MB",
                "color map MB",
                "ms a frame",
            ),
        ),
        Table(
            "V",
            "zero-shot segmentation of ScanNet (20 classes) and S3DIS (13): mean IoU in per cent of "
            "seen, unseen and all classes",
            (SCANNET_CLASSES, S3DIS_CLASSES),
            _mean_iou_rows,
            ("mean IoU %", "features map MB", "ms a frame"),
        ),
        Table(
            "VI",
            "zero-shot segmentation of ScanNet: IoU and accuracy of the four unseen classes",
            (SCANNET_CLASSES,),
            _class_rows(SCANNET_CLASSES, SCANNET20),
        ),
        Table(
            "VII",
            "zero-shot segmentation of S3DIS: IoU and accuracy of the four unseen classes",
            (S3DIS_CLASSES,),
            _class_rows(S3DIS_CLASSES, S3DIS13),
        ),
    )
}


def more_rows(table: Table, found: Mapping[str, ByExperiment]) -> list[list[str]]:
    """What else was measured of ours, means over the scenes, by method and experiment."""
    rows = []
    for method, by_experiment in found.items():
        for name, results in by_experiment.items():
            cells = (
                cell(mean(column(results, title)), 0 if title in COUNTS else 2)
                for title in table.more
            )
            rows.append([method, name, str(len(results.done)), *cells])
    return [["method", "experiment", "scenes", *table.more], *rows] if table.more else []


def summary(table: Table, found: Mapping[str, ByExperiment]) -> dict[str, Any]:
    """Everything as JSON values: the paper's rows, ours, and every scene's numbers."""
    header, *paper = paper_rows(table.number)
    return {
        "table": table.number,
        "title": table.title,
        "header": header,
        "paper": paper,
        "ours": [row for name, each in found.items() for row in table.rows(name, each, header)],
        "scenes": {
            method: {
                name: {
                    "said": list(results.said),
                    "done": results.done,
                    "failed": results.failed,
                    "missing": list(results.missing),
                }
                for name, results in each.items()
            }
            for method, each in found.items()
        },
    }
