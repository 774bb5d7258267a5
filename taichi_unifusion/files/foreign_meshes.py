"""Meshes of any program: ours and other PLY files directly, the rest by trimesh."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..errors import FileError, InputError
from ..types import Mesh
from .meshes import read_mesh

SUFFIXES = (".ply", ".glb", ".gltf", ".obj", ".off", ".stl")


def read_any_mesh(path: str | Path) -> Mesh:
    """Read the triangles of a mesh file, parts of a scene in their places; colour only from PLY.

    Raises FileError where the file is missing or damaged, InputError for a suffix that is not a
    mesh's.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path}: meshes are read from {', '.join(SUFFIXES)}, not from '{path.suffix}'"
        )
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    if suffix == ".ply":
        return read_mesh(path)
    import trimesh  # a second of import

    try:
        return _joined(trimesh.load_scene(path, process=False))
    except Exception as error:  # its readers raise whatever they stumble over
        reason = " ".join(str(error).split())[:200]
        raise FileError(
            f"{path}: cannot be read as a mesh ({type(error).__name__}: {reason})"
        ) from None


def _joined(scene) -> Mesh:
    """The triangles of a trimesh scene, in its own frame; trimesh would join the textures too, at
    gigabytes.
    """
    vertices, faces, count = [], [], 0
    for node in scene.graph.nodes_geometry:
        T_scene_part, name = scene.graph[node]
        part = scene.geometry[name]
        if hasattr(part, "faces"):  # else lines or points
            vertices.append(part.vertices @ T_scene_part[:3, :3].T + T_scene_part[:3, 3])
            faces.append(part.faces + count)
            count += len(part.vertices)
    if not faces:
        raise ValueError("it holds no triangles")
    return Mesh(np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int32))
