"""`unifusion config`: settings -> YAML."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import arg

from ..config import Config
from .commented_yaml import commented_yaml
from .options import OPTIONAL, Settings
from .terminal import DONE


@dataclass(frozen=True)
class ShowConfig:
    """Print every setting and what it means, as it would be used, in YAML that --config reads back.

    Settings come from the defaults, then from --config FILE, then from options. A file needs to
    hold only what differs.
    """

    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint=OPTIONAL)] = None
    """YAML file of settings that differ from the defaults."""
    settings: Settings = field(default_factory=Config)


def show_config(options: ShowConfig) -> int:
    """Settings -> YAML."""
    print(commented_yaml(options.settings), end="")
    return DONE
