"""The methods that a table compares: our defaults, the published settings, YAML files of your own."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from taichi_unifusion.config import dump_config, load_config
from taichi_unifusion.errors import InputError

PUBLISHED = Path(__file__).resolve().parents[1] / "configs" / "paper.yaml"
METHODS: dict[str, Path | None] = {"ours": None, "published": PUBLISHED}  # name -> configuration
SUFFIXES = (".yaml", ".yml")


@dataclass(frozen=True)
class Method:
    """A configuration, by the name of its row and of its folder."""

    name: str
    config: Path | None = None  # None for our defaults
    digest: str | None = None  # of the settings in the file


def methods_of(names: Sequence[str]) -> list[Method]:
    """The methods that are named or files; raises InputError for an unknown one or two of one name,
    FileError or ConfigError for a file that cannot be used.
    """
    methods: dict[str, Method] = {}
    given: dict[str, str] = {}
    for name in names:
        method = method_of(name)
        if method.name in methods:
            raise InputError(
                f"methods: '{given[method.name]}' and '{name}' would both be called "
                f"'{method.name}' and share a folder; give each once, by a name of its own"
            )
        methods[method.name], given[method.name] = method, name
    return list(methods.values())


def method_of(name: str) -> Method:
    """One of METHODS, or a YAML file; raises as `methods_of`."""
    path = METHODS.get(name, Path(name))
    if path is None:
        return Method(name)
    if name not in METHODS:
        if path.suffix not in SUFFIXES or not path.exists():
            raise InputError(
                f"method '{name}' is unknown; there are {', '.join(METHODS)} and FILE.yaml"
            )
        if path.stem in METHODS:
            raise InputError(
                f"method '{name}' would be called '{path.stem}', as a method that there is already; "
                "give the file another name"
            )
        name, path = path.stem, path.resolve()
    settings = dump_config(load_config(path))
    return Method(name, path, hashlib.sha256(settings.encode()).hexdigest())
