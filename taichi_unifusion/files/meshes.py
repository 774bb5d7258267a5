"""Meshes written: PLY, GLB and OBJ. `mesh_reading` reads them."""

from __future__ import annotations

import os
from pathlib import Path

from numpy.typing import NDArray

from ..errors import InputError, MissingDependency, as_path
from .atomic import atomic_write
from .glb import write_glb
from .ply import Triangles, colors_of, write_ply

MESH_SUFFIXES = (".ply", ".glb", ".obj")


def write_mesh(path: str | os.PathLike, mesh: Triangles, T_up_world: NDArray | None = None) -> None:
    """Write `mesh` atomically; the suffix of `path` chooses PLY (binary), GLB or OBJ.

    Attribute "color" becomes 8-bit RGB, which GLB holds as linear light. PLY holds all other
    attributes as float properties, GLB and OBJ leave them out. A GLB whose world has a known up,
    `T_up_world` (4, 4), stands upright in viewers; the other formats hold the world as it
    is. Raises InputError for another suffix, bad face indices or an empty GLB/OBJ, FileError where
    the file cannot be written.
    """
    path = as_path("mesh file", path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InputError(
            f"{path}: a mesh is written as {', '.join(MESH_SUFFIXES)}, not as '{path.suffix}'"
        )
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise InputError(
            f"{path}: the faces name vertices {mesh.faces.min()}..{mesh.faces.max()}, "
            f"but the mesh has {len(mesh.vertices)}"
        )
    if suffix != ".ply" and not len(mesh.faces):
        raise InputError(f"{path}: the mesh is empty, which {suffix} cannot hold; write a .ply")
    if suffix == ".obj":
        content = _encode_obj(path, mesh)
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)
        return
    with atomic_write(path) as temporary, open(temporary, "wb") as file:
        if suffix == ".ply":
            write_ply(file, mesh)
        else:
            write_glb(file, mesh, T_up_world=T_up_world)


def _encode_obj(path: Path, mesh: Triangles) -> bytes:
    """The bytes of an OBJ file, vertices and faces in their order."""
    try:
        import trimesh
    except ImportError:
        raise MissingDependency(
            f"{path}: writing .obj needs trimesh: pip install trimesh"
        ) from None
    exported = trimesh.Trimesh(
        mesh.vertices,
        mesh.faces,
        vertex_normals=mesh.normals,
        process=False,
        vertex_colors=colors_of(mesh),
    )
    content = exported.export(file_type="obj", include_normals=mesh.normals is not None)
    return str(content).encode()
