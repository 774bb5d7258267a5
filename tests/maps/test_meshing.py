"""Marching cubes: the tables, the kernels against their twins, and what every mesh must be."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import reference
from mesh_laws import area_and_volume, assert_closed, assert_welded
from skimage.measure import marching_cubes

from taichi_unifusion.errors import InputError
from taichi_unifusion.kernels import marching_cubes as kernels
from taichi_unifusion.maps import SurfaceMap, meshing
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.maps.meshing import drop_small_parts, welded
from taichi_unifusion.maps.sheets import whole
from taichi_unifusion.maps.voxel_data import VoxelData
from taichi_unifusion.types import Mesh

R = 4  # samples a cube edge in these tests
VS = 0.05
ALL = 0xFFFFFFFF  # support everywhere
ROUNDING = 1e-6  # [m] float32 positions of a few voxels
AREA = 0.002  # relative: other triangulations of the same crossings of a smooth field


def cubes_of(field: np.ndarray, first=(0, 0, 0), keep=None):
    """Cubes (keys, upper, samples) that carry a field (n R)^3 on the lattice, but those that `keep`
    (n, n, n) leaves out.
    """
    n = len(field) // R
    places = np.array([q for q in product(range(n), repeat=3) if keep is None or keep[q]])
    samples = [field[tuple(slice(R * i, R * i + R) for i in q)].reshape(-1) for q in places]
    keys = (places + first).astype(np.int32)
    return (
        keys,
        meshing._upper_cubes(meshing._codes(keys)),
        np.ascontiguousarray(samples, np.float32),
    )


def march(field: np.ndarray, first=(0, 0, 0)):
    keys, upper, samples = cubes_of(field, first)
    support = np.full((len(keys), 2), ALL, np.uint32)
    return meshing._march(keys, upper, support, samples, R, VS)[:2]


# ---- Tables ----


def triangles_of(case: int) -> np.ndarray:
    counts, _, table, _ = meshing.marching_cubes_tables()
    return table[case, : 3 * counts[case]].reshape(-1, 3)


def ends(e: int) -> tuple[int, int]:
    """Corner numbers of a cell edge."""
    *low, axis = meshing.marching_cubes_tables()[3][e].tolist()
    lower = low[0] * 4 + low[1] * 2 + low[2]
    return lower, lower | 4 >> axis


@pytest.mark.parametrize("case", range(256))
def test_every_case_is_a_disc_bounded_by_the_cells_faces(case):
    """Vertices on exactly the crossed edges; inner edges shared twice, in both directions; the
    border in the cell's faces.
    """
    triangles, flags = triangles_of(case), meshing.marching_cubes_tables()[1][case]
    crossed = {e for e in range(12) if (case >> ends(e)[0] & 1) != (case >> ends(e)[1] & 1)}
    assert set(triangles.flatten().tolist()) == crossed == {e for e in range(12) if flags >> e & 1}
    directed = [tuple(t[[k, (k + 1) % 3]].tolist()) for t in triangles for k in range(3)]
    assert len(set(directed)) == len(directed)
    border = [(a, b) for a, b in directed if (b, a) not in directed]
    assert len(border) == reference.face_segments(case)
    assert sorted(a for a, _ in border) == sorted(b for _, b in border) == sorted(crossed)
    for a, b in border:
        corners = [meshing.STEPS[c] for c in (*ends(a), *ends(b))]
        assert any(len({corner[d] for corner in corners}) == 1 for d in range(3))


def test_complements_have_as_many_crossed_edges_and_single_corners_one_triangle():
    counts, flags, _, _ = meshing.marching_cubes_tables()
    np.testing.assert_array_equal(flags, flags[::-1])
    assert counts[0] == counts[255] == 0 and counts.max() <= 5
    assert all(counts[1 << o] == 1 and counts[255 - (1 << o)] == 1 for o in range(8))


@pytest.mark.parametrize("case", range(1, 255))
def test_triangles_are_counter_clockwise_seen_from_in_front(case):
    """The area vector of a case points from the corners behind towards those in front."""
    middles = np.array([np.mean([meshing.STEPS[c] for c in ends(e)], axis=0) for e in range(12)])
    a, b, c = np.moveaxis(middles[triangles_of(case)], 1, 0)
    behind = np.array([case >> o & 1 for o in range(8)], bool)
    forward = np.mean([meshing.STEPS[o] for o in np.flatnonzero(~behind)], axis=0) - np.mean(
        [meshing.STEPS[o] for o in np.flatnonzero(behind)], axis=0
    )
    area = np.cross(b - a, c - a).sum(axis=0)
    assert area @ forward > 0 or np.allclose(forward, 0) or np.allclose(area, 0)


# ---- Kernels against their twins ----


@pytest.fixture(scope="module")
def patchy():
    """2^3 cubes of random samples, one cube missing, some samples unknown, some cells unsupported."""
    rng = np.random.default_rng(3)
    field = rng.normal(size=(2 * R,) * 3).astype(np.float32)
    field[rng.uniform(size=field.shape) < 0.03] = reference.UNKNOWN
    keep = np.ones((2, 2, 2), bool)
    keep[1, 0, 1] = False
    keys, upper, samples = cubes_of(field, (-1, 5, 0), keep)
    support = rng.integers(0, 2**32, (len(keys), 2), dtype=np.uint32) | rng.integers(
        0, 2**32, (len(keys), 2), dtype=np.uint32
    )
    whole = np.full((2 * R + 1,) * 3, reference.UNKNOWN)
    whole[:-1, :-1, :-1] = field
    whole[R : 2 * R, :R, R : 2 * R] = reference.UNKNOWN
    return keys, upper, samples, support, whole


def twin_cases(patchy) -> np.ndarray:
    keys, _, _, support, whole = patchy
    cases = np.zeros((2 * R,) * 3, int)
    for key, mask in zip(keys - (-1, 5, 0), reference.unpack_masks(support), strict=True):
        block = tuple(slice(R * k, R * k + R + 1) for k in key)
        cases[tuple(slice(R * k, R * k + R) for k in key)] = reference.classify_cells(
            whole[block], mask.reshape(4, 4, 4), R
        )
    return cases


def classified(patchy):
    keys, upper, samples, support, _ = patchy
    triangle_counts, flags, _, edge_table = meshing.marching_cubes_tables()
    cases, edges = np.zeros(samples.shape, np.uint8), np.zeros(samples.shape, np.int32)
    counts = np.empty((len(keys), 2), np.int32)
    kernels.classify_cells(
        R, upper, support, samples, triangle_counts, edge_table, flags, edges, cases, counts
    )
    return cases, edges, counts


def lattice(patchy, values) -> np.ndarray:
    """(Q, R^3) by cube -> (2 R)^3."""
    whole = np.zeros((2 * R,) * 3, values.dtype)
    for key, block in zip(patchy[0] - (-1, 5, 0), values, strict=True):
        whole[tuple(slice(R * k, R * k + R) for k in key)] = block.reshape(R, R, R)
    return whole


def test_classify_cells_equals_its_twin(patchy):
    """Also the vertices and triangles that it counts."""
    cases, edges, counts = classified(patchy)
    twin = twin_cases(patchy)
    np.testing.assert_array_equal(lattice(patchy, cases), twin)
    assert len(np.unique(twin)) > 50
    crossed = reference.crossed_edges(twin)
    assert {
        (*at, d)
        for d in range(3)
        for at in map(tuple, np.argwhere(lattice(patchy, edges) >> d & 1).tolist())
    } == crossed
    vertices, triangles = counts.T
    np.testing.assert_array_equal(triangles, meshing.marching_cubes_tables()[0][cases].sum(axis=1))
    assert vertices.sum() == len(crossed)
    np.testing.assert_array_equal(vertices, sum((edges >> d & 1).sum(axis=1) for d in range(3)))


def test_emit_mesh_equals_its_twin(patchy):
    """One vertex on every crossed edge, where the field is zero; every cell's triangles join the
    vertices of its own edges.
    """
    keys, upper, samples, support, whole = patchy
    vertices, faces, _ = meshing._march(keys, upper, support, samples, R, VS)
    edge_table = meshing.marching_cubes_tables()[3]
    places, wanted = reference.emit_mesh(
        whole, twin_cases(patchy), R, np.array([-1, 5, 0]), VS, triangles_of, edge_table
    )
    found = sorted(map(tuple, vertices.astype(float).tolist()))
    np.testing.assert_allclose(found, sorted(map(tuple, places.tolist())), atol=ROUNDING)
    emitted = vertices[faces].reshape(-1, 9)
    assert wanted.shape == emitted.shape
    nearest = np.abs(wanted[:, None] - emitted[None]).max(axis=2).argmin(axis=1)
    assert len(np.unique(nearest)) == len(wanted)
    np.testing.assert_allclose(emitted[nearest], wanted, atol=ROUNDING)


def test_sum_normals_equals_its_twin(patchy):
    keys, upper, samples, support, _ = patchy
    vertices, faces, _ = meshing._march(keys, upper, support, samples, R, VS)
    sums, per_area = np.zeros((len(vertices), 3), np.int32), meshing.NORMAL_UNIT * (R / VS) ** 2
    kernels.sum_normals(vertices, faces, per_area, sums)
    np.testing.assert_allclose(
        sums / per_area,
        reference.sum_normals(vertices.astype(float), faces),
        atol=1e-4 * (VS / R) ** 2,
    )


# ---- Meshes ----


@pytest.mark.parametrize("seed", range(3))
def test_random_fields_give_closed_surfaces(seed):
    """Noise at every sample, all ambiguous cases included, outside of the surface all around."""
    field = np.random.default_rng(seed).normal(size=(3 * R,) * 3)
    for axis in range(3):
        field[tuple(slice(None) if a != axis else [0, 1, -2, -1] for a in range(3))] = 1.0
    vertices, faces = march(field)
    assert len(faces) > 1000
    assert_closed(vertices, faces)
    assert area_and_volume(vertices, faces)[1] > 0  # normals out of what is behind the surface


@pytest.mark.parametrize("first", [(0, 0, 0), (-2, -3, 1)])
def test_smooth_fields_agree_with_scikit_image(first):
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, 5 * R)] * 3, indexing="ij"), axis=-1)
    field = np.linalg.norm(x * (1, 1.3, 1.6), axis=-1) - 0.7 + 0.1 * np.sin(5 * x[..., 0])
    vertices, faces = march(field, first)
    assert_closed(vertices, faces)
    theirs, their_faces, *_ = marching_cubes(field.astype(np.float32), 0.0, spacing=[VS / R] * 3)
    theirs = theirs + (np.array(first) - 0.5) * VS
    assert len(theirs) == len(vertices)
    np.testing.assert_allclose(
        np.sort(vertices, axis=0), np.sort(theirs, axis=0), atol=5 * ROUNDING
    )
    ours = area_and_volume(vertices, faces)
    area, volume = area_and_volume(theirs, their_faces)
    assert ours[0] == pytest.approx(area, rel=AREA) and ours[1] == pytest.approx(
        abs(volume), rel=AREA
    )


@pytest.fixture(scope="module")
def places() -> set[tuple[int, ...]]:
    rng = np.random.default_rng(0)
    return set(map(tuple, (rng.integers(-3, 3, (60, 3)) + (8000, -8000, 0)).tolist()))


def test_upper_cubes_are_found_by_code(places):
    keys = np.array(sorted(places), np.int32)
    rows = {key: n for n, key in enumerate(map(tuple, keys.tolist()))}
    wanted = [
        [rows.get(tuple((key + step).tolist()), -1) for step in meshing.STEPS] for key in keys
    ]
    np.testing.assert_array_equal(meshing._upper_cubes(meshing._codes(keys)), wanted)


def test_codes_are_in_the_order_of_keys_and_gain_all_upper_neighbours(places):
    keys = np.array(sorted(places), np.int32)
    codes = meshing._codes(keys)
    assert (np.diff(codes) > 0).all()
    np.testing.assert_array_equal(meshing._keys(codes), keys)
    wanted = {tuple((np.array(key) + step).tolist()) for key in places for step in meshing.STEPS}
    np.testing.assert_array_equal(meshing._keys(meshing._with_upper(codes)), sorted(wanted))
    assert not len(meshing._with_upper(codes[:0]))


@pytest.mark.parametrize("resolution", [1, 2, 3, 4, 7, 32])
def test_last_cells_are_those_that_hold_the_last_mesh_cells(resolution):
    """A cube needs the one above it at a step exactly where one of these is supported."""
    masks = reference.unpack_masks(meshing._last_cells(resolution)).reshape(8, 4, 4, 4)
    cells = [int((i + 0.5) / resolution * 4) for i in range(resolution)]  # as classify_cells does
    for step, mask in zip(meshing.STEPS, masks, strict=True):
        wanted = np.zeros((4, 4, 4), bool)
        wanted[tuple(cells[-1:] if up else slice(None) for up in step)] = True
        np.testing.assert_array_equal(mask.astype(bool), wanted)


@pytest.mark.parametrize("resolution", [1, 3, 4])
def test_cubes_left_out_have_no_part_in_the_mesh(resolution):
    """The mesh of random voxels equals that of all cubes around them, each with its samples."""
    target = SurfaceMap(encoder=EncoderSettings(rank=6, anchors=64), two_sides=False)
    rng = np.random.default_rng(4)
    keys = np.unique(rng.integers(-3, 3, (400, 3)), axis=0).astype(np.int32)
    voxels = VoxelData(
        keys,
        {
            "latents": rng.normal(size=(len(keys), 6, 1)).astype(np.float32),
            "weights": np.ones(len(keys), np.float32),
            "masks": np.bitwise_and.reduce(
                rng.integers(0, 2**32, (2, len(keys), 2), dtype=np.uint32)
            ),
            "evidence": np.zeros((len(keys), 64), np.int8),
        },
    )
    target.grid.add(voxels)
    meshes, sheet = [], whole(target.grid)
    every = meshing._codes_near(target.grid, target.grid.used_slots(), None)
    for codes, support in (
        meshing._cubes(target.grid, every, sheet, 14, resolution),
        all_cubes(target.grid, 14),
    ):
        keys, upper = meshing._keys(codes), meshing._upper_cubes(codes)
        sdf = np.empty((len(keys), resolution**3), np.float32)
        basis = meshing.grid_basis(target.encoder.tables.encoding, resolution)
        fields = target.grid["latents"], sheet.rows, sheet.latents
        meshing.query.sdf_grid(6, keys, target.grid.index, *fields, *basis, sdf)
        meshes.append((len(keys), meshing._march(keys, upper, support, sdf, resolution, VS)))
    (few, mesh), (many, complete) = meshes
    assert few < many and len(mesh[1]) > 20
    np.testing.assert_array_equal(mesh[0], complete[0])
    np.testing.assert_array_equal(mesh[1], complete[1])


def all_cubes(grid, closing: int):
    """Codes (Q,) and support (Q, 2) of all cubes around a grid's voxels, and of one more beyond."""
    codes = meshing._with_upper(meshing._with_upper(np.sort(meshing._codes(grid.voxel_keys()))))
    support = np.empty((len(codes), 2), np.uint32)
    sheet = whole(grid)
    masks = grid["masks"], sheet.rows, sheet.masks
    meshing.query.corner_support(meshing._keys(codes), grid.index, *masks, closing, support)
    return codes, support


def test_an_empty_map_has_an_empty_mesh():
    mesh = SurfaceMap().extract_mesh()
    assert mesh.vertices.shape == mesh.faces.shape == mesh.normals.shape == (0, 3)


@pytest.mark.parametrize("resolution", [0, 33, -1])
def test_resolutions_out_of_range_are_refused(resolution):
    with pytest.raises(InputError, match="resolution: must lie in 1..32"):
        SurfaceMap().extract_mesh(resolution)


def test_join_parts_equals_its_twin():
    """Random triangles over many vertices, in several parts: every vertex ends with the first
    vertex of its part.
    """
    rng = np.random.default_rng(5)
    faces = rng.integers(0, 400, (230, 3)).astype(np.int32)
    part, changed = np.arange(400, dtype=np.int32), np.ones(1, np.int32)
    while changed[0]:
        changed[0] = 0
        kernels.join_parts(faces, part, changed)
    np.testing.assert_array_equal(part, reference.join_parts(faces, 400))
    assert len(set(part.tolist())) > 10


def test_small_parts_are_dropped_and_the_rest_is_untouched():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    vertices = np.concatenate([0.01 * square, square + 2])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]], np.int32)
    mesh = Mesh(
        vertices,
        faces,
        np.tile(np.float32([0, 0, 1]), (8, 1)),
        {"x": np.arange(8, dtype=np.float32)[:, None]},
    )
    large = drop_small_parts(mesh, 0.001)
    np.testing.assert_array_equal(large.vertices, vertices[4:])
    np.testing.assert_array_equal(large.faces, faces[:2])
    np.testing.assert_array_equal(large.attributes["x"][:, 0], np.arange(4, 8))
    assert drop_small_parts(mesh, 0) is mesh and len(drop_small_parts(mesh, 2).faces) == 0


def test_two_sheets_are_welded_without_faces_of_two_corners_at_one_place():
    one = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 1, 0]], np.float32)  # the last one twice
    other = np.array([[1, 0, 0], [0, 1, 0], [1, 1, 0], [5, 5, 5], [5, 5, 5]], np.float32)
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    vertices, found, source = welded(
        [(one, faces), (other, np.array([[0, 2, 1], [2, 3, 4]], np.int32))]
    )
    assert_welded(vertices, found)
    assert source.tolist() == [0, 2] and len(vertices) == 4
    assert (vertices[found[1]] == other[[0, 2, 1]]).all()
