"""Meshes written as PLY, binary little-endian; `ply_reading` reads them back.

Nothing here imports `types`, so that `Mesh.save` can call it.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

# type in the file, names of the properties, values (V, number of names)
Column = tuple[str, tuple[str, ...], NDArray[Any]]
FACE_ROW = np.dtype([("count", "u1"), ("indices", "<i4", 3)])


class Triangles(Protocol):
    """What can be written: `types.Mesh`, or anything with its fields."""

    @property
    def vertices(self) -> NDArray[np.float32]: ...  # (V, 3) [m]
    @property
    def faces(self) -> NDArray[np.int32]: ...  # (F, 3)
    @property
    def normals(self) -> NDArray[np.float32] | None: ...  # (V, 3) unit
    @property
    def attributes(self) -> Mapping[str, NDArray[np.float32]]: ...  # name -> (V, c)


def color_to_uint8(color: NDArray) -> NDArray[np.uint8]:
    """Colours in [0, 1], of any shape, as bytes; values outside are clipped, NaN is black."""
    color = np.nan_to_num(np.asarray(color, np.float32), nan=0.0, posinf=1.0, neginf=0.0)
    return (np.clip(color, 0, 1) * 255 + 0.5).astype(np.uint8)


def colors_of(mesh: Triangles) -> NDArray[np.uint8] | None:
    """The colours of a mesh as bytes (V, 3), None where it has none; InputError for another shape."""
    color = mesh.attributes.get("color")
    if color is None:
        return None
    if color.ndim != 2 or color.shape[1] != 3:
        raise InputError(f"mesh: attribute 'color' must be (V, 3) RGB in [0, 1], got {color.shape}")
    return color_to_uint8(color)


def write_ply(file: BinaryIO, mesh: Triangles) -> None:
    """Write `mesh` to an open file: float positions and normals, 8-bit colours, other attributes as
    float properties.

    An attribute of one column is a property of its name, one of c columns is name_0 .. name_{c-1};
    a comment in the header says which, so that reading gives the same attributes. Raises InputError
    for names that PLY cannot hold.
    """
    rows, comments = vertex_rows(mesh)
    file.write(ply_header(rows.dtype, comments, len(rows), len(mesh.faces)))
    for table in (rows, face_rows(mesh.faces)):
        if len(table):
            file.write(table.view(np.uint8).data)


def vertex_rows(mesh: Triangles) -> tuple[NDArray[Any], list[str]]:
    """A row (V,) of properties for every vertex, and the header's comments; raises InputError as
    `write_ply`.
    """
    columns, comments = _columns_of(mesh)
    rows = np.empty(
        len(mesh.vertices), [(name, kind) for kind, group, _ in columns for name in group]
    )
    for _, group, values in columns:
        for i, name in enumerate(group):
            rows[name] = values[:, i]
    return rows, comments


def face_rows(faces: NDArray[np.int32]) -> NDArray[Any]:
    """A row (F,) for every triangle (F, 3)."""
    rows = np.empty(len(faces), FACE_ROW)
    rows["count"], rows["indices"] = 3, faces
    return rows


def ply_header(rows: np.dtype, comments: Sequence[str], vertices: int, triangles: int) -> bytes:
    """The header of a file with so many rows of vertices, and triangles."""
    kinds = {"<f4": "float", "|u1": "uchar"}
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *comments,
        f"element vertex {vertices}",
        *(f"property {kinds[rows[name].str]} {name}" for name in rows.names or ()),
        f"element face {triangles}",
        "property list uchar int vertex_indices",
        "end_header",
    ]
    return ("\n".join(lines) + "\n").encode("ascii")


def _columns_of(mesh: Triangles) -> tuple[list[Column], list[str]]:
    """The vertices' columns, and header comments that say which of them form an attribute."""
    columns: list[Column] = [("<f4", ("x", "y", "z"), mesh.vertices)]
    if mesh.normals is not None:
        columns.append(("<f4", ("nx", "ny", "nz"), mesh.normals))
    comments, colors = [], colors_of(mesh)
    for name, values in mesh.attributes.items():
        if values.ndim != 2:
            raise InputError(f"mesh: attribute '{name}' must be (V, c), got {values.shape}")
        if name == "color" and colors is not None:
            columns.append(("u1", ("red", "green", "blue"), colors))
            continue
        if not re.fullmatch(r"[!-~]+", name):
            raise InputError(
                f"mesh: attribute '{name}' cannot be named so in a PLY file; use letters, digits and _"
            )
        comments.append(f"comment attribute {name} {values.shape[1]}")
        columns.append(("<f4", property_names(name, values.shape[1]), values))
    names = [name for _, group, _ in columns for name in group]
    if len(set(names)) != len(names):
        raise InputError(
            f"mesh: two attributes would share a PLY property name among {', '.join(names)}; rename one"
        )
    return columns, comments


def property_names(name: str, columns: int) -> tuple[str, ...]:
    """The PLY properties that hold an attribute of so many columns."""
    return (name,) if columns == 1 else tuple(f"{name}_{i}" for i in range(columns))
