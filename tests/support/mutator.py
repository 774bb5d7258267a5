"""Mutations of files, for fuzzing: what discs, networks, editors and hostile people do to them."""

from __future__ import annotations

import random
import re
import struct

NUMBERS = (0, 1, 2, 127, 128, 255, 256, 32767, 65535, 2**31 - 1, 2**31, 2**32 - 1, 2**63)
WORDS = (
    b"-1",
    b"0",
    b"1e999",
    b"nan",
    b"99999999999999999999",
    b"\x00",
    b"[" * 3000,
    b"9" * 5000,
    b"\xff\xfe",
    b"null",
    b"true",
    b'""',
    b"{}",
    b"-0.0",
    b"../../x",
)
TEXT_NUMBER = re.compile(rb"-?[0-9]+(\.[0-9]+)?")


def mutate(data: bytes, seed: int) -> bytes:
    """One to three changes of `data`, the same for the same seed."""
    chance = random.Random(seed)
    for _ in range(chance.choice((1, 1, 1, 2, 3))):
        data = chance.choice(CHANGES)(data, chance)
    return data


def _place(data: bytes, chance: random.Random) -> int:
    """Mostly where headers are."""
    end = len(data) if chance.random() < 0.5 else min(len(data), 256)
    return chance.randrange(max(end, 1))


def _flip(data: bytes, chance: random.Random) -> bytes:
    changed, at = bytearray(data or b"\0"), _place(data, chance)
    changed[at] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _number(data: bytes, chance: random.Random) -> bytes:
    """A number of some width, big- or little-endian, that is at an edge."""
    size, order = chance.choice((1, 2, 4, 8)), chance.choice(("little", "big"))
    at, value = _place(data, chance), chance.choice(NUMBERS) % 256**size
    return data[:at] + value.to_bytes(size, order) + data[at + size :]


def _float(data: bytes, chance: random.Random) -> bytes:
    at, value = _place(data, chance), chance.choice((float("nan"), float("inf"), -1.0, 1e30))
    packed = struct.pack(chance.choice(("<f", ">d")), value)
    return data[:at] + packed + data[at + len(packed) :]


def _cut(data: bytes, chance: random.Random) -> bytes:
    return data[: chance.randrange(len(data) + 1)]


def _remove(data: bytes, chance: random.Random) -> bytes:
    at = _place(data, chance)
    return data[:at] + data[at + chance.randint(1, 16) :]


def _repeat(data: bytes, chance: random.Random) -> bytes:
    at, size = _place(data, chance), chance.randint(1, 64)
    return data[:at] + data[at : at + size] * chance.randint(2, 4) + data[at + size :]


def _noise(data: bytes, chance: random.Random) -> bytes:
    at, noise = _place(data, chance), chance.randbytes(chance.randint(1, 32))
    return data[:at] + noise + data[at + len(noise) :]


def _word(data: bytes, chance: random.Random) -> bytes:
    """A number in a text, or something anywhere, becomes another word."""
    found = list(TEXT_NUMBER.finditer(data[:100_000]))
    if not found or chance.random() < 0.2:
        at = _place(data, chance)
        return data[:at] + chance.choice(WORDS) + data[at:]
    match = chance.choice(found)
    return data[: match.start()] + chance.choice(WORDS) + data[match.end() :]


def _line(data: bytes, chance: random.Random) -> bytes:
    lines = data.splitlines(keepends=True)
    if len(lines) < 2:
        return _remove(data, chance)
    a, b = chance.randrange(len(lines)), chance.randrange(len(lines))
    lines[a], lines[b] = lines[b], lines[a]
    if chance.random() < 0.5:
        del lines[a]
    return b"".join(lines)


CHANGES = (_flip, _number, _float, _cut, _remove, _repeat, _noise, _word, _line)
