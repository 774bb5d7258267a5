"""Ctrl-C and SIGTERM as a request: finish the current piece of work, keep what is done; the second
one stops at once.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

INTERRUPTED = 130  # exit code

STOPPING = b"\nunifusion: stopping: this frame is finished, then everything is written (once more: stop at once)\n"
CLOSED = b"\nunifusion: closed\n"
STOPPED = b"\nunifusion: error: stopped\n"
SHOW_CURSOR = b"\x1b[?25h"  # progress bars hide it


@contextmanager
def stop_on_signal(
    clean_up: Callable[[], None], *, viewer: bool = False
) -> Iterator[Callable[[], bool]]:
    """Gives a function that says whether a stop was asked for; at a second signal, `clean_up` and
    the end of the process. For a `viewer`, which has nothing to write, this is its usual end.

    The second does not raise KeyboardInterrupt: that may come up in the middle of a clean-up, or
    where Python ignores it.
    """
    requested = threading.Event()

    def handle(number: int, stack: object) -> None:
        if not requested.is_set():
            requested.set()
            # not through sys.stderr or logging: the signal may have interrupted one of their lines
            os.write(2, CLOSED if viewer else STOPPING)
            return
        try:
            clean_up()
            if viewer:
                os._exit(0)
            os.write(2, STOPPED + SHOW_CURSOR if sys.stderr.isatty() else STOPPED)
        finally:
            os._exit(INTERRUPTED)

    # only the main thread may set handlers
    if threading.current_thread() is not threading.main_thread():
        yield requested.is_set
        return
    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield requested.is_set
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
