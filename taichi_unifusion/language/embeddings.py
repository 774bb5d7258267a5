"""Text embeddings from a file: names and their vectors, computed once, no network needed to ask."""

from __future__ import annotations

import csv
import difflib
import re
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError
from ..files.arrays import read_archive, read_array
from ..files.atomic import read_bytes
from ..files.json_text import parse_json
from ..networks.encoders import unit_length

# letters of a word of a name from which it is surely not another word with one more, less or moved,
LONG = 8
VERY_LONG = 10  # or with one exchanged
SHOWN = 3  # names that hold the very word that is asked
SLIP, SURE_SLIP = 0.75, 0.85  # likeness of words with letters in another order, and of other words


@dataclass(frozen=True)
class TextEmbeddings:
    """Names and their vectors; a name is found however it is capitalised and composed, with spaces or
    underscores, without its (remark), or by a synonym that its file lists.
    """

    name: str
    names: tuple[str, ...]
    vectors: NDArray[np.float32]  # (n, c) unit length
    synonyms: Mapping[str, int] = field(default_factory=dict)  # other name -> row

    def text_features(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """(m, c) of the texts; raises InputError, with the nearest names, for one that the file
        does not hold.
        """
        return self.vectors[[self._row(text) for text in texts]]

    def _row(self, text: str) -> int:
        row = self._find(text)
        if row is not None:
            return row
        near = self._spelled_like(_plain(text))
        raise InputError(
            f"{self.name}: has no vector for '{text}'{near}; it holds {len(self.names)} names (query "
            "--list-names prints them), and with a text encoder any text can be asked"
        )

    def _find(self, text: str) -> int | None:
        for plain in (_plain, _bare):  # 'runner (carpet)' before 'runner'
            rows = {plain(name): i for i, name in reversed(list(enumerate(self.names)))}
            if plain(text) in rows:
                return rows[plain(text)]
        return {_plain(name): row for name, row in self.synonyms.items()}.get(_plain(text))

    def _spelled_like(self, word: str) -> str:
        """What may have been meant: names that differ by a slip of the fingers, not other words."""
        names = sorted({_bare(name) for name in self.names} | {*map(_plain, self.synonyms)})
        near = [
            name
            for name in difflib.get_close_matches(word, names, n=6, cutoff=SLIP)
            if sorted(name) == sorted(word)
            or difflib.SequenceMatcher(None, word, name).ratio() >= SURE_SLIP
        ]
        near = near or [
            name for name in names if any(_slipped(word, part) for part in name.split())
        ]
        words = " or ".join(f"'{name}'" for name in near[:2])
        if words:
            return f" (did you mean {words}?)"
        holding = [name for name in names if word in name.split()][:SHOWN]
        words = ", ".join(f"'{name}'" for name in holding)
        return f" (names with that word: {words})" if words else ""

    def listing(self) -> list[tuple[str, tuple[str, ...]]]:
        """Every name, and what else finds it: ('sofa', ('couch', 'lounge'))."""
        others: dict[int, list[str]] = {}
        for word, row in self.synonyms.items():
            if _plain(word) != _plain(self.names[row]):
                others.setdefault(row, []).append(word)
        return [(name, tuple(sorted(others.get(row, ())))) for row, name in enumerate(self.names)]

    def has(self, text: str) -> bool:
        """Whether there is a vector for the text."""
        return self._find(text) is not None

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
        listed, synonyms = [str(name) for name in named], {}
    else:
        vectors = read_array(path)
        beside = [path.with_suffix(suffix) for suffix in (".txt", ".json", ".csv")]
        found = Path(names) if names else next((other for other in beside if other.exists()), None)
        if found is None:
            raise FileError(f"{path}: give the file of its names, with --names")
        listed, synonyms = _read_names(found)
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
    return TextEmbeddings(str(path), tuple(listed), vectors, synonyms)


def _read_names(path: Path) -> tuple[list[str], dict[str, int]]:
    """Names in order, and synonyms of them with their row; a name that two rows have as a synonym is
    the first's.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
        if path.suffix == ".json":
            entries = parse_json(text)
            names = [each["name"] if isinstance(each, dict) else str(each) for each in entries]
            synonyms = {
                str(word): row
                for row, each in reversed(list(enumerate(entries)))
                if isinstance(each, dict) and isinstance(each.get("synonyms"), list)
                for word in each["synonyms"]
            }
            return names, synonyms
        if path.suffix == ".csv":
            return [row[-1] for row in csv.reader(text.splitlines()) if row], {}
        lines = [line.strip() for line in text.splitlines()]
        return [line for line in lines if line and not line.startswith("#")], {}
    except (ValueError, KeyError, TypeError) as error:
        raise FileError(
            f"{path}: not a list of names ({type(error).__name__}: {str(error)[:120]})"
        ) from None


def _slipped(word: str, part: str) -> bool:
    """Whether a word is one of a name with a single slip of the fingers inside: a letter that is missing
    or too many, two that changed places, in very long words another one. Short words and endings make
    other words.
    """
    short, long = sorted((word, part), key=len)
    if len(short) < LONG or (short[0], short[-1]) != (long[0], long[-1]):
        return False
    if len(long) == len(short) + 1:
        return any(long[:i] + long[i + 1 :] == short for i in range(len(long)))
    apart = [i for i, (a, b) in enumerate(zip(short, long, strict=False)) if a != b]
    if len(short) != len(long) or not apart or apart[-1] - apart[0] > 1:
        return False
    return sorted(short) == sorted(long) or (len(apart) == 1 and len(short) >= VERY_LONG)


def _plain(name: str) -> str:
    composed = unicodedata.normalize("NFC", name)
    return " ".join(re.sub(r"[_\s]+", " ", composed).lower().split())


def _bare(name: str) -> str:
    return _plain(re.sub(r"\(.*?\)", " ", name.replace("_", " ")))
