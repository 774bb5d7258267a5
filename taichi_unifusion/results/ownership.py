"""Which files of a results folder runs have written: only these may be replaced or removed.

`metrics.json` lists them. While a run writes, a mark stands in its place, which lists them too: so a
run that is killed then is seen by whoever reads the folder, and the next one knows what to replace.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import FileError
from ..files.atomic import read_bytes, write_text
from .record import SCHEMA_VERSION, UNFINISHED, read_record, write_record
from .run_folder import RunFolder

MOST_BYTES = 64 << 20  # of a record that is read


def owned_files(folder: RunFolder) -> frozenset[str]:
    """The files that runs have written into a folder, its record included, relative to it; none
    where the record is missing or makes no sense.
    """
    values = _json(folder.record)
    if not isinstance(values, dict) or not isinstance(values.get("files"), dict | list):
        return frozenset()
    names = [folder.relative(folder.record), *values["files"]]
    for key in ("answers", "earlier_files"):
        names += values[key] if isinstance(values.get(key), list) else []
    names += _answers(folder)
    return frozenset(name for name in names if isinstance(name, str) and folder.could_write(name))


def strangers(folder: RunFolder, wanted: Iterable[Path]) -> list[str]:
    """What stands in the way of `wanted` files and was written by no run, relative to the folder."""
    owned = owned_files(folder)
    there = [folder.relative(file) for file in wanted if file.exists() or file.is_symlink()]
    return sorted(set(there) - owned)


def mark_unfinished(folder: RunFolder, files: Collection[str]) -> None:
    """Put a mark in the place of the record: a run writes `files`, or has written them; raises
    FileError.
    """
    mark = {"schema_version": SCHEMA_VERSION, UNFINISHED: True, "files": sorted(files)}
    write_text(folder.record, json.dumps(mark, indent=2) + "\n")


def is_unfinished(folder: RunFolder) -> bool:
    """Whether a run was ended while it wrote into the folder, or still does."""
    values = _json(folder.record)
    return isinstance(values, dict) and bool(values.get(UNFINISHED))


def add_answers(folder: RunFolder, files: Iterable[Path]) -> None:
    """Let the record list the answers to questions that were put to the maps, so that the next run
    removes them; nothing where there is no record. Raises FileError where it cannot be written.
    """
    try:
        record = read_record(folder.record)
    except FileError:
        return
    answers = tuple(sorted({*record.answers, *map(folder.relative, files)}))
    if answers != record.answers:
        write_record(folder.record, replace(record, answers=answers))


def answer_files(folder: RunFolder) -> tuple[Path, ...]:
    """The answers that exist and that questions have left, as the record or their own list says: a
    file with such a name may be the user's.
    """
    owned = owned_files(folder) | set(_answers(folder))
    return tuple(file for file in folder.asked if folder.relative(file) in owned)


def describe_earlier(folder: RunFolder) -> str:
    """What a further run would replace, in words; "" where no run has written here."""
    owned = {name for name in owned_files(folder) if (folder.path / name).exists()}
    if not owned:
        return ""
    maps = [name for name, file in folder.maps.items() if folder.relative(file) in owned]
    held = [f"{'map' if len(maps) == 1 else 'maps'} {', '.join(maps)}"] * bool(maps)
    held += ["a mesh"] * any(folder.relative(file) in owned for file in folder.meshes)
    held += ["answers"] * any(folder.relative(file) in owned for file in folder.asked)
    ended = "what is left of a run that was ended" if is_unfinished(folder) else "an earlier run"
    return f"{ended} ({'; '.join(held or ['no map'])})"


def _answers(folder: RunFolder) -> list[str]:
    """Answers as their own files name them: records of older versions do not."""
    names: list[str] = []
    asked = _json(folder.answers)
    if isinstance(asked, list) and all(isinstance(each, dict) and "text" in each for each in asked):
        names.append(folder.relative(folder.answers))
        there = {folder.relative(file) for file in folder.asked}
        told = [each[key] for each in asked for key in ("mesh", "picture") if key in each]
        names += [name for name in told if isinstance(name, str) and name in there]
    segmented = _json(folder.segmentation)
    if isinstance(segmented, dict) and "labels" in segmented:
        names += [folder.relative(file) for file in folder.segmentation_files]
    return names


def _json(path: Path) -> Any:
    """The values of a JSON file; None where there are none."""
    try:
        if path.stat().st_size > MOST_BYTES:
            return None
        return json.loads(read_bytes(path))
    except (OSError, ValueError, RecursionError):
        return None
