"""Powers of two that bring a property's values to where sums in cells, which are whole numbers, are
fine enough and have room: a time stamp of 1e9 s as well as a probability of 1e-9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..types import Frame
from .base_map import BaseMap

# Of the largest value: between them values are summed as they are, in steps of 6e-8; others are
# brought to the upper one, below which sums of two million pixels have room for values four times as large.
LEAST, MOST, ROOM = -8, 16, 18  # exponents of two
FINE = 12  # bits that the largest value of a frame must have
STEP_BITS = 24  # of the steps in which latents are summed exactly
FARTHEST = 120  # of an exponent, so that two to it is an ordinary float32


def exponent_of(largest: float) -> int:
    """The exponent e such that values / 2^e are summed, where none is larger than this."""
    if largest == 0 or 2.0**LEAST <= largest <= 2.0**MOST:
        return 0
    return max(-FARTHEST, min(FARTHEST, math.frexp(largest)[1] - MOST))


def by_channel(maps: Sequence[BaseMap], exponents: Sequence[int]) -> tuple[int, ...]:
    """One for each channel of the maps, of one for each map; none where all are 0."""
    if not any(exponents):
        return ()
    return tuple(e for each, e in zip(maps, exponents, strict=True) for _ in range(each.channels))


def exponents_for(maps: Sequence[BaseMap], frame: Frame) -> tuple[int, ...]:
    """For each channel of the maps, by what a frame carries."""
    return by_channel(maps, [exponent_of(frame.largest.get(each.name, 1.0)) for each in maps])


def steps_for(exponents: Sequence[int]) -> float:
    """Steps of 1 that are fine enough for values of these exponents: 2^-24 of the largest."""
    return 2.0 ** (STEP_BITS - min([0, *(e + MOST for e in exponents if e < 0)]))


def fits(maps: Sequence[BaseMap], exponents: Sequence[int], frame: Frame) -> bool:
    """Whether what a frame carries can be added to sums of these exponents, one for each channel:
    there is room, and it is not lost between their steps.
    """
    first = 0
    for each in maps:
        e, size = exponents[first] if exponents else 0, frame.largest.get(each.name, 1.0)
        if size and not math.ldexp(1, e - FINE) <= size <= math.ldexp(1, e + ROOM):
            return False
        first += each.channels
    return True
