"""What can go wrong, as types: one root, each child also the built-in that callers expect.

A message says what, where and what to do, in one sentence. The command line catches
`UniFusionError` once and exits 2.
"""

from __future__ import annotations

from collections.abc import Iterable


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


def check_choice(name: str, value: str, choices: Iterable[str]) -> None:
    """Raise InputError, with the right ones, unless the value of `name` is one of the choices."""
    if value not in choices:
        raise InputError(f"{name}: '{value}' is unknown, choose one of {', '.join(choices)}")
