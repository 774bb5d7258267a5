"""What a command that makes maps has in its hands while it runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from .options import RunOptions

if TYPE_CHECKING:
    from ..language import EncoderChoice
    from ..networks.encoders import ImageEncoder
    from ..pipeline import Pipeline
    from ..results import RunFolder
    from ..results.saver import RunSaver
    from ..run_log import RunResult
    from ..viewer.null import Watcher
    from .viewing import WatchOptions


class MapOptions(RunOptions, Protocol):
    """The options of a command that makes maps of a recording."""

    @property
    def watch(self) -> WatchOptions: ...
    @property
    def image_encoder(self) -> EncoderChoice | None: ...


@dataclass(frozen=True)
class Run:
    """A run into a folder that is locked for it: what is asked for, what saves it, what watches it, and
    what says that it is to stop.
    """

    options: MapOptions
    folder: RunFolder
    saver: RunSaver
    encoder: ImageEncoder | None  # of image-text features, if they are mapped
    watcher: Watcher
    stop: Callable[[], bool]


@dataclass(frozen=True)
class Mapped:
    """Maps of a recording, and what made them."""

    pipeline: Pipeline
    run: RunResult
    tracking: Mapping[str, Any] | None  # what to say of poses in the record
    written: tuple[Path, ...]  # files that are in the folder already
