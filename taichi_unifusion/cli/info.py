"""`unifusion info`: files -> tables."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from .terminal import report


@dataclass(frozen=True)
class Info:
    """Show what a results folder, a map file or a mesh holds, and whether it is sound."""

    path: Annotated[Positional[Path], arg(metavar="DIR|FILE")]
    """Results folder, map (.safetensors) or mesh (.ply, .glb, .obj)."""


def info(options: Info) -> int:
    """Files -> tables."""
    from ..results.inspection import inspect

    inspection = inspect(options.path)
    if inspection.text:
        print(inspection.text)
    return report(inspection.problems)
