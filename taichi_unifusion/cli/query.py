"""`unifusion query`: texts -> where they are, as heat-coloured meshes, pictures and ranked boxes."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, UseAppendAction, arg

from ..results.tables import format_table
from .options import TextOptions
from .results_source import holds_folder
from .terminal import report
from .texts import make_encoder, templates_of

if TYPE_CHECKING:
    from ..language.questions import Answer
    from ..results.run_folder import RunFolder

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Query:
    """Find what a text names in a reconstruction: objects, materials, activities.

    Example: unifusion query results/flat "sofa" "something to sit on"

    Each text gives query-TEXT.ply, coloured by relevance, query-TEXT.png, and ranked regions in
    query.json.
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """Results folder of `unifusion understand`."""
    texts: Annotated[
        Positional[tuple[str, ...]], arg(metavar="TEXT...", help_behavior_hint="(one or more)")
    ]
    """What to look for."""
    negative: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(metavar="TEXT", help_behavior_hint="(beside common things; give it once for each)"),
    ] = ()
    """What else may be there: a text is found where it beats all of these."""
    threshold: Annotated[float, arg(metavar="R")] = 0.5
    """Relevance, 0..1, that makes a region; 0.5 is a draw with the strongest of what else may be
    there.
    """
    min_area: Annotated[float, arg(metavar="M2")] = 0.01
    """Regions of less than this area, in square metres, are left out."""
    top: Annotated[int, arg(metavar="N")] = 10
    """Regions to list for each text."""
    encoder: Annotated[TextOptions, arg(name="")] = field(default_factory=TextOptions)


@holds_folder(shared=True)
def query(options: Query) -> int:
    """Texts -> meshes, pictures and regions."""
    from ..errors import InputError

    if not options.texts:
        raise InputError(
            'query: say what to look for, for example: unifusion query results/flat "sofa"'
        )
    from ..files.atomic import check_writable, write_text
    from ..language.questions import ask
    from ..results.folder_writer import FolderWriter
    from ..results.ownership import add_answers
    from ..results.run_folder import RunFolder
    from ..results.understood import read_understood

    understood = read_understood(options.dir, options.encoder.device)
    folder = RunFolder(check_writable(options.dir))
    writer = FolderWriter(folder)
    encoder = make_encoder(options.encoder, understood.features.settings.source, options.dir)
    answers = ask(
        understood.features,
        understood.mesh,
        encoder,
        options.texts,
        negatives=options.negative,
        threshold=options.threshold,
        min_area=options.min_area,
        templates=templates_of(options.encoder),
    )
    from ..files.meshes import write_mesh
    from ..language.pictures import cameras_that_see, heat_mesh
    from ..rendering.preview import render_preview

    listed = []
    for answer in answers:
        mesh, name = heat_mesh(understood.mesh, answer.relevance), file_name(answer.text)
        file, picture = folder.answer_mesh(name), folder.answer_picture(name)
        writer.write(file, lambda path, mesh=mesh: write_mesh(path, mesh))
        cameras = (
            cameras_that_see(understood.trajectory, answer.regions[0].centroid)
            if answer.found
            else understood.trajectory
        )
        writer.write(
            picture,
            lambda path, mesh=mesh, cameras=cameras: render_preview(
                mesh, path, trajectory=cameras, up=understood.outlook.up.direction
            ),
        )
        listed.append({"mesh": file.name, "picture": picture.name, **describe(answer, options.top)})
    text = json.dumps(listed, indent=2)
    writer.write(folder.answers, lambda path: write_text(path, text + "\n"))
    if options.encoder.json:
        print(text)
    else:
        print("\n\n".join([*map(_table, listed), _origin(folder)]))
    writer.attempt(
        f"{folder.record}: could not be updated", lambda: add_answers(folder, writer.written)
    )
    return report(writer.failures)


def describe(answer: Answer, top: int) -> dict[str, Any]:
    """An answer as JSON values."""
    return {
        "text": answer.text,
        "found": answer.found,
        "highest_relevance": round(float(answer.relevance.max(initial=0)), 4),
        "regions": [
            {
                "score": round(region.score, 4),
                "area_m2": round(region.area, 4),
                "centroid": [round(x, 3) for x in region.centroid.tolist()],
                "box": [[round(x, 3) for x in corner] for corner in region.box.tolist()],
            }
            for region in answer.regions[:top]
        ],
        "regions_in_all": len(answer.regions),
    }


def file_name(text: str) -> str:
    """A text as a part of a file's name."""
    kept = "".join(letter if letter.isalnum() else "-" for letter in text.lower())
    return "-".join(part for part in kept.split("-") if part)[:60] or "text"


def _origin(folder: RunFolder) -> str:
    """Where the coordinates of tables begin."""
    from ..errors import FileError
    from ..results.record import read_record
    from ..results.summary import describe_origin

    try:
        return f"x y z from {describe_origin(read_record(folder.record))}"
    except FileError:  # a folder without a record, or a damaged one
        return "x y z in the world of the map"


def _table(entry: dict[str, Any]) -> str:
    if not entry["found"]:
        return (
            f"{entry['text']}: not here; its relevance is {entry['highest_relevance']:.2f} at most, "
            "and something else is nearer everywhere"
        )
    rows = [["rank", "score", "area m2", "centre x y z m", "size m"]]
    for i, region in enumerate(entry["regions"], start=1):
        low, high = region["box"]
        rows.append(
            [
                str(i),
                f"{region['score']:.2f}",
                f"{region['area_m2']:.2f}",
                " ".join(f"{x:.2f}" for x in region["centroid"]),
                " x ".join(f"{b - a:.2f}" for a, b in zip(low, high, strict=True)),
            ]
        )
    more = entry["regions_in_all"] - len(entry["regions"])
    return (
        f"{entry['text']}: {entry['regions_in_all']} region{'s' * (entry['regions_in_all'] != 1)}, {entry['mesh']}, "
        f"{entry['picture']}\n{format_table(rows)}" + (f"\nand {more} more" if more else "")
    )
