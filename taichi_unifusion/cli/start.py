"""Where `unifusion` begins: Ctrl-C and SIGTERM are heard before anything heavy is imported, and do
the same in every command.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
from types import FrameType

INTERRUPTED = 130  # exit code


def main() -> int:
    """Run the command line of this process and return its exit code."""
    open_what_is_closed()
    atexit.register(_hear_no_more)  # runs last
    asked: list[int] = []  # signals that came

    def stop(number: int, frame: FrameType | None) -> None:
        asked.append(number)
        raise KeyboardInterrupt

    for number in (signal.SIGINT, signal.SIGTERM):
        if callable(handler := signal.getsignal(number)) or handler is signal.SIG_DFL:
            signal.signal(number, stop)  # else somebody wants it ignored
    try:
        from .main import main as run

        code = run()
    except (KeyboardInterrupt, Exception) as error:
        # while modules were imported; compiled ones make an ImportError or the like of the first
        if not asked and not isinstance(error, KeyboardInterrupt):
            raise
        os.write(2, b"unifusion: error: stopped\n")
        code = INTERRUPTED

    def end(number: int, frame: FrameType | None) -> None:
        os._exit(code)

    for number in (signal.SIGINT, signal.SIGTERM):  # all is written: nothing is left to stop
        if callable(signal.getsignal(number)):
            signal.signal(number, end)
    return code


def _hear_no_more() -> None:
    """Once Python takes itself apart it hears no signals, and one would end the process by itself:
    ignored, not blocked, since other threads would take what this one blocks.
    """
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)


def open_what_is_closed() -> None:
    """Let standard input, output and error that were closed read and write nothing; else the next files
    that are opened, maps among them, would take their numbers, and get what is printed.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # takes the lowest free number, this one
            if getattr(sys, name) is None:
                mode = "r" if number == 0 else "w"
                setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115
