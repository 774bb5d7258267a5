"""Pairs items of two recordings by time stamp, one to one, nearest first."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

LONGEST_DIFFERENCE = 1.0  # [s]; with more, pairs mean nothing and their number explodes


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
