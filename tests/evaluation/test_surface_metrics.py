"""Surface metrics against cases with known answers, Open3D and laws."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest
from meshes import (
    CAMERA,
    at,
    box,
    joined,
    mesh_of,
    moved,
    open3d_scene,
    random_rigid,
    random_soup,
    rectangle,
)

from taichi_unifusion import PinholeCamera, open_dataset
from taichi_unifusion.errors import InputError, PoseError
from taichi_unifusion.evaluation import Viewpoints, evaluate_surface
from taichi_unifusion.evaluation.viewpoints import points_within_view
from taichi_unifusion.geometry.triangles import (
    CANDIDATES,
    EXACT_M,
    SurfaceDistance,
    areas,
    sample_surface,
    squared_distance_to_triangles,
)
from taichi_unifusion.rendering.mesh_checks import check_mesh

SAMPLES = 4000
SHARE = 0.02  # of a share estimated from 4000 points: 2.5 sigma at most, and ours are stratified
ROUNDING = 1e-5  # [m] float32 vertices some metres from the origin
SAME_POINTS = 0.01  # two independent estimates from 20,000 points
SAMPLES_AGREE = 0.02  # relative, of mean distances between samples drawn by two libraries
DIFFERS = 0.01  # share of points within a pixel of a silhouette, at 160 x 120 pixels
UNIT = ((0, 0), (1, 1))


def score(reconstruction, ground_truth, **options):
    return evaluate_surface(reconstruction, ground_truth, **{"samples": SAMPLES, **options})


# --- Known answers --------------------------------------------------------------------------------------------------


def test_a_mesh_against_itself_is_perfect():
    result = score(random_soup(200, 0), random_soup(200, 0))
    assert (result.accuracy_cm, result.completeness_cm, result.chamfer_cm) == pytest.approx(
        (0, 0, 0), abs=100 * ROUNDING
    )
    assert [(s.precision, s.recall, s.f1) for s in result.scores] == [(1, 1, 1)] * 2
    assert (result.reconstruction_points, result.ground_truth_points) == (SAMPLES, SAMPLES)


def test_a_shifted_plane_is_off_by_the_shift_everywhere():
    result = score(rectangle(*UNIT, 0.02), rectangle((-1, -1), (2, 2), 0.0))
    assert result.accuracy_cm == pytest.approx(2, abs=100 * ROUNDING)
    coarse, fine = result.scores
    assert (coarse.threshold, coarse.precision, fine.threshold, fine.precision) == (
        0.025,
        1.0,
        0.01,
        0.0,
    )
    assert fine.f1 == fine.recall == 0


def test_half_a_plane_is_right_but_not_complete():
    result = score(rectangle((0, 0), (0.5, 1), 0.0), rectangle(*UNIT, 0.0))
    assert result.accuracy_cm == pytest.approx(0, abs=100 * ROUNDING)
    # mean of x - 0.5 beyond the middle: 100 / 8 cm
    assert result.completeness_cm == pytest.approx(12.5, abs=0.2)
    assert result.chamfer_cm == pytest.approx((result.accuracy_cm + result.completeness_cm) / 2)
    # the strip beside the edge is within the threshold
    for found, recall in zip(result.scores, (0.525, 0.51), strict=True):
        assert (found.precision, found.recall) == (1, pytest.approx(recall, abs=SHARE))
        assert found.f1 == pytest.approx(2 * recall / (1 + recall), abs=SHARE)


def test_an_invented_sheet_costs_precision_only():
    truth = rectangle(*UNIT, 0.0)
    result = score(joined(truth, rectangle(*UNIT, 1.0)), truth)
    assert (
        result.scores[0].precision == pytest.approx(0.5, abs=SHARE) and result.scores[0].recall == 1
    )
    assert result.accuracy_cm == pytest.approx(50, abs=100 * SHARE)


def test_swapping_the_meshes_swaps_the_columns():
    a, b = random_soup(60, 1), random_soup(60, 2)
    forth, back = score(a, b, thresholds=(0.05,)), score(b, a, thresholds=(0.05,))
    assert forth.scores[0].precision == pytest.approx(back.scores[0].recall, abs=SHARE)
    assert forth.scores[0].f1 == pytest.approx(back.scores[0].f1, abs=SHARE)
    assert forth.accuracy_cm == pytest.approx(back.completeness_cm, rel=0.05)


def test_numbers_do_not_depend_on_where_the_meshes_stand():
    a, b, T = random_soup(60, 1), random_soup(60, 2), random_rigid(3)
    here, there = score(a, b), score(moved(a, T), moved(b, T))
    assert there.accuracy_cm == pytest.approx(here.accuracy_cm, abs=100 * ROUNDING)
    assert there.completeness_cm == pytest.approx(here.completeness_cm, abs=100 * ROUNDING)


def test_triangulation_does_not_matter():
    coarse = score(rectangle(*UNIT, 0.02), rectangle(*UNIT, 0.0), distance_to="surface")
    fine = score(rectangle(*UNIT, 0.02, steps=40), rectangle(*UNIT, 0.0, steps=17))
    assert fine.accuracy_cm == pytest.approx(coarse.accuracy_cm, abs=100 * ROUNDING)


def test_N5_the_seed_decides():
    a, b = random_soup(40, 1), random_soup(40, 2)
    assert score(a, b, seed=1) == score(a, b, seed=1) != score(a, b, seed=2)


# --- Sampling and distances -----------------------------------------------------------------------------------------


def test_samples_lie_on_the_surface_in_proportion_to_area():
    mesh = random_soup(12, 4)
    points = sample_surface(mesh.vertices, mesh.faces, 20_000, np.random.default_rng(0))
    area = areas(mesh.vertices, mesh.faces)
    edges = np.concatenate([[0], np.cumsum(area)]) / area.sum() * len(points)
    for (first, last), corners in zip(
        pairwise(edges), mesh.vertices[mesh.faces].astype(float), strict=True
    ):
        part = points[int(np.ceil(first)) : int(last)]  # strata follow the list of triangles
        assert (
            np.sqrt(
                squared_distance_to_triangles(part, np.repeat(corners[None], len(part), 0))
            ).max(initial=0)
            < ROUNDING
        )
        if len(part) > 100:
            # if even over the triangle: a twelfth of the sum of |corner - centre|^2
            spread = np.cov(part.T).trace()
            assert part.mean(axis=0) == pytest.approx(
                corners.mean(axis=0), abs=0.1 * np.sqrt(spread)
            )
            assert spread == pytest.approx(
                ((corners - corners.mean(axis=0)) ** 2).sum() / 12, rel=0.1
            )


def test_distance_to_a_triangle_of_any_shape():
    triangle = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0.0]])
    points = np.array(
        [[0.2, 0.2, -0.3], [-3, -4, 0], [0.5, -2, 0], [1, 1, 0], [2, 0, 1], [0.3, 0.3, 0]]
    )
    known = [0.3, 5, 2, np.sqrt(0.5), np.sqrt(2), 0]
    found = np.sqrt(
        squared_distance_to_triangles(points, np.repeat(triangle[None], len(points), 0))
    )
    np.testing.assert_allclose(found, known, atol=1e-12)
    segment, point = triangle[[0, 1, 0]], triangle[[0, 0, 0]]
    assert squared_distance_to_triangles(np.array([[0.5, 1, 0.0]]), segment[None]) == pytest.approx(
        1
    )
    assert squared_distance_to_triangles(np.array([[3, 4, 0.0]]), point[None]) == pytest.approx(25)


@pytest.mark.parametrize(
    "mesh",
    [random_soup(300, 5), random_soup(4000, 6, size=0.02), rectangle((-5, -5), (5, 5), 0.0)],
    ids=["soup", "crumbs", "two large triangles"],
)
def test_distances_are_those_of_every_triangle(mesh):
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (150, 3))
    corners = mesh.vertices[mesh.faces].astype(float)
    known = np.sqrt(
        np.min(
            [
                squared_distance_to_triangles(points, np.repeat(c[None], len(points), 0))
                for c in corners
            ],
            0,
        )
    )
    measure = SurfaceDistance(mesh.vertices, mesh.faces)
    found, near = measure(points), known < EXACT_M
    np.testing.assert_allclose(found[near], known[near], atol=ROUNDING)
    assert ((found >= known - ROUNDING) & (found <= known + measure.radius)).all()
    assert near.any()


def test_distances_agree_with_open3d():
    o3d = pytest.importorskip("open3d")
    mesh = random_soup(500, 7, slivers=False)  # of which Open3D loses some
    points = np.random.default_rng(1).uniform(-1, 1, (2000, 3))
    known = open3d_scene(mesh).compute_distance(o3d.core.Tensor(points.astype(np.float32))).numpy()
    near = known < EXACT_M
    assert near.sum() > 100
    np.testing.assert_allclose(
        SurfaceDistance(mesh.vertices, mesh.faces)(points)[near], known[near], atol=ROUNDING
    )


def test_fewer_pieces_than_candidates():
    mesh = mesh_of([(0, 0, 0), (1e-3, 0, 0), (0, 1e-3, 0)], [(0, 1, 2)])
    assert SurfaceDistance(mesh.vertices, mesh.faces).tree.n < CANDIDATES[0]
    assert score(
        rectangle((0, 0), (1e-3, 1e-3), 0), rectangle((0, 0), (1e-3, 1e-3), 1e-3)
    ).accuracy_cm == pytest.approx(0.1)


def test_published_protocol_agrees_with_open3d():
    o3d = pytest.importorskip("open3d")
    meshes = random_soup(80, 8), random_soup(80, 9)
    result = score(*meshes, samples=20_000, distance_to="samples")
    o3d.utility.random.seed(1)
    clouds = [
        o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(m.vertices), o3d.utility.Vector3iVector(m.faces)
        ).sample_points_uniformly(20_000)
        for m in meshes
    ]
    forth, back = (np.asarray(a.compute_point_cloud_distance(b)) for a, b in (clouds, clouds[::-1]))
    assert result.accuracy_cm == pytest.approx(100 * forth.mean(), rel=SAMPLES_AGREE)
    assert result.completeness_cm == pytest.approx(100 * back.mean(), rel=SAMPLES_AGREE)
    for found in result.scores:
        assert found.precision == pytest.approx((forth < found.threshold).mean(), abs=SAME_POINTS)
        assert found.recall == pytest.approx((back < found.threshold).mean(), abs=SAME_POINTS)


# --- The crop to what cameras saw -----------------------------------------------------------------------------------

# A camera at the origin looks along +z at a wall at z = 2, partly hidden by a box whose front is at
# z = 1.
WALL, BOX = rectangle((-2, -2), (2, 2), 2.0), box((-0.2, -0.2, 1.0), (0.2, 0.2, 1.4))
SCENE = joined(WALL, BOX)
VIEWS = Viewpoints(CAMERA, at(0, 0, 0)[None], 0.3, 3.0)


def in_view(points, behind: float = 0.0, views: Viewpoints = VIEWS) -> list[bool]:
    return points_within_view(views, SCENE, (np.array(points, float),), (behind,))[0].tolist()


def test_what_a_camera_sees():
    assert in_view([(0, 0, 1), (0.19, -0.19, 1), (0.6, 0, 2), (1.5, 1.1, 2)]) == [True] * 4
    # the box's back and side, the wall behind it
    assert in_view([(0, 0, 1.4), (0.2, 0, 1.2), (0.3, 0, 2)]) == [False] * 3
    # beside the image, behind the camera
    assert in_view([(1.7, 0, 2), (0, 1.3, 2), (0, 0, -1), (0, 0, 0)]) == [False] * 4
    assert in_view([(0, 0, 0.5), (0.6, 0, 1.9)]) == [True] * 2  # free space
    assert in_view([(0, 0, 1.05), (0.6, 0, 2.05)], behind=0.1) == [True] * 2
    assert in_view([(0, 0, 1.15), (0.6, 0, 2.15)], behind=0.1) == [False] * 2
    assert (
        in_view(
            [(0, 0, 0.25), (0.6, 0, 2)], views=Viewpoints(CAMERA, VIEWS.T_world_camera, 0.3, 1.9)
        )
        == [False] * 2
    )


def test_one_camera_that_sees_is_enough():
    both = Viewpoints(CAMERA, np.stack([at(0, 0, 0), at(0.5, 0, 0)]), 0.3, 3.0)
    assert in_view([(0.3, 0, 2), (0, 0, 1)], views=both) == [True, True]


def test_where_rays_hit_nothing_space_is_free():
    alone = Viewpoints(CAMERA, at(0, 0, 0)[None], 0.3, 3.0)
    (seen,) = points_within_view(alone, BOX, (np.array([[0.6, 0, 2.0], [0.6, 0, 3.5]]),), (0.1,))
    assert seen.tolist() == [True, False]


def test_a_slanted_surface_is_seen_between_the_pixel_centres():
    """At 70 degrees, depth changes by 2 cm from a pixel's centre to its edge: more than the
    tolerance.
    """
    slope = np.tan(np.radians(70))
    plane = mesh_of(
        [(x, y, 2 + slope * x) for x in (-0.5, 0.3) for y in (-1, 1)], [(0, 1, 2), (1, 3, 2)]
    )
    points = sample_surface(plane.vertices, plane.faces, 2000, np.random.default_rng(0))
    (seen,) = points_within_view(VIEWS, plane, (points,), (0.005,))
    x, y, z = points.T
    within = (
        (np.abs(40 * x / z + 31.5 - 31.5) < 31.9)
        & (np.abs(40 * y / z) < 23.9)
        & (z > 0.31)
        & (z < 2.99)
    )
    assert seen[within].all() and within.sum() > 500


def test_invented_surface_counts_and_unseen_surface_does_not():
    def precision(*extra):
        return (
            score(joined(rectangle((-1.5, -1.1), (1.5, 1.1), 2.0), *extra), SCENE, views=VIEWS)
            .scores[0]
            .precision
        )

    patch = 0.5**2 / (3 * 2.2 - 0.8**2)  # of what is judged of the wall: not what the box hides
    assert precision() == 1
    in_the_way = rectangle((0.45, 0.45), (0.95, 0.95), 1.5)
    assert precision(in_the_way) == pytest.approx(1 / (1 + patch), abs=SHARE)
    second_wall = rectangle((0.45, 0.45), (0.95, 0.95), 2.06)
    assert precision(second_wall) == pytest.approx(1 / (1 + patch), abs=SHARE)
    for unseen in (
        rectangle((0.45, 0.45), (0.95, 0.95), 2.5),
        rectangle((1.5, 0), (2, 0.5), 1.5),
        rectangle((-0.1, -0.1), (0.1, 0.1), 1.3),
    ):
        assert precision(unseen) == 1


def test_only_seen_truth_must_be_there():
    shown = joined(
        rectangle((-1.61, -1.21), (1.61, 1.21), 2.0), rectangle((-0.2, -0.2), (0.2, 0.2), 1.0)
    )
    result = score(shown, SCENE, views=VIEWS)
    assert result.scores[0].recall == result.scores[0].precision == 1
    assert score(shown, SCENE).scores[0].recall < 0.5
    assert result.ground_truth_unseen == pytest.approx(
        1 - (3.2 * 2.4 - 0.8**2 + 0.4**2) / (16 + 6 * 0.16), abs=SHARE
    )
    assert result.reconstruction_points == SAMPLES


def test_views_agree_with_open3d_in_a_furnished_room():
    o3d = pytest.importorskip("open3d")
    room = open_dataset("synthetic", frames=12, width=160, height=120)
    mesh, pose, camera = room.ground_truth_mesh(), room.T_world_camera[3], room.camera
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [
            sample_surface(mesh.vertices, mesh.faces, 20_000, rng),
            rng.uniform((-2, -1.5, 0), (2, 1.5, 2.5), (20_000, 3)),
        ]
    )
    (seen,) = points_within_view(
        Viewpoints(camera, pose[None], 0.3, 4.0), mesh, (points,), (0.005,)
    )
    toward = points - pose[:3, 3]
    rays = np.hstack([np.broadcast_to(pose[:3, 3], toward.shape), toward]).astype(np.float32)
    # in shares of the way
    free = open3d_scene(mesh).cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    x, y, z = (toward @ pose[:3, :3]).T
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (z >= 0.3) & (z <= 4) & (np.abs(u - 79.5) < 80) & (np.abs(v - 59.5) < 60)
    known = inside & (free * z >= z - 0.005)
    assert (seen != known).mean() < DIFFERS
    assert known.mean() > 0.1 and (inside & ~known).mean() > 0.05


# --- Bad input ------------------------------------------------------------------------------------------------------

EMPTY = mesh_of([], [])


@pytest.mark.parametrize(
    ("meshes", "options", "told"),
    [
        ((EMPTY, WALL), {}, "reconstruction: has no triangles"),
        ((WALL, EMPTY), {}, "ground truth: has no triangles"),
        ((mesh_of([(0, 0, 0)] * 5, []), WALL), {}, "no triangles, only 5 points"),
        (
            (mesh_of([(0, 0, np.nan), (1, 0, 0), (0, 1, 0)], [(0, 1, 2)]), WALL),
            {},
            "1 of 3 vertices are not finite",
        ),
        ((mesh_of([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 2)]), WALL), {}, "no area"),
        (
            (mesh_of([(0, 0, 0), (1, 0, 0), (2, 0, 0)], [(0, 1, 3)]), WALL),
            {},
            "name vertices 0..3, but it has 3",
        ),
        ((rectangle((10, 10), (11, 11), 0.0), WALL), {}, "do not overlap"),
        ((WALL, WALL), {"thresholds": ()}, "thresholds above 0"),
        ((WALL, WALL), {"thresholds": (0.0,)}, "thresholds above 0"),
        ((WALL, WALL), {"thresholds": (float("nan"),)}, "thresholds above 0"),
        ((WALL, WALL), {"samples": 0}, "samples >= 1"),
        ((WALL, WALL), {"distance_to": "vertices"}, "choose surface or samples"),
        (
            (WALL, WALL),
            {"views": Viewpoints(CAMERA, at(0, 0, 5)[None])},
            "see nothing of the ground truth",
        ),
        (
            (rectangle((1.8, 1.8), (2, 2), 2.0), WALL),
            {"views": VIEWS},
            "look at nothing of the reconstruction",
        ),
    ],
)
def test_bad_meshes_are_told_in_one_sentence(meshes, options, told):
    with pytest.raises(InputError, match=told):
        score(*meshes, **options)


@pytest.mark.parametrize(
    ("poses", "options", "error", "told"),
    [
        (np.full((1, 4, 4), np.nan), {}, PoseError, "pose 0: holds NaN"),
        (np.stack([np.eye(4), 2 * np.eye(4)]), {}, PoseError, "pose 1"),
        (np.empty((0, 4, 4)), {}, InputError, "at least one pose"),
        (np.eye(4), {}, InputError, r"\(N, 4, 4\)"),
        (
            np.eye(4)[None],
            {"depth_min": 3.0, "depth_max": 2.0},
            InputError,
            "depth_min < depth_max",
        ),
    ],
)
def test_bad_views_are_told_in_one_sentence(poses, options, error, told):
    with pytest.raises(error, match=told):
        Viewpoints(PinholeCamera(64, 48, 40, 40, 32, 24), poses, **options)


def test_results_are_values():
    result = score(WALL, WALL)
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.accuracy_cm = 0
    assert check_mesh(WALL, "wall").vertices.flags.c_contiguous
