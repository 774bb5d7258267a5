"""Names of a package that load when they are used, so that what needs Taichi is not imported by what does not."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def lazy_names(package: str, modules: Mapping[str, str],
               names: Sequence[str]) -> tuple[Callable[[str], Any], Callable[[], Sequence[str]]]:
    """`__getattr__` and `__dir__` of a package that has `names`, those in `modules` (name -> module) loaded when first used."""
    def load(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        value = getattr(import_module(f".{modules[name]}", package), name)
        setattr(sys.modules[package], name, value)
        return value

    return load, lambda: names
