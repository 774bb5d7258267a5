"""Time stamps: their unit, and pairs of items of two recordings, one to one, nearest first.

Counted in nanoseconds since 1970 a stamp has more digits than a float: stamps are whole
nanoseconds here, and become seconds after the first is subtracted.
"""

from __future__ import annotations

from collections.abc import Sequence
from decimal import Decimal
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

LONGEST_DIFFERENCE = 1.0  # [s]; with more, pairs mean nothing and their number explodes
SECONDS = "seconds"
PER_SECOND = {SECONDS: 1, "milliseconds": 10**3, "microseconds": 10**6, "nanoseconds": 10**9}
LARGE = 1e11  # larger is no number of seconds
THIS_AGE = 9e8, 4.2e9  # [s] since 1970: 1998 to 2103
LONGEST_STEP = 1e3  # [s] between two frames; more is another unit
LONGEST_STEP_OF_AGE = 100.0  # [s] for stamps that would be of this age
USUAL_STEP = 1 / 30  # [s]
MOST_DIGITS = 25  # longer is no time


def unit_of(words: Sequence[str]) -> str:
    """The unit of time stamps, finite numbers as text, by their size and the steps between them: a
    key of PER_SECOND.
    """
    stamps = np.unique(np.array([float(word) for word in words]))
    largest = float(np.abs(stamps).max(initial=0.0))
    step = float(np.median(np.diff(stamps))) if len(stamps) > 1 else None
    if largest < LARGE and (step is None or step <= LONGEST_STEP):
        return SECONDS
    units = [unit for unit in PER_SECOND if unit != SECONDS]
    for unit in units:
        of_age = THIS_AGE[0] <= largest / PER_SECOND[unit] <= THIS_AGE[1]
        if of_age and (step is None or step / PER_SECOND[unit] <= LONGEST_STEP_OF_AGE):
            return unit
    if step is None:
        return "nanoseconds" if largest >= 1e17 else "microseconds"
    return min(units, key=lambda unit: abs(np.log(step / PER_SECOND[unit] / USUAL_STEP)))


def to_nanoseconds(word: str, unit: str = SECONDS) -> int:
    """A time stamp, a finite number as text, in whole nanoseconds, no digit of it lost."""
    exact = Decimal(word)
    if exact.adjusted() > MOST_DIGITS:
        raise InputError(f"'{word[:40]}' is no time stamp")
    return round(exact * (10**9 // PER_SECOND[unit]))


def since(nanoseconds: Sequence[int], first: int) -> NDArray[np.float64]:
    """Seconds (N,) from `first` on."""
    return np.array([(stamp - first) / 10**9 for stamp in nanoseconds], np.float64)


def range_of(nanoseconds: Sequence[int]) -> str:
    """The first and the last of stamps, in seconds, for a message."""
    return f"{min(nanoseconds) / 1e9:.6f} to {max(nanoseconds) / 1e9:.6f}"


def associate(
    a: NDArray[np.float64], b: NDArray[np.float64], max_difference: float
) -> NDArray[np.int64]:
    """(P, 2) index pairs into the sorted time stamps a and b [s], in the order of a.

    Of all pairs within `max_difference` the closest is taken first, and each stamp is used once, as
    TUM's benchmark does.
    """
    check_max_difference(max_difference)
    first = np.searchsorted(b, a - max_difference, side="left")
    last = np.searchsorted(b, a + max_difference, side="right")
    count = np.maximum(last - first, 0)
    i = np.repeat(np.arange(len(a)), count)
    j = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - first, count)
    # a stable sort: of equal differences the earlier stamps are paired first
    order = np.argsort(np.abs(a[i] - b[j]), kind="stable")
    free_a, free_b = np.ones(len(a), bool), np.ones(len(b), bool)
    pairs = []
    for k in order:
        if free_a[i[k]] and free_b[j[k]]:
            free_a[i[k]] = free_b[j[k]] = False
            pairs.append((i[k], j[k]))
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def nearest(stamps: NDArray[Any], query: NDArray[Any]) -> NDArray[np.int64]:
    """For each query the index of the nearest of the sorted, non-empty `stamps`, in any unit."""
    right = np.clip(np.searchsorted(stamps, query), 1, max(len(stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps) - 1)
    return np.where(np.abs(query - stamps[left]) <= np.abs(stamps[right] - query), left, right)


def check_max_difference(max_difference: float) -> None:
    """Raise InputError unless 0 < max_difference <= 1 s."""
    if not 0 < max_difference <= LONGEST_DIFFERENCE:
        raise InputError(
            f"max_difference: must be above 0 and at most {LONGEST_DIFFERENCE} s, got {max_difference}"
        )
