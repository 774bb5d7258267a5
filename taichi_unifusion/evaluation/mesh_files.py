"""Meshes of any program: ours and other PLY files directly, the rest by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import FileError, InputError
from ..io import read_mesh
from ..types import Mesh

SUFFIXES = (".ply", ".glb", ".gltf", ".obj", ".off", ".stl")


def read_any_mesh(path: str | Path) -> Mesh:
    """Read the triangles of a mesh file, parts of a scene in their places; colour only from PLY.

    Raises FileError where the file is missing or damaged, InputError for a suffix that is not a mesh's.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(f"{path}: meshes are read from {', '.join(SUFFIXES)}, not from '{path.suffix}'")
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    if suffix == ".ply":
        return read_mesh(path)
    import trimesh  # a second of import

    try:
        loaded = trimesh.load(path, process=False)
        whole = loaded.to_mesh() if isinstance(loaded, trimesh.Scene) else loaded
        return Mesh(np.asarray(whole.vertices, np.float32), np.asarray(whole.faces, np.int32))
    except Exception as error:  # its readers raise whatever they stumble over
        reason = " ".join(str(error).split())[:200]
        raise FileError(f"{path}: cannot be read as a mesh ({type(error).__name__}: {reason})") from None
