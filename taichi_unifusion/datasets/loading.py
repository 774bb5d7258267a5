"""Loading ahead: a thread reads the next frame while the caller works on the current one."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from ..errors import InputError, shortened
from ..types import Frame
from .dataset import DatasetView
from .live import Arriving

FIRST, STRIDE = 5, 5  # of the first frames: how many tell the scale, and how far apart they are


def check_sequence(what: str, sequence: object) -> None:
    """Raise InputError for what cannot be indexed as a sequence of frames."""
    if isinstance(sequence, Frame):
        raise InputError(
            f"{what}: expected a sequence of frames, got one Frame: give [frame], or use step(frame)"
        )
    indexed = hasattr(sequence, "__len__") and hasattr(sequence, "__getitem__")
    if not indexed or isinstance(sequence, str | bytes | dict):
        raise InputError(
            f"{what}: expected a sequence of frames, as open_dataset gives or a list, got {shortened(sequence)}"
        )


def load_ahead(sequence: Sequence[Frame], start: int = 0) -> Iterator[Callable[[], Frame]]:
    """Yield one function for each frame from `start`, in order: it returns the frame, or raises what
    loading the frame raised. A thread loads the next frame meanwhile. Frames that are still to come
    are waited for.
    """
    if isinstance(sequence, Arriving):
        yield from sequence.arriving()
        return
    # two threads must not launch kernels at once: load each frame in the caller's thread
    if getattr(recording_of(sequence), "runs_kernels", False):
        yield from (partial(sequence.__getitem__, i) for i in range(start, len(sequence)))
        return
    with ThreadPoolExecutor(max_workers=1, thread_name_prefix="load") as pool:
        ahead = deque()
        for i in range(start, len(sequence) + 1):
            if i < len(sequence):
                ahead.append(pool.submit(sequence.__getitem__, i))
            if i > start:
                yield ahead.popleft().result


def first_frames(sequence: Sequence[Frame], stop: Callable[[], bool]) -> Iterator[Frame]:
    """Some of the first frames of a sequence, those that can be loaded, until `stop` says so."""
    for i in range(0, min(len(sequence), FIRST * STRIDE), STRIDE):
        if stop():
            return
        try:
            frame = sequence[i]
        except Exception:  # noqa: BLE001 - whoever loads the frame in its turn hears of it
            continue
        if isinstance(frame, Frame):
            yield frame


def recording_of(sequence: Sequence[Frame]) -> Sequence[Frame]:
    """The data set that a view, or a view of a view, shows."""
    while isinstance(sequence, DatasetView):
        sequence = sequence.dataset
    return sequence


def index_in_recording(sequence: Sequence[Frame], i: int) -> int:
    """Index in the underlying data set of frame `i` of a view."""
    while isinstance(sequence, DatasetView):
        sequence, i = sequence.dataset, sequence.indices[i]
    return i
