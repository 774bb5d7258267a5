"""The file of answers that `unifusion check --fix` writes and a run takes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from ...errors import InputError
from ...files.atomic import write_text
from ...files.strict_yaml import read_yaml

HEAD = "# answers of `unifusion check`; give them to a run with --fix FILE\n"
SECTIONS = ("recording", "settings")


@dataclass(frozen=True)
class Fix:
    """Options of `open_dataset` and settings of a run, as plain values."""

    recording: Mapping[str, Any] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)


def write_fix(path: Path, fix: Fix) -> None:
    """Write the answers atomically; raises FileError where that fails."""
    values = {"recording": dict(fix.recording), "settings": dict(fix.settings)}
    kept = {name: section for name, section in values.items() if section}
    write_text(path, HEAD + (yaml.safe_dump(kept, sort_keys=False) if kept else ""))


def read_fix(path: str | Path) -> Fix:
    """Read such a file; InputError where it holds something else, FileError where it cannot be read."""
    values = read_yaml(path) or {}
    if not isinstance(values, dict) or not all(
        name in SECTIONS and isinstance(section, dict) for name, section in values.items()
    ):
        raise InputError(
            f"{path}: expected the sections {' and '.join(SECTIONS)} that `unifusion check --fix` writes; "
            "settings alone are given with --config"
        )
    return Fix(**values)
