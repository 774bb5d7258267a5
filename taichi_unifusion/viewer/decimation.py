"""Fewer triangles where a page could not hold them all, with a sentence that says what was lost."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry.triangles import SurfaceDistance
from ..rendering.simplification import simplify
from ..types import Mesh
from .scene import Scene, SceneMesh

MEASURED = 3000  # vertices of the whole mesh whose distance to the reduced one is measured
LEAST_SAID = 1e-4  # [m]; what is less is said to be under that


def decimate_scene(scene: Scene, triangles: int) -> Scene:
    """The scene with at most about so many triangles, shared by its meshes as they share them now."""
    if scene.triangles <= triangles:
        return scene
    share = triangles / scene.triangles
    meshes = [decimate(mesh, int(share * len(mesh.mesh.faces))) for mesh in scene.meshes]
    return replace(scene, meshes=tuple(meshes))


def decimate(shown: SceneMesh, triangles: int) -> SceneMesh:
    """A mesh of about so many triangles; each vertex takes colours and values of the nearest one of
    the whole mesh. Its note says what was done, and how far off it is. Errors as `simplify`.
    """
    whole = shown.mesh
    if len(whole.faces) <= triangles:
        return shown
    from scipy.spatial import KDTree

    mesh = simplify(whole, max(triangles, 4))
    rows = np.asarray(KDTree(whole.vertices).query(mesh.vertices)[1])
    mean, most = _off(whole.vertices, mesh)
    note = (
        f"{len(mesh.faces):,} of {len(whole.faces):,} triangles are shown: {_said(mean)} off the whole mesh in the "
        f"mean, 99 % within {1e3 * max(most, LEAST_SAID):.1f} mm"
    )
    layers = tuple(layer.take(rows) for layer in shown.layers)
    return replace(shown, mesh=mesh, layers=layers, note=_joined(shown.note, note))


def _off(points: NDArray, mesh: Mesh) -> tuple[float, float]:
    """Mean and 99th percentile [m] of the distance of some points to a mesh."""
    chosen = np.linspace(0, len(points) - 1, min(len(points), MEASURED)).astype(int)
    distances = SurfaceDistance(mesh.vertices, mesh.faces)(points[chosen])
    return float(distances.mean()), float(np.percentile(distances, 99))


def _said(length: float) -> str:
    """A length [m] in words, to a tenth of a millimetre."""
    return f"{1e3 * length:.1f} mm" if length >= LEAST_SAID else f"under {1e3 * LEAST_SAID:.1f} mm"


def _joined(*notes: str) -> str:
    return "; ".join(note for note in notes if note)
