"""PLY meshes read in all three encodings, checked before they are trusted."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError
from ..types import Mesh
from .ply import property_names

MAX_HEADER = 1 << 16  # [bytes]; real headers have a few hundred

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_ENCODINGS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_COUNT = re.compile(r"\d{1,18}")
_COLOR_RANGE = {"u1": 255.0, "u2": 65535.0}  # other types hold [0, 1] already


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str  # NumPy type without byte order
    count: str | None = None  # NumPy type of a list's length; None: a single number


@dataclass(frozen=True)
class _Element:
    name: str
    rows: int
    properties: tuple[_Property, ...]


def parse_ply(data: bytes, name: str) -> Mesh:
    """The mesh in the bytes of a PLY file called `name` in messages; faces of more corners become
    fans of triangles.

    Raises FileError where the header is wrong, the file is shorter or longer than it says, or a
    face names no vertex.
    """
    encoding, elements, attributes, start = _parse_header(data, name)
    color_range = next(
        (_COLOR_RANGE.get(p.kind, 1.0) for e in elements for p in e.properties if p.name == "red"),
        1.0,
    )
    body = data[start:]
    # the words of an ascii file become float64, read like a binary file of this one type
    if encoding == "ascii":
        try:
            body = np.array(body.split(), dtype="<f8").tobytes()
        except ValueError:
            raise FileError(
                f"{name}: the PLY file says ascii but holds something else than numbers"
            ) from None
        elements = [
            _Element(
                e.name,
                e.rows,
                tuple(_Property(p.name, "f8", p.count and "f8") for p in e.properties),
            )
            for e in elements
        ]
    tables, offset = {}, 0
    for element in elements:
        tables[element.name], offset = _read_element(
            body, offset, element, _ENCODINGS[encoding], name
        )
    if offset != len(body):
        raise FileError(
            f"{name}: the PLY file holds more data than its header announces; was it changed by a text tool?"
        )
    lists = tables.get("face", _Columns()).lists
    vertices, normals, values = _vertex_data(
        tables.get("vertex", _Columns()).numbers, attributes, color_range, name
    )
    polygons = lists.get("vertex_indices", lists.get("vertex_index", np.empty((0, 3))))
    return Mesh(vertices, _triangles(polygons, len(vertices), name), normals, values)


@dataclass(frozen=True)
class Uneven:
    """Lists of several lengths: rows (M,) and their items (M, length), for each length."""

    count: int  # of all rows
    groups: list[tuple[NDArray[np.int64], NDArray]] = field(default_factory=list)


@dataclass(frozen=True)
class _Columns:
    """What one element holds, by property: single numbers, and lists (2-D where all are equally
    long).
    """

    numbers: Mapping[str, NDArray] = field(default_factory=dict)
    lists: Mapping[str, NDArray | Uneven] = field(default_factory=dict)


def _parse_header(data: bytes, name: str) -> tuple[str, list[_Element], dict[str, int], int]:
    """Encoding, elements, our attributes (name -> columns) and where the body starts."""
    if not re.match(rb"ply\s*?[\r\n]", data):
        raise FileError(f"{name}: not a PLY file (it does not begin with 'ply')")
    end = re.search(rb"[\r\n]end_header[ \t]*(\r\n|\n|\r)", data[:MAX_HEADER])
    if end is None:
        raise FileError(f"{name}: the PLY header has no end; the file is truncated or damaged")
    encoding, elements, attributes = "", [], {}
    for line in data[: end.start()].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", word, "1.0"] if word in _ENCODINGS:
                encoding = word
            case ["comment", "attribute", attribute, columns] if _COUNT.fullmatch(columns):
                attributes[attribute] = int(columns)
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["element", element, rows] if _COUNT.fullmatch(rows) and element not in (
                e.name for e in elements
            ):
                elements.append(_Element(element, int(rows), ()))
            case ["property", *words] if elements and (prop := _parse_property(words)):
                last = elements[-1]
                if prop.name in (p.name for p in last.properties):
                    raise FileError(f"{name}: the PLY header names property '{prop.name}' twice")
                elements[-1] = _Element(last.name, last.rows, (*last.properties, prop))
            case _:
                raise FileError(
                    f"{name}: the PLY header holds a line that makes no sense: '{line[:80]}'"
                )
    if not encoding:
        raise FileError(
            f"{name}: the PLY header names no format; expected one of {', '.join(_ENCODINGS)}, version 1.0"
        )
    return encoding, elements, attributes, end.end()


def _parse_property(words: list[str]) -> _Property | None:
    match words:
        case [kind, name] if kind in _TYPES:
            return _Property(name, _TYPES[kind])
        case ["list", count, kind, name] if (
            count in _TYPES and kind in _TYPES and _TYPES[count][0] in "iu"
        ):
            return _Property(name, _TYPES[kind], _TYPES[count])
    return None


def _row_type(element: _Element, order: str, lengths: Mapping[str, int]) -> np.dtype[Any]:
    """The type of a row whose lists, by name, are so long; their lengths are named #list."""
    return np.dtype(
        [
            item
            for p in element.properties
            for item in (
                [("#" + p.name, order + p.count), (p.name, order + p.kind, (lengths[p.name],))]
                if p.count
                else [(p.name, order + p.kind)]
            )
        ]
    )


def _read_element(
    body: bytes, offset: int, element: _Element, order: str, name: str
) -> tuple[_Columns, int]:
    """The columns of one element and where the next element starts."""
    numbers = [p.name for p in element.properties if not p.count]
    lists = [p.name for p in element.properties if p.count]
    if not element.properties or not element.rows:
        return _Columns({key: np.empty(0) for key in numbers}), offset
    reader = _RowReader(element, order, name)
    lengths = dict(zip(lists, reader.read(body, offset)[0], strict=True))
    start, row = offset, _row_type(element, order, lengths)
    table = np.frombuffer(
        body, row, min(element.rows, (len(body) - offset) // row.itemsize), offset
    )
    as_first = np.logical_and.reduce(
        [np.ones(len(table), bool), *(table["#" + key] == lengths[key] for key in lists)]
    )
    # rows of the same list lengths as the first one are read at once, without copies
    table = table[: len(table) if as_first.all() else as_first.argmin()]
    offset += table.nbytes
    if len(table) == element.rows:
        return _Columns(
            {key: table[key] for key in numbers}, {key: table[key] for key in lists}
        ), offset
    return _read_uneven(body, start, element, order, name)


def _read_uneven(
    body: bytes, offset: int, element: _Element, order: str, name: str
) -> tuple[_Columns, int]:
    """As `_read_element`, where lists differ in length: rows of equal lengths are read together."""
    groups: dict[tuple[int, ...], tuple[list[int], list[int]]] = {}  # lengths -> rows, offsets
    reader = _RowReader(element, order, name)
    for n in range(element.rows):
        lengths, end = reader.read(body, offset)
        rows, offsets = groups.setdefault(lengths, ([], []))
        rows.append(n)
        offsets.append(offset)
        offset = end
    data = np.frombuffer(body, np.uint8)
    numbers = {
        p.name: np.empty(element.rows, order + p.kind) for p in element.properties if not p.count
    }
    lists = {p.name: Uneven(element.rows) for p in element.properties if p.count}
    for lengths, (rows, offsets) in groups.items():
        row = _row_type(element, order, dict(zip(lists, lengths, strict=True)))
        places = np.array(offsets)[:, None] + np.arange(row.itemsize)
        table = data[places].reshape(-1).view(row)
        for key, values in numbers.items():
            values[rows] = table[key]
        for key, values in lists.items():
            values.groups.append((np.array(rows), table[key].reshape(len(rows), -1)))
    return _Columns(numbers, lists), offset


class _RowReader:
    """Finds how long the lists of a row are, and where the row ends."""

    def __init__(self, element: _Element, order: str, name: str) -> None:
        self.element, self.name = element, name
        # for each list the bytes before its length, how that is packed, and the bytes of an item
        self.steps: list[tuple[int, struct.Struct, int]] = []
        self.tail = 0  # bytes after the last list
        for p in element.properties:
            size = np.dtype(p.kind).itemsize
            if p.count:
                count = struct.Struct(order + np.dtype(p.count).char)
                self.steps.append((self.tail, count, size))
                self.tail = 0
            else:
                self.tail += size

    def read(self, body: bytes, at: int) -> tuple[tuple[int, ...], int]:
        """The lengths of the lists of the row at `at`, and its end; raises FileError."""
        lengths = []
        for before, count, size in self.steps:
            at += before
            if at + count.size > len(body):
                raise _truncated(self.name, self.element)
            (length,) = count.unpack_from(body, at)
            if not 0 <= length < 1 << 31 or length % 1:
                raise FileError(
                    f"{self.name}: a list in element '{self.element.name}' of the PLY file has length "
                    f"{length:g}"
                )
            lengths.append(int(length))
            at += count.size + int(length) * size
        if at + self.tail > len(body):
            raise _truncated(self.name, self.element)
        return tuple(lengths), at + self.tail


def _truncated(name: str, element: _Element) -> FileError:
    return FileError(
        f"{name}: the PLY file is truncated: it ends before the {element.rows} rows of element '{element.name}'"
    )


def _vertex_data(
    columns: dict[str, NDArray], attributes: dict[str, int], color_range: float, name: str
) -> tuple[NDArray, NDArray | None, dict[str, NDArray]]:
    """Vertices, normals and attributes: first those that the header declares (name -> columns),
    then every other property.
    """
    rest = dict(columns)

    def taken(*names: str) -> NDArray[np.float32]:
        """These columns side by side, each handed out once."""
        return np.stack([rest.pop(key) for key in names], axis=1).astype(np.float32)

    def take(*names: str) -> NDArray[np.float32] | None:
        """These columns, or None unless all are there."""
        return taken(*names) if all(key in rest for key in names) else None

    vertices, normals, color = (
        take("x", "y", "z"),
        take("nx", "ny", "nz"),
        take("red", "green", "blue"),
    )
    if vertices is None:
        raise FileError(f"{name}: the PLY file has no vertices with x, y and z")
    values: dict[str, NDArray[np.float32]] = {}
    if color is not None:
        values["color"] = color / np.float32(color_range)
    for attribute, count in attributes.items():
        group = take(*property_names(attribute, count)) if 0 < count <= len(rest) else None
        if group is not None:
            values[attribute] = group
    return vertices, normals, values | {key: taken(key) for key in list(rest)}


def _triangles(polygons: NDArray[Any] | Uneven, count: int, name: str) -> NDArray[np.int32]:
    """Faces (F, 3) of polygons, which index `count` vertices; a polygon of k corners is a fan of k
    - 2 triangles.
    """
    if isinstance(polygons, Uneven):
        fans = [(rows, _fans(items)) for rows, items in polygons.groups]
        owners = np.concatenate([np.repeat(rows, fan.shape[1]) for rows, fan in fans])
        corners = np.concatenate([fan.reshape(-1, 3) for _, fan in fans])
        corners = corners[np.argsort(owners, kind="stable")]  # in the file's order
    else:
        corners = _fans(polygons).reshape(-1, 3)
    if len(corners) and not (corners.min() >= 0 and corners.max() < count):
        raise FileError(f"{name}: a face of the PLY file names a vertex outside 0..{count - 1}")
    faces = corners.astype(np.int32)
    if corners.dtype.kind == "f" and (faces != corners).any():  # from ascii
        raise FileError(
            f"{name}: a face of the PLY file names a vertex by a number that is not whole"
        )
    return faces


def _fans(polygons: NDArray[Any]) -> NDArray[Any]:
    """Triangles (F, k - 2, 3) of polygons (F, k)."""
    first = np.repeat(polygons[:, :1], max(polygons.shape[1] - 2, 0), axis=1)
    return np.stack([first, polygons[:, 1:-1], polygons[:, 2:]], axis=2)
