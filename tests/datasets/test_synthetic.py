"""The synthetic room: exact ground truth, a Kinect's noise as modelled, the same bytes whatever the
order.
"""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.datasets.synthetic import SyntheticRoom, look_at
from taichi_unifusion.errors import InputError
from taichi_unifusion.rendering.kernels.solids import kinect_depth
from taichi_unifusion.rendering.primitives import CHORD_ERROR
from taichi_unifusion.runtime import current
from taichi_unifusion.types import PinholeCamera

# [m], [degrees] between frames of the default loop: what frame-to-frame tracking bears
MAX_STEP, MAX_TURN = 0.10, 8.0
CASTING_ERROR = 2e-5  # [m] float32 of rays and maps, at grazing incidence and 4 m
# share of rays that pass a curved outline within the chord error, and see different things
SILHOUETTES = 0.001
SAMPLING = 0.03  # relative; five standard errors of the deviation of 19,200 pixels


@pytest.fixture(scope="module")
def room() -> SyntheticRoom:
    return SyntheticRoom(width=320, height=240)


@pytest.fixture(scope="module")
def mesh(room):
    return room.ground_truth_mesh()


def read(exact: np.ndarray, *, degrees: float = 0.0, frame: int = 0, seed: int = 0) -> np.ndarray:
    """The sensor's reading of exact depth [m] on surfaces seen at this angle of incidence."""
    current()
    depth = np.zeros_like(exact)
    kinect_depth(
        exact,
        np.full_like(exact, np.cos(np.radians(degrees))),
        exact.min(),
        seed,
        frame,
        575.0,
        depth,
    )
    return depth


def wall(z: float) -> np.ndarray:
    """A wall about z [m] away, leaning by 10 % of it, so that rounding to millimetres and
    disparities averages out.
    """
    return np.repeat(np.linspace(0.95 * z, 1.05 * z, 160, dtype=np.float32)[None], 120, axis=0)


def cast_mesh(mesh, T_world_camera, rays):
    """Depth of the nearest triangle along rays with unit z, and whether it faces the camera, in
    float64 NumPy.
    """
    vertices = (mesh.vertices.astype(np.float64) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    # negative where the triangle is counter-clockwise to the eye
    front = np.einsum("fi,fi->f", np.cross(b - a, c - a), a)
    sides = [np.cross(b, c), np.cross(c, a), np.cross(a, b)]
    depth, facing = [], []
    for ray in rays:
        w = np.stack([side @ ray for side in sides])
        inside = ((w >= 0).all(axis=0) | (w <= 0).all(axis=0)) & (np.abs(w.sum(axis=0)) > 1e-15)
        t = front[inside] / w[:, inside].sum(axis=0)
        ahead = np.flatnonzero(t > 0)
        nearest = ahead[t[ahead].argmin()]
        depth.append(t[nearest])
        facing.append(front[inside][nearest] < 0)
    return np.array(depth), np.array(facing)


def test_exact_depth_is_that_of_the_ground_truth_mesh(room, mesh):
    rng = np.random.default_rng(0)
    camera = room.camera
    errors, facing = [], []
    for index in (0, 14, 37, 51):
        u, v = rng.integers(0, camera.width, 25), rng.integers(0, camera.height, 25)
        rays = np.stack(
            [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(25)], axis=1
        )
        z, front = cast_mesh(mesh, room.T_world_camera[index], rays)
        errors.append(np.abs(room.exact_depth(index)[v, u] - z))
        facing.append(front)
    errors = np.concatenate(errors)
    assert np.median(errors) < CASTING_ERROR  # flat faces are exact in the mesh
    # chords seen at down to 6 degrees; one ray may pass a silhouette
    assert np.sum(errors > 10 * CHORD_ERROR) <= 1
    assert np.concatenate(facing).all()


def test_all_of_exact_depth_agrees_with_an_independent_ray_caster(room, mesh):
    o3d = pytest.importorskip("open3d")
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32))
    )
    K = room.camera.matrix
    K[:2, 2] += 0.5  # Open3D's pixel centres lie at half integers
    for index in (5, 48):
        T_camera_world = np.linalg.inv(room.T_world_camera[index])
        rays = scene.create_rays_pinhole(
            o3d.core.Tensor(K), o3d.core.Tensor(T_camera_world), *room.camera.size
        )
        error = np.abs(scene.cast_rays(rays)["t_hit"].numpy() - room.exact_depth(index))
        assert np.median(error) < CASTING_ERROR
        assert np.mean(error > 10 * CHORD_ERROR) < SILHOUETTES


def test_mesh_faces_and_normals_point_into_free_space(mesh):
    a, b, c = (mesh.vertices[mesh.faces[:, k]].astype(np.float64) for k in range(3))
    n = np.cross(b - a, c - a)
    area = np.linalg.norm(n, axis=1)
    assert area.min() > 0
    shading = mesh.normals[mesh.faces].mean(axis=1)
    # chords of fine tessellation bend by a few degrees
    assert np.einsum("fi,fi->f", n / area[:, None], shading).min() > 0.9
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


def test_a_frame_is_the_same_bytes_in_any_order_and_run():
    alone = SyntheticRoom(width=160, height=120)[7]
    other = SyntheticRoom(width=160, height=120)
    frames = {i: other[i] for i in (3, 9, 7)}
    for again in (frames[7], other[7], next(iter(other[7:8]))):
        assert again.depth.tobytes() == alone.depth.tobytes()
        assert again.color.tobytes() == alone.color.tobytes()
    assert (alone.name, alone.index) == ("synthetic frame 7", 7)


def test_the_seed_changes_the_noise_and_nothing_else():
    a, b = (SyntheticRoom(width=160, height=120, seed=seed)[4] for seed in (0, 1))
    assert a.color.tobytes() == b.color.tobytes()
    assert np.mean(a.depth != b.depth) > 0.5


def test_without_noise_depth_is_exact(room):
    quiet = SyntheticRoom(width=320, height=240, noise=False)
    assert (
        quiet[11].depth.tobytes()
        == quiet.exact_depth(11).tobytes()
        == room.exact_depth(11).tobytes()
    )


@pytest.mark.parametrize("z", (0.8, 1.5, 2.5, 3.5, 4.5))
def test_noise_grows_with_the_square_of_depth(z):
    exact = wall(z).astype(np.float64)
    reading = read(wall(z))
    axial = 0.0012 + 0.0019 * (exact - 0.4) ** 2
    step = exact**2 / (8 * 575 * 0.075)  # of an eighth of a pixel of disparity
    expected = np.sqrt(axial**2 + (step**2 + 0.001**2) / 12)  # both roundings are uniform errors
    error = (reading - exact) / expected
    assert (reading > 0).all()
    assert abs(error.std() - 1) < SAMPLING
    assert abs(error.mean()) < 0.05
    gaps = np.diff(np.unique(reading))
    # whole millimetres apart
    assert np.median(gaps) == pytest.approx(np.median(step), abs=0.001 + 0.3 * np.median(step))


def test_noise_of_frames_pixels_and_seeds_is_unrelated():
    exact = wall(2.0)
    error = read(exact) - exact
    neighbours = np.roll(error, 1, axis=0), np.roll(error, 1, axis=1)
    for other in (read(exact, frame=1) - exact, read(exact, seed=1) - exact, *neighbours):
        assert abs(np.corrcoef(error.ravel(), other.ravel())[0, 1]) < 4 / np.sqrt(error.size)


@pytest.mark.parametrize("z", (0.3, 6.5))
def test_no_reading_outside_the_range(z):
    assert not read(wall(z)).any()


def test_projector_shadow_lies_left_of_what_stands_in_front():
    near, far, left = 1.0, 2.5, 80
    exact = np.full((60, 160), far, np.float32)
    exact[:, left:110] = near
    depth = read(exact)
    width = int(575 * 0.075 * (1 / near - 1 / far))
    jitter = 4  # [px] beyond the lateral noise
    assert not depth[:, left - width + jitter : left - jitter].any()
    for lit in (
        slice(0, left - width - jitter),
        slice(left + jitter, 110 - jitter),
        slice(110 + jitter, None),
    ):
        assert depth[:, lit].all()


def test_edges_are_ragged_and_grazing_surfaces_drop_out():
    exact = np.full((200, 40), 2.0, np.float32)
    exact[:, 20:] = 2.2
    swapped = np.abs(read(exact) - exact) > 0.1
    assert 0.1 < swapped[:, 19:21].mean() < 0.6 and not swapped[:, :15].any()
    share = [np.mean(read(exact, degrees=degrees)[:, :15] > 0) for degrees in (45, 75, 80, 86)]
    assert share[0] == 1 and share[1] > share[2] > share[3] == 0


def test_readings_are_whole_millimetres_in_range_and_mostly_there(room):
    for index in (0, 20, 40):
        depth = room[index].depth
        valid = depth > 0
        assert valid.mean() > 0.85
        assert depth[valid].min() >= 0.4 and depth.max() <= 5.5
        np.testing.assert_allclose(depth * 1000, np.round(depth * 1000), atol=1e-3)


def test_color_is_that_of_the_surface_point_not_of_the_view(room):
    scene, camera = room._scene, PinholeCamera(1, 1, 575.0, 575.0, 0.0, 0.0)
    rng = np.random.default_rng(1)
    T = room.T_world_camera[20]
    depth, hit = scene.cast(room.camera, T)
    color, _ = scene.shade(room.camera, T, depth, hit)
    seen = 0
    for v, u in zip(rng.integers(0, 240, 80), rng.integers(0, 320, 80), strict=True):
        z = depth[v, u]
        x = (
            T[:3, :3]
            @ (
                (u - room.camera.cx) / room.camera.fx * z,
                (v - room.camera.cy) / room.camera.fy * z,
                z,
            )
            + T[:3, 3]
        )
        eye = T[:3, 3] + rng.uniform(-0.3, 0.3, 3)
        T_other = look_at(eye, x)
        other_depth, other_hit = scene.cast(camera, T_other)
        if abs(other_depth[0, 0] - np.linalg.norm(x - eye)) > 1e-4:
            continue  # hidden from there
        other, _ = scene.shade(camera, T_other, other_depth, other_hit)
        # float32 of the point, against texture gradients
        assert np.abs(other[0, 0].astype(int) - color[v, u]).max() <= 3
        seen += 1
    assert seen > 60


def test_poses_are_rigid_smooth_and_close_the_loop(room):
    T = room.T_world_camera
    R, following = T[:, :3, :3], np.roll(T, -1, axis=0)
    np.testing.assert_allclose(
        R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-12
    )
    assert np.linalg.det(R).min() > 0.999
    assert np.linalg.norm(following[:, :3, 3] - T[:, :3, 3], axis=1).max() < MAX_STEP
    turn = np.degrees(np.arccos((np.einsum("nij,nij->n", R, following[:, :3, :3]) - 1) / 2))
    assert turn.max() < MAX_TURN
    np.testing.assert_array_equal(room[3].T_world_camera, T[3])


def test_the_camera_passes_everything_and_bumps_into_nothing():
    room = SyntheticRoom(width=160, height=120, noise=False)
    scene, views = room._scene, 0
    for T in room.T_world_camera:
        depth, hit = scene.cast(room.camera, T)
        # the room is closed, and a Kinect reads from 0.4 m on
        assert depth.min() > 0.5 and depth.max() < 6
        views = views + np.isin(np.arange(len(scene.shapes)), hit)
    assert np.mean(views >= 3) > 0.85  # some legs stand behind others


@pytest.mark.parametrize("size", ((1, 1), (37, 23), (16, 17)))
def test_any_image_size_works(size):
    frame = SyntheticRoom(frames=1, width=size[0], height=size[1])[0]
    assert frame.depth.shape == size[::-1] and frame.color.any()


@pytest.mark.parametrize("wrong", ({"frames": 0}, {"width": 0}, {"height": -1}))
def test_sizes_must_be_positive(wrong):
    with pytest.raises(InputError):
        SyntheticRoom(**wrong)
