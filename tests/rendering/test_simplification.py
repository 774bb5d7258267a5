"""Fewer triangles: the shape, the borders and the orientation stay, and the stated error is the true one."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.errors import InputError
from taichi_unifusion.geometry.triangles import area_vectors, areas
from taichi_unifusion.rendering.simplification import border_edges, simplify, surface_error
from taichi_unifusion.types import Mesh

pytest.importorskip("fast_simplification")

FLAT = 1e-6  # [m] float32 rounding of coordinates of some metres
KEPT = 0.003  # of its area that a flat mesh may lose at its ragged border


def grid(count: int, height=lambda x, y: 0 * x, keep=lambda x, y: x > -np.inf) -> Mesh:
    """Two triangles in each of count x count cells of the unit square whose centre is kept."""
    x, y = np.meshgrid(*[np.linspace(0, 1, count + 1)] * 2, indexing="ij")
    vertices = np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3).astype(np.float32)
    i, j = np.meshgrid(*[np.arange(count)] * 2, indexing="ij")
    a = (i * (count + 1) + j).ravel()
    kept = keep((i.ravel() + 0.5) / count, (j.ravel() + 0.5) / count)
    cells = a[kept, None] + np.array([[0, count + 1, count + 2, 0, count + 2, 1]])
    return Mesh(vertices, cells.reshape(-1, 3).astype(np.int32))


def test_a_flat_mesh_keeps_its_area_and_its_border():
    ragged = grid(60, keep=lambda x, y: np.hypot(x - 0.5, y - 0.4) > 0.2)
    fewer = simplify(ragged, len(ragged.faces) // 6)
    assert len(fewer.faces) <= 1.05 * len(ragged.faces) / 6
    before, after = (areas(m.vertices, m.faces).sum() for m in (ragged, fewer))
    assert after == pytest.approx(before, rel=KEPT)
    assert np.abs(fewer.vertices[:, 2]).max() < FLAT
    # also the outline of the hole: no triangle spans it
    centers = fewer.vertices[fewer.faces].mean(axis=1)
    assert np.hypot(centers[:, 0] - 0.5, centers[:, 1] - 0.4).min() > 0.19


def test_a_curved_mesh_stays_near_and_faces_the_same_way():
    def bump(x, y):
        return 0.2 * np.sin(4 * x) * np.cos(3 * y)

    full = grid(80, bump)
    fewer = simplify(full, len(full.faces) // 4)
    off = np.abs(fewer.vertices[:, 2] - bump(*fewer.vertices[:, :2].T))
    assert off.max() < 2e-3
    assert (area_vectors(fewer.vertices, fewer.faces)[:, 2] > 0).all()
    assert (fewer.normals[:, 2] > 0).all() and len(fewer.normals) == len(fewer.vertices)
    np.testing.assert_allclose(np.linalg.norm(fewer.normals, axis=1), 1, atol=1e-5)
    assert np.unique(fewer.faces).tolist() == list(range(len(fewer.vertices)))
    error = surface_error(fewer, full)
    assert 0 < error.rms_mm < 1 and error.rms_mm < error.p99_mm <= error.largest_mm < 5


def test_a_mesh_of_few_triangles_is_left_as_it_is():
    full = grid(4)
    assert simplify(full, 32).faces is full.faces or np.array_equal(
        simplify(full, 32).faces, full.faces
    )


def test_the_error_is_the_distance_of_the_surfaces():
    low, high = grid(10), grid(7, lambda x, y: 0 * x + 0.012)
    assert surface_error(low, low).largest_mm < 1e-3
    error = surface_error(low, high)
    for value in (error.rms_mm, error.p99_mm, error.largest_mm):
        assert value == pytest.approx(12, abs=0.01)
    assert "12.00 mm off the full mesh (RMS), 99 % within 12.0 mm" in str(error)
    # what is missing counts as well: measured from both surfaces
    half = grid(10, keep=lambda x, y: x < 0.5)
    assert surface_error(half, low).largest_mm == pytest.approx(500, rel=0.02)
    assert surface_error(low, half).largest_mm == pytest.approx(500, rel=0.02)


def test_border_edges_are_those_of_one_triangle():
    edges, owner = border_edges(grid(3).faces)
    assert len(edges) == 12 and (owner < 18).all()
    for edge, triangle in zip(edges, owner, strict=True):
        assert set(edge) <= set(grid(3).faces[triangle])


@pytest.mark.parametrize(
    ("mesh", "triangles", "message"),
    [
        (grid(3), 0, "at least one triangle"),
        (Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), 5, "no triangles"),
        (Mesh(np.full((3, 3), np.nan, np.float32), np.array([[0, 1, 2]])), 5, "not finite"),
    ],
)
def test_what_cannot_be_simplified_is_said(mesh, triangles, message):
    with pytest.raises(InputError, match=message):
        simplify(mesh, triangles)
