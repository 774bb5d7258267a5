"""Meshes read: PLY of any program directly, other formats by trimesh."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from ..errors import FileError, InputError
from ..types import Mesh
from .atomic import read_bytes
from .glb_reading import parse_own_glb
from .ply_reading import parse_ply
from .texture import Texture

SUFFIXES = (".ply", ".glb", ".gltf", ".obj", ".off", ".stl")


def read_mesh(path: str | os.PathLike[str]) -> Mesh:
    """Read a PLY mesh, ours or another program's; raises FileError where it is missing, truncated
    or inconsistent.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: meshes are read from .ply, not from '{path.suffix}'")
    return parse_ply(read_bytes(path), name=str(path))


def read_any_mesh(path: str | Path) -> Mesh:
    """Read the triangles of a mesh file, parts of a scene in their places; colour only from PLY
    and from our own GLB, which is read in the map's world, however it stands in viewers.

    Raises FileError where the file is missing or damaged, InputError for a suffix that is not a
    mesh's.
    """
    return read_textured_mesh(path)[0]


def read_textured_mesh(path: str | Path) -> tuple[Mesh, Texture | None]:
    """What `read_any_mesh` reads, and the texture where the file is a GLB of ours that has one."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise InputError(
            f"{path}: meshes are read from {', '.join(SUFFIXES)}, not from '{path.suffix}'"
        )
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    if suffix == ".ply":
        return read_mesh(path), None
    try:
        if suffix == ".glb" and (own := parse_own_glb(read_bytes(path))):
            return own
        import trimesh  # a second of import

        return _joined(trimesh.load_scene(path, process=False)), None
    except Exception as error:  # noqa: BLE001 - its readers raise whatever they stumble over
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
