"""Meshes written as GLB, the binary form of glTF 2.0: one mesh of one node, in the file's own frame.

Like `ply`, this imports no more than NumPy: a library for all of glTF takes a second to import,
which every run would wait for.
"""

from __future__ import annotations

import json
import struct
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .ply import Triangles, colors_of

TYPES = {"<f4": 5126, "<u4": 5125, "u1": 5121}  # componentType of glTF
VERTICES, INDICES = 34962, 34963  # what a buffer view is for


def write_glb(file: BinaryIO, mesh: Triangles) -> None:
    """Write `mesh` to an open file: positions, normals and 8-bit colours by vertex, in their order.

    Raises InputError where vertices are not finite: glTF has no number for that.
    """
    if not np.isfinite(mesh.vertices).all():
        raise InputError("mesh: has vertices that are not finite, which GLB cannot hold")
    columns: dict[str, NDArray[Any]] = {"POSITION": np.ascontiguousarray(mesh.vertices, "<f4")}
    colors = colors_of(mesh)
    if colors is not None:
        opaque = np.full((len(colors), 1), 255, np.uint8)  # rows of four bytes, as glTF aligns them
        columns["COLOR_0"] = np.hstack([colors, opaque])
    if mesh.normals is not None:
        columns["NORMAL"] = np.ascontiguousarray(mesh.normals, "<f4")
    blocks = [np.ascontiguousarray(mesh.faces, "<u4").reshape(-1), *columns.values()]
    header = json.dumps(_describe(blocks, list(columns)), separators=(",", ":")).encode()
    header += b" " * (-len(header) % 4)
    size = sum(block.nbytes for block in blocks)
    file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(header) + 8 + size))
    file.write(struct.pack("<I4s", len(header), b"JSON") + header)
    file.write(struct.pack("<I4s", size, b"BIN\0"))
    for block in blocks:
        file.write(block.data)


def _describe(blocks: list[NDArray[Any]], names: list[str]) -> dict[str, Any]:
    """The JSON of a mesh whose indices are the first block, and whose vertices the others."""
    offsets = np.cumsum([0, *(block.nbytes for block in blocks)]).tolist()
    views = [
        {
            "buffer": 0,
            "byteOffset": offset,
            "byteLength": block.nbytes,
            "target": VERTICES if i else INDICES,
        }
        for i, (offset, block) in enumerate(zip(offsets, blocks, strict=False))
    ]
    return {
        "asset": {"version": "2.0", "generator": "taichi_unifusion"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {name: 1 + i for i, name in enumerate(names)},
                        "indices": 0,
                        "mode": 4,  # triangles
                    }
                ]
            }
        ],
        "accessors": [_accessor(i, block) for i, block in enumerate(blocks)],
        "bufferViews": views,
        "buffers": [{"byteLength": offsets[-1]}],
    }


def _accessor(view: int, block: NDArray[Any]) -> dict[str, Any]:
    """How to read a block: (N,) indices or (N, c) by vertex; bytes are colours."""
    kind = block.dtype.str.removeprefix("|")
    accessor = {
        "bufferView": view,
        "componentType": TYPES[kind],
        "count": len(block),
        "type": "SCALAR" if block.ndim == 1 else f"VEC{block.shape[1]}",
        "min": np.atleast_1d(block.min(axis=0)).tolist(),
        "max": np.atleast_1d(block.max(axis=0)).tolist(),
    }
    return accessor | ({"normalized": True} if kind == "u1" else {})
