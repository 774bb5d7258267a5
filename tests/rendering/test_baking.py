"""Textures: every place of the surface shows the field's colour there, also at the charts' rims and when
seen from far, and what the field does not know is filled in.
"""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.errors import InputError
from taichi_unifusion.files.texture import Texture
from taichi_unifusion.geometry.triangles import sample_surface
from taichi_unifusion.rendering.atlas import unwrap
from taichi_unifusion.rendering.baking import bake
from taichi_unifusion.rendering.textured_scene import mip_levels
from taichi_unifusion.types import Mesh

pytest.importorskip("xatlas")
trimesh = pytest.importorskip("trimesh")

TEXEL = 0.02
STEP = 1 / 255  # of 8 bits


def ball() -> Mesh:
    """A faceted ball of 1 m, whose charts are bent."""
    made = trimesh.creation.icosphere(subdivisions=3, radius=0.5)
    return Mesh(
        np.float32(made.vertices), np.int32(made.faces), np.float32(made.vertices / 0.5), {}
    )


def ramp(points):
    """A colour that names the place within the ball; known everywhere."""
    return np.clip(points + 0.5, 0, 1).astype(np.float32), np.ones(len(points), bool)


def look_up(image, coordinates):
    """Bilinear colours (N, 3) in [0, 1] at texture coordinates (N, 2), as graphics hardware defines them."""
    height, width = image.shape[:2]
    x, y = (coordinates * (width, height) - 0.5).T
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    a, b = (y - i)[:, None], (x - j)[:, None]

    def at(row, column):
        return image[row.clip(0, height - 1), column.clip(0, width - 1)] / 255

    return (1 - a) * ((1 - b) * at(i, j) + b * at(i, j + 1)) + a * (
        (1 - b) * at(i + 1, j) + b * at(i + 1, j + 1)
    )


def on_surface(textured, count=4000):
    """Random places of a textured mesh, world (N, 3) and texture (N, 2)."""
    mesh, rng = textured.mesh, np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(3), count)
    faces = mesh.faces[rng.integers(0, len(mesh.faces), count)]
    points = np.einsum("nk,nkd->nd", weights, mesh.vertices[faces])
    return points, np.einsum("nk,nkd->nd", weights, textured.texture.coordinates[faces])


@pytest.fixture(scope="module")
def textured():
    return bake(ball(), ramp, texel_m=TEXEL, max_side=512)


def test_the_texture_shows_the_field_everywhere(textured):
    points, coordinates = on_surface(textured)
    off = np.abs(look_up(textured.texture.image, coordinates) - ramp(points)[0]).max(axis=1)
    # a linear field is interpolated exactly, but for rounding to bytes and a rim that is a texel wide
    assert np.median(off) < STEP and np.percentile(off, 99) < TEXEL / 2 and off.max() < 2 * TEXEL


def test_the_surface_stays_and_vertices_are_only_doubled(textured):
    mesh, whole = textured.mesh, ball()
    assert len(mesh.faces) == len(whole.faces) and len(mesh.vertices) > len(whole.vertices)
    corners = [np.sort(m.vertices[m.faces].sum(axis=1), axis=0) for m in (mesh, whole)]
    np.testing.assert_allclose(*corners, atol=1e-6)
    np.testing.assert_allclose(mesh.normals, mesh.vertices / 0.5, atol=1e-6)
    assert 0 <= textured.texture.coordinates.min() <= textured.texture.coordinates.max() <= 1


def test_texels_are_as_wide_as_asked(textured):
    mesh, size = textured.mesh, textured.texture.image.shape[1::-1]
    corners = textured.texture.coordinates[mesh.faces] * np.array(size)
    a, b, c = corners.swapaxes(0, 1)
    (ux, uy), (vx, vy) = (b - a).T, (c - a).T
    texels = np.abs(ux * vy - uy * vx).sum() / 2
    surface = 4 * np.pi * 0.25
    assert surface / texels == pytest.approx(TEXEL**2, rel=0.2)


def test_nothing_but_the_surface_is_in_any_mip_level():
    def red(points):
        return np.tile(np.float32([1, 0.2, 0]), (len(points), 1)), np.ones(len(points), bool)

    image = bake(ball(), red, texel_m=TEXEL, max_side=512).texture.image
    for level in mip_levels(image):
        assert (level == [255, 51, 0]).all()


def test_far_away_colors_do_not_bleed_between_charts(textured):
    points, coordinates = on_surface(textured)
    level = mip_levels(textured.texture.image)[2]  # a texel is four wide
    off = np.abs(look_up(level, coordinates) - ramp(points)[0]).max(axis=1)
    assert np.percentile(off, 99) < 4 * TEXEL and off.max() < 12 * TEXEL


def test_what_the_field_does_not_know_takes_the_nearest_color():
    def upper_half(points):
        colors, _ = ramp(points)
        known = points[:, 2] > 0
        return np.where(known[:, None], colors, 0), known

    half = bake(ball(), upper_half, texel_m=TEXEL, max_side=512)
    points, coordinates = on_surface(half)
    shown = look_up(half.texture.image, coordinates)
    low = points[:, 2] < -0.05
    # all of it lies nearest to the equator, at the place straight above
    assert np.abs(shown[low, 2] - 0.5).max() < 2 * TEXEL
    wide = low & (np.linalg.norm(points[:, :2], axis=1) > 0.3)
    outward = points[wide, :2] / np.linalg.norm(points[wide, :2], axis=1, keepdims=True)
    assert (((shown[wide, :2] - 0.5) * outward).sum(axis=1) > 0.45).all()


def test_triangles_smaller_than_a_texel_have_their_own_color():
    rng = np.random.default_rng(2)
    places = rng.random((60, 3)) - 0.5
    corners = places[:, None] + 0.002 * rng.normal(size=(60, 3, 3))
    mesh = Mesh(
        corners.reshape(-1, 3).astype(np.float32), np.arange(180, dtype=np.int32).reshape(-1, 3)
    )
    small = bake(mesh, ramp, texel_m=TEXEL, max_side=512)
    points, coordinates = on_surface(small, 500)
    off = np.abs(look_up(small.texture.image, coordinates) - ramp(points)[0])
    assert off.max() < 2 * TEXEL


def test_triangles_without_an_area_are_left_out():
    whole = ball()
    flat = np.array([[0, 0, 1], [5, 9, 9]], np.int32)
    mesh = Mesh(whole.vertices, np.concatenate([flat, whole.faces]), whole.normals)
    made = bake(mesh, ramp, texel_m=TEXEL, max_side=512)
    assert len(made.mesh.faces) == len(whole.faces)
    points, coordinates = on_surface(made)
    assert np.abs(made.texture.at(coordinates) - ramp(points)[0]).max() < 2 * TEXEL


def test_a_texture_that_would_be_too_large_gets_wider_texels():
    small = bake(ball(), ramp, texel_m=0.001, max_side=200)
    assert max(small.texture.image.shape) <= 200 and small.texel_m > 0.005


def test_a_surface_that_cannot_fit_is_said():
    points = sample_surface(ball().vertices, ball().faces, 900, np.random.default_rng(0))
    corners = points[:, None] + 0.001 * np.eye(3)
    crumbs = Mesh(
        corners.reshape(-1, 3).astype(np.float32), np.arange(2700, dtype=np.int32).reshape(-1, 3)
    )
    with pytest.raises(InputError, match="charts do not fit into 16 x 16 texels"):
        unwrap(crumbs, 0.001, 16)


def test_a_texture_is_looked_up_as_graphics_hardware_does():
    image = np.random.default_rng(0).integers(0, 256, (7, 5, 3), np.uint8)
    coordinates = np.random.default_rng(1).random((500, 2)).astype(np.float32)
    texture = Texture(coordinates, image)
    np.testing.assert_allclose(texture.at(coordinates), look_up(image, coordinates), atol=1e-6)
    corners = np.array([(0, 0), (1, 1), (-3, 0.5), (2.5 / 5, 3.5 / 7)])
    ends = np.stack([image[0, 0], image[6, 4], image[3, 0], image[3, 2]]) / 255
    np.testing.assert_allclose(texture.at(corners), ends, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"texel_m": 0.0}, "wider than 0 m"),
        ({"max_side": 8}, "16..16384 texels"),
        ({"color": lambda p: (np.zeros((len(p), 3)), np.zeros(len(p), bool))}, "know nothing"),
    ],
)
def test_what_cannot_be_baked_is_said(options, message):
    with pytest.raises(InputError, match=message):
        bake(ball(), **{"color": ramp, "texel_m": TEXEL, **options})
