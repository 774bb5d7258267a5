"""Up: from the floor of rooms and tabletops turned any way, from poses where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from meshes import parallelogram
from places import DATA

from taichi_unifusion.datasets.synthetic import SyntheticRoom, look_at
from taichi_unifusion.geometry.gravity import Up, find_up, smallest_turn
from taichi_unifusion.geometry.quaternions import quaternion_to_rotation
from taichi_unifusion.rendering.textured_scene import load_scene

EXACT_DEGREES = 1.0  # on exact surfaces
NOISY_DEGREES = 3.0  # with a Kinect's noise
NO_CAMERA = np.empty((0, 4, 4))
TURNS = quaternion_to_rotation(
    np.vstack([(0, 0, 0, 1), np.random.default_rng(3).normal(size=(3, 4))])
)


def turned(R, vertices, cameras=NO_CAMERA):
    """Vertices and cameras of a z-up world in one that is turned."""
    moved = np.array(cameras, float).reshape(-1, 4, 4).copy()
    moved[:, :3] = R @ moved[:, :3]
    return (vertices @ R.T).astype(np.float32), moved


def off(up: Up, R) -> float:
    """Angle to the true up [degrees]."""
    return float(np.degrees(np.arccos(np.clip(up.direction @ R[:, 2], -1, 1))))


def rectangle(corner, a, b, steps: int = 12):
    """Vertices and faces of a rectangle whose normal is a x b."""
    mesh = parallelogram(corner, a, b, steps)
    return mesh.vertices, mesh.faces


def joined(*parts):
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    faces = [faces + start for (_, faces), start in zip(parts, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in parts]), np.concatenate(faces)


def box(low, high):
    """Top and sides of a box seen from outside, as what stands on something is seen."""
    (x, y, z), (dx, dy, dz) = low, np.subtract(high, low)
    return joined(
        rectangle((x, y, z + dz), (dx, 0, 0), (0, dy, 0)),
        rectangle((x, y, z), (dx, 0, 0), (0, 0, dz)),
        rectangle((x + dx, y, z), (0, dy, 0), (0, 0, dz)),
        rectangle((x + dx, y + dy, z), (-dx, 0, 0), (0, 0, dz)),
        rectangle((x, y + dy, z), (0, -dy, 0), (0, 0, dz)),
    )


def room_from_within(x, y, width, depth, height=2.5):
    """Floor and walls of a room with a corner at (x, y, 0), its ceiling unseen."""
    return joined(
        rectangle((x, y, 0), (width, 0, 0), (0, depth, 0)),
        rectangle((x, y, 0), (0, 0, height), (width, 0, 0)),
        rectangle((x, y, 0), (0, depth, 0), (0, 0, height)),
        rectangle((x + width, y, 0), (0, 0, height), (0, depth, 0)),
        rectangle((x, y + depth, 0), (width, 0, 0), (0, 0, height)),
    )


@pytest.fixture(scope="module")
def furnished():
    room = SyntheticRoom(frames=12)
    mesh = room.ground_truth_mesh()
    return mesh.vertices, mesh.faces, room.T_world_camera


@pytest.mark.parametrize("R", TURNS)
def test_up_of_a_furnished_room_turned_any_way(furnished, R):
    vertices, faces, cameras = furnished
    vertices, cameras = turned(R, vertices, cameras)
    for seen_by in (cameras, cameras[:1], cameras[5:6]):
        up = find_up(vertices, faces, seen_by)
        assert up.how == "floor" and off(up, R) < EXACT_DEGREES
        assert abs(up.floor) < 0.01


@pytest.mark.parametrize("R", TURNS)
def test_up_of_a_flat_of_ten_rooms(R):
    rooms = [room_from_within(4 * (i % 5), 5 * (i // 5), 3.8, 4.8) for i in range(10)]
    rooms += [box((4 * i + 1, 1, 0), (4 * i + 2.6, 1.8, 0.75)) for i in range(5)]
    vertices, faces = joined(*rooms)
    vertices = vertices + np.random.default_rng(0).normal(0, 0.005, vertices.shape)
    eyes = [(4 * (i % 5) + 1, 5 * (i // 5) + 0.5, 1.5) for i in range(10)]
    cameras = [
        look_at(eye, np.add(eye, (1.5, 1 - 2 * (i % 2), -0.7))) for i, eye in enumerate(eyes)
    ]
    vertices, cameras = turned(R, vertices, cameras)
    up = find_up(vertices, faces, cameras)
    assert up.how == "floor" and off(up, R) < EXACT_DEGREES and abs(up.floor) < 0.01


@pytest.mark.parametrize("R", TURNS)
@pytest.mark.parametrize("pitch", [35, 50, 70])
def test_up_of_a_tabletop_that_one_camera_looks_down_at(R, pitch):
    """The camera's own up is as many degrees off as it looks down."""
    vertices, faces = joined(
        rectangle((-0.5, -0.4, 0), (1, 0, 0), (0, 0.8, 0)),
        box((-0.1, -0.1, 0), (0.15, 0.1, 0.3)),
        box((0.25, 0, 0), (0.35, 0.1, 0.12)),
    )
    way = np.radians(pitch)
    camera = look_at((-0.9 * np.cos(way), 0.1, 0.9 * np.sin(way) + 0.1), (0, 0, 0.1))
    vertices, cameras = turned(R, vertices, [camera])
    up = find_up(vertices, faces, cameras)
    assert up.how == "floor" and off(up, R) < EXACT_DEGREES and abs(up.floor) < 0.01


def test_the_floor_is_below_the_cameras_and_the_lowest_of_the_large_planes():
    vertices, faces = joined(
        room_from_within(0, 0, 4, 4),
        box((1, 1, 0), (3.2, 3.2, 0.8)),
        rectangle((0, 0, 2.5), (0, 4, 0), (4, 0, 0)),  # the ceiling
        rectangle((0.2, 0.2, -1.5), (0.3, 0, 0), (0, 0.3, 0)),  # a scrap of the storey below
    )
    up = find_up(vertices, faces, np.array([look_at((0.5, 0.5, 1.6), (3, 3, 1))]))
    assert off(up, np.eye(3)) < EXACT_DEGREES and abs(up.floor) < 0.01


def test_without_poses_up_is_what_worlds_usually_have(furnished):
    vertices, faces, _ = furnished
    up = find_up(vertices, faces, NO_CAMERA)
    assert off(up, np.eye(3)) < EXACT_DEGREES
    down = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]])  # z up to y down
    leaning = rectangle((-1, -1, 3), (0, 2, 0), (2, 0, 0))  # a wall that faces the camera
    floor = rectangle((-1, 1, 1), (2, 0, 0), (0, 0, 2))
    up = find_up(*joined(leaning, floor), NO_CAMERA)
    assert off(up, down) < EXACT_DEGREES


def test_where_no_floor_can_be_told_the_poses_say_up():
    wall = rectangle((2, -2, 0), (0, 0, 3), (0, 4, 0))  # all that is seen
    rolled = look_at((0, 0, 1.5), (2, 0, 1.2))
    rolled[:3, :3] = rolled[:3, :3] @ quaternion_to_rotation(np.array([[0, 0, 0.06, 1]]))[0]
    up = find_up(*wall, rolled[None])
    assert up.how == "cameras" and "--up" in up.sentence
    assert np.allclose(up.direction, -rolled[:3, 1])
    level = [look_at((0, y, 1.5), (2, y / 2, 1.0 + 0.2 * y)) for y in (-1, 0, 1)]
    up = find_up(*wall, np.array(level))
    assert up.how == "convention" and np.allclose(up.direction, (0, 0, 1))


def test_a_ball_has_no_floor():
    rng = np.random.default_rng(0)
    from scipy.spatial import ConvexHull

    points = rng.normal(size=(2000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    faces = ConvexHull(points).simplices
    a, b, c = (points[faces[:, k]] for k in range(3))
    inwards = np.einsum("nd,nd->n", np.cross(b - a, c - a), a) < 0
    faces[inwards] = faces[inwards][:, ::-1]
    up = find_up(points, faces, np.array([look_at((-3, 0, 1), (0, 0, 0))]))
    assert up.how in ("cameras", "convention")


def test_two_walls_that_are_as_likely_are_not_believed():
    """A roof's inside: two slopes, neither of which is a floor."""
    slopes = joined(
        rectangle((0, 0, 0), (4, 0, 0), (0, 2, 2.2)), rectangle((0, 0, 0), (0, -2, 2.2), (4, 0, 0))
    )
    up = find_up(*slopes, np.array([look_at((0, 0, 1.5), (3, 0, 1.0))]))
    assert up.how == "cameras"


def test_nothing_to_see():
    empty = np.empty((0, 3), np.float32), np.empty((0, 3), np.int32)
    assert find_up(*empty, NO_CAMERA).how == "guess"
    camera = look_at((0, 0, 1), (1, 0, 1))
    assert np.allclose(find_up(*empty, camera[None]).direction, (0, 0, 1))
    vertices = np.full((3, 3), np.nan)
    assert find_up(vertices, np.array([[0, 1, 2]]), camera[None]).how == "cameras"


def test_the_smallest_turn_and_T_up_world():
    rng = np.random.default_rng(0)
    for a, b in rng.normal(size=(20, 2, 3)):
        a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
        for target in (b, a, -a):
            R = smallest_turn(a, target)
            assert np.allclose(R @ a, target) and np.allclose(R @ R.T, np.eye(3))
            assert np.isclose(np.linalg.det(R), 1)
            assert np.isclose((np.trace(R) - 1) / 2, a @ target)  # by no more than the angle
    up = Up(np.array([0, -1.0, 0]), "floor", -1.2)
    T = up.T_up_world
    assert np.allclose(T @ (3, 1.2, 4, 1), (3, 4, 0, 1))  # a point of the floor, 1.2 m below y = 0
    assert np.allclose(Up(np.array([0, 0, 1.0]), "given").T_up_world, np.eye(4))


@pytest.mark.parametrize("R", TURNS)
def test_up_of_a_furnished_house(R):
    """As it was modelled: its triangles face any way, and hidden ones are among them."""
    house = DATA / "aws-small-house" / "house.glb"
    if not house.exists():
        pytest.skip(f"no data at {house}; set UNIFUSION_DATA")
    mesh = load_scene(house).mesh()
    cameras = [
        look_at((3.3, -3.3, 1.45), (0.9, -2.2, 0.5)),
        look_at((-1.8, -1.8, 1.5), (0, -2.7, 0.6)),
    ]
    vertices, cameras = turned(R, mesh.vertices, cameras)
    for seen_by in (cameras, cameras[:1]):
        up = find_up(vertices, mesh.faces, seen_by)
        assert up.how == "floor" and off(up, R) < EXACT_DEGREES and abs(up.floor) < 0.01


def test_up_of_real_frames():
    """Of the kitchen: the floor's normal, as fitted over 20 frames, and one wall's, to which it is square."""
    folder = DATA / "7scenes-redkitchen"
    if not folder.is_dir():
        pytest.skip(f"no data at {folder}; set UNIFUSION_DATA")
    import cv2

    kitchen, found = np.array((0.0205, -0.8892, -0.4571)), 0
    for i in range(0, 300, 50):
        depth = cv2.imread(str(folder / f"frame-{i:06d}.depth.png"), cv2.IMREAD_UNCHANGED)
        T = np.loadtxt(folder / f"frame-{i:06d}.pose.txt")
        z = np.where(depth == 65535, 0, depth / 1000)[::2, ::2]
        v, u = 2.0 * np.mgrid[:240, :320]
        points = np.stack([(u - 320) / 585 * z, (v - 240) / 585 * z, z], axis=-1).reshape(-1, 3)
        k = np.arange(z.size).reshape(z.shape)
        a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, :-1].ravel(), k[1:, 1:].ravel()
        faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
        corner = z.ravel()[faces]
        near = np.ptp(corner, axis=1) < 0.05 * corner.min(axis=1)
        faces = faces[(corner.min(axis=1) > 0.3) & near]
        up = find_up(points @ T[:3, :3].T + T[:3, 3], faces, T[None])
        if up.how == "floor":
            found += 1
            assert np.degrees(np.arccos(up.direction @ kitchen)) < NOISY_DEGREES
    assert found >= 4
