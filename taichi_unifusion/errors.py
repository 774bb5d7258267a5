"""What can go wrong, as types: one root, each child also the built-in that callers expect.

A message says what, where and what to do, in one sentence. The command line catches
`UniFusionError` once and exits 2. Below the types: the checks of a caller's words that every room
needs.
"""

from __future__ import annotations

import difflib
import functools
import inspect
import numbers
import os
import re
import reprlib
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, SupportsFloat, TypeVar, Union, get_args, get_origin, get_type_hints

T = TypeVar("T")

_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")
_LARGEST_INTEGER = 2**63  # what NumPy and files can hold
_KINDS = {
    float: "a number",
    int: "a whole number",
    bool: "true or false",
    str: "text",
    Path: "a file's name",
    os.PathLike: "a Path",
    Mapping: "a dictionary",
}


class UniFusionError(Exception):
    """Root of every error that this package raises on purpose."""


class InputError(UniFusionError, ValueError):
    """A value given by the caller does not fit: wrong shape, type, range or name."""


class ConfigError(InputError):
    """A configuration file or option is not valid."""


class DatasetError(UniFusionError, ValueError):
    """A data set as a whole cannot be used: unknown format, empty folder, no intrinsics, unreadable
    trajectory.
    """


class FrameError(DatasetError):
    """One frame cannot be used; a run skips it, counts it and goes on."""


class SizeMismatch(FrameError):
    """Two images of one frame differ in size."""


class PoseError(FrameError):
    """A pose is missing, not finite or not a rigid transform."""


class NotRigid(PoseError):
    """A pose is finite but no rigid transform: whose it is, why, and T (4, 4) as it was found."""

    def __init__(self, name: str, why: str, T: Any) -> None:
        super().__init__(name, why, T)
        self.name, self.T = name, T

    def __str__(self) -> str:
        return f"{self.name}: {self.args[1]}"


class NoOverlap(DatasetError):
    """Two recordings do not see the same place, or not surely."""


class OutOfRange(InputError):
    """A point lies outside the index range of a map."""


class CapacityError(UniFusionError, MemoryError):
    """A map would outgrow the memory that is safe to use."""


class RuntimeStateError(UniFusionError, RuntimeError):
    """Taichi is not initialised, or was initialised again since this object was made."""


class FileError(UniFusionError, OSError):
    """A file or folder cannot be read or written."""


class MapCorrupt(FileError):
    """A map file is truncated, altered, of another version, or not ours."""


class MissingDependency(UniFusionError, ImportError):
    """An optional package is needed; the message holds the command that installs it."""


_NO_MEMORY = re.compile("out.of.memory|memory allocation .* failed|could not allocate", re.I)


def as_known(error: Exception) -> Exception:
    """The error as CapacityError where it says that memory has run out, as Python, NumPy and Taichi
    each do in their own way; else as it is.
    """
    if isinstance(error, UniFusionError):
        return error
    if not isinstance(error, MemoryError) and not (
        isinstance(error, RuntimeError) and _NO_MEMORY.search(str(error))
    ):
        return error
    reason = " ".join(str(error).split())[:160] or "no more is to be had"
    known = CapacityError(
        f"memory has run out ({reason}): use larger voxels, fewer maps or smaller images, or a machine with more"
    )
    known.__cause__ = error
    return known


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise InputError, with the right ones, unless the value of `name` is one of the choices."""
    if value not in choices:
        near = did_you_mean(value, choices)
        shown = f"'{value[:80]}'" if isinstance(value, str) else shortened(value)
        raise InputError(
            f"{name}: {shown} is unknown{near}{';' if near else ','} choose one of {', '.join(choices)}"
        )


def check_range(name: str, value: float, low: float, high: float, unit: str = "") -> None:
    """Raise InputError unless a number lies in low..high; NaN does not."""
    if isinstance(value, bool) or not isinstance(value, (int, float, SupportsFloat)):
        raise InputError(f"{name}: expected a number, got {shortened(value)}")
    if not low <= float(value) <= high:
        raise InputError(
            f"{name}: must lie in {low:g}..{high:g}{f' {unit}' if unit else ''}, got {shortened(value)}"
        )


def check_whole(name: str, value: object, low: int, high: int, unit: str = "") -> None:
    """Raise InputError unless a whole number lies in low..high."""
    if isinstance(value, bool) or not isinstance(value, numbers.Integral):
        raise InputError(f"{name}: expected a whole number, got {shortened(value)}")
    check_range(name, int(value), low, high, unit)


def check_kind(what: str, value: object, kind: type | tuple[type, ...], hint: str = "") -> None:
    """Raise InputError, which ends with the hint, unless a value is of a kind, or of one of several."""
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        words = " or ".join(map(_kind_words, kinds))
        raise InputError(f"{what}: expected {words}, got {shortened(value)}{hint}")


def as_path(what: str, value: object) -> Path:
    """The name of a file or folder, text or a Path; raises InputError, which calls it `what`, for
    anything else.
    """
    check_kind(what, value, (str, os.PathLike))
    return Path(value)  # pyright: ignore[reportArgumentType]


def check_box(low: Sequence[float], high: Sequence[float]) -> None:
    """Raise InputError unless every coordinate of one corner of a box is below that of the other."""
    if not all(a < b for a, b in zip(low, high, strict=True)):
        raise InputError(
            "bounds: every coordinate of the first corner must be below that of the second, got "
            f"{' '.join(f'{x:g}' for x in low)} and {' '.join(f'{x:g}' for x in high)}"
        )


def strict(kind: type[T]) -> type[T]:
    """A class whose constructor raises InputError for an unknown keyword, and for too many values or
    too few.
    """
    construct = kind.__init__
    signature = inspect.signature(construct)
    known = tuple(signature.parameters)[1:]

    @functools.wraps(construct)
    def __init__(self: Any, *args: Any, **keywords: Any) -> None:
        check_keywords(kind.__name__, keywords, known)
        try:
            signature.bind(self, *args, **keywords)
        except TypeError as error:
            raise InputError(f"{kind.__name__}: {error}; it takes {', '.join(known)}") from None
        construct(self, *args, **keywords)

    kind.__init__ = __init__
    return kind


def check_keywords(what: str, given: Iterable[str], known: Collection[str]) -> None:
    """Raise InputError, with the right ones, for a keyword that `what` does not have."""
    for name in given:
        if name not in known:
            near = did_you_mean(name, known)
            raise InputError(f"{what}: there is no '{name[:80]}'{near}; it has {', '.join(known)}")


def check_types(settings: Any) -> None:
    """Raise InputError unless every field of a dataclass holds what its annotation says; NumPy's
    numbers are numbers.
    """
    for name, wanted in _field_types(type(settings)).items():
        check_type(name, getattr(settings, name), wanted)


def check_type(name: str, value: object, wanted: Any) -> None:
    """Raise InputError unless the value of `name` is what an annotation says, numbers as in
    `check_types`.
    """
    if get_origin(wanted) is Literal:
        check_choice(name, value, get_args(wanted))
    elif not _is_of(value, wanted):
        raise InputError(f"{name}: expected {_kind_words(wanted)}, got {shortened(value)}")


@functools.cache
def _field_types(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind)
    return {name: hints[name] for name in kind.__dataclass_fields__}  # pyright: ignore[reportAttributeAccessIssue]


def _is_of(value: object, wanted: Any) -> bool:
    origin, options = get_origin(wanted), get_args(wanted)
    if origin in (Union, UnionType):
        return any(_is_of(value, each) for each in options)
    if wanted is Path:
        return isinstance(value, str | os.PathLike)
    if origin is Literal:
        return isinstance(value, str | int)  # `check_choice` names the choices
    if origin is tuple:
        every = (
            options[:1] * len(value) if isinstance(value, tuple) and options[-1] is ... else options
        )
        return (
            isinstance(value, tuple) and len(value) == len(every) and all(map(_is_of, value, every))
        )
    if wanted in (float, int):
        number = numbers.Real if wanted is float else numbers.Integral
        return isinstance(value, number) and not isinstance(value, bool)
    return wanted is Any or isinstance(value, origin or wanted)


def _kind_words(wanted: Any) -> str:
    """A type in words."""
    origin, options = get_origin(wanted), get_args(wanted)
    if origin in (Union, UnionType):
        return " or ".join(_kind_words(each) for each in options)
    if origin is tuple:
        return "a tuple, as ('a', 'b')" if options[0] is str else "a tuple"
    wanted = origin or wanted
    if wanted in _KINDS:
        return _KINDS[wanted]
    return "nothing" if wanted is NoneType else f"{getattr(wanted, '__name__', wanted)}(...)"


def did_you_mean(word: object, known: Iterable[str], at_most: int = 1) -> str:
    """What follows an unknown word in a sentence, " (did you mean 'x' or 'y'?)", or nothing if none of
    the known is like it.
    """
    near = difflib.get_close_matches(str(word)[:80].lower(), list(known), n=at_most)
    names = " or ".join(f"'{name}'" for name in near)
    return f" (did you mean {names}?)" if near else ""


def convert(value: object, wanted: Any, name: str) -> Any:
    """`value`, text or what YAML makes of it, as the type `wanted`; InputError calls it `name`.

    Types: float, int, bool, str, Path, Literal, tuple, and unions of them with None. Numbers are
    finite; a whole number may be written 640.0 or 1e3. Text for a tuple is 320x240 for whole
    numbers, 0.5/0.25 for others; a list is taken item by item.
    """
    if get_origin(wanted) in (Union, UnionType):
        if value is None and NoneType in get_args(wanted):
            return None
        wanted = next(option for option in get_args(wanted) if is_convertible(option))
    if get_origin(wanted) is Literal:
        check_choice(name, value, get_args(wanted))
        return value
    if get_origin(wanted) is tuple:
        return _convert_tuple(value, get_args(wanted), name)
    converted = _CONVERTERS[wanted](value)
    if converted is None:
        raise InputError(f"{name}: expected {_KINDS[wanted]}, got {shortened(value)}")
    return converted


def is_convertible(wanted: Any) -> bool:
    """Whether `convert` can make this type, or one of a union's, from text."""
    origin = get_origin(wanted)
    if origin in (Union, UnionType):
        return any(is_convertible(option) for option in get_args(wanted))
    return wanted in _CONVERTERS or origin is Literal or origin is tuple


def shortened(value: object) -> str:
    """A value for a message, of bounded length whatever it holds."""
    try:
        return reprlib.repr(value)
    except ValueError:  # a whole number of more digits than Python prints
        return type(value).__name__


def plain_text(text: str) -> str:
    """Text in which control characters, which may come from a file's name and could steer a
    terminal, are written as \\x1b; lines and tabs stay.
    """
    return _CONTROLS.sub(lambda found: f"\\x{ord(found[0]):02x}", text)


def _convert_tuple(value: object, types: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    """Items of `types`: (item, ...) for any number of them, else one type each."""
    separator = {int: "x", float: "/"}.get(types[0])
    expected = "a list"
    items = value
    if isinstance(value, str) and separator:
        items = value.split(separator)
        expected = (
            "WIDTHxHEIGHT" if types == (int, int) else f"numbers with {separator} between them"
        )
    any_number = len(types) == 2 and types[1] is Ellipsis
    if not isinstance(items, list) or not (any_number or len(items) == len(types)):
        raise InputError(f"{name}: expected {expected}, got {shortened(value)}")
    wanted = [types[0]] * len(items) if any_number else types
    if items is value:
        return tuple(convert(item, wanted[i], f"{name}[{i}]") for i, item in enumerate(items))
    try:
        return tuple(convert(item, wanted[i], name) for i, item in enumerate(items))
    except InputError:
        raise InputError(f"{name}: expected {expected}, got {shortened(value)}") from None


def _number(value: object) -> int | float | None:
    """A finite number, or text that is one; None for anything else."""
    if isinstance(value, str):
        for kind in (int, float):
            try:
                value = kind(value)
                break
            except ValueError:
                continue
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    return value if abs(value) <= sys.float_info.max else None  # False for NaN


def _whole_number(value: object) -> int | None:
    number = _number(value)
    if number is None or number != int(number) or abs(number) >= _LARGEST_INTEGER:
        return None
    return int(number)


def _real_number(value: object) -> float | None:
    number = _number(value)
    return None if number is None else float(number)


def _boolean(value: object) -> bool | None:
    if isinstance(value, str):
        return {"true": True, "false": False}.get(value.lower())
    return value if isinstance(value, bool) else None


_CONVERTERS = {
    float: _real_number,
    int: _whole_number,
    bool: _boolean,
    str: lambda value: value if isinstance(value, str) else None,
    Path: lambda value: Path(value).expanduser() if isinstance(value, str) and value else None,
}
