"""Settings as YAML with what each of them means, from the sentences beside their fields."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import Any

import yaml

WIDTH = 98


def commented_yaml(settings: Any, indent: str = "") -> str:
    """A dataclass as YAML, each value below a comment with its sentence."""
    return "".join(line + "\n" for line in _lines(settings, indent)).lstrip("\n")


def _lines(settings: Any, indent: str) -> Iterator[str]:
    sentences = field_sentences(type(settings))
    for each in fields(settings):
        value = getattr(settings, each.name)
        yield ""
        comment = sentences.get(each.name, "")
        yield from (f"{indent}# {line}" for line in textwrap.wrap(comment, WIDTH - len(indent) - 2))
        if is_dataclass(value):
            yield f"{indent}{each.name}:"
            yield from _lines(value, indent + "  ")
        else:
            plain = list(value) if isinstance(value, tuple) else value
            # a list of one in brackets, for no line to break
            written = yaml.safe_dump([plain], default_flow_style=True, width=10_000).strip()[1:-1]
            yield f"{indent}{each.name}: {written}"


def field_sentences(kind: type) -> dict[str, str]:
    """The text that stands below each field of a dataclass, its own before its parents'."""
    found: dict[str, str] = {}
    for each in reversed(kind.__mro__[:-1]):
        body = ast.parse(textwrap.dedent(inspect.getsource(each))).body[0]
        assert isinstance(body, ast.ClassDef)
        for field, text in zip(body.body, body.body[1:], strict=False):
            if not isinstance(field, ast.AnnAssign) or not isinstance(field.target, ast.Name):
                continue
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                found[field.target.id] = " ".join(str(text.value.value).split())
    return found
