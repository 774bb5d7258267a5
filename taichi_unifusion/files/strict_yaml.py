"""YAML as people write settings: plain keys and values. What only surprises is refused."""

from __future__ import annotations

import os
from typing import Any

import yaml
from yaml.error import MarkedYAMLError

from ..errors import InputError
from .atomic import read_bytes

MAX_BYTES = 65_536  # the longest settings file of ours has 3 kB; more is another file
MAX_NESTING = 8  # mappings and lists within each other; our settings need 4


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """What the file holds, None if it is empty.

    Refused are a key given twice (plain YAML would keep the last), aliases and deep nesting (with
    them a small file keeps a parser busy for ever), and tags that make Python objects. Raises
    FileError where the file cannot be read, InputError, with the line, where it holds such YAML.
    """
    data = read_bytes(path)
    if len(data) > MAX_BYTES:
        raise InputError(
            f"{path}: holds {len(data)} bytes, more than the {MAX_BYTES} of any settings; is it another file?"
        )
    try:
        _check_plain(data)
        return yaml.load(data, Loader=_StrictLoader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f", line {mark.line + 1}" if mark else ""
        problem = getattr(error, "problem", None) or "unreadable characters"
        raise InputError(f"{path}{where}: not valid YAML ({problem})") from None
    except ValueError as error:  # a date or number that does not exist
        raise InputError(f"{path}: not valid YAML ({str(error)[:200]})") from None


class _StrictLoader(yaml.SafeLoader):
    """The safe loader, which also refuses a key that is given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = str(key_node.value)
            if key in seen:
                raise MarkedYAMLError(
                    None, None, f"key '{key}' is given twice", key_node.start_mark
                )
            seen.add(key)
        return super().construct_mapping(node, deep)


def _check_plain(data: bytes) -> None:
    """Raise yaml.YAMLError at the first alias, or where values are nested too deep."""
    depth = 0
    for event in yaml.parse(data, Loader=yaml.SafeLoader):
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        problem = None
        if isinstance(event, yaml.AliasEvent):
            problem = "aliases are not allowed here"
        elif depth > MAX_NESTING:
            problem = f"more than {MAX_NESTING} nested values are not allowed here"
        if problem:
            raise MarkedYAMLError(None, None, problem, event.start_mark)
