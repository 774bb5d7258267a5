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
        self._shared: dict[int, dict[bytes, int]] = {}  # by slab: vertices by their place
        self._files = ExitStack()
        try:
            self._rows, self._faces = (
                self._files.enter_context(tempfile.TemporaryFile(dir=path.parent))  # noqa: SIM115
                for _ in range(2)
            )
        except OSError as error:
            raise file_error("write", path, error) from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._files.close()

    def add(self, mesh: Triangles, shared: NDArray[np.bool_], slab: int) -> None:
        """Append a piece; of its vertices, `shared` (V,) may be those of other pieces too."""
        rows, self._comments = vertex_rows(mesh)
        self._row = rows.dtype
        known = {**self._shared.get(slab - 1, {}), **self._shared.get(slab, {})}
        number = np.full(len(rows), -1, np.int64)
        for v in np.flatnonzero(shared):
            number[v] = known.get(mesh.vertices[v].tobytes(), -1)
        new = number < 0
        number[new] = self.vertices + np.arange(new.sum())
        own = self._shared.setdefault(slab, {})
        own |= {mesh.vertices[v].tobytes(): int(number[v]) for v in np.flatnonzero(shared)}
        for old in [each for each in self._shared if each < slab - 1]:
            del self._shared[old]
        try:
            self._rows.write(rows[new].tobytes())
            self._faces.write(number[mesh.faces].astype("<i4").tobytes())
        except OSError as error:
            raise file_error("write", self.path, error) from error
        self.vertices += int(new.sum())
        self.triangles += len(mesh.faces)

    @property
    def places(self) -> NDArray[np.float32]:
        """The vertices (V, 3) [m] of all pieces."""
        places = np.empty((self.vertices, 3), np.float32)
        for begin, rows in self._chunks(self._rows, self._row or np.dtype("<f4")):
            for d, axis in enumerate("xyz"):
                places[begin : begin + len(rows), d] = rows[axis]
        return places

    def faces(self) -> Iterator[NDArray[np.int32]]:
        """The triangles (F, 3) of all pieces, some at a time."""
        for _, faces in self._chunks(self._faces, np.dtype(("<i4", (3,)))):
            yield faces

    def write(self, kept: NDArray[np.bool_] | None = None) -> tuple[int, int]:
        """Write the PLY atomically, only the vertices `kept` (V,) and their triangles; returns how
        many there are. Raises FileError.
        """
        kept = np.ones(self.vertices, bool) if kept is None else kept
        number = np.cumsum(kept, dtype=np.int32) - 1
        triangles = sum(int(kept[faces[:, 0]].sum()) for faces in self.faces())
        vertices = int(kept.sum())
        row = self._row or np.dtype([(axis, "<f4") for axis in "xyz"])
        with atomic_write(self.path) as temporary, open(temporary, "wb") as file:
            file.write(ply_header(row, self._comments, vertices, triangles))
            for begin, rows in self._chunks(self._rows, row):
                file.write(rows[kept[begin : begin + len(rows)]].tobytes())
            for faces in self.faces():
                file.write(face_rows(number[faces[kept[faces[:, 0]]]]).tobytes())
        return vertices, triangles

    def _chunks(self, file: IO[bytes], row: np.dtype) -> Iterator[tuple[int, NDArray[Any]]]:
        """Rows of a file, some at a time, and which is the first."""
        file.flush()
        end = os.fstat(file.fileno()).st_size // row.itemsize
        for begin in range(0, end, CHUNK):
            count = min(CHUNK, end - begin)
            data = os.pread(file.fileno(), count * row.itemsize, begin * row.itemsize)
            yield begin, np.frombuffer(data, row).copy()
