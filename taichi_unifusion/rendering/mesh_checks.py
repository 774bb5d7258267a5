"""What kernels and metrics may rely on in a mesh, checked once."""

from __future__ import annotations

import numpy as np

from ..errors import InputError
from ..geometry.triangles import areas
from ..types import Mesh


def check_mesh(mesh: Mesh, name: str) -> Mesh:
    """The mesh with arrays as kernels take them; raises InputError where it is empty, not finite or
    inconsistent.

    `name` says which mesh it is, in messages.
    """
    vertices = np.ascontiguousarray(mesh.vertices, np.float32)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    if not len(faces):
        raise InputError(
            f"{name}: has no triangles"
            + (f", only {len(vertices)} points" if len(vertices) else "")
        )
    if not 0 <= faces.min() <= faces.max() < len(vertices):
        raise InputError(
            f"{name}: its triangles name vertices {faces.min()}..{faces.max()}, but it has {len(vertices)}"
        )
    bad = int((~np.isfinite(vertices).all(axis=1)).sum())
    if bad:
        raise InputError(f"{name}: {bad} of {len(vertices)} vertices are not finite numbers")
    if not areas(vertices, faces).sum() > 0:
        raise InputError(f"{name}: its triangles have no area")
    return Mesh(vertices, faces, mesh.normals, mesh.attributes)
