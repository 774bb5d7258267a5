"""What every `unifusion evaluate` command does with its numbers: a table, or JSON on screen and in
a file.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .options import ScoreOptions
from .terminal import DONE


def check_out(options: ScoreOptions) -> None:
    """Raise FileError if the file for the numbers cannot be written, before any work is spent."""
    if options.out:
        from ..files.atomic import check_writable

        check_writable(options.out.parent)


def show(options: ScoreOptions, about: Mapping[str, Any], result: Any, *blocks: str) -> int:
    """Print blocks of text with an empty line between them, or JSON, and write the file; returns
    the exit code. `result` is a dataclass.
    """
    text = json.dumps(_plain({**about, **dataclasses.asdict(result)}), indent=2)
    if options.out:
        from ..files.atomic import write_text

        write_text(options.out, text + "\n")
    print(text if options.json else "\n\n".join(blocks))
    return DONE


def cell(value: float | None, digits: int = 2, factor: float = 1.0) -> str:
    """A number for a table; - where there is none."""
    return "-" if value is None else f"{factor * value:.{digits}f}"


def percent(share: float | None) -> str:
    """A share of 0..1 for a table, in per cent."""
    return cell(share, 1, 100.0)


def _plain(value: Any) -> Any:
    """The value as JSON knows it: no infinity, no NaN."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return str(value) if isinstance(value, Path) else value
