"""What a run is about to replace in its results folder."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

from ..config import Config
from .options import OutputOptions

if TYPE_CHECKING:
    from ..results import RunFolder

logger = logging.getLogger(__name__)


def say_what_is_replaced(
    folder: RunFolder, output: OutputOptions, settings: Config, features: bool, tracked: bool
) -> None:
    """Warn where the folder holds an earlier run; raises FileError where it holds what is no run's."""
    from ..results.ownership import describe_earlier
    from ..results.writer import check_free

    if not output.overwrite:
        check_free(folder, settings, features, tracked)
    if output.into is not None and output.into.resolve() == folder.path.resolve():
        return
    if earlier := describe_earlier(folder):
        logger.warning(
            "%s holds %s: this run replaces it when it is done; another --out keeps it",
            folder.path,
            earlier,
        )
