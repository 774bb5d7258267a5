"""Frames one ahead: a thread reads the next frame while the caller works on the one before."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from ..types import Frame
from . import DatasetView


def load_ahead(sequence: Sequence[Frame]) -> Iterator[Callable[[], Frame]]:
    """One loader a frame, in order; a thread loads the next frame while the caller works on the one
    before.

    Calling the loader returns the frame or raises what loading it raised.
    """
    # launches from two threads must not overlap
    if getattr(recording_of(sequence), "runs_kernels", False):
        yield from (partial(sequence.__getitem__, i) for i in range(len(sequence)))
        return
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="load") as pool:
        ahead = deque()
        for i in range(len(sequence) + 1):
            if i < len(sequence):
                ahead.append(pool.submit(sequence.__getitem__, i))
            if i > 0:
                yield ahead.popleft().result


def recording_of(sequence: Sequence[Frame]) -> Sequence[Frame]:
    """The data set behind views of it."""
    while isinstance(sequence, DatasetView):
        sequence = sequence.dataset
    return sequence


def index_in_recording(sequence: Sequence[Frame], i: int) -> int:
    """The place in the data set behind views of what is frame i of the view."""
    while isinstance(sequence, DatasetView):
        sequence, i = sequence.dataset, sequence.indices[i]
    return i
