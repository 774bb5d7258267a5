"""The signed distance field and its mesh on scenes whose distance is known (N4), in every mode."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_laws import area_and_volume, assert_closed, assert_welded
from scenes import box, box_distance, cloud_of, joined, rectangle, sphere, sphere_distance, taken
from viewpoints import FINE, rays

from taichi_unifusion import Frame, PointCloud, SurfaceMap, preprocess
from taichi_unifusion.errors import InputError

VS = 0.05
RADIUS, HALF = 0.3, 0.25
SPHERE, BOX, PLANE = (0.013, 0.02, -0.03), (2.0, 0.01, 0.02), (-2.0, 0.0, 0.1)
TILTED_U, TILTED_V = np.array([0.4, 0.0, 0.15]), np.array([-0.05, 0.35, 0.1])
NORMAL = np.cross(TILTED_U, TILTED_V) / np.linalg.norm(np.cross(TILTED_U, TILTED_V))

# Bounds in metres at 5 cm voxels and d = 1, with a margin over what was measured.
ON_SPHERE, ON_SPHERE_MEAN = 0.003, 0.0008  # vertices; regularisation rounds the curvature off
ON_PLANE = 0.0015  # vertices on a tilted plane
ON_BOX_FACE, ON_BOX_EDGE = 0.0030, 0.012  # a voxel's smooth latent rounds edges off
NEAR_FIELD = 0.006  # sdf within 0.15 voxels of the surface, where samples lie
NORMAL_ANGLE = 8.0  # degrees, of mesh normals on the sphere


@pytest.fixture(scope="module")
def scene() -> SurfaceMap:
    """Sphere, box and tilted plane, far enough apart, in one map.

    With the default closing, some cells that the surface only cuts at a corner stay open: closed
    surfaces need 1.
    """
    target = SurfaceMap(support_closing=1)
    target.integrate(
        joined(
            sphere(RADIUS, 0.006, SPHERE),
            box(HALF, 0.006, BOX),
            rectangle(PLANE, TILTED_U, TILTED_V, 0.006),
        )
    )
    return target


@pytest.fixture(scope="module")
def mesh(scene):
    return scene.extract_mesh(4)


def part(mesh, low: float, high: float):
    """Vertices, faces and normals with low < x < high."""
    inside = (mesh.vertices[:, 0] > low) & (mesh.vertices[:, 0] < high)
    number = np.cumsum(inside) - 1
    faces = mesh.faces[inside[mesh.faces].all(axis=1)]
    return mesh.vertices[inside].astype(float), number[faces], mesh.normals[inside].astype(float)


def test_the_mesh_is_welded_and_of_three_parts(mesh):
    assert_welded(mesh.vertices, mesh.faces)
    assert mesh.vertices.dtype == mesh.normals.dtype == np.float32 and mesh.faces.dtype == np.int32
    assert sum(len(part(mesh, *span)[0]) for span in ((-3, -1), (-1, 1), (1, 3))) == len(
        mesh.vertices
    )
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    assert len({tuple(v) for v in mesh.vertices.tolist()}) == len(mesh.vertices)


def test_N4_a_sphere_seen_from_all_sides_is_a_closed_sphere(mesh):
    vertices, faces, normals = part(mesh, -1, 1)
    assert_closed(vertices, faces)
    distance = np.abs(sphere_distance(vertices, RADIUS, SPHERE))
    assert distance.max() < ON_SPHERE and distance.mean() < ON_SPHERE_MEAN, (
        distance.max(),
        distance.mean(),
    )
    outward = (vertices - SPHERE) / np.linalg.norm(vertices - SPHERE, axis=1, keepdims=True)
    # into free space
    assert (
        np.degrees(np.arccos(np.clip((normals * outward).sum(axis=1), -1, 1))).max() < NORMAL_ANGLE
    )
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    facing = np.einsum("ni,ni->n", np.cross(b - a, c - a), a + b + c - 3 * np.array(SPHERE))
    # counter-clockwise seen from free space; 0: two vertices at one place
    assert (facing >= 0).all()
    area, volume = area_and_volume(vertices - SPHERE, faces)
    assert area == pytest.approx(4 * np.pi * RADIUS**2, rel=0.02)
    assert volume == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.02)
    assert len(vertices) - 3 * len(faces) // 2 + len(faces) == 2  # one piece without handles


def test_N4_a_box_has_flat_faces_and_rounded_edges(mesh):
    vertices, faces, normals = part(mesh, 1, 3)
    assert_closed(vertices, faces)
    distance = np.abs(box_distance(vertices, HALF, BOX))
    second = np.sort(np.abs(vertices - BOX), axis=1)[:, 1]
    on_face = second < HALF - 2 * VS
    assert (
        on_face.mean() > 0.3
        and distance[on_face].max() < ON_BOX_FACE
        and distance.max() < ON_BOX_EDGE
    ), (distance[on_face].max(), distance.max())
    assert (np.einsum("ni,ni->n", normals, vertices - BOX) > 0).all()


def test_N4_a_plane_is_flat_and_ends_where_the_data_end(mesh):
    vertices, _, normals = part(mesh, -3, -1)
    offset = vertices - PLANE
    a, b = np.linalg.lstsq(np.column_stack([TILTED_U, TILTED_V, NORMAL]), offset.T, rcond=None)[0][
        :2
    ]
    inner = (
        np.maximum(np.abs(a) * np.linalg.norm(TILTED_U), np.abs(b) * np.linalg.norm(TILTED_V)) < 0.3
    )
    assert inner.mean() > 0.5 and np.abs(offset @ NORMAL)[inner].max() < ON_PLANE, np.abs(
        offset @ NORMAL
    )[inner].max()
    assert (normals[inner] @ NORMAL).min() > np.cos(np.radians(NORMAL_ANGLE))
    beyond = np.maximum(
        (np.abs(a) - 1) * np.linalg.norm(TILTED_U), (np.abs(b) - 1) * np.linalg.norm(TILTED_V)
    )
    # the support mask: the diagonals of the last seen cell and of one beyond
    assert beyond.max() < 2 * VS / 4 * np.sqrt(3)


def test_N4_sdf_is_the_distance_near_the_surface_and_positive_in_front(scene):
    rng = np.random.default_rng(3)
    depth = rng.uniform(-0.15, 0.15, (4000, 1)) * VS
    for cloud, distance in (
        (sphere(RADIUS, 0.02, SPHERE), lambda x: sphere_distance(x, RADIUS, SPHERE)),
        (rectangle(PLANE, 0.7 * TILTED_U, 0.7 * TILTED_V, 0.02), lambda x: (x - PLANE) @ NORMAL),
    ):
        at = rng.integers(0, len(cloud), 4000)
        x = cloud.points[at] + depth * cloud.normals[at]
        values, valid = scene.sdf(x)
        error = np.abs(values - distance(x))
        assert valid.all() and error.max() < NEAR_FIELD, error.max()
        slope = np.polyfit(depth[:, 0], values, 1)[0]
        assert 0.5 < slope < 1.15, slope  # shrunk towards zero by the prior, never turned round
    values, valid = scene.sdf(np.array([[0, 0, 5.0], SPHERE]))
    assert not valid.any() and not values.any()


def test_vertices_lie_on_the_zero_level(scene, mesh):
    """The grid and the query decode the same field."""
    values, valid = scene.sdf(mesh.vertices)
    # linear interpolation within cells of a quarter voxel
    assert valid.all() and np.abs(values).max() < VS / 4 / 8


@pytest.mark.parametrize("resolution", [1, 3, 8])
def test_every_resolution_gives_the_same_closed_surface(scene, resolution):
    vertices, faces, _ = part(scene.extract_mesh(resolution), -1, 1)
    if resolution >= 3:
        assert_closed(vertices, faces)
    distance = np.abs(sphere_distance(vertices, RADIUS, SPHERE))
    assert distance.max() < (ON_SPHERE if resolution >= 3 else 0.011), distance.max()


@pytest.mark.parametrize(
    "settings",
    [
        {"gpis": "derivatives"},
        {"sample_distance": 0.1},
        {"sampling": "points"},
        {"sampling": "points", "gpis": "derivatives"},
        {"margin": 2},
        {"gpis": "samples"},
        {"gpis": "samples", "noise": 0.1, "margin": 2},
        {"noise": 0.3, "margin": 2},
    ],
    ids=lambda settings: "-".join(f"{v}" for v in settings.values()),
)
def test_N4_a_sphere_in_every_mode(settings):
    target = SurfaceMap(support_closing=1, **settings)
    target.integrate(sphere(RADIUS, 0.006, SPHERE))
    mesh = target.extract_mesh(4)
    assert_closed(mesh.vertices, mesh.faces)
    distance = np.abs(sphere_distance(mesh.vertices, RADIUS, SPHERE))
    assert distance.max() < 0.005 and distance.mean() < 0.0015, (distance.max(), distance.mean())
    assert (np.einsum("ni,ni->n", mesh.normals, mesh.vertices - SPHERE) > 0).all()
    shell = sphere(RADIUS, 0.03, SPHERE)
    outside, inside = (
        target.sdf(shell.points + side * 0.15 * VS * shell.normals)[0] for side in (1, -1)
    )
    assert (outside > 0).all() and (inside < 0).all()


def test_F4_S5_one_frame_gives_a_mesh_and_one_point_nothing():
    """A ball before a wall, as one depth image; before it, single readings that must leave no
    voxel.
    """
    target = SurfaceMap()
    lone = cloud_of([[0.01, 0.02, 1.0]], [[0, 0, -1.0]])
    done = target.integrate(lone)
    assert (done.voxels, len(target)) == (0, 0) and len(target.extract_mesh().faces) == 0
    ray = rays(FINE)
    b, square = ray @ (0, 0, 1.0), (ray**2).sum(axis=-1)
    root = b**2 - square * (1 - 0.1**2)
    depth = np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / square, 1.3).astype(np.float32)
    target.integrate(preprocess(Frame(depth, FINE)))
    mesh = target.extract_mesh()
    assert_welded(mesh.vertices, mesh.faces)
    error = np.minimum(
        np.abs(sphere_distance(mesh.vertices, 0.1, (0, 0, 1))), np.abs(mesh.vertices[:, 2] - 1.3)
    )
    assert len(mesh.faces) > 300 and np.median(error) < 0.002 and (error < 0.02).mean() > 0.98
    # towards the camera, where space is free
    assert (np.einsum("ni,ni->n", mesh.normals, mesh.vertices) < 0).mean() > 0.98
    assert [len(target), target.memory_bytes > 0] == [
        target.integrate(taken(lone, slice(0))).total_voxels,
        True,
    ]


def test_a_cloud_without_normals_is_refused(scene):
    with pytest.raises(InputError, match="the cloud has no normals"):
        scene.integrate(PointCloud(np.zeros((3, 3), np.float32)))


@pytest.mark.parametrize(
    "wrong",
    [
        {"voxel_size": 0.0},
        {"noise": 0.0},
        {"min_points": 0},
        {"margin": 3},
        {"sampling": "cell"},
        {"gpis": "sample"},
        {"sample_distance": 0.0},
        {"sample_distance": 1.1},
        {"support_points": -1},
    ],
)
def test_settings_that_make_no_map_are_refused_by_name(wrong):
    with pytest.raises(InputError, match=f"^{next(iter(wrong))}: "):
        SurfaceMap(**wrong)
