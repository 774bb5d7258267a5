"""A signed distance is one where it says so, on a plane and on a sphere; and meshes of boxes."""

from __future__ import annotations

import numpy as np
import pytest
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.errors import InputError
from taichi_unifusion.maps.distance import distances

VS, RADIUS, HEIGHT = 0.05, 0.3, 0.013  # [m]
WITHIN = 0.10  # of the true distance...
SLACK = 0.02 * VS  # ...beside what a regression leaves of a surface itself [m]
NEAR = (-0.5, -0.3, -0.2, -0.1, 0.1, 0.2, 0.3, 0.4, 0.5)  # [voxels] where nearly all is known
FAR = (-3.0, -2.0, -1.5, 1.5, 2.0, 3.0)  # [voxels] where nothing is


@pytest.fixture(scope="module")
def scenes():
    """Points, normals and map of a plane and of a sphere."""
    uf.init(DEVICE)
    rng = np.random.default_rng(0)
    flat = np.c_[rng.uniform(-0.5, 0.5, (30_000, 2)), np.full(30_000, HEIGHT)]
    ball = rng.normal(size=(30_000, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    made = {}
    for name, points, normals in (
        ("plane", flat, np.tile((0.0, 0.0, 1.0), (len(flat), 1))),
        ("sphere", RADIUS * ball, ball),
    ):
        surface = uf.SurfaceMap(voxel_size=VS)
        surface.integrate(uf.PointCloud(points.astype(np.float32), normals.astype(np.float32)))
        inner = np.abs(points[:, :2]).max(axis=1) < 0.4
        made[name] = points[inner][:400], normals[inner][:400], surface
    return made


@pytest.mark.parametrize("name", ["plane", "sphere"])
def test_what_is_known_is_the_distance(scenes, name):
    points, normals, surface = scenes[name]
    for offset in np.linspace(-2, 2, 41):
        values, known = surface.sdf(points + offset * VS * normals)
        error = np.abs(values - offset * VS)[known]
        assert (error <= WITHIN * abs(offset) * VS + SLACK).all(), (offset, error.max())


@pytest.mark.parametrize("name", ["plane", "sphere"])
def test_it_is_known_near_the_surface_and_not_far_from_it(scenes, name):
    points, normals, surface = scenes[name]
    for offset in NEAR:
        values, known = surface.sdf(points + offset * VS * normals)
        assert known.mean() > 0.97 and (np.sign(values[known]) == np.sign(offset)).all()
    for offset in FAR:
        assert not surface.sdf(points + offset * VS * normals)[1].any()


def test_it_grows_with_the_distance(scenes):
    points, normals, surface = scenes["plane"]
    offsets = np.linspace(-0.6, 0.7, 27)
    means = [surface.sdf(points + offset * VS * normals)[0].mean() for offset in offsets]
    assert (np.diff(means) > 0).all()


def test_a_field_that_is_no_distance_is_walked_down():
    """One that flattens as ours does, and one that ends before the surface."""
    points = np.zeros((50, 3), np.float32)
    points[:, 2] = np.linspace(-0.9, 0.9, 50)

    def flattened(x):
        return np.tanh(x[:, 2]).astype(np.float32), np.ones(len(x), bool)

    values, known = distances(flattened, points)
    assert known.all() and np.abs(values - points[:, 2]).max() < 0.02
    values, known = distances(lambda x: (flattened(x)[0], np.abs(x[:, 2]) > 0.3), points)
    assert not known.any()
    assert (values[np.abs(points[:, 2]) > 0.3] != 0).all()


def test_bounds_hold_all_voxels_and_cut_the_mesh(scenes):
    _, _, surface = scenes["sphere"]
    low, high = surface.bounds
    assert (
        (low < -RADIUS).all() and (high > RADIUS).all() and (high - low < 2 * RADIUS + 4 * VS).all()
    )
    assert uf.SurfaceMap(voxel_size=VS).bounds is None
    whole = surface.extract_mesh(2)
    same = surface.extract_mesh(2, bounds=(low, high))
    np.testing.assert_array_equal(whole.vertices, same.vertices)
    box = np.array([(-0.1, -0.2, 0.05), (0.3, 0.4, 0.4)])
    part = surface.extract_mesh(2, bounds=box)
    assert ((part.vertices >= box[0]) & (part.vertices <= box[1])).all()
    corners = whole.vertices[whole.faces]
    assert len(part.faces) == ((corners >= box[0]) & (corners <= box[1])).all(axis=(1, 2)).sum()
    assert not len(surface.extract_mesh(2, bounds=(5, 5, 5, 6, 6, 6)).faces)
    with pytest.raises(InputError, match="bounds"):
        surface.extract_mesh(2, bounds=(1, 2, 3, 4))
