"""Text embeddings from a file: names and their vectors, computed once, no network needed to ask."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, did_you_mean
from ..files.arrays import read_archive, read_array
from ..files.atomic import read_bytes
from ..files.json_text import parse_json
from ..networks.encoders import unit_length


@dataclass(frozen=True)
class TextEmbeddings:
    """Names and their vectors; a name is found however it is capitalised, with spaces or
    underscores, without its (remark).
    """

    name: str
    names: tuple[str, ...]
    vectors: NDArray[np.float32]  # (n, c) unit length

    def text_features(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """(m, c) of the texts; raises InputError, with the nearest names, for one that the file
        does not hold.
        """
        return self.vectors[[self._row(text) for text in texts]]

    def _row(self, text: str) -> int:
        for plain in (_plain, _bare):  # 'runner (carpet)' before 'runner'
            rows = {plain(name): i for i, name in reversed(list(enumerate(self.names)))}
            if plain(text) in rows:
                return rows[plain(text)]
        near = did_you_mean(_plain(text), [_plain(name) for name in self.names], at_most=3)
        raise InputError(
            f"{self.name}: has no vector for '{text}'{near or '.'} It holds {len(self.names)} names; "
            "with a text encoder any text can be asked"
        )

    def has(self, text: str) -> bool:
        """Whether there is a vector for the text."""
        return _plain(text) in {_plain(name) for name in self.names} | {
            _bare(name) for name in self.names
        }

    @property
    def anything(self) -> NDArray[np.float32]:
        """(c,) what all names have in common: a name must beat it to say something."""
        return unit_length(self.vectors.mean(axis=0))


def read_embeddings(file: str | Path, *, names: str | Path | None = None) -> TextEmbeddings:
    """Read `.npz` with arrays `names` (n,) and `vectors` (n, c), or `.npy` (n, c) with the names in
    another file.

    `names`: .txt with one a line, .csv with them in its last column, or .json with a list of texts
    or of objects with "name"; the file beside the vectors with one of these suffixes without it.
    Raises FileError, InputError where they do not fit.
    """
    path = Path(file)
    if path.suffix == ".npz":
        named, vectors = read_archive(path, ("names", "vectors")).values()
        if named.ndim != 1 or named.dtype.kind != "U":
            raise InputError(
                f"{path}: 'names' must be a list of texts, got {named.shape} {named.dtype}"
            )
        listed = [str(name) for name in named]
    else:
        vectors = read_array(path)
        beside = [path.with_suffix(suffix) for suffix in (".txt", ".json", ".csv")]
        found = Path(names) if names else next((other for other in beside if other.exists()), None)
        if found is None:
            raise FileError(f"{path}: give the file of its names, with --names")
        listed = _read_names(found)
    if (
        vectors.ndim != 2
        or vectors.dtype.kind != "f"
        or len(vectors) != len(listed)
        or not len(listed)
    ):
        raise InputError(
            f"{path}: expected one vector a name, got {vectors.shape} {vectors.dtype} for {len(listed)} names"
        )
    vectors = unit_length(vectors)
    if not np.isfinite(vectors).all():
        bad = listed[int(np.argmin(np.isfinite(vectors).all(axis=1)))]
        raise InputError(f"{path}: the vector of '{bad}' is zero or not finite")
    return TextEmbeddings(str(path), tuple(listed), vectors)


def _read_names(path: Path) -> list[str]:
    try:
        text = read_bytes(path).decode("utf-8-sig")
        if path.suffix == ".json":
            return [
                entry["name"] if isinstance(entry, dict) else str(entry)
                for entry in parse_json(text)
            ]
        if path.suffix == ".csv":
            return [row[-1] for row in csv.reader(text.splitlines()) if row]
        return [
            line.strip() for line in text.splitlines() if line.strip() and not line.startswith("#")
        ]
    except (ValueError, KeyError, TypeError, csv.Error) as error:
        raise FileError(
            f"{path}: not a list of names ({type(error).__name__}: {str(error)[:120]})"
        ) from None


def _plain(name: str) -> str:
    return " ".join(re.sub(r"[_\s]+", " ", name).lower().split())


def _bare(name: str) -> str:
    return _plain(re.sub(r"\(.*?\)", " ", name.replace("_", " ")))
