"""Charts: every triangle lies in one, flat, hardly stretched, and alone where it lies."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.geometry.triangles import areas
from taichi_unifusion.rendering.atlas import ONE_PLACE, unwrap
from taichi_unifusion.rendering.baking import bake
from taichi_unifusion.rendering.charts import STEEPEST, cut_charts
from taichi_unifusion.types import Mesh

trimesh = pytest.importorskip("trimesh")


def mesh_of(made) -> Mesh:
    return Mesh(np.float32(made.vertices), np.int32(made.faces))


def turned_box() -> Mesh:
    """A box of many triangles that stands at 45 degrees to the world's axes, with noise."""
    box = trimesh.creation.box((2, 1.2, 0.8)).subdivide().subdivide().subdivide()
    box.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 4, (0, 0, 1)))
    noise = np.random.default_rng(0).normal(size=box.vertices.shape)
    return Mesh(np.float32(box.vertices + 0.004 * noise), np.int32(box.faces))


def ramp(turns: float = 2.5) -> Mesh:
    """A ramp that winds over itself: one chart by its normals, which would lie on itself."""
    angle = np.linspace(0, 2 * np.pi * turns, 200)
    inner, outer = (
        np.stack([r * np.cos(angle), r * np.sin(angle), 0.1 * angle], axis=1) for r in (1, 2)
    )
    a = np.arange(199)[:, None]
    faces = np.concatenate([np.hstack([a, a + 200, a + 201]), np.hstack([a, a + 201, a + 1])])
    return Mesh(np.concatenate([inner, outer]).astype(np.float32), faces.astype(np.int32))


MESHES = {
    "box": turned_box(),
    "ball": mesh_of(trimesh.creation.icosphere(subdivisions=3)),
    "ramp": ramp(),
    "soup": Mesh(
        np.random.default_rng(1).random((300, 3)).astype(np.float32),
        np.arange(300, dtype=np.int32).reshape(-1, 3),
    ),
}


def flat_areas(places: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Signed areas (F,)."""
    a, b, c = places[faces].astype(np.float64).swapaxes(0, 1)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    return (ux * vy - uy * vx) / 2


@pytest.mark.parametrize("name", MESHES)
def test_charts_are_flat_and_hardly_stretched(name):
    mesh = MESHES[name]
    charts = cut_charts(mesh).flattened()
    assert np.array_equal(charts.source[charts.faces], mesh.faces)  # nothing but doubled vertices
    shrunk = flat_areas(charts.places, charts.faces) / areas(mesh.vertices, mesh.faces)
    # none is turned over, none much narrower than it is
    assert (shrunk > STEEPEST - 1e-3).all() and (shrunk < 1 + 1e-3).all()
    size = areas(mesh.vertices, mesh.faces)
    assert (shrunk * size).sum() / size.sum() > 0.8


def test_a_box_has_six_charts_however_it_stands():
    assert cut_charts(MESHES["box"]).chart.max() + 1 == 6


@pytest.mark.parametrize("name", MESHES)
def test_no_texel_belongs_to_two_places(name):
    pytest.importorskip("xatlas")
    mesh = MESHES[name]
    atlas = unwrap(mesh, 0.01, 2048)
    assert len(atlas.mesh.faces) == len(mesh.faces)
    # random places of the surface, drawn as dots: those in one texel are one place
    rng = np.random.default_rng(2)
    faces = atlas.mesh.faces[rng.integers(0, len(mesh.faces), 60_000)]
    weights = rng.dirichlet(np.ones(3), len(faces))
    points = np.einsum("nk,nkd->nd", weights, atlas.mesh.vertices[faces])
    texels = np.floor(np.einsum("nk,nkd->nd", weights, atlas.places[faces])).astype(int)
    assert texels.min() >= 0 and (texels < (atlas.width, atlas.height)).all()
    code = texels[:, 1] * atlas.width + texels[:, 0]
    order = np.argsort(code, kind="stable")
    same = np.flatnonzero(code[order[1:]] == code[order[:-1]])
    assert len(same) > 50
    apart = np.linalg.norm(points[order[same]] - points[order[same + 1]], axis=1)
    assert apart.max() < ONE_PLACE * 0.01


def test_a_ramp_that_winds_over_itself_keeps_its_colors():
    pytest.importorskip("xatlas")
    high = 0.1 * 2.5 * 2 * np.pi

    def height(points):
        colors = np.repeat(points[:, 2:] / high, 3, axis=1).clip(0, 1).astype(np.float32)
        return colors, np.ones(len(points), bool)

    made = bake(MESHES["ramp"], height, texel_m=0.01, max_side=2048)
    centers = made.texture.coordinates[made.mesh.faces].mean(axis=1)
    shown = made.texture.at(centers)[:, 0] * high
    np.testing.assert_allclose(
        shown, made.mesh.vertices[made.mesh.faces].mean(axis=1)[:, 2], atol=0.02
    )
