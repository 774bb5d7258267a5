"""Recordings in the formats that people have: `open_dataset("tum", path)` gives frames that can be
indexed and sliced.
"""

from __future__ import annotations

import difflib
import inspect
import os
from collections.abc import Iterable
from importlib import import_module
from pathlib import Path

from ..errors import DatasetError, InputError
from .base import Dataset, DatasetView

FORMATS = {  # name -> module here, what opens a recording
    "synthetic": ("synthetic", "SyntheticRoom"),
    "7scenes": ("seven_scenes", "open_seven_scenes"),
    "replica": ("replica", "open_replica"),
    "tum": ("tum", "open_tum"),
    "scannet": ("scannet", "open_scannet"),
    "k4a": ("k4a", "open_k4a"),
    "folder": ("folder", "open_folder"),
    "scene": ("scene", "open_scene"),
}

__all__ = ["FORMATS", "Dataset", "DatasetView", "open_dataset"]


def open_dataset(format: str, path: str | Path | None = None, **options) -> Dataset:
    """Open the recording at `path`; frames are read when indexed.

    Recordings take `depth_scale` (units a metre), `camera` (a PinholeCamera of the depth images)
    and `drop_alpha`, "tum" and "folder" also `max_difference` [s]; "k4a" takes `align`,
    `depth_scale` and `max_difference`; "synthetic" and "scene" are rendered and have options of
    their own. Raises DatasetError for an unknown format, a path that does not exist or holds no
    such recording, InputError for an unknown option.
    """
    if format not in FORMATS:
        raise DatasetError(
            f"format '{format}' is unknown{_suggest(format, FORMATS)}; formats: {', '.join(FORMATS)}"
        )
    module, name = FORMATS[format]
    opener = getattr(import_module(f".{module}", __name__), name)
    parameters = inspect.signature(opener).parameters
    known = [key for key in parameters if key not in ("self", "path")]
    for option in options:
        if option not in known:
            raise InputError(
                f"option '{option}' is unknown for format '{format}'{_suggest(option, known)}; "
                f"options: {', '.join(known)}"
            )
    if path is None:
        if parameters["path"].default is inspect.Parameter.empty:
            raise DatasetError(f"format '{format}' needs the path of a recording")
        return opener(**options)
    path = Path(path).expanduser()
    if not os.path.exists(path):  # unlike Path.exists it answers for any name
        raise DatasetError(f"{path}: no such file or folder")
    return opener(path, **options)


def _suggest(word: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(word).lower(), list(known), n=1)
    return f", did you mean '{near[0]}'?" if near else ""
