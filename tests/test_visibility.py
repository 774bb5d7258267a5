"""Evidence from rays: the kernels against their twins, and where a surface must end and where it must not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference
import reference_visibility as twin
from scenes import rough
from test_meshing import area_and_volume, assert_welded

from taichi_unifusion import Frame, PinholeCamera, PointCloud, SurfaceMap, load_map, preprocess
from taichi_unifusion.encoding import EncoderSettings
from taichi_unifusion.errors import InputError, MapCorrupt, OutOfRange, PoseError, SizeMismatch
from taichi_unifusion.kernels import visibility as kernels
from taichi_unifusion.map_files import read_map, write_map
from taichi_unifusion.maps import voxel_grid
from taichi_unifusion.maps.voxel_grid import VoxelGrid
from taichi_unifusion.meshing import cut_mesh
from taichi_unifusion.types import DepthView

VS = 0.05
CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5)
ENCODER = EncoderSettings(rank=8, anchors=64)
FLIPPED = 1e-3      # share of cells in which float32 puts a pixel, or a threshold, on the other side
EVIDENCE = 1e-4     # [votes] of float32 weights about 1 and votes about 100
AT_EDGE = 0.1       # [voxels] mean distance of the mesh's border from the true edge, with `carve`...
RIM = 0.1  # of the area: cells half outside of the only image have no vote
NEAR_EDGE = 0.5     # ...and of 95 % of it: two cells
BEYOND_EDGE = 0.6   # [voxels] without it, the surface goes on to where voxels end: the same 95 %
AREA = 1e-4         # relative: cuts go through vertices that are this near, in edges


def pose(position, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Rigid transform; angles [rad] about y, x and z."""
    T = np.eye(4)
    for angle, (i, j) in ((yaw, (2, 0)), (pitch, (1, 2)), (roll, (0, 1))):
        turn = np.eye(3)
        turn[[i, j, i, j], [i, j, j, i]] = np.cos(angle), np.cos(angle), -np.sin(angle), np.sin(angle)
        T[:3, :3] = T[:3, :3] @ turn
    T[:3, 3] = position
    return T


# ---- Kernels against their twins ----

@pytest.fixture(scope="module")
def voxels() -> dict[tuple, reference.Voxel]:
    """Voxels around a camera at the origin, before and behind it and beside its image, with noisy planes in them."""
    rng, encoder = np.random.default_rng(0), reference.Encoder(ENCODER.rank, ENCODER.anchors)
    features = encoder((twin.CENTERS - 0.5) / 2)
    z = rng.integers(3, 18, (250, 1))
    keys = np.vstack([np.hstack([rng.uniform(-0.6, 0.6, (250, 2)) * z, z]), rng.uniform(-18, 18, (80, 3))]).astype(int)
    found = {}
    for key in sorted(map(tuple, np.unique(keys, axis=0).tolist())):
        normal = rng.normal(size=3)
        plane = (twin.CENTERS - rng.uniform(0.2, 0.8, 3)) @ normal / np.linalg.norm(normal)
        F = np.linalg.lstsq(features, plane[:, None], rcond=None)[0] * rng.choice([0.01, 1, 1, 1])  # some of them too flat
        found[key] = reference.Voxel(F.astype(np.float32).astype(float), 5.0, rng.uniform(size=64) < 0.5)
    return found


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    """Readings from 0.2 to 1 m in patches, a third of them none; 1 at all borders."""
    rng = np.random.default_rng(1)
    image = np.kron(rng.uniform(0.2, 1, (15, 20)) * (rng.uniform(size=(15, 20)) > 0.3), np.ones((8, 8)))
    image[[0, -1]] = image[:, [0, -1]] = 1.0
    return image.astype(np.float32)


def pack_masks(masks: np.ndarray) -> np.ndarray:
    """(N, 64) bool -> (N, 2) words, first cell in the highest bit."""
    return np.packbits(masks, axis=1).view(">u4").astype(np.uint32)


def vote(voxels: dict, depth: np.ndarray, T: np.ndarray, sign: int, evidence: np.ndarray) -> None:
    target = SurfaceMap(encoder=ENCODER)
    keys = np.array(list(voxels), np.int32)
    kernels.vote_cells(ENCODER.rank, len(keys), keys, pack_masks(np.array([v.mask for v in voxels.values()])),
                       np.array([v.F for v in voxels.values()], np.float32), target._regressor.cell_gradients.to_numpy(), VS,
                       depth, CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy, np.ascontiguousarray(T[:3], np.float32), sign,
                       evidence)


@pytest.mark.parametrize("T", [pose((0.003, 0.0017, -0.0021)), pose((0.1, -0.05, 0.02), 0.4, -0.3, 1.0)],
                         ids=["straight", "turned"])
def test_vote_cells_equals_its_twin(voxels, depth, T):
    """Before and behind the camera, inside and outside the image; the same frame with sign -1 takes its votes out.

    The camera is never quite at the origin, where cells fall exactly between pixels.
    """
    evidence = np.zeros((len(voxels), 64), np.int8)
    vote(voxels, depth, T, 1, evidence)
    wanted = np.array(list(twin.vote_cells(reference.Encoder(ENCODER.rank, ENCODER.anchors), voxels, VS, depth, CAMERA,
                                           T).values()))
    assert min((wanted == v).sum() for v in (-1, 1)) > 100 and (evidence != wanted).mean() < FLIPPED
    vote(voxels, depth, T, -1, evidence)
    assert not evidence.any()


def test_votes_stay_within_what_a_cell_can_hold(voxels, depth):
    evidence, once = (np.zeros((len(voxels), 64), np.int8) for _ in range(2))
    vote(voxels, depth, np.eye(4), 1, once)
    evidence[:] = 126 * once
    for _ in range(3):
        vote(voxels, depth, np.eye(4), 1, evidence)
    np.testing.assert_array_equal(evidence, 127 * once.astype(int))
    for _ in range(2):
        vote(voxels, depth, np.eye(4), -1, evidence)
    np.testing.assert_array_equal(evidence, 125 * once.astype(int))


def test_a_frame_without_readings_casts_no_vote(voxels, depth):
    evidence = np.zeros((len(voxels), 64), np.int8)
    vote(voxels, np.zeros_like(depth), np.eye(4), 1, evidence)
    assert not evidence.any()


def test_a_reading_at_the_image_border_counts_and_one_pixel_on_does_not():
    """One voxel without support, small in the image, at the last pixels and just outside."""
    for u, seen in ((0, True), (159, True), (-2, False), (161, False)):
        center = np.array([(u - CAMERA.cx) / CAMERA.fx, 0.0, 1.0]) * 50
        key = tuple(np.floor(center / VS).astype(int).tolist())
        evidence = np.zeros((1, 64), np.int8)
        vote({key: reference.Voxel(np.zeros((ENCODER.rank, 1)), 1.0, np.zeros(64, bool))},
             np.full((120, 160), 100, np.float32), np.eye(4), 1, evidence)
        assert evidence.all() == evidence.any() == seen, u


def test_add_evidence_equals_its_twin():
    rng = np.random.default_rng(3)
    old, more = rng.integers(-127, 128, (50, 64), dtype=np.int8), rng.integers(-127, 128, (30, 64), dtype=np.int8)
    slots, added = rng.permutation(50)[:30].astype(np.int32), old.copy()
    kernels.add_evidence(slots, more, added)
    np.testing.assert_array_equal(added[slots], twin.add_evidence(old[slots], more))
    others = np.setdiff1d(np.arange(50), slots)
    np.testing.assert_array_equal(added[others], old[others])


def test_interpolate_evidence_equals_its_twin():
    rng, grid = np.random.default_rng(4), VoxelGrid(rows=1, channels=1, evidence=True)
    keys = np.unique(rng.integers(-2, 2, (40, 3)), axis=0).astype(np.int32)
    slots = np.empty(len(keys), np.int32)
    grid.claim(len(keys), keys, np.ones(len(keys), np.float32), slots)
    masks, evidence = rng.uniform(size=(grid.capacity, 64)) < 0.5, rng.integers(-127, 128, (grid.capacity, 64), dtype=np.int8)
    masks[slots[0]] = False
    x, values = rng.uniform(-2.5, 2.5, (2000, 3)), np.empty(2000, np.float32)
    points = (x * VS).astype(np.float32)
    kernels.interpolate_evidence(points, 1 / VS, grid.slot, pack_masks(masks), evidence, values)
    by_key = {tuple(key): s for key, s in zip(keys.tolist(), slots, strict=True)}
    wanted = twin.interpolate_evidence({key: evidence[s] for key, s in by_key.items()},
                                       {key: masks[s] for key, s in by_key.items()}, points.astype(float) / VS)
    assert 0.2 < (wanted == 1).mean() < 0.9
    assert (np.abs(values - wanted) > EVIDENCE * 127).mean() < FLIPPED


# ---- Where a surface ends ----

def plane_before_wall(T_scene_camera: np.ndarray, edge: float, far: float = 2.0) -> Frame:
    """Exact depth of the plane z = 1 where x < edge, and of the wall z = far beyond; 0: no wall."""
    v, u = np.mgrid[:CAMERA.height, :CAMERA.width]
    camera_rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1)
    ray, origin = camera_rays @ T_scene_camera[:3, :3].T, T_scene_camera[:3, 3]
    depth = (1 - origin[2]) / ray[..., 2]
    wall = (far - origin[2]) / ray[..., 2] if far else 0.0
    return Frame(np.where(origin[0] + depth * ray[..., 0] < edge, depth, wall).astype(np.float32), CAMERA)


POSES = [pose((0.15 * np.cos(k * np.pi / 4) * (1 + 0.1 * k), 0.1 * np.sin(k * np.pi / 4), 0), 0.1 * np.sin(k),
              0.05 * np.cos(2 * k))
         for k in range(12)]
T_WORLD_SCENE = pose((0.3, -0.2, 0), 0.4, 0.3, 0.5)  # so that nothing lies along the voxels


def clouds_of(edge: float, poses=POSES, far: float = 2.0) -> list[PointCloud]:
    """In world coordinates."""
    return [preprocess(plane_before_wall(T, edge, far)).transformed(T_WORLD_SCENE @ T) for T in poses]


def mapped(clouds, **settings) -> SurfaceMap:
    """A map whose every cell may hold surface, so that nothing but evidence can end one."""
    target = SurfaceMap(**{"support_points": 0, **settings})
    for cloud in clouds:
        target.integrate(cloud)
    return target


def beyond_edge(target: SurfaceMap, edge: float) -> np.ndarray:
    """How far the border of the near plane's mesh lies beyond the edge [voxels], in the middle of the images."""
    mesh = target.extract_mesh(4)
    assert_welded(mesh.vertices, mesh.faces)
    pairs = np.sort(np.vstack([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1)
    edges, uses = np.unique(pairs, axis=0, return_counts=True)
    x = (mesh.vertices[np.unique(edges[uses == 1])].astype(float) - T_WORLD_SCENE[:3, 3]) @ T_WORLD_SCENE[:3, :3]
    near = (np.abs(x[:, 2] - 1) < 0.2) & (np.abs(x[:, 1]) < 0.2) & (x[:, 0] > edge - 0.15)
    assert near.sum() > 20
    return (x[near, 0] - edge) / VS


@pytest.mark.parametrize("edge", [0.0, 0.017])
def test_a_surface_ends_at_the_edge_that_rays_pass(edge):
    clouds = clouds_of(edge)
    with_votes, without = (beyond_edge(mapped(clouds, carve=carve), edge) for carve in (True, False))
    assert np.abs(with_votes).mean() < AT_EDGE and np.quantile(np.abs(with_votes), 0.95) < NEAR_EDGE, with_votes
    assert np.quantile(without, 0.95) > BEYOND_EDGE, without


def mesh_bytes(target: SurfaceMap) -> tuple[bytes, ...]:
    mesh = target.extract_mesh(3)
    assert len(mesh.faces) > 100
    return mesh.vertices.tobytes(), mesh.faces.tobytes(), mesh.normals.tobytes()


def test_clouds_without_a_view_never_cut_anything():
    clouds = clouds_of(0.0, POSES[:3])
    blind = mapped([replace(cloud, view=None) for cloud in clouds])
    data = blind._grid.export()
    assert data.evidence.max() == len(clouds) and (data.evidence >= 0).all() and mesh_bytes(blind) == mesh_bytes(
        mapped(clouds, carve=False))
    assert mesh_bytes(mapped(clouds)) != mesh_bytes(blind)


def test_what_a_single_frame_saw_stays_when_others_do_not_see_it():
    """One frame sees a plane with nothing behind it; the others look the other way, or see it not at all."""
    seen = clouds_of(9.0, POSES[:1])[0]
    alone = mapped([seen])
    area = area_and_volume(*_triangles(alone))[0]
    assert area == pytest.approx(area_and_volume(*_triangles(mapped([seen], carve=False)))[0], rel=RIM)
    for k in range(3):
        away = T_WORLD_SCENE @ pose((0, 0, 0), np.pi + 0.1 * k)
        alone.integrate(preprocess(plane_before_wall(np.eye(4), 9.0)).transformed(away))
    both = area_and_volume(*_triangles(alone))[0]
    assert both > 1.7 * area  # and the wall behind the camera beside it


def _triangles(target: SurfaceMap):
    mesh = target.extract_mesh(3)
    return mesh.vertices, mesh.faces


def test_more_evidence_wanted_leaves_less_surface():
    clouds = clouds_of(0.0, POSES[:4])
    areas = [area_and_volume(*_triangles(mapped(clouds, min_evidence=wanted)))[0] for wanted in (-127.0, 0.0, 2.0)]
    bare = area_and_volume(*_triangles(mapped(clouds, carve=False)))[0]
    assert areas[0] == pytest.approx(bare, rel=1e-6) and areas[0] > areas[1] > areas[2] > 0
    assert len(mapped(clouds, min_evidence=5.0).extract_mesh(3).faces) == 0  # there were but four frames


def test_readings_beyond_the_mapped_range_also_say_that_space_is_free():
    """The wall is too far for points, yet its rays cut the plane's rim."""
    assert np.abs(beyond_edge(mapped(clouds_of(0.0, far=7.0)), 0.0)).mean() < AT_EDGE


# ---- Views ----

def test_a_moved_cloud_keeps_its_view():
    cloud, T = preprocess(plane_before_wall(np.eye(4), 0.0)), pose((1, 2, 3), 0.3, 0.2, 0.1)
    there = cloud.transformed(T)
    np.testing.assert_allclose(there.view.T_camera_cloud @ T, np.eye(4), atol=1e-12)
    back = there.view.T_camera_cloud[:3, :3] @ there.points.T + there.view.T_camera_cloud[:3, 3:]
    np.testing.assert_allclose(back.T, cloud.points, atol=1e-5)
    assert there.view.depth is cloud.view.depth and PointCloud(cloud.points).transformed(T).view is None


def test_a_view_that_makes_no_sense_is_refused():
    good = np.ones((120, 160), np.float32)
    for depth, T, error in ((good[:, :9], np.eye(4), SizeMismatch), (good.astype(float), np.eye(4), SizeMismatch),
                            (good * np.nan, np.eye(4), InputError), (good, 2 * np.eye(4), PoseError)):
        with pytest.raises(error):
            DepthView(depth, CAMERA, T)
    assert DepthView(np.asfortranarray(good), CAMERA, np.eye(4)).depth.flags.c_contiguous


# ---- Evidence in maps and files ----

@pytest.fixture(scope="module")
def carved() -> SurfaceMap:
    return mapped(clouds_of(0.0, POSES[:3]))


def test_evidence_is_saved_and_loaded_bit_for_bit(carved, tmp_path):
    carved.save(tmp_path / "map")
    loaded = load_map(tmp_path / "map")
    data, again = carved._grid.export(), loaded._grid.export()
    assert data.evidence.min() < 0 < data.evidence.max() and data.evidence.dtype == np.int8
    assert again.evidence.tobytes() == data.evidence.tobytes() and mesh_bytes(loaded) == mesh_bytes(carved)
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "map").read_bytes()


def test_growing_pools_keep_the_evidence(carved, monkeypatch):
    monkeypatch.setattr(voxel_grid, "FIRST_CAPACITY", 4)
    small = mapped(clouds_of(0.0, POSES[:3]))
    assert small._grid.capacity > 4 and small._grid.export().evidence.tobytes() == carved._grid.export().evidence.tobytes()


def test_merging_adds_evidence(carved, tmp_path):
    carved.save(tmp_path / "map")
    merged = load_map(tmp_path / "map")
    for votes in (2, 3):
        merged.merge(carved)
        np.testing.assert_array_equal(merged._grid.export().evidence, votes * carved._grid.export().evidence)
    apart = mapped([cloud.transformed(pose((20, 0, 0))) for cloud in clouds_of(0.0, POSES[:2])])
    together = mapped(clouds_of(0.0, POSES[:3]) + [cloud.transformed(pose((20, 0, 0))) for cloud in clouds_of(0.0, POSES[:2])])
    apart.merge(carved)  # where no frame sees the other's voxels, merging is integrating all
    np.testing.assert_array_equal(apart._grid.export().keys, together._grid.export().keys)
    np.testing.assert_array_equal(apart._grid.export().evidence, together._grid.export().evidence)


def test_without_carve_there_is_no_evidence(tmp_path):
    target = mapped(clouds_of(0.0, POSES[:1]), carve=False)
    target.save(tmp_path / "map")
    assert target._grid.export().evidence is None and "evidence" not in read_map(tmp_path / "map")[0]
    assert load_map(tmp_path / "map")._grid.export().evidence is None


@pytest.mark.parametrize("damage", [lambda e: None, lambda e: e[:, :63].copy(), lambda e: e[:-1].copy(),
                                    lambda e: e.astype(np.int32)],
                         ids=["missing", "cells", "rows", "type"])
def test_damaged_evidence_is_refused(carved, tmp_path, damage):
    carved.save(tmp_path / "map")
    tensors, manifest = read_map(tmp_path / "map")
    evidence = damage(tensors.pop("evidence"))
    write_map(tmp_path / "map", tensors if evidence is None else {**tensors, "evidence": evidence}, manifest)
    with pytest.raises(MapCorrupt, match="'evidence' should be"):
        load_map(tmp_path / "map")


def test_removing_the_last_frame_takes_out_its_votes_and_a_refused_removal_none():
    first, second = clouds_of(0.0, POSES[:2])
    target, alone = mapped([first]), mapped([first])._grid.export()
    target.integrate(second)
    bad = replace(second, points=second.points.copy())
    bad.points[7] = 1e9
    before = target._grid.export()
    with pytest.raises(OutOfRange):
        target.remove(bad)
    assert target._grid.export().evidence.tobytes() == before.evidence.tobytes()
    assert (before.evidence[np.isin(_codes(before.keys), _codes(alone.keys))] != alone.evidence).any()
    target.remove(second)
    after = target._grid.export()
    np.testing.assert_array_equal(after.keys, alone.keys)
    np.testing.assert_array_equal(after.evidence, alone.evidence)


def _codes(keys: np.ndarray) -> np.ndarray:
    return keys.astype(np.int64) @ (1 << 42, 1 << 21, 1)


def test_clouds_of_points_alone_carry_no_view():
    assert rough(0).view is None


# ---- cut_mesh ----

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
    return np.column_stack([places, np.zeros(len(places))]).astype(np.float32), faces.astype(np.int32)


def assert_cut(sheet, values, area: float) -> None:
    vertices, faces = cut_mesh(*sheet, values.astype(np.float32))
    assert_welded(vertices, faces)
    assert vertices.dtype == np.float32 and faces.dtype == np.int32 and len(np.unique(vertices, axis=0)) == len(vertices)
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    doubled = np.cross(b - a, c - a)
    assert (doubled[:, 2] > -1e-9).all() and doubled[:, 2].sum() / 2 == pytest.approx(area, rel=AREA)
    pairs = np.sort(np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    uses = np.unique(pairs, axis=0, return_counts=True)[1]
    assert uses.max() == 2
    assert len(vertices) - len(uses) + len(faces) == 1  # Euler: one piece without holes: an edge is cut once


@pytest.mark.parametrize(("slope", "offset", "area"), [((1, 0), -0.3, 0.7), ((-1, 0), 0.3, 0.3), ((0, 1), -0.55, 0.45),
                                                       ((1, 1), -1, 0.5), ((-1, -1), 0.5, 0.125)])
def test_a_cut_along_a_line_leaves_the_area_on_its_side(sheet, slope, offset, area):
    assert_cut(sheet, sheet[0][:, :2] @ slope + offset, area)


def test_a_cut_through_vertices_makes_no_slivers_and_no_vertex_twice():
    """A grid of squares cut along one of its lines, through vertices whose value is exactly 0."""
    n = 9
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    places = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1).astype(np.float32)
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1, 1)
    faces = np.vstack([a + [0, n, n + 1], a + [0, n + 1, 1]]).astype(np.int32)
    for values, area in ((places[:, 0] - 3, 40), (3 - places[:, 0], 24), (places[:, 0] + places[:, 1] - 8, 32),
                         (np.where(places[:, 0] < 4, 0, -1), 24)):
        assert_cut((places, faces), values, area)


def test_a_mesh_of_one_sign_is_kept_or_gone(sheet):
    vertices, faces = sheet
    kept = cut_mesh(vertices, faces, np.zeros(len(vertices), np.float32))
    assert kept[0] is vertices and kept[1] is faces
    gone = cut_mesh(vertices, faces, np.full(len(vertices), -1, np.float32))
    assert gone[0].shape == gone[1].shape == (0, 3) and gone[1].dtype == np.int32
