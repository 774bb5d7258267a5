"""Frames that come as they are taken, from a camera or from a recording played at its own frame rate.

A source is anything that gives frames one after the other and waits for the next; it runs in a thread of its
own. `LiveFrames` holds what has arrived and not been asked for: where mapping is slower than the source, the
oldest are dropped, and counted.
"""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import partial

from ..errors import FrameError, InputError
from ..geometry.velocities import FRAME_RATE
from ..types import Frame
from .dataset import Dataset, DatasetView

CAPACITY = 2  # frames that wait; more would only be older when their turn comes
LONGEST_WAIT = 0.1  # [s] before asking again whether to stop
# what a source gives: a frame, why one cannot be used, or a function that returns or raises these
Item = Frame | FrameError | Callable[[], Frame]
LONGEST_PAUSE = 5.0  # [s] between two frames of a replay; a longer gap of a recording is cut short


class Arriving(Sequence[Frame]):
    """A sequence whose frames are still to come; `len` says how many have arrived until now."""

    name: str = "live"
    warnings: tuple[str, ...] = ()

    @abstractmethod
    def arriving(self) -> Iterator[Callable[[], Frame]]:
        """Wait for the frames, one after the other: a function for each that returns it, or raises why it
        cannot be used. Ends where the source does.
        """

    def __getitem__(self, index):
        raise InputError(f"{self.name}: frames of a live source come once and in order")


class LiveFrames(Arriving):
    """The frames of a source, the newest of them where they come faster than they are taken.

        with LiveFrames(source, "my camera") as frames:
            for frame in frames: ...

    `received` and `dropped` count; `stop` is asked while nothing comes. An error of the source ends the
    iteration with it, once the frames before it are taken; a FrameError costs its own frame only.
    """

    def __init__(
        self,
        source: Iterable[Item],
        name: str,
        *,
        capacity: int = CAPACITY,
        stop: Callable[[], bool] = lambda: False,
        most: int | None = None,
    ) -> None:
        if capacity < 1:
            raise InputError(f"{name}: capacity must be at least 1, got {capacity}")
        self.name, self.warnings = name, tuple(getattr(source, "warnings", ()))
        self.received = self.dropped = 0
        self._source, self._capacity, self._stop, self._most = source, capacity, stop, most
        self._waiting: deque[Item] = deque()
        self._change = threading.Condition()
        self._ended, self._failure = False, None
        self._thread = threading.Thread(target=self._receive, name="live", daemon=True)
        self._thread.start()

    def __len__(self) -> int:
        return self.received

    def __enter__(self) -> LiveFrames:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def __iter__(self) -> Iterator[Frame]:
        for load in self.arriving():
            with suppress(FrameError):
                yield load()

    def arriving(self) -> Iterator[Callable[[], Frame]]:
        while (item := self._next()) is not None:
            yield _given(item)

    def close(self) -> None:
        """Let the source end; frames that wait can still be taken."""
        with self._change:
            self._ended = True
            self._change.notify_all()
        if (end := getattr(self._source, "close", None)) is not None:
            with suppress(
                ValueError
            ):  # a generator that is running just now ends with its next frame
                end()

    def _next(self) -> Item | None:
        """The oldest frame that waits, None at the end; waits for one."""
        with self._change:
            while not self._waiting:
                if self._failure is not None:
                    failure, self._failure = self._failure, None
                    raise failure
                if self._ended or self._stop():
                    return None
                self._change.wait(LONGEST_WAIT)
            return self._waiting.popleft()

    def _receive(self) -> None:
        """What the thread does: take frames from the source until it ends."""
        try:
            for item in self._source:
                with self._change:
                    if self._ended:
                        return
                    self.received += 1
                    if len(self._waiting) >= self._capacity:
                        self._waiting.popleft()
                        self.dropped += 1
                    self._waiting.append(item)
                    self._change.notify_all()
                    if self._most is not None and self.received >= self._most:
                        return
        except Exception as error:  # noqa: BLE001 - raised again where frames are taken
            self._failure = error
        finally:
            with self._change:
                self._ended = True
                self._change.notify_all()


class Replay:
    """The frames of a recording at the pace in which they were taken, as a camera gives them.

    `speed` 2 is twice as fast. Where a recording has no time stamps, its frames come at 30 Hz. A frame that
    cannot be read comes as its FrameError; one that is rendered, as a function that renders it.
    """

    def __init__(self, frames: Dataset, speed: float = 1.0) -> None:
        if not speed > 0:
            raise InputError(f"replay: speed must be positive, got {speed}")
        self.frames, self.speed, self.warnings = frames, speed, frames.warnings

    def __iter__(self) -> Iterator[Item]:
        recording = self.frames
        while isinstance(recording, DatasetView):
            recording = recording.dataset
        due, before = time.perf_counter(), None
        for i in range(len(self.frames)):
            item: Item
            stamp = None
            if recording.runs_kernels:  # two threads must not launch kernels at once
                item = partial(self.frames.__getitem__, i)
            else:
                try:
                    item = self.frames[i]
                    stamp = item.timestamp
                except FrameError as error:
                    item = error
            step = 1 / FRAME_RATE
            if stamp is not None:
                step = 0.0 if before is None else min(max(stamp - before, 0), LONGEST_PAUSE)
                before = stamp
            due += step / self.speed
            time.sleep(max(0, due - time.perf_counter()))
            yield item


def _given(item: Item) -> Callable[[], Frame]:
    if callable(item):
        return item

    def load() -> Frame:
        if isinstance(item, FrameError):
            raise item
        return item

    return load
