"""cut_mesh: a mesh ends within its triangles, where values between its vertices turn negative."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_laws import assert_welded

from taichi_unifusion.maps.cut_mesh import cut_mesh

AREA = 1e-4  # relative: cuts go through vertices that are this near, in edges


@pytest.fixture(scope="module")
def sheet():
    """The unit square in triangles at random places, facing +z."""
    from scipy.spatial import Delaunay

    rng = np.random.default_rng(6)
    inner, side = rng.uniform(size=(300, 2)), np.linspace(0, 1, 9)
    border = [(x, y) for x in side for y in side if x in (0, 1) or y in (0, 1)]
    places = np.vstack([inner, border])
    faces = Delaunay(places).simplices
    (ux, uy), (vx, vy) = (places[faces[:, k]].T - places[faces[:, 0]].T for k in (1, 2))
    turned = ux * vy < uy * vx
    faces[turned] = faces[turned][:, ::-1]
    return np.column_stack([places, np.zeros(len(places))]).astype(np.float32), faces.astype(
        np.int32
    )


def assert_within(sheet, source, points) -> None:
    """Each point (N, 3) lies in the face of the sheet that it is said to come from."""
    a, b, c = np.moveaxis(sheet[0][sheet[1][source]].astype(float), 1, 0)
    whole = np.cross(b - a, c - a)[:, 2]
    for p, q in ((a, b), (b, c), (c, a)):
        assert (np.cross(q - p, points - p)[:, 2] >= -1e-6 * whole).all()


def assert_cut(sheet, values, area: float) -> None:
    vertices, faces, source = cut_mesh(*sheet, values.astype(np.float32))
    assert_welded(vertices, faces)
    assert (
        vertices.dtype == np.float32
        and faces.dtype == np.int32
        and len(np.unique(vertices, axis=0)) == len(vertices)
    )
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    assert_within(sheet, source, (a + b + c) / 3)
    doubled = np.cross(b - a, c - a)
    assert (doubled[:, 2] > -1e-9).all() and doubled[:, 2].sum() / 2 == pytest.approx(
        area, rel=AREA
    )
    pairs = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    uses = np.unique(pairs, axis=0, return_counts=True)[1]
    assert uses.max() == 2
    # Euler: one piece without holes: an edge is cut once
    assert len(vertices) - len(uses) + len(faces) == 1


@pytest.mark.parametrize(
    ("slope", "offset", "area"),
    [
        ((1, 0), -0.3, 0.7),
        ((-1, 0), 0.3, 0.3),
        ((0, 1), -0.55, 0.45),
        ((1, 1), -1, 0.5),
        ((-1, -1), 0.5, 0.125),
    ],
)
def test_a_cut_along_a_line_leaves_the_area_on_its_side(sheet, slope, offset, area):
    assert_cut(sheet, sheet[0][:, :2] @ slope + offset, area)


def test_a_cut_through_vertices_makes_no_slivers_and_no_vertex_twice():
    """A grid of squares cut along one of its lines, through vertices whose value is exactly 0."""
    n = 9
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    places = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    faces = np.vstack([a + [0, n, n + 1], a + [0, n + 1, 1]]).astype(np.int32)
    for values, area in (
        (places[:, 0] - 3, 40),
        (3 - places[:, 0], 24),
        (places[:, 0] + places[:, 1] - 8, 32),
        (np.where(places[:, 0] < 4, 0, -1), 24),
    ):
        assert_cut((places, faces), values, area)


def test_a_mesh_of_one_sign_is_kept_or_gone(sheet):
    vertices, faces = sheet
    kept = cut_mesh(vertices, faces, np.zeros(len(vertices), np.float32))
    assert kept[0] is vertices and kept[1] is faces
    np.testing.assert_array_equal(kept[2], np.arange(len(faces)))
    gone = cut_mesh(vertices, faces, np.full(len(vertices), -1, np.float32))
    assert (
        gone[0].shape == gone[1].shape == (0, 3) and len(gone[2]) == 0 and gone[1].dtype == np.int32
    )
