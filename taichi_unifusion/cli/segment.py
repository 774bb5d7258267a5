"""`unifusion segment`: a list of names -> the best of them everywhere, as a coloured mesh with a
legend.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from ..errors import InputError
from ..results.tables import format_table
from .options import OPTIONAL, TextOptions
from .results_source import holds_folder
from .terminal import report
from .texts import make_encoder, templates_of


@dataclass(frozen=True)
class Segment:
    """Label a reconstruction with the best of a list of names at every vertex.

    Example: unifusion segment results/flat --labels names.txt

    Gives segmentation.ply (with the row of the name as `label`), segmentation.png with a legend,
    and segmentation.json.

    With --truth, `unifusion evaluate segmentation` measures the same.
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """Results folder of `unifusion understand`."""
    labels: Annotated[Path, arg(metavar="FILE")]
    """Names, one a line; a line may begin with a number, which then is the label, as in
    '3 kitchen table'.
    """
    truth: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """Points with true labels, a PLY file with a property `label`: IoU and accuracy are measured
    there.
    """
    encoder: Annotated[TextOptions, arg(name="")] = field(default_factory=TextOptions)


@holds_folder(shared=True)
def segment(options: Segment) -> int:
    """Names -> labelled mesh, picture, scores."""
    names = read_labels_file(options.labels)
    from ..files.atomic import check_writable, write_text
    from ..files.images import write_png
    from ..files.meshes import write_mesh
    from ..language.pictures import label_colors, label_mesh, segmentation_picture
    from ..language.questions import segment as segment_points
    from ..results.folder_writer import FolderWriter
    from ..results.ownership import add_answers
    from ..results.run_folder import RunFolder
    from ..results.understood import read_understood

    truth = _read_truth(options.truth) if options.truth else None
    understood = read_understood(options.dir, options.encoder.device)
    folder = RunFolder(check_writable(options.dir))
    writer = FolderWriter(folder)
    encoder = make_encoder(options.encoder, understood.features.settings.source, options.dir)
    found = segment_points(
        understood.features,
        understood.mesh.vertices,
        encoder,
        tuple(names.values()),
        templates=templates_of(options.encoder),
    )
    colors = label_colors(len(names))
    mesh = label_mesh(understood.mesh, found, tuple(names), colors)
    writer.write(folder.segmentation_mesh, lambda path: write_mesh(path, mesh))
    writer.write(
        folder.segmentation_picture,
        lambda path: write_png(
            path, segmentation_picture(mesh, found, colors, understood.outlook.views)
        ),
    )
    summary: dict[str, Any] = {"labels": _shares(names, found, colors)}
    if truth is not None:
        summary["scores"] = _scores(
            understood.features, encoder, names, truth, templates_of(options.encoder)
        )
    text = json.dumps(summary, indent=2)
    writer.write(folder.segmentation, lambda path: write_text(path, text + "\n"))
    print(text if options.encoder.json else _tables(summary, writer.files))
    writer.attempt(
        f"{folder.record}: could not be updated", lambda: add_answers(folder, writer.written)
    )
    return report(writer.failures)


def read_labels_file(path: Path) -> dict[int, str]:
    """Label -> name of a file of names; raises FileError where it holds none, InputError for a name
    or number given twice.
    """
    from ..errors import FileError
    from ..files.atomic import read_bytes

    try:
        lines = read_bytes(path).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise FileError(f"{path}: not a text file") from None
    lines = [" ".join(line.split()) for line in lines]
    lines = [line for line in lines if line and not line.startswith("#")]
    numbered = [line.partition(" ") for line in lines if re.fullmatch(r"[0-9]{1,9} .*", line)]
    if len(numbered) == len(lines):
        names = [(int(number), name) for number, _, name in numbered]
    else:
        names = list(enumerate(lines))
    if not names:
        raise FileError(f"{path}: holds no names; expected one a line")
    for what, values in zip(("number", "name"), zip(*names, strict=True), strict=True):
        value, times = Counter(values).most_common(1)[0]
        if times > 1:
            raise InputError(f"{path}: holds the {what} '{value}' {times} times; each once")
    return dict(names)


def _read_truth(path: Path) -> Any:
    from ..files.mesh_reading import read_mesh

    mesh = read_mesh(path)
    if "label" not in mesh.attributes:
        raise InputError(
            f"{path}: has no vertex property 'label', only {', '.join(mesh.attributes) or 'positions'}"
        )
    return mesh


def _shares(names: Mapping[int, str], found: Any, colors: Any) -> list[dict[str, Any]]:
    """Label, name, colour and share of the vertices of every name."""
    total = max(len(found.labels), 1)
    return [
        {
            "label": label,
            "name": name,
            "color": (255 * colors[i] + 0.5).astype(int).tolist(),
            "share": round(float((found.labels == i).sum() / total), 4),
        }
        for i, (label, name) in enumerate(names.items())
    ]


def _scores(
    features: Any, encoder: Any, names: Mapping[int, str], truth: Any, templates: Any
) -> dict[str, Any]:
    """IoU and accuracy at the true points."""
    import numpy as np

    from ..evaluation.segmentation import evaluate_segmentation
    from ..language.questions import UNLABELLED
    from ..language.questions import segment as segment_points

    found = segment_points(
        features, truth.vertices, encoder, tuple(names.values()), templates=templates
    )
    predicted = np.where(found.labels >= 0, np.array(list(names))[found.labels], UNLABELLED)
    result = evaluate_segmentation(predicted, truth.attributes["label"][:, 0], names=names)
    return {
        "points": result.points,
        "mean_iou": result.mean_iou,
        "mean_accuracy": result.mean_accuracy,
        "overall_accuracy": result.overall_accuracy,
        "classes": [
            {
                "name": score.name,
                "iou": score.iou,
                "accuracy": score.accuracy,
                "points": score.points,
            }
            for score in result.classes
        ],
        "confusion": {"labels": result.labels, "counts": result.confusion},
    }


def _tables(summary: dict[str, Any], files: list[str]) -> str:
    rows = [["label", "name", "share %"]]
    rows += [
        [str(entry["label"]), entry["name"], f"{100 * entry['share']:.1f}"]
        for entry in sorted(summary["labels"], key=lambda entry: -entry["share"])
        if entry["share"] > 0
    ]
    text = format_table(rows)
    if "scores" in summary:
        scores = summary["scores"]
        rows = [["class", "IoU %", "accuracy %", "points"]]
        mean = {
            "name": "mean",
            "iou": scores["mean_iou"],
            "accuracy": scores["mean_accuracy"],
            "points": scores["points"],
        }
        rows += [
            [
                each["name"],
                f"{100 * each['iou']:.1f}",
                f"{100 * each['accuracy']:.1f}",
                f"{each['points']:,}",
            ]
            for each in (*scores["classes"], mean)
        ]
        text += f"\n\n{format_table(rows)}\n{100 * scores['overall_accuracy']:.1f} % of the points are right"
    return f"{text}\n\n{', '.join(files)}"
