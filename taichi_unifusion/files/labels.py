"""Labels as people keep them: a PLY property, lines of text, a NumPy array; and names of classes."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FileError, InputError
from .arrays import read_array
from .atomic import read_bytes
from .mesh_reading import read_mesh
from .text_rows import parse_lines

SUFFIXES = (".ply", ".txt", ".npy")
LABEL = re.compile(r"-?[0-9]{1,9}")


@dataclass(frozen=True)
class LabelFile:
    """One label a point or vertex, and where they are if the file says so."""

    labels: NDArray[np.float64]  # (N,) whole numbers, if the file is right
    points: NDArray[np.float32] | None = None  # (N, 3) world [m]


def read_labels(path: str | Path, attribute: str = "label") -> LabelFile:
    """Read labels from a PLY file's vertex property `attribute`, a .txt with one number a line, or
    a .npy array.

    Raises FileError where the file is missing or damaged, InputError for another suffix or a PLY
    without that property.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        mesh = read_mesh(path)
        if attribute not in mesh.attributes:
            raise InputError(
                f"{path}: has no vertex property '{attribute}', only {', '.join(mesh.attributes) or 'positions'}"
            )
        values = mesh.attributes[attribute]
        if values.shape[1] != 1:
            raise InputError(
                f"{path}: property '{attribute}' has {values.shape[1]} columns; a label is one number"
            )
        return LabelFile(values[:, 0].astype(np.float64), mesh.vertices)
    if suffix == ".txt":
        return LabelFile(_parse_text(path))
    if suffix == ".npy":
        values = read_array(path)
        if values.dtype.kind not in "iufb" or values.squeeze().ndim != 1:
            raise InputError(
                f"{path}: expected one number a point, got {values.shape} {values.dtype}"
            )
        return LabelFile(values.squeeze().astype(np.float64))
    raise InputError(
        f"{path}: labels are read from {', '.join(SUFFIXES)}, not from '{path.suffix}'"
    )


def read_class_names(path: str | Path) -> dict[int, str]:
    """Read lines `label name`, such as `3 kitchen table`; empty lines and # comments are fine.
    Raises FileError.
    """
    names: dict[int, str] = {}
    for number, line in _lines(Path(path)):
        label, _, name = line.partition(" ")
        if not LABEL.fullmatch(label) or not name.strip():
            raise FileError(
                f"{path}, line {number}: expected 'label name', such as '3 chair', got '{line[:80]}'"
            )
        if int(label) in names:
            raise FileError(
                f"{path}, line {number}: label {label} has a name already, '{names[int(label)]}'"
            )
        names[int(label)] = name.strip()
    if not names:
        raise FileError(f"{path}: holds no names; expected lines 'label name', such as '3 chair'")
    return names


def _parse_text(path: Path) -> NDArray[np.float64]:
    values = []
    for number, line in _lines(path):
        try:
            values.append(float(line))
        except ValueError:
            raise FileError(
                f"{path}, line {number}: expected one number, got '{line[:80]}'"
            ) from None
    if not values:
        raise FileError(f"{path}: holds no labels; expected one number a line")
    return np.array(values)


def _lines(path: Path) -> list[tuple[int, str]]:
    """Number and text of the lines that are neither empty nor comments."""
    try:
        lines = list(parse_lines(read_bytes(path), str(path)))
    except DatasetError as error:
        raise FileError(str(error)) from None
    return [(number, " ".join(line.split())) for number, line in lines]
