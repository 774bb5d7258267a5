"""Finding the numbered files of a recording."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable
from pathlib import Path

from ..errors import DatasetError


def list_names(folder: Path) -> list[str]:
    """The names in `folder`, sorted; DatasetError if it is no folder that can be read."""
    try:
        return sorted(os.listdir(folder))
    except FileNotFoundError:
        raise DatasetError(f"{folder}: no such folder") from None
    except NotADirectoryError:
        raise DatasetError(f"{folder}: is a file, expected the folder of a recording") from None
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be listed ({error.strerror})") from error


def numbered_files(folder: Path, pattern: str) -> dict[int, Path]:
    """Frame number -> file for the names that match `pattern`, whose group 1 is the number."""
    match = re.compile(pattern).fullmatch
    return {int(found[1]): folder / name for name in list_names(folder) if (found := match(name))}


def first_existing(paths: Iterable[Path]) -> Path | None:
    """The first of the paths that exists."""
    return next((path for path in paths if path.exists()), None)


def file_of(number: int, found: dict[int, Path], folder: Path, template: str) -> Path:
    """The file of frame `number`, or where it should be: named by the template, with the suffix
    that others have.
    """
    if number in found:
        return found[number]
    missing = folder / template.format(number)
    return missing.with_suffix(next(iter(found.values())).suffix) if found else missing
