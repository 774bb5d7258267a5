"""LZVN, what LZFSE uses for small or simple data: a byte says how many literals follow and how many
bytes are copied from before.
"""

from __future__ import annotations

END, NOTHING = 0x06, (0x0E, 0x16)


def decode_lzvn(data: bytes, out: bytearray, end: int) -> None:
    """Append what the instructions in `data` give, until `out` has `end` bytes.

    Raises ValueError or IndexError for data that are damaged.
    """
    at, distance = 0, 0
    while (code := data[at]) != END:
        if code in NOTHING:
            at += 1
            continue
        literals, length, distance, size = _instruction(data, at, code, distance)
        at += size
        if at + literals > len(data) or len(out) + literals + length > end:
            raise ValueError("an instruction gives more bytes than there are")
        out += data[at : at + literals]
        at += literals
        copy_match(out, distance, length)


def _instruction(data: bytes, at: int, code: int, distance: int) -> tuple[int, int, int, int]:
    """Literals, bytes to copy, how far back they lie, and bytes of the instruction itself."""
    if code >= 0xF0:  # a match at the distance of the last one
        return (0, data[at + 1] + 16, distance, 2) if code == 0xF0 else (0, code & 15, distance, 1)
    if code >= 0xE0:  # literals alone
        return (data[at + 1] + 16, 0, distance, 2) if code == 0xE0 else (code & 15, 0, distance, 1)
    if 0xA0 <= code < 0xC0:
        both = data[at + 1] | data[at + 2] << 8
        return code >> 3 & 3, ((code & 7) << 2 | both & 3) + 3, both >> 2, 3
    if 0x70 <= code < 0x80 or code >= 0xD0:
        raise ValueError(f"{code:#x} is no instruction")
    literals, length, high = code >> 6, (code >> 3 & 7) + 3, code & 7
    if high == 7:
        return literals, length, data[at + 1] | data[at + 2] << 8, 3
    if high == 6:  # the distance of the last match; without literals it means something else
        if not literals:
            raise ValueError(f"{code:#x} is no instruction")
        return literals, length, distance, 1
    return literals, length, high << 8 | data[at + 1], 2


def copy_match(out: bytearray, distance: int, length: int) -> None:
    """Append `length` bytes that start `distance` before the end, which may run into themselves;
    ValueError where that lies before the start.
    """
    if not length:
        return
    if not 0 < distance <= len(out):
        raise ValueError("a match lies before the start")
    start = len(out) - distance
    if distance >= length:
        out += out[start : start + length]
    else:
        out += (bytes(out[start:]) * (length // distance + 1))[:length]
