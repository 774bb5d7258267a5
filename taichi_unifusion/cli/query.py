"""`unifusion query`: texts -> where they are, as heat-coloured meshes, pictures and ranked boxes."""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from ..results.tables import format_table
from .options import TextOptions
from .results_source import holds_folder
from .terminal import report
from .texts import check_fits, make_encoder, templates_of

if TYPE_CHECKING:
    from ..errors import InputError
    from ..language.questions import Answer
    from ..networks.encoders import TextEncoder
    from ..results.folder_writer import FolderWriter
    from ..results.run_folder import RunFolder
    from ..results.understood import Understood

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Query:
    """Find what a text names in a reconstruction: objects, materials, activities.

    Example: unifusion query results/flat "sofa" "something to sit on"

    Each text that is found gives query-TEXT.ply, coloured by relevance, query-TEXT.png, and ranked
    regions in query.json; several together also query.ply with a column each.
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
    list_names: FlagCreatePairsOff[bool] = False
    """Print the names that an embeddings file holds, one a line with its synonyms, and end."""
    encoder: Annotated[TextOptions, arg(name="")] = field(default_factory=TextOptions)


@holds_folder(shared=True)
def query(options: Query) -> int:
    """Texts -> meshes, pictures and regions."""
    from ..errors import InputError

    if options.list_names:
        print(_names(options))
        return 0
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
    texts, unknown = split_known(encoder, options.texts)
    answers = ask(
        understood.features,
        understood.mesh,
        encoder,
        texts,
        negatives=options.negative,
        threshold=options.threshold,
        min_area=options.min_area,
        templates=templates_of(options.encoder),
    )
    listed = [_write_answer(writer, understood, answer, options) for answer in answers]
    listed += [{"text": text, "found": False, "reason": str(why)} for text, why in unknown.items()]
    writer.failures.extend(unknown.values())
    _write_columns(writer, understood, answers)
    text = json.dumps(listed, indent=2)
    writer.write(folder.answers, lambda path: write_text(path, text + "\n"))
    if options.encoder.json:
        print(text)
    else:  # errors say what is unknown
        said = [entry for entry in listed if entry["text"] not in unknown]
        ranked = [_ranking(options.threshold)] * any(entry["found"] for entry in said)
        print("\n\n".join([*map(_table, said), "\n".join([*ranked, _origin(folder)])]))
    writer.attempt(
        f"{folder.record}: could not be updated", lambda: add_answers(folder, writer.written)
    )
    return report(writer.failures)


def _names(options: Query) -> str:
    """What can be asked with the embeddings file given, each name with its synonyms, as lines or JSON;
    raises InputError for another encoder, or where its vectors do not fit the map of features.
    """
    from ..errors import InputError
    from ..language import TEXT_ENCODERS
    from ..language.embeddings import TextEmbeddings
    from ..results.understood import describe_features

    features = describe_features(options.dir)
    text = options.encoder.text or features.source
    if (kind := text.partition(":")[0]) in TEXT_ENCODERS and kind != "embeddings":
        raise InputError(
            f"query: {text} takes any text; --list-names is for --text embeddings:FILE"
        )
    encoder = make_encoder(options.encoder, features.source, options.dir)
    assert isinstance(encoder, TextEmbeddings)
    check_fits(encoder, features, options.dir)
    listing = encoder.listing()
    if options.encoder.json:
        return json.dumps([{"name": name, "synonyms": other} for name, other in listing], indent=2)
    return "\n".join(f"{name}: {', '.join(other)}" if other else name for name, other in listing)


def split_known(
    encoder: TextEncoder, texts: Sequence[str]
) -> tuple[list[str], dict[str, InputError]]:
    """The texts that an encoder has vectors for, and why it has none for the others; raises the first
    of these where there is no text left.
    """
    from ..errors import InputError

    known, unknown = [], {}
    for text in dict.fromkeys(texts):
        try:
            encoder.text_features([text])
            known.append(text)
        except InputError as error:
            unknown[text] = error
    if not known:
        raise next(iter(unknown.values()))
    return known, unknown


def _write_answer(
    writer: FolderWriter, understood: Understood, answer: Answer, options: Query
) -> dict[str, Any]:
    """Mesh and picture of what was found, and what the list of answers says of it. What was not found
    has no files, and those of an earlier question go.
    """
    from ..files.images import write_png
    from ..files.meshes import write_mesh
    from ..language.answers import answer_picture, file_name, why_not_here
    from ..language.pictures import cameras_that_see, heat_mesh
    from ..rendering.preview import choose_views

    name, files = file_name(answer.text), {}
    mesh_file, picture = writer.folder.answer_mesh(name), writer.folder.answer_picture(name)
    described = describe(answer, options.top)
    if not answer.found:
        writer.remove(mesh_file)
        writer.remove(picture)
        why = why_not_here(answer, understood.mesh, options.threshold, options.min_area)
        return {**described, "reason": why}
    mesh = heat_mesh(understood.mesh, answer.relevance)
    cameras = cameras_that_see(understood.trajectory, answer.regions[0].centroid)
    views = choose_views(mesh, trajectory=cameras, up=understood.outlook.up.direction)
    writer.write(mesh_file, lambda path: write_mesh(path, mesh))
    writer.write(
        picture,
        lambda path: write_png(path, answer_picture(mesh, answer.text, answer.regions, views)),
    )
    files = {"mesh": mesh_file.name, "picture": picture.name}
    return {**files, **described}


def _write_columns(writer: FolderWriter, understood: Understood, answers: Sequence[Answer]) -> None:
    """One mesh with the relevance of every text that was found as a column, where there are several."""
    from ..files.meshes import write_mesh
    from ..language.answers import file_name

    found = [answer for answer in answers if answer.found]
    file = writer.folder.answer_columns
    if len(found) < 2:
        writer.remove(file)
        return
    mesh = understood.mesh
    for answer in found:
        column = re.sub(r"[^0-9A-Za-z_]", "_", file_name(answer.text))
        mesh = mesh.with_attribute(f"relevance_{column}", answer.relevance)
    writer.write(file, lambda path: write_mesh(path, mesh))


def describe(answer: Answer, top: int) -> dict[str, Any]:
    """An answer as JSON values."""
    return {
        "text": answer.text,
        "found": answer.found,
        "highest_relevance": round(float(answer.relevance.max(initial=0)), 4),
        "regions": [
            {
                "strength_m2": round(region.strength, 4),
                "score": round(region.score, 4),
                "area_m2": round(region.area, 4),
                "centroid": [round(x, 3) for x in region.centroid.tolist()],
                "box": [[round(x, 3) for x in corner] for corner in region.box.tolist()],
            }
            for region in answer.regions[:top]
        ],
        "regions_in_all": len(answer.regions),
    }


def _ranking(threshold: float) -> str:
    """What regions are ranked by."""
    return f"ranked by strength: (score - {threshold:g}) times the part of the area that is certain"


def _origin(folder: RunFolder) -> str:
    """Where the coordinates of tables begin."""
    from ..errors import FileError
    from ..results.record import read_record
    from ..results.summary import describe_origin

    try:
        return f"origin of x y z: {describe_origin(read_record(folder.record))}"
    except FileError:  # a folder without a record, or a damaged one
        return "origin of x y z: that of the map"


def _table(entry: dict[str, Any]) -> str:
    if not entry["found"]:
        return f"{entry['text']}: not here; {entry['reason']}"
    rows = [["rank", "strength m2", "score", "area m2", "centre x y z m", "size m"]]
    for i, region in enumerate(entry["regions"], start=1):
        low, high = region["box"]
        rows.append(
            [
                str(i),
                f"{region['strength_m2']:.3f}",
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
