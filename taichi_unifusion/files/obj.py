"""A textured mesh as OBJ, with its material and its image beside it; y is up, as most readers take it."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .atomic import atomic_write, write_text
from .ply import Triangles
from .texture import ImageKind, Texture

MATERIAL = "surface"
DIGITS = {"v": "%.5f", "vt": "%.6f", "vn": "%.4f"}  # 0.01 mm, a hundredth of a texel


def write_textured_obj(
    path: Path, mesh: Triangles, texture: Texture, T_out_world: NDArray, image: ImageKind
) -> list[Path]:
    """Write NAME.obj, NAME.mtl and NAME.png or .jpg, and give their paths; the vertices are moved
    by the rigid T_out_world (4, 4). Raises FileError where one cannot be written.
    """
    material, picture = path.with_suffix(".mtl"), path.with_suffix(f".{image}")
    R, t = T_out_world[:3, :3], T_out_world[:3, 3]
    coordinates = texture.coordinates * (1, -1) + (0, 1)  # OBJ's run up
    text = io.StringIO()
    text.write(f"# taichi_unifusion, metres\nmtllib {material.name}\n")
    _write_rows(text, "v", mesh.vertices @ R.T + t)
    _write_rows(text, "vt", coordinates)
    corners = [mesh.faces + 1] * 2
    if mesh.normals is not None:
        _write_rows(text, "vn", mesh.normals @ R.T)
        corners.append(corners[0])
    text.write(f"usemtl {MATERIAL}\n")
    corner = "/".join(["%d"] * len(corners))
    faces = np.stack(corners, axis=2).reshape(len(mesh.faces), -1)
    np.savetxt(text, faces, f"f {corner} {corner} {corner}")
    with atomic_write(picture) as temporary:
        temporary.write_bytes(texture.encoded(image))
    write_text(
        material,
        f"newmtl {MATERIAL}\nKa 0 0 0\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {picture.name}\n",
    )
    write_text(path, text.getvalue())
    return [path, material, picture]


def _write_rows(text: io.StringIO, key: str, rows: NDArray) -> None:
    np.savetxt(text, rows, f"{key} " + " ".join([DIGITS[key]] * rows.shape[1]))
