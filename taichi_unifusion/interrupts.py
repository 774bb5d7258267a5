"""Ctrl-C and SIGTERM as a request: finish the current piece of work, keep what is done; the second one stops at once."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

MESSAGE = b"\nunifusion: stopping after this frame; what is done is written (once more: stop at once, write nothing)\n"


@contextmanager
def stop_on_signal() -> Iterator[Callable[[], bool]]:
    """Gives a function that says whether a stop was asked for; a second signal raises KeyboardInterrupt."""
    requested = threading.Event()

    def handle(number: int, stack: object) -> None:
        if requested.is_set():
            raise KeyboardInterrupt
        requested.set()
        os.write(2, MESSAGE)  # not through sys.stderr or logging, which may be in the middle of a line

    if threading.current_thread() is not threading.main_thread():  # only the main thread may set handlers
        yield requested.is_set
        return
    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield requested.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
