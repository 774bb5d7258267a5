"""Evidence from rays in maps and files: where a surface must end, and where it must not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mesh_laws import area_and_volume, assert_welded
from scenes import rough
from viewpoints import CAMERA, VS, pose

from taichi_unifusion import Frame, PointCloud, SurfaceMap, load_map, preprocess
from taichi_unifusion.errors import (
    FrameError,
    InputError,
    MapCorrupt,
    OutOfRange,
    PoseError,
    SizeMismatch,
)
from taichi_unifusion.files.maps import read_map, write_map
from taichi_unifusion.maps import voxel_grid
from taichi_unifusion.types import ImageView

AT_EDGE = 0.1  # [voxels] mean distance of the mesh's border from the true edge, with `carve`...
NEAR_EDGE = 0.5  # ...and of 95 % of it: two cells
BEYOND_EDGE = 0.6  # [voxels] without it, the surface goes on to where voxels end: the same 95 %
RIM = 0.1  # of the area: cells half outside of the only image have no vote


# ---- Where a surface ends ----


def plane_before_wall(T_scene_camera: np.ndarray, edge: float, far: float = 2.0) -> Frame:
    """Exact depth of the plane z = 1 where x < edge, and of the wall z = far beyond; 0: no wall."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    camera_rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], axis=-1
    )
    ray, origin = camera_rays @ T_scene_camera[:3, :3].T, T_scene_camera[:3, 3]
    depth = (1 - origin[2]) / ray[..., 2]
    wall = (far - origin[2]) / ray[..., 2] if far else 0.0
    return Frame(
        np.where(origin[0] + depth * ray[..., 0] < edge, depth, wall).astype(np.float32), CAMERA
    )


POSES = [
    pose(
        (0.15 * np.cos(k * np.pi / 4) * (1 + 0.1 * k), 0.1 * np.sin(k * np.pi / 4), 0),
        0.1 * np.sin(k),
        0.05 * np.cos(2 * k),
    )
    for k in range(12)
]
T_WORLD_SCENE = pose((0.3, -0.2, 0), 0.4, 0.3, 0.5)  # so that nothing lies along the voxels


def clouds_of(edge: float, poses=POSES, far: float = 2.0) -> list[PointCloud]:
    """In world coordinates."""
    return [
        preprocess(plane_before_wall(T, edge, far)).transformed(T_WORLD_SCENE @ T) for T in poses
    ]


def mapped(clouds, **settings) -> SurfaceMap:
    """A map whose every cell may hold surface, so that nothing but evidence can end one."""
    target = SurfaceMap(**{"support_points": 0, **settings})
    for cloud in clouds:
        target.integrate(cloud)
    return target


def beyond_edge(target: SurfaceMap, edge: float) -> np.ndarray:
    """How far the border of the near plane's mesh lies beyond the edge [voxels], in the middle of
    the images.
    """
    mesh = target.extract_mesh(4)
    assert_welded(mesh.vertices, mesh.faces)
    pairs = np.sort(
        np.vstack([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]]), axis=1
    )
    edges, uses = np.unique(pairs, axis=0, return_counts=True)
    x = (
        mesh.vertices[np.unique(edges[uses == 1])].astype(float) - T_WORLD_SCENE[:3, 3]
    ) @ T_WORLD_SCENE[:3, :3]
    near = (np.abs(x[:, 2] - 1) < 0.2) & (np.abs(x[:, 1]) < 0.2) & (x[:, 0] > edge - 0.15)
    assert near.sum() > 20
    return (x[near, 0] - edge) / VS


@pytest.mark.parametrize("edge", [0.0, 0.017])
def test_a_surface_ends_at_the_edge_that_rays_pass(edge):
    clouds = clouds_of(edge)
    with_votes, without = (
        beyond_edge(mapped(clouds, carve=carve), edge) for carve in (True, False)
    )
    assert (
        np.abs(with_votes).mean() < AT_EDGE and np.quantile(np.abs(with_votes), 0.95) < NEAR_EDGE
    ), with_votes
    assert np.quantile(without, 0.95) > BEYOND_EDGE, without


def mesh_bytes(target: SurfaceMap) -> tuple[bytes, ...]:
    mesh = target.extract_mesh(3)
    assert len(mesh.faces) > 100
    return mesh.vertices.tobytes(), mesh.faces.tobytes(), mesh.normals.tobytes()


def test_clouds_without_a_view_never_cut_anything():
    clouds = clouds_of(0.0, POSES[:3])
    blind = mapped([replace(cloud, view=None) for cloud in clouds])
    data = blind.voxels()
    assert (
        data.evidence.max() == len(clouds)
        and (data.evidence >= 0).all()
        and mesh_bytes(blind) == mesh_bytes(mapped(clouds, carve=False))
    )
    assert mesh_bytes(mapped(clouds)) != mesh_bytes(blind)


def test_what_a_single_frame_saw_stays_when_others_do_not_see_it():
    """One frame sees a plane with nothing behind it; the others look the other way, or see it not
    at all.
    """
    seen = clouds_of(9.0, POSES[:1])[0]
    alone = mapped([seen])
    area = area_and_volume(*_triangles(alone))[0]
    assert area == pytest.approx(
        area_and_volume(*_triangles(mapped([seen], carve=False)))[0], rel=RIM
    )
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
    areas = [
        area_and_volume(*_triangles(mapped(clouds, min_evidence=wanted)))[0]
        for wanted in (-127.0, 0.0, 2.0)
    ]
    bare = area_and_volume(*_triangles(mapped(clouds, carve=False)))[0]
    assert areas[0] == pytest.approx(bare, rel=1e-6) and areas[0] > areas[1] > areas[2] > 0
    # there were but four frames
    assert len(mapped(clouds, min_evidence=5.0).extract_mesh(3).faces) == 0


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
    assert (
        there.view.values is cloud.view.values
        and PointCloud(cloud.points).transformed(T).view is None
    )


def test_a_view_that_makes_no_sense_is_refused():
    good = np.ones((120, 160), np.float32)
    for depth, T, error in (
        (good[:, :9], np.eye(4), SizeMismatch),
        (good.astype(float), np.eye(4), FrameError),
        (good * np.nan, np.eye(4), InputError),
        (good, 2 * np.eye(4), PoseError),
    ):
        with pytest.raises(error):
            PointCloud(np.zeros((1, 3), np.float32), view=ImageView(depth, CAMERA, T))
    assert ImageView(np.asfortranarray(good), CAMERA).values.flags.c_contiguous


# ---- Evidence in maps and files ----


@pytest.fixture(scope="module")
def carved() -> SurfaceMap:
    return mapped(clouds_of(0.0, POSES[:3]))


def test_evidence_is_saved_and_loaded_bit_for_bit(carved, tmp_path):
    carved.save(tmp_path / "map")
    loaded = load_map(tmp_path / "map")
    data, again = carved.voxels(), loaded.voxels()
    assert data.evidence.min() < 0 < data.evidence.max() and data.evidence.dtype == np.int8
    assert again.evidence.tobytes() == data.evidence.tobytes() and mesh_bytes(loaded) == mesh_bytes(
        carved
    )
    loaded.save(tmp_path / "again")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "map").read_bytes()


def test_growing_pools_keep_the_evidence(carved, monkeypatch):
    monkeypatch.setattr(voxel_grid, "FIRST_CAPACITY", 4)
    small = mapped(clouds_of(0.0, POSES[:3]))
    assert (
        small.grid.capacity > 4
        and small.voxels().evidence.tobytes() == carved.voxels().evidence.tobytes()
    )


def test_merging_adds_evidence(carved, tmp_path):
    carved.save(tmp_path / "map")
    merged = load_map(tmp_path / "map")
    for votes in (2, 3):
        merged.merge(carved)
        np.testing.assert_array_equal(merged.voxels().evidence, votes * carved.voxels().evidence)
    apart = mapped([cloud.transformed(pose((20, 0, 0))) for cloud in clouds_of(0.0, POSES[:2])])
    together = mapped(
        clouds_of(0.0, POSES[:3])
        + [cloud.transformed(pose((20, 0, 0))) for cloud in clouds_of(0.0, POSES[:2])]
    )
    apart.merge(carved)  # where no frame sees the other's voxels, merging is integrating all
    np.testing.assert_array_equal(apart.voxels().keys, together.voxels().keys)
    np.testing.assert_array_equal(apart.voxels().evidence, together.voxels().evidence)


def test_without_carve_there_is_no_evidence(tmp_path):
    target = mapped(clouds_of(0.0, POSES[:1]), carve=False)
    target.save(tmp_path / "map")
    assert target.voxels().evidence is None and "evidence" not in read_map(tmp_path / "map")[0]
    assert load_map(tmp_path / "map").voxels().evidence is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda e: None,
        lambda e: e[:, :63].copy(),
        lambda e: e[:-1].copy(),
        lambda e: e.astype(np.int32),
    ],
    ids=["missing", "cells", "rows", "type"],
)
def test_damaged_evidence_is_refused(carved, tmp_path, damage):
    carved.save(tmp_path / "map")
    tensors, manifest = read_map(tmp_path / "map")
    evidence = damage(tensors.pop("evidence"))
    write_map(
        tmp_path / "map",
        tensors if evidence is None else {**tensors, "evidence": evidence},
        manifest,
    )
    with pytest.raises(MapCorrupt, match="'evidence' should be"):
        load_map(tmp_path / "map")


def test_removing_the_last_frame_takes_out_its_votes_and_a_refused_removal_none():
    first, second = clouds_of(0.0, POSES[:2])
    target, alone = mapped([first]), mapped([first]).voxels()
    target.integrate(second)
    bad = replace(second, points=second.points.copy())
    bad.points[7] = 1e9
    before = target.voxels()
    with pytest.raises(OutOfRange):
        target.remove(bad)
    assert target.voxels().evidence.tobytes() == before.evidence.tobytes()
    assert (
        before.evidence[np.isin(_codes(before.keys), _codes(alone.keys))] != alone.evidence
    ).any()
    target.remove(second)
    after = target.voxels()
    np.testing.assert_array_equal(after.keys, alone.keys)
    np.testing.assert_array_equal(after.evidence, alone.evidence)


def _codes(keys: np.ndarray) -> np.ndarray:
    return keys.astype(np.int64) @ (1 << 42, 1 << 21, 1)


def test_clouds_of_points_alone_carry_no_view():
    assert rough(0).view is None
