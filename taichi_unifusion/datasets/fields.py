"""The keys of a YAML file as a dataclass: its fields are the keys, their types and their defaults.
Strict.
"""

from __future__ import annotations

from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from ..errors import DatasetError, FileError, InputError, convert, did_you_mean
from ..files.strict_yaml import read_yaml

Fields = TypeVar("Fields")


def read_fields(path: Path, kind: type[Fields]) -> Fields:
    """The dataclass `kind` from the file; DatasetError names the key that is unknown, missing or of
    another type.
    """
    try:
        values = read_yaml(path)
    except (FileError, InputError) as error:
        raise DatasetError(str(error)) from None
    if not isinstance(values, dict):
        raise DatasetError(f"{path}: expected lines of the form 'fx: 525.0'")
    return convert_fields(kind, values, str(path))


def convert_fields(kind: type[Fields], values: dict[Any, Any], source: str) -> Fields:
    """The dataclass `kind` from keys and values that `source` holds; errors as in `read_fields`."""
    types = get_type_hints(kind)
    for key in values:
        if key not in types:
            raise DatasetError(
                f"{source}: unknown key '{str(key)[:40]}'{did_you_mean(key, types)} "
                f"(keys: {', '.join(types)})"
            )
    missing = [name for name in _required_keys(kind) if name not in values]
    if missing:
        raise DatasetError(f"{source}: no {', '.join(missing)} in it")
    try:
        return kind(
            **{key: convert(value, types[key], f"{source}: {key}") for key, value in values.items()}
        )
    except InputError as error:
        raise DatasetError(str(error)) from None


def _required_keys(kind: Any) -> list[str]:
    return [each.name for each in fields(kind) if each.default is each.default_factory is MISSING]
