"""What a person sees of a command: messages, and a progress bar where stderr is a screen."""

from __future__ import annotations

import io
import logging
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, TextIO

from ..errors import UniFusionError, plain_text

DONE, BUG, FAILED = 0, 1, 2  # exit codes
LINE_INTERVAL = 10.0  # [s] between progress lines where there is no bar

logger = logging.getLogger("taichi_unifusion")


class StderrHandler(logging.Handler):
    """Log records as lines on stderr, above the bar if there is one."""

    def __init__(self) -> None:
        super().__init__()
        self.write_above_bar: Callable[[str], None] | None = None

    def emit(self, record: logging.LogRecord) -> None:
        label = {logging.WARNING: "warning: ", logging.ERROR: "error: "}.get(record.levelno, "")
        message = plain_text(record.getMessage())
        if label:  # one sentence, whatever names of files hold
            message = message.replace("\n", "\\n")
        text = f"unifusion: {label}{message}"
        if record.exc_info:
            text += "\n" + logging.Formatter().formatException(record.exc_info)
        if self.write_above_bar:
            self.write_above_bar(text)
        elif sys.stderr is not None:  # None where it was closed
            sys.stderr.write(text + "\n")
            sys.stderr.flush()


class PlainOutput(io.TextIOBase):
    """Standard output for what commands print: names from files cannot steer the terminal, and
    letters that it lacks are escaped. Nothing is written where it was closed.
    """

    def __init__(self, stream: TextIO | None) -> None:
        self.stream = stream

    def write(self, text: str) -> int:
        if self.stream is not None:
            encoding = getattr(self.stream, "encoding", None) or "utf-8"
            written = plain_text(text).encode(encoding, "backslashreplace").decode(encoding)
            self.stream.write(written)
        return len(text)

    def flush(self) -> None:
        if self.stream is not None:
            self.stream.flush()

    def isatty(self) -> bool:
        return self.stream is not None and self.stream.isatty()


@contextmanager
def log_to_stderr(debug: bool = False) -> Iterator[None]:
    """Show what the package logs while the block runs."""
    handler, level = StderrHandler(), logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG if debug else logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(level)


def report(errors: Sequence[Exception]) -> int:
    """Show errors, and return the exit code that they make."""
    unforeseen = [error for error in errors if not isinstance(error, UniFusionError)]
    for error in errors:
        if error in unforeseen:
            logger.error(
                "an error that nobody foresaw, %s: %s; please report it, with what UNIFUSION_DEBUG=1 shows",
                type(error).__name__,
                " ".join(str(error).split())[:300],
            )
        else:
            logger.error("%s", error)
    return BUG if unforeseen else FAILED if errors else DONE


@contextmanager
def frame_progress(total: int, what: str = "frame") -> Iterator[Callable[[int, int], None]]:
    """Gives a function to call with (frames done, frames in all), or
    `what` else is counted: a bar with rate and time left, or
    now and then a line.
    """
    if not sys.stderr.isatty():
        yield _progress_lines(what)
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        SpinnerColumn(),
        TextColumn(f"{what}s"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar, _above(bar):
        task = bar.add_task(what, total=total, rate="")

        def update(done: int, total: int) -> None:
            speed = bar.tasks[0].speed
            bar.update(task, completed=done, rate=f"{speed:.1f} {what}s/s" if speed else "")

        yield update


@contextmanager
def _above(bar: Any) -> Iterator[None]:
    """Let the log write above a rich bar."""
    handlers = [handler for handler in logger.handlers if isinstance(handler, StderrHandler)]
    for handler in handlers:
        handler.write_above_bar = lambda text: bar.console.print(
            text, markup=False, highlight=False, soft_wrap=True
        )
    try:
        yield
    finally:
        for handler in handlers:
            handler.write_above_bar = None


def _progress_lines(what: str) -> Callable[[int, int], None]:
    first, last = None, -LINE_INTERVAL

    def update(done: int, total: int) -> None:
        nonlocal first, last
        now = time.perf_counter()
        first = first or (now, done)  # rates leave out the first frame, which includes compiling
        if now - last < LINE_INTERVAL and done < total:
            return
        last, rate = now, (done - first[1]) / (now - first[0]) if now > first[0] else 0.0
        left = (
            f", {rate:.1f} {what}s/s, {(total - done) / rate:.0f} s left"
            if rate and done < total
            else ""
        )
        logger.info("%s %d of %d%s", what, done, total, left)

    return update
