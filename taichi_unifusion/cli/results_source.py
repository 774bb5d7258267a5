"""Results folders as viewers use them, with the text encoder that the command line names."""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..results.lock import lock_folder
from ..results.run_folder import RunFolder
from .options import EncoderOptions

if TYPE_CHECKING:
    from ..viewer.results_scene import SceneOptions
    from ..viewer.source import ResultsSource

logger = logging.getLogger(__name__)

Command = Callable[[Any], int]


def holds_folder(*, shared: bool = False) -> Callable[[Command], Command]:
    """Makes a command hold the results folder `options.dir` while it runs, unless it writes
    elsewhere, into `options.out`; see `lock_folder`.
    """

    def holding(command: Command) -> Command:
        @wraps(command)
        def held(options: Any) -> int:
            if getattr(options, "out", None) is not None or not options.dir.is_dir():
                return command(options)
            with lock_folder(RunFolder(options.dir), shared=shared):
                return command(options)

        return held

    return holding


def results_source(path: Path, scene: SceneOptions, encoder: EncoderOptions) -> ResultsSource:
    """A results folder, with the text encoder that is asked for or belongs to its features."""
    from ..viewer.source import ResultsSource
    from .texts import make_encoder

    if not _can_encode(path, encoder.text):
        return ResultsSource(path, scene)
    return ResultsSource(
        path, scene, lambda source, directory: make_encoder(encoder, source, directory)
    )


def _can_encode(path: Path, text: str | None) -> bool:
    """Whether questions can be put to a results folder: it holds features, and there is an encoder
    for the words.
    """
    from ..maps.stored import read_description

    features = RunFolder(path).features
    if not features.exists():
        return False
    source = read_description(features).source
    if text is None and not source.startswith("clip:"):
        logger.info(
            "%s: holds features of %s; to ask, give the text encoder that belongs to them, with --text",
            path,
            source or "an unknown network",
        )
        return False
    return True
