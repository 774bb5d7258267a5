"""LZFSE, Apple's compression: blocks `bvx-` (stored), `bvxn` (LZVN), `bvx1` and `bvx2` (finite-state
entropy), until `bvx$`.

`liblzfse` (package pyliblzfse) does the same some fifty times faster, and is taken where it is
installed. Sizes are judged before anything is allocated for them; whatever does not fit is a
FrameError.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import NoReturn

from ..errors import FrameError
from .lzvn import copy_match, decode_lzvn

END = b"bvx$"
BLOCK = struct.Struct("<4sI")  # magic, bytes that the block gives
V1 = struct.Struct("<5Ii4HI3H")  # of `bvx1`, after BLOCK and before the frequencies
FREQUENCIES = (20, 20, 64, 256)  # symbols of L, M, D and of literals
STATES = (64, 64, 256, 1024)
L_BITS = (*[0] * 16, 2, 3, 5, 8)
M_BITS = (*[0] * 16, 3, 5, 8, 11)
D_BITS = tuple(i // 4 for i in range(64))
MOST = 40_000  # literals, or matches, of one block as the format bounds them

# (bits to read, what is added to them, symbol) of a state
State = tuple[int, int, int]


@dataclass(frozen=True)
class BlockHeader:
    """What stands before the payload of a block of literals and matches."""

    literals: int
    matches: int
    literal_bytes: int
    literal_bits: int  # -7..0, of the last byte
    literal_states: tuple[int, ...]
    match_bytes: int
    match_bits: int
    match_states: tuple[int, ...]  # of L, M, D
    frequencies: Sequence[int]
    size: int  # [bytes] of the header


@dataclass(frozen=True)
class Block:
    """Where a block's payload lies, and how many bytes it gives."""

    magic: bytes
    gives: int
    start: int
    end: int
    header: BlockHeader | None = None  # of literals and matches


def decompress(data: bytes, size: int, where: str) -> bytes:
    """The `size` bytes that `data` holds, or a FrameError that names `where`."""
    try:
        blocks = list(_blocks(data, size))
        promised = sum(block.gives for block in blocks)
        if promised != size:
            _fail(f"they give {promised} bytes, expected {size}")
        out = _native(data, size) or _decode(data, blocks)
    except (struct.error, IndexError, ValueError) as error:
        raise FrameError(
            f"{where}: the LZFSE data are damaged ({str(error)[:80] or 'cut off'})"
        ) from None
    return bytes(out)


def _native(data: bytes, size: int) -> bytes | None:
    """What the optional package makes of it; None without the package, or where it fails, so that
    ours says why.
    """
    try:
        import liblzfse  # pyright: ignore[reportMissingImports]
    except ImportError:
        return None
    try:
        out = liblzfse.decompress(data)
    except Exception:  # noqa: BLE001 - its errors have no type of their own
        return None
    return out if len(out) == size else None


def _blocks(data: bytes, most: int) -> Iterator[Block]:
    """The blocks of `data`, which together promise no more than `most` bytes."""
    at = 0
    while (magic := data[at : at + 4]) != END:
        gives, header = BLOCK.unpack_from(data, at)[1], None
        if gives > most:
            _fail(f"a block promises {gives} bytes where {most} are left")
        if magic == b"bvx-":
            start, count = at + 8, gives
        elif magic == b"bvxn":
            start, count = at + 12, int.from_bytes(data[at + 8 : at + 12], "little")
        elif magic in (b"bvx1", b"bvx2"):
            header = _header_v1(data, at) if magic == b"bvx1" else _header_v2(data, at)
            start, count = at + header.size, header.literal_bytes + header.match_bytes
        else:
            _fail(f"no block starts with {magic!r}" if magic else "cut off")
        most -= gives
        at = start + count
        if at > len(data):
            _fail("a block is cut off")
        yield Block(magic, gives, start, at, header)


def _decode(data: bytes, blocks: Sequence[Block]) -> bytearray:
    out = bytearray()
    for block in blocks:
        end, payload = len(out) + block.gives, data[block.start : block.end]
        if block.header is not None:
            _decode_block(payload, block.header, out, end)
        elif block.magic == b"bvxn":
            decode_lzvn(payload, out, end)
        else:
            out += payload
        if len(out) != end:
            _fail("a block gives another number of bytes than it promises")
    return out


def _fail(reason: str) -> NoReturn:
    raise ValueError(reason)


def _header_v1(data: bytes, at: int) -> BlockHeader:
    values = V1.unpack_from(data, at + 8)
    start = at + 8 + V1.size
    frequencies = struct.unpack_from(f"<{sum(FREQUENCIES)}H", data, start)
    _, literals, matches, literal_bytes, match_bytes, literal_bits = values[:6]
    match_bits = values[10] - (values[10] >> 31 << 32)
    size = 8 + V1.size + 2 * sum(FREQUENCIES)
    states = values[6:10], values[11:14]
    return BlockHeader(
        *(literals, matches, literal_bytes, literal_bits, states[0]),
        *(match_bytes, match_bits, states[1], frequencies, size),
    )


def _header_v2(data: bytes, at: int) -> BlockHeader:
    first, second, third = struct.unpack_from("<3Q", data, at + 8)

    def bits(word: int, start: int, count: int) -> int:
        return word >> start & ((1 << count) - 1)

    size = bits(third, 0, 32)
    if not 32 <= size <= 32 + 2 * sum(FREQUENCIES):
        _fail("the header of a block has an impossible size")
    return BlockHeader(
        literals=bits(first, 0, 20),
        matches=bits(first, 40, 20),
        literal_bytes=bits(first, 20, 20),
        literal_bits=bits(first, 60, 3) - 7,
        literal_states=tuple(bits(second, 10 * i, 10) for i in range(4)),
        match_bytes=bits(second, 40, 20),
        match_bits=bits(second, 60, 3) - 7,
        match_states=tuple(bits(third, 32 + 10 * i, 10) for i in range(3)),
        frequencies=_frequencies(data[at + 32 : at + size]),
        size=size,
    )


def _frequencies(packed: bytes) -> list[int]:
    """Of all symbols, each in a code of 2, 3, 5, 8 or 14 bits."""
    stream, left = int.from_bytes(packed, "little"), 8 * len(packed)
    found = []
    while len(found) < sum(FREQUENCIES) and packed:
        if not stream & 1:
            count, value = 2, stream >> 1 & 1
        elif not stream & 2:
            count, value = 3, 2 + (stream >> 2 & 1)
        elif not stream & 4:
            count, value = 5, 4 + (stream >> 3 & 3)
        elif not stream & 8:
            count, value = 8, 8 + (stream >> 4 & 15)
        else:
            count, value = 14, 24 + (stream >> 4 & 1023)
        stream >>= count
        left -= count
        if left < 0:
            _fail("the frequencies of a block are cut off")
        found.append(value)
    return found or [0] * sum(FREQUENCIES)


def _states(frequencies: Sequence[int], states: int) -> list[State]:
    """What every state reads, and which symbol it gives; more frequent symbols have more states and
    read fewer bits.
    """
    if sum(frequencies) > states:
        _fail("symbols are more frequent than there are states")
    table = []
    for symbol, frequency in enumerate(frequencies):
        if not frequency:
            continue
        k = states.bit_length() - frequency.bit_length()
        longer = ((2 * states) >> k) - frequency  # states that read k bits, the others one less
        for j in range(frequency):
            if j < longer:
                table.append((k, ((frequency + j) << k) - states, symbol))
            else:
                table.append((k - 1, (j - longer) << (k - 1), symbol))
    return table


class _Bits:
    """The bits of a payload from its end to its start, in windows of 64 for each byte."""

    def __init__(self, payload: bytes, unused: int) -> None:
        if not -7 <= unused <= 0:
            _fail("a payload ends within no byte")
        self.at = 8 * len(payload) + unused
        padded = payload + bytes(8)
        self.windows = [
            int.from_bytes(padded[i : i + 8], "little") for i in range(len(payload) + 1)
        ]


def _decode_block(payload: bytes, header: BlockHeader, out: bytearray, end: int) -> None:
    if max(header.literals, header.matches) > MOST or header.literals % 4:
        _fail("a block has an impossible number of literals or matches")
    middle = header.literal_bytes
    bounds = [0, *accumulate(FREQUENCIES)]
    tables = [_states(header.frequencies[bounds[i] : bounds[i + 1]], STATES[i]) for i in range(4)]
    literals = _literals(_Bits(payload[:middle], header.literal_bits), tables[3], header)
    stream = _Bits(payload[middle:], header.match_bits)
    _copy(stream, tables, header, literals, out, end)


def _literals(stream: _Bits, table: list[State], header: BlockHeader) -> bytearray:
    """All literals: four interleaved sequences of states."""
    windows, at = stream.windows, stream.at
    a, b, c, d = header.literal_states
    found = bytearray()
    add = found.append
    for _ in range(header.literals // 4):
        k, base, symbol = table[a]
        at -= k
        a = base + (windows[at >> 3] >> (at & 7) & ((1 << k) - 1))
        add(symbol)
        k, base, symbol = table[b]
        at -= k
        b = base + (windows[at >> 3] >> (at & 7) & ((1 << k) - 1))
        add(symbol)
        k, base, symbol = table[c]
        at -= k
        c = base + (windows[at >> 3] >> (at & 7) & ((1 << k) - 1))
        add(symbol)
        k, base, symbol = table[d]
        at -= k
        d = base + (windows[at >> 3] >> (at & 7) & ((1 << k) - 1))
        add(symbol)
        if at < 0:
            _fail("the literals of a block are cut off")
    return found


def _copy(
    stream: _Bits,
    tables: list[list[State]],
    header: BlockHeader,
    literals: bytearray,
    out: bytearray,
    end: int,
) -> None:
    """Literals and matches: L bytes of the literals, then M bytes from D before, in turn."""
    windows, at = stream.windows, stream.at
    values = [
        _values(table, extra)
        for table, extra in zip(tables[:3], (L_BITS, M_BITS, D_BITS), strict=True)
    ]
    states, taken, distance = list(header.match_states), 0, 0
    for _ in range(header.matches):
        numbers = []
        for i in range(3):
            k, base, extra, least = values[i][states[i]]
            at -= k + extra
            if at < 0:
                _fail("the matches of a block are cut off")
            both = windows[at >> 3] >> (at & 7) & ((1 << (k + extra)) - 1)
            states[i] = base + (both >> extra)
            numbers.append(least + (both & ((1 << extra) - 1)))
        count, length, new = numbers
        distance = new or distance
        out += literals[taken : taken + count]
        taken += count
        if taken > len(literals) or len(out) + length > end:
            _fail("a block gives more bytes than it promises")
        copy_match(out, distance, length)


def _values(table: list[State], extra: tuple[int, ...]) -> list[tuple[int, int, int, int]]:
    """Of every state: its bits, what is added to them, and the bits and the least of its value."""
    least = [0, *accumulate(1 << bits for bits in extra)]
    return [(k, base, extra[symbol], least[symbol]) for k, base, symbol in table]
