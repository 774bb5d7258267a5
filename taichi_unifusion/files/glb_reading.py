"""Meshes read back from the GLB files that `glb` writes: exactly, in the map's world,
colours as sRGB."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..types import Mesh
from .glb import GENERATOR, TYPES
from .images import decode_color
from .json_text import parse_json
from .srgb import linear_to_srgb
from .texture import Texture

NUMBERS = {code: kind for kind, code in TYPES.items()}
COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}


def parse_own_glb(data: bytes) -> tuple[Mesh, Texture | None] | None:
    """The mesh and its texture, if it has one, in the bytes of a GLB file that we wrote; None for any
    other file, those of earlier versions included, which hold colours as bytes.

    Raises ValueError, KeyError, IndexError, struct.error or FrameError where the file is damaged.
    """
    if data[:4] != b"glTF":
        return None
    (size,) = struct.unpack_from("<I", data, 12)
    said = parse_json(data[20 : 20 + size])
    if said["asset"].get("generator") != GENERATOR:
        return None
    if any(entry["componentType"] not in NUMBERS for entry in said["accessors"]):
        return None
    (length,) = struct.unpack_from("<I", data, 20 + size)
    body = data[28 + size :]
    if len(body) != length:
        raise ValueError(f"it promises {length} bytes and holds {len(body)}")
    (primitive,) = said["meshes"][0]["primitives"]

    def read(accessor: int) -> NDArray[Any]:
        entry = said["accessors"][accessor]
        view, columns = said["bufferViews"][entry["bufferView"]], COLUMNS[entry["type"]]
        kind = NUMBERS[entry["componentType"]]
        values = np.frombuffer(body, kind, entry["count"] * columns, view["byteOffset"])
        return values.reshape(entry["count"], columns).copy()

    columns = {name: read(accessor) for name, accessor in primitive["attributes"].items()}
    vertices, faces = columns["POSITION"], read(primitive["indices"]).reshape(-1, 3)
    if faces.max() >= len(vertices):
        raise ValueError(f"a triangle names vertex {faces.max()} of {len(vertices)}")
    attributes = {"color": linear_to_srgb(columns["COLOR_0"])} if "COLOR_0" in columns else {}
    mesh = Mesh(vertices, faces.astype(np.int32), columns.get("NORMAL"), attributes)
    if "TEXCOORD_0" not in columns:
        return mesh, None
    view = said["bufferViews"][said["images"][0]["bufferView"]]
    picture = body[view["byteOffset"] : view["byteOffset"] + view["byteLength"]]
    return mesh, Texture(columns["TEXCOORD_0"], decode_color(picture, "its texture"))
