"""What watches a run: the protocol, and the one that does not."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from ..pipeline import Pipeline
from ..run_log import SkippedFrame, StepResult
from ..types import Frame


class Watcher(Protocol):
    """Is told what a run does, in the thread that does it."""

    def on_step(self, frame: Frame, step: StepResult, pipeline: Pipeline) -> None:
        """A frame was fused."""

    def on_skip(self, skipped: SkippedFrame) -> None:
        """A frame was not used."""

    def finish(self, directory: Path, stop: Callable[[], bool] = lambda: False) -> None:
        """The run is over, and its results lie in a folder; comes back when nobody watches any
        more, or `stop` says so.
        """

    def close(self) -> None:
        """Nothing more will be told, as after an error."""


class NullViewer:
    """Nobody watches."""

    def on_step(self, frame: Frame, step: StepResult, pipeline: Pipeline) -> None:
        return None

    def on_skip(self, skipped: SkippedFrame) -> None:
        return None

    def finish(self, directory: Path, stop: Callable[[], bool] = lambda: False) -> None:
        return None

    def close(self) -> None:
        return None
