"""A PLY that is written while its mesh is made: pieces go to disk as they come, welded where they
meet, so that no more than a piece need be in memory.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any, Self

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_write, file_error
from .ply import Triangles, face_rows, ply_header, vertex_rows

CHUNK = 1 << 20  # rows read and written at once


class MeshStream:
    """Collects the pieces of a mesh in files without a name beside `path`.

    Pieces come in order of their slab, and share vertices with others of the same slab and of the
    one before. Raises FileError where the disk refuses.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.vertices, self.triangles = 0, 0
        self._row: np.dtype | None = None
        self._comments: list[str] = []
        # by slab: vertices by their place, with the part that they belong to
        self._shared: dict[int, dict[bytes, tuple[int, int]]] = {}
        self._joined: list[int] = []  # by part, one that it is connected with, or itself
        self._areas: list[float] = []  # of parts [m^2]
        self._files = ExitStack()
        try:
            self._rows, self._faces, self._parts = (
                self._files.enter_context(tempfile.TemporaryFile(dir=path.parent))  # noqa: SIM115
                for _ in range(3)
            )
        except OSError as error:
            raise file_error("write", path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def add(
        self,
        mesh: Triangles,
        shared: NDArray[np.bool_],
        slab: int,
        part: NDArray[np.int32],
        areas: NDArray[np.float64],
    ) -> None:
        """Append a piece: of its vertices, `shared` (V,) may be those of other pieces too, and each
        belongs to the connected `part` (V,) of it, which have `areas` (P,) [m^2].
        """
        rows, self._comments = vertex_rows(mesh)
        self._row = rows.dtype
        part = part + np.int32(len(self._joined))
        self._joined += range(len(self._joined), len(self._joined) + len(areas))
        self._areas += areas.tolist()
        before, own = self._shared.get(slab - 1, {}), self._shared.setdefault(slab, {})
        number = np.full(len(rows), -1, np.int64)
        meeting = np.flatnonzero(shared)
        places = [mesh.vertices[v].tobytes() for v in meeting]
        known = [own.get(place) or before.get(place) for place in places]
        for v, there in zip(meeting, known, strict=True):
            number[v] = -1 if there is None else there[0]
        met = {(there[1], int(part[v])) for v, there in zip(meeting, known, strict=True) if there}
        for one, other in sorted(met):
            self._join(one, other)
        new = number < 0
        number[new] = self.vertices + np.arange(new.sum())
        own |= {
            place: (int(number[v]), int(part[v])) for v, place in zip(meeting, places, strict=True)
        }
        for old in [each for each in self._shared if each < slab - 1]:
            del self._shared[old]
        try:
            self._rows.write(rows[new].tobytes())
            self._parts.write(part[new].astype("<i4").tobytes())
            self._faces.write(number[mesh.faces].astype("<i4").tobytes())
        except OSError as error:
            raise file_error("write", self.path, error) from error
        self.vertices += int(new.sum())
        self.triangles += len(mesh.faces)

    def _root(self, part: int) -> int:
        """The one that stands for all that a part is connected with."""
        while (above := self._joined[part]) != part:
            self._joined[part] = self._joined[above]
            part = above
        return part

    def _join(self, one: int, other: int) -> None:
        one, other = self._root(one), self._root(other)
        if one != other:
            self._joined[max(one, other)] = min(one, other)

    def _kept_parts(self, min_area: float) -> NDArray[np.bool_]:
        """Which parts (P,) have so many square metres, with all that they are connected with."""
        roots = np.array([self._root(part) for part in range(len(self._joined))], np.int64)
        total = np.bincount(roots, self._areas, len(roots))
        return np.asarray(total >= min_area)[roots]

    def write(self, min_area: float = 0.0) -> tuple[int, int]:
        """Write the PLY atomically, without connected parts of less than `min_area` square metres;
        returns how many vertices and triangles there are. Raises FileError.
        """
        parts = self._kept_parts(min_area)
        number = np.empty(self.vertices, np.int32)  # of vertices that are kept, -1 for others
        vertices = 0
        for begin, part in self._chunks(self._parts, np.dtype("<i4")):
            kept = parts[part]
            number[begin : begin + len(part)] = np.where(kept, vertices - 1 + np.cumsum(kept), -1)
            vertices += int(kept.sum())
        every = np.dtype(("<i4", (3,)))
        triangles = sum(
            int((number[faces[:, 0]] >= 0).sum()) for _, faces in self._chunks(self._faces, every)
        )
        row = self._row or np.dtype([(axis, "<f4") for axis in "xyz"])
        with atomic_write(self.path) as temporary, open(temporary, "wb") as file:
            file.write(ply_header(row, self._comments, vertices, triangles))
            for begin, rows in self._chunks(self._rows, row):
                file.write(rows[number[begin : begin + len(rows)] >= 0].tobytes())
            for _, faces in self._chunks(self._faces, every):
                renumbered = number[faces]
                file.write(face_rows(renumbered[renumbered[:, 0] >= 0]).tobytes())
        return vertices, triangles

    def _chunks(self, file: IO[bytes], row: np.dtype) -> Iterator[tuple[int, NDArray[Any]]]:
        """Rows of a file, some at a time, and which is the first."""
        file.flush()
        end = os.fstat(file.fileno()).st_size // row.itemsize
        for begin in range(0, end, CHUNK):
            count = min(CHUNK, end - begin)
            data = os.pread(file.fileno(), count * row.itemsize, begin * row.itemsize)
            yield begin, np.frombuffer(data, row).copy()
