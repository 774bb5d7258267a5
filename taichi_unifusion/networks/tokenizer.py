"""CLIP's byte-pair tokens, for text encoders that were exported without their tokenizer."""

from __future__ import annotations

import gzip
import io
import re
import zlib
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError
from ..files.atomic import read_bytes

MERGES = 49152 - 256 - 2  # that CLIP uses; the published list is longer
MAX_BYTES = 16 << 20  # of the list; the published one has 3 MB, of which the beginning is used
WORD_END = "</w>"
PIECES = re.compile(
    r"<\|startoftext\|>|<\|endoftext\|>|'s|'t|'re|'ve|'m|'ll|'d|[^\W\d_]+|\d|(?:[^\s\w]|_)+",
    re.IGNORECASE,
)


class ClipTokenizer:
    """Texts -> token numbers, with the merges that CLIP was trained with
    (`bpe_simple_vocab_16e6.txt.gz`, or `merges.txt`).
    """

    def __init__(self, file: str | Path) -> None:
        self.file = Path(file)
        pairs = _read_merges(self.file)
        letters = [
            letter for _, letter in sorted(_BYTE_LETTERS.items(), key=lambda item: _order(item[0]))
        ]
        tokens = [
            *letters,
            *(letter + WORD_END for letter in letters),
            *("".join(pair) for pair in pairs),
        ]
        self.ranks = {pair: rank for rank, pair in enumerate(pairs)}
        self.numbers = {token: number for number, token in enumerate(tokens)}
        self.start, self.end = len(tokens), len(tokens) + 1

    def __call__(self, texts: Sequence[str], length: int = 77) -> NDArray[np.int64]:
        """(n, length): start, tokens, end, and zeros; raises InputError for a text of more tokens."""
        rows = np.zeros((len(texts), length), np.int64)
        for row, text in zip(rows, texts, strict=True):
            numbers = [self.start, *self._encode(text), self.end]
            if len(numbers) > length:
                raise InputError(
                    f"text '{text[:60]}': has {len(numbers)} tokens, the text encoder takes {length}; shorten it"
                )
            row[: len(numbers)] = numbers
        return rows

    def _encode(self, text: str) -> list[int]:
        found = []
        for piece in PIECES.findall(" ".join(text.lower().split())):
            spelled = "".join(_BYTE_LETTERS[byte] for byte in piece.encode())
            found += [self.numbers[token] for token in self._merge(spelled)]
        return found

    def _merge(self, word: str) -> tuple[str, ...]:
        """The word's tokens: pairs are joined in the order in which they were learned."""
        if word in self._known:
            return self._known[word]
        parts = (*word[:-1], word[-1] + WORD_END)
        while len(parts) > 1:
            pair = min(
                zip(parts, parts[1:], strict=False),
                key=lambda pair: self.ranks.get(pair, len(self.ranks)),
            )
            if pair not in self.ranks:
                break
            joined, i = [], 0
            while i < len(parts):
                both = parts[i : i + 2] == pair
                joined.append("".join(pair) if both else parts[i])
                i += 2 if both else 1
            parts = tuple(joined)
        self._known[word] = parts
        return parts

    @cached_property
    def _known(self) -> dict[str, tuple[str, ...]]:
        return {}


def _read_merges(path: Path) -> list[tuple[str, str]]:
    data = read_bytes(path)
    try:
        if data[:2] == b"\x1f\x8b":
            with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
                data = file.read(MAX_BYTES + 1)
        text = data.decode("utf-8")
    except (OSError, EOFError, zlib.error, UnicodeDecodeError):
        raise FileError(f"{path}: not a list of byte-pair merges, or a damaged file") from None
    if len(data) > MAX_BYTES:
        raise FileError(f"{path}: unpacks to more than any list of merges holds")
    # the first line is a version
    lines = [line.split() for line in text.splitlines()[1 : MERGES + 1]]
    pairs = [(line[0], line[1]) for line in lines if len(line) == 2]
    if not pairs or len(pairs) < len(lines) - 1:
        raise FileError(
            f"{path}: expected one pair of tokens a line, as in CLIP's bpe_simple_vocab_16e6.txt.gz"
        )
    return pairs


def _printable(byte: int) -> bool:
    return 33 <= byte <= 126 or 161 <= byte <= 172 or 174 <= byte <= 255


def _order(byte: int) -> tuple[bool, int]:
    """Printable bytes come first in the vocabulary."""
    return not _printable(byte), byte


def _byte_letters() -> dict[int, str]:
    """A printable letter for every byte: itself where it is printable, else one beyond Latin-1, in
    order.
    """
    others = [byte for byte in range(256) if not _printable(byte)]
    return {
        byte: chr(byte) if _printable(byte) else chr(256 + others.index(byte))
        for byte in range(256)
    }


_BYTE_LETTERS = _byte_letters()
