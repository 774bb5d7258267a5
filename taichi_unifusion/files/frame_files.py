"""Which file belongs to which frame: by its name, or by the number in it."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from ..errors import DatasetError, FrameError
from .text_rows import finite_or_none

_SUFFIX = re.compile(r"\.[A-Za-z][A-Za-z0-9]*$")
_DIGITS = re.compile(r"[0-9]+")


def list_names(folder: Path) -> list[str]:
    """The names in `folder`, sorted; DatasetError if it is no folder that can be read."""
    try:
        return sorted(os.listdir(folder))
    except FileNotFoundError:
        raise DatasetError(f"{folder}: no such folder") from None
    except NotADirectoryError:
        raise DatasetError(f"{folder}: is a file, expected a folder") from None
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be listed ({error.strerror})") from error


def first_existing(paths: Iterable[Path]) -> Path | None:
    """The first of the paths that exists."""
    return next((path for path in paths if path.exists()), None)


# Files of a known pattern, by frame number


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Frame number -> file for the names that match `pattern`, whose group 1 is the number."""
    match = re.compile(pattern).fullmatch
    return {int(found[1]): folder / name for name in list_names(folder) if (found := match(name))}


def file_of(number: int, found: dict[int, Path], folder: Path, template: str) -> Path:
    """The file of frame `number`, or where it should be: named by the template, with the suffix
    that others have.
    """
    if number in found:
        return found[number]
    missing = folder / template.format(number)
    return missing.with_suffix(next(iter(found.values())).suffix) if found else missing


# Files of any names


def stem_of(name: str) -> str:
    """A file's name without its folder and suffix: "a/frame-7.depth.png" -> "frame-7.depth"."""
    return _SUFFIX.sub("", os.path.basename(name))


def number_of(name: str) -> int | None:
    """The frame number in a name: the last one in its stem; None where there is none, or where the
    stem is a number with a point, a time stamp.
    """
    stem = stem_of(name)
    digits = _DIGITS.findall(stem)
    if not digits or ("." in stem and finite_or_none(stem) is not None):
        return None
    return int(digits[-1])


def in_order(stems: Iterable[str]) -> list[str]:
    """Stems as people count: by value if all are numbers (time stamps), else with the numbers in
    them by value.
    """
    stems = list(stems)
    if all(finite_or_none(stem) is not None for stem in stems):
        return sorted(stems, key=lambda stem: (float(stem), stem))
    return sorted(
        stems,
        key=lambda stem: [
            int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", stem))
        ],
    )


def files_by_stem(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """Stem -> file for the names that end so, whatever their case, hidden ones left out.

    Raises DatasetError where two files bear one name, or `folder` is none.
    """
    found: dict[str, Path] = {}
    for name in list_names(folder):
        if name.startswith(".") or not name.lower().endswith(tuple(suffixes)):
            continue
        other = found.setdefault(Path(name).stem, folder / name)
        if other.name != name:
            raise DatasetError(
                f"{folder}: {other.name} and {name} are two files of one name, keep one"
            )
    return found


@dataclass(frozen=True)
class FrameFolder:
    """One file a frame in a folder, under the frame's name or its number."""

    folder: Path
    files: dict[str, Path]  # by stem

    def file_of(self, frame_name: str, index: int) -> Path | None:
        """The file with the name of the frame's image, else with the number in that name (`index`
        if it has none); None where there is no such file.

        Raises FrameError where two files have that number.
        """
        file = self.files.get(stem_of(frame_name))
        if file is not None:
            return file
        number = number_of(frame_name)
        numbered = self._by_number.get(index if number is None else number, [])
        if len(numbered) > 1:
            raise FrameError(
                f"{self.folder}: {numbered[0].name} and {numbered[1].name} have the same number; "
                f"name the file after the frame, {stem_of(frame_name) or index}"
            )
        return numbered[0] if numbered else None

    @cached_property
    def _by_number(self) -> dict[int | None, list[Path]]:
        found: dict[int | None, list[Path]] = {}
        for path in self.files.values():
            found.setdefault(number_of(path.name), []).append(path)
        return found
