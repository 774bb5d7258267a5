"""Meshes written as GLB, the binary form of glTF 2.0: metres, +Y up, linear vertex colours or an sRGB texture.

Vertices stay as they are in the map's world; the one node of the file turns them upright. Like
`ply`, this imports no more than NumPy: a library for all of glTF takes a second to import, which
every run would wait for.
"""

from __future__ import annotations

import json
import struct
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .ply import Triangles, colors_of
from .srgb import LINEAR_OF_BYTE
from .texture import MIME_TYPES, ImageKind, Texture

GENERATOR = "taichi_unifusion"
TYPES = {"<f4": 5126, "<u4": 5125}  # componentType of glTF
VERTICES, INDICES = 34962, 34963  # what a buffer view is for
LINEAR, LINEAR_MIPMAP_LINEAR, CLAMP_TO_EDGE = 9729, 9987, 33071  # of a sampler
UNLIT = "KHR_materials_unlit"
ALIGNMENT = 4  # bytes, of the parts of the file
# to a frame whose z is up from one whose y is: x stays, y is the old z, z the old -y
T_GLTF_UP = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]], np.float64)


def write_glb(
    file: BinaryIO,
    mesh: Triangles,
    texture: Texture | None = None,
    *,
    T_up_world: NDArray | None = None,
    lit: bool = False,
    image: ImageKind = "jpg",
    light: NDArray | None = None,
) -> None:
    """Write `mesh` to an open file: positions, unit normals, and its texture or else its 8-bit
    colours by vertex, as linear light; in the order of the vertices.

    `T_up_world` (4, 4), rigid, takes the world to a frame whose z is up, and gives the node its
    turn to +Y up; without it the world is taken as it is. `light` (V, 3) is written as linear light
    in place of the mesh's own colours. Colours of a recording hold its light, so
    viewers are told to add none (KHR_materials_unlit) unless `lit`. Raises InputError where
    vertices are not finite: glTF has no number for that.
    """
    if not np.isfinite(mesh.vertices).all():
        raise InputError("mesh: has vertices that are not finite, which GLB cannot hold")
    columns: dict[str, NDArray[Any]] = {"POSITION": np.ascontiguousarray(mesh.vertices, "<f4")}
    colors = None if texture or light is not None else colors_of(mesh)
    if texture is not None:
        columns["TEXCOORD_0"] = np.ascontiguousarray(texture.coordinates, "<f4")
    elif light is not None:
        columns["COLOR_0"] = np.ascontiguousarray(light, "<f4")
    elif colors is not None:
        # floats: 8 linear bits would lose the dark steps, and trimesh misreads 16
        columns["COLOR_0"] = LINEAR_OF_BYTE.astype("<f4")[colors]
    if mesh.normals is not None:
        columns["NORMAL"] = unit_normals(mesh.normals)
    blocks = [np.ascontiguousarray(mesh.faces, "<u4").reshape(-1), *columns.values()]
    picture = texture.encoded(image) if texture else b""
    said = _describe(blocks, list(columns), len(picture))
    matt: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    said["materials"] = [{"pbrMetallicRoughness": matt}]
    if texture:
        matt["baseColorTexture"] = {"index": 0}
        said |= _describe_texture(len(blocks), image)
    if (texture or "COLOR_0" in columns) and not lit:
        said["materials"][0]["extensions"] = {UNLIT: {}}
        said["extensionsUsed"] = [UNLIT]
    if T_up_world is not None:
        # column by column
        said["nodes"][0]["matrix"] = (T_GLTF_UP @ T_up_world).T.reshape(-1).tolist()
    _write_chunks(file, said, [*(block.data for block in blocks), picture])


def unit_normals(normals: NDArray) -> NDArray[np.float32]:
    """Normals (V, 3) of length 1; those that have none point along z."""
    normals = np.nan_to_num(np.asarray(normals, np.float64), posinf=0.0, neginf=0.0)
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    known = lengths > 1e-6
    return np.where(known, normals / np.where(known, lengths, 1), (0, 0, 1)).astype("<f4")


def _write_chunks(file: BinaryIO, said: dict[str, Any], parts: list[Any]) -> None:
    header = json.dumps(said, separators=(",", ":")).encode()
    header += b" " * (-len(header) % ALIGNMENT)
    size = sum(memoryview(part).nbytes for part in parts)
    padding = b"\0" * (-size % ALIGNMENT)
    size += len(padding)
    file.write(struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(header) + 8 + size))
    file.write(struct.pack("<I4s", len(header), b"JSON") + header)
    file.write(struct.pack("<I4s", size, b"BIN\0"))
    for part in (*parts, padding):
        file.write(part)


def _describe(blocks: list[NDArray[Any]], names: list[str], picture: int) -> dict[str, Any]:
    """The JSON of a mesh whose indices are the first block, and whose vertices the others; then
    come so many bytes of a picture.
    """
    offsets = np.cumsum([0, *(block.nbytes for block in blocks)]).tolist()
    views: list[dict[str, Any]] = [
        {
            "buffer": 0,
            "byteOffset": offset,
            "byteLength": block.nbytes,
            "target": VERTICES if i else INDICES,
        }
        for i, (offset, block) in enumerate(zip(offsets, blocks, strict=False))
    ]
    if picture:
        views.append({"buffer": 0, "byteOffset": offsets[-1], "byteLength": picture})
    primitive = {
        "attributes": {name: 1 + i for i, name in enumerate(names)},
        "indices": 0,
        "material": 0,
        "mode": 4,  # triangles
    }
    return {
        "asset": {"version": "2.0", "generator": GENERATOR},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "map"}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": [_accessor(i, block) for i, block in enumerate(blocks)],
        "bufferViews": views,
        "buffers": [{"byteLength": offsets[-1] + picture}],
    }


def _accessor(view: int, block: NDArray[Any]) -> dict[str, Any]:
    """How to read a block: (N,) indices or (N, c) by vertex."""
    return {
        "bufferView": view,
        "componentType": TYPES[block.dtype.str],
        "count": len(block),
        "type": "SCALAR" if block.ndim == 1 else f"VEC{block.shape[1]}",
        "min": np.atleast_1d(block.min(axis=0)).tolist(),
        "max": np.atleast_1d(block.max(axis=0)).tolist(),
    }


def _describe_texture(view: int, image: ImageKind) -> dict[str, Any]:
    """The JSON of a texture whose picture lies in a buffer view."""
    sampler = {
        "magFilter": LINEAR,
        "minFilter": LINEAR_MIPMAP_LINEAR,
        "wrapS": CLAMP_TO_EDGE,
        "wrapT": CLAMP_TO_EDGE,
    }
    return {
        "textures": [{"sampler": 0, "source": 0}],
        "samplers": [sampler],
        "images": [{"bufferView": view, "mimeType": MIME_TYPES[image]}],
    }
