"""The software rasteriser and the pictures that it makes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from places import DATA

from taichi_unifusion.errors import InputError, PoseError
from taichi_unifusion.rendering.depth_buffer import draw_depth_buffer
from taichi_unifusion.rendering.drawing import Viewpoint, render_mesh
from taichi_unifusion.rendering.preview import render_preview
from taichi_unifusion.types import Mesh, PinholeCamera, Trajectory

cv2 = pytest.importorskip("cv2")

CAMERA = PinholeCamera(64, 48, 40.0, 40.0, 31.5, 23.5)
DEPTH_TOLERANCE = 1e-5  # relative: depth is stored as float32
EDGE_BAND = 1e-5  # barycentric: pixels so near an edge may go to either side
LEVELS = 2  # of 255: rounding of colours in float32
# share of pixels on the edge of two colours that may look like a third (blue and green: cyan)
MIXED = 0.005
RED, GREEN, BLUE, YELLOW, CYAN, WHITE = (
    (0.8, 0.1, 0.1),
    (0.1, 0.7, 0.1),
    (0.1, 0.1, 0.8),
    (0.8, 0.8, 0.1),
    (0.1, 0.7, 0.7),
    (0.8, 0.8, 0.8),
)


def looking(eye, target, up=(0, 0, 1)) -> np.ndarray:
    """T_world_camera of a camera at `eye` that looks at `target`."""
    forward = np.subtract(target, eye) / np.linalg.norm(np.subtract(target, eye))
    right = np.cross(forward, up) / np.linalg.norm(np.cross(forward, up))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = np.stack([right, np.cross(forward, right), forward], axis=1), eye
    return T


def quad(corners, color, steps: int = 1) -> Mesh:
    """A rectangle of 2 steps^2 triangles from 4 corners, counter-clockwise seen from the drawn
    side.
    """
    a, b, _, d = np.asarray(corners, float)
    s = np.linspace(0, 1, steps + 1)
    vertices = (a + s[:, None, None] * (b - a) + s[None, :, None] * (d - a)).reshape(-1, 3)
    index = np.arange((steps + 1) ** 2).reshape(steps + 1, steps + 1)
    p, q, r, t = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    faces = np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, t], axis=1)])
    return Mesh(
        vertices.astype(np.float32),
        faces.astype(np.int32),
        None,
        {"color": np.tile(np.float32(color), (len(vertices), 1))},
    )


def join(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + start for m, start in zip(meshes, starts, strict=False)]).astype(
            np.int32
        ),
        None,
        {"color": np.concatenate([m.attributes["color"] for m in meshes])},
    )


def room(steps: int = 4) -> Mesh:
    """A 4 x 3 x 2 m room seen from within: red wall at +x, green -x, blue +y, yellow -y, white
    floor, cyan ceiling.
    """
    x, y, z = 2.0, 1.5, 2.0
    return join(
        quad([(x, -y, 0), (x, -y, z), (x, y, z), (x, y, 0)], RED, steps),
        quad([(-x, -y, 0), (-x, y, 0), (-x, y, z), (-x, -y, z)], GREEN, steps),
        quad([(-x, y, 0), (x, y, 0), (x, y, z), (-x, y, z)], BLUE, steps),
        quad([(-x, -y, 0), (-x, -y, z), (x, -y, z), (x, -y, 0)], YELLOW, steps),
        quad([(-x, -y, 0), (x, -y, 0), (x, y, 0), (-x, y, 0)], WHITE, steps),
        quad([(-x, -y, z), (-x, y, z), (x, y, z), (x, -y, z)], CYAN, steps),
    )


def share_of(image: np.ndarray, color) -> float:
    """Share of the pixels, background left out, with nearly the hue of `color`."""
    pixels = image.reshape(-1, 3).astype(float)
    alike = pixels @ (np.array(color) / np.linalg.norm(color)) > 0.99 * np.linalg.norm(
        pixels, axis=1
    )
    return float((alike & drawn(image).ravel()).mean())


def drawn(image: np.ndarray) -> np.ndarray:
    """Pixels (H, W) that are not background."""
    return image.min(axis=2) < 235


def is_like(pixel, color) -> bool:
    """Whether a pixel has the hue of `color` and, under soft light, not much less than its
    brightness.
    """
    pixel, color = np.asarray(pixel, float) / 255, np.asarray(color)
    return bool(
        pixel @ color > 0.99 * np.linalg.norm(pixel) * np.linalg.norm(color)
        and 0.6 < pixel.sum() / color.sum() < 1.1
    )


def depth_of(mesh: Mesh, T_world_camera) -> np.ndarray:
    """Depth (H, W) of the sides that face the camera, 0 where nothing is seen."""
    buffer = draw_depth_buffer(
        mesh.vertices, mesh.faces, CAMERA, T_world_camera, 0.1, two_sided=False
    )
    return buffer.depth(0.0)


# The kernel


def test_rasterize_leaves_no_gap_along_shared_edges():
    """Edges and diagonals run exactly through pixel centres here."""
    wall = quad([(-0.5, -0.5, 1), (-0.5, 0.5, 1), (0.5, 0.5, 1), (0.5, -0.5, 1)], RED, steps=20)
    T = np.eye(4)
    T[:2, 3] = 0.0125, 0.0125  # half a pixel at depth 1
    depth = depth_of(wall, T)
    inside = depth[5:42, 13:50]
    assert (inside > 0).all() and (depth == 0).any()


def test_rasterize_does_not_depend_on_order():
    mesh = room(6)
    T = looking((0.3, 0.2, 1.0), (2, 1, 0.5))
    depth = depth_of(mesh, T)
    other = Mesh(mesh.vertices, np.random.default_rng(0).permutation(mesh.faces))
    shuffled = depth_of(other, T)
    assert np.array_equal(depth, shuffled) and (depth > 0).all()


def test_N5_same_mesh_gives_the_same_bytes():
    view = Viewpoint(CAMERA, looking((0.3, 0.2, 1.0), (2, 1, 0.5)))
    assert np.array_equal(render_mesh(room(), view), render_mesh(room(), view))


# Pictures of one view


@pytest.mark.parametrize(
    ("target", "color"),
    [((2, 0, 1), RED), ((-2, 0, 1), GREEN), ((0, 1.5, 1), BLUE), ((0, -1.5, 1), YELLOW)],
)
def test_walls_have_their_colors(target, color):
    image = render_mesh(room(), Viewpoint(CAMERA, looking((0, 0, 1), target)))
    assert is_like(image[24, 32], color)


def test_up_is_up_and_right_is_right():
    image = render_mesh(room(), Viewpoint(CAMERA, looking((-1.5, 0, 1), (2, 0, 1))))
    assert is_like(image[2, 32], CYAN) and is_like(image[-3, 32], WHITE)
    # y is left when one looks along x with z up
    assert is_like(image[24, 2], BLUE) and is_like(image[24, -3], YELLOW)


def test_near_things_hide_far_ones():
    box = quad([(1, -0.2, 0.8), (1, -0.2, 1.2), (1, 0.2, 1.2), (1, 0.2, 0.8)], BLUE)
    for mesh in (join(room(), box), join(box, room())):
        image = render_mesh(mesh, Viewpoint(CAMERA, looking((0, 0, 1), (2, 0, 1))))
        assert is_like(image[24, 32], BLUE) and is_like(image[24, 50], RED)
        beyond = render_mesh(mesh, Viewpoint(CAMERA, looking((0, 0, 1), (2, 0, 1)), near=1.5))
        assert is_like(beyond[24, 32], RED)


def test_backs_are_not_drawn():
    outside = render_mesh(room(), Viewpoint(CAMERA, looking((5, 0, 5), (0, 0, 0.5))))
    assert is_like(outside[24, 32], WHITE)  # the floor, through the ceiling and the red wall
    assert (
        share_of(outside, RED) == 0
        and share_of(outside, CYAN) < MIXED
        and share_of(outside, GREEN) > 0.03
    )


def test_colors_are_interpolated_in_perspective():
    # a slope: rows of pixels lie at constant depth
    mesh = quad([(-4, -1, 1), (-4, 1, 5), (4, 1, 5), (4, -1, 1)], RED)
    mesh = mesh.with_attribute(
        "color", (mesh.vertices[:, 2:] - 1) / 4 * np.float32([0.5, 0.5, 0.5]) + 0.25
    )
    image = render_mesh(mesh, Viewpoint(CAMERA, np.eye(4)))
    rows = np.arange(6, 24)
    y = (rows - CAMERA.cy) / CAMERA.fy
    depth = 3 / (1 - 2 * y)  # of the plane z = 3 + 2 y
    expected = (depth - 1) / 4 * 0.5 + 0.25
    ratio = image[rows, 32, 0] / 255 / expected
    # light is constant there; 8 bits and half a pixel
    np.testing.assert_allclose(ratio, ratio.mean(), rtol=0.03)


def test_corners_are_darker_than_open_walls():
    image = render_mesh(room(), Viewpoint(CAMERA, looking((0, 0, 1), (2, 0, 1))))
    at_corner = render_mesh(room(), Viewpoint(CAMERA, looking((0.8, 0.5, 1), (2, 1.5, 1))))
    column = at_corner[24].astype(int).sum(axis=1)
    assert column[31:34].min() < 0.9 * image[24, 32].astype(int).sum()


def test_mesh_without_color_is_grey_and_shaded():
    mesh = room()
    image = render_mesh(
        Mesh(mesh.vertices, mesh.faces), Viewpoint(CAMERA, looking((0.3, 0.2, 1.0), (2, 1, 0.5)))
    ).astype(int)
    assert np.ptp(image, axis=2).max() <= LEVELS and np.ptp(image[..., 0]) > 30


def test_given_normals_equal_computed_ones_on_a_plane():
    wall = quad([(2, -2, 0), (2, -2, 2), (2, 2, 2), (2, 2, 0)], RED, 3)
    normals = np.tile(np.float32([-1, 0, 0]), (len(wall.vertices), 1))
    view = Viewpoint(CAMERA, looking((0, 0, 1), (2, 0, 1)))
    a, b = (
        render_mesh(wall, view),
        render_mesh(Mesh(wall.vertices, wall.faces, normals, wall.attributes), view),
    )
    assert np.abs(a.astype(int) - b).max() <= LEVELS


def test_nan_is_left_out():
    mesh = room()
    vertices, color = mesh.vertices.copy(), mesh.attributes["color"].copy()
    wall = np.flatnonzero(
        (mesh.vertices[:, 0] > 1.9)
        & np.isclose(color[:, 0], RED[0])
        & np.isclose(color[:, 1], RED[1])
    )
    vertices[wall[12]] = np.nan  # the middle of the red wall
    color[wall[0]] = np.nan
    view = Viewpoint(CAMERA, looking((0, 0, 1), (2, 0, 1)))
    image = render_mesh(Mesh(vertices, mesh.faces, None, {"color": color}), view)
    assert image[24, 32].min() > 240 and is_like(image[24, 50], RED)  # a hole, the rest as before


# The preview file


def orbit(count: int = 12) -> Trajectory:
    angles = np.linspace(0, 5, count)
    poses = [
        looking((0.3 * np.cos(a), 0.3 * np.sin(a), 1.2), (2 * np.cos(a), 2 * np.sin(a), 0.8))
        for a in angles
    ]
    return Trajectory(np.arange(float(count)), np.array(poses))


def panels(path: Path, size: tuple[int, int]) -> list[np.ndarray]:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)[..., ::-1]
    assert image.shape[0] == size[1] and image.dtype == np.uint8 and image.shape[2] == 3
    return [image[:, : size[0]], image[:, -size[0] :]]


TURNS = {
    "z up": np.eye(3),
    "y down": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0.0]]),
    "tilted": looking((0, 0, 0), (1, 2, 3))[:3, :3],
}


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS.keys())
def test_preview_with_poses_looks_into_the_room_whatever_is_up(tmp_path, turn):
    mesh, trajectory = room(), orbit()
    T = np.eye(4)
    T[:3, :3] = turn
    turned = Mesh((mesh.vertices @ turn.T).astype(np.float32), mesh.faces, None, mesh.attributes)
    render_preview(
        turned,
        tmp_path / "p.png",
        trajectory=Trajectory(trajectory.timestamps, T @ trajectory.T_world_camera),
        size=(160, 120),
    )
    camera, overview = panels(tmp_path / "p.png", (160, 120))
    assert drawn(camera).mean() > 0.95  # from within, the room fills the picture
    # the floor is seen through the ceiling
    assert share_of(overview, WHITE) > 0.15 and share_of(overview, CYAN) < MIXED
    # the two far walls
    assert sum(share_of(overview, color) > 0.01 for color in (RED, GREEN, BLUE, YELLOW)) == 2
    rows = np.flatnonzero(drawn(overview).any(axis=1))
    assert rows[0] < 20 and rows[-1] > 100  # it is fitted into the picture, with a margin
    assert os.listdir(tmp_path) == ["p.png"]


def test_preview_without_poses_shows_two_sides(tmp_path):
    render_preview(room(), tmp_path / "p.png", size=(160, 120))
    seen = [
        {
            name
            for name, color in (("r", RED), ("g", GREEN), ("b", BLUE), ("y", YELLOW))
            if share_of(panel, color) > 0.01
        }
        for panel in panels(tmp_path / "p.png", (160, 120))
    ]
    assert all(len(walls) == 2 for walls in seen) and seen[0] != seen[1]


def test_preview_of_one_frame_in_its_camera_frame_shows_its_front(tmp_path):
    """x right, y down, z forward: from above (+z) one would see backs only."""
    wall = quad([(-1, -1, 3), (-1, 1, 3), (1, 1, 3), (1, -1, 3)], RED, 4)
    floor = quad([(-1, 1, 3), (-1, 1, 1), (1, 1, 1), (1, 1, 3)], BLUE, 4)
    render_preview(join(wall, floor), tmp_path / "p.png", size=(160, 120))
    for panel in panels(tmp_path / "p.png", (160, 120)):
        assert share_of(panel, BLUE) > 0.05
    assert share_of(panels(tmp_path / "p.png", (160, 120))[0], RED) > 0.05


def test_specks_far_away_do_not_shrink_the_overview(tmp_path):
    speck = quad([(60, 60, 0), (60.05, 60, 0), (60.05, 60.05, 0), (60, 60.05, 0)], RED)
    render_preview(join(room(), speck), tmp_path / "p.png", trajectory=orbit(), size=(160, 120))
    assert share_of(panels(tmp_path / "p.png", (160, 120))[1], WHITE) > 0.15


def test_camera_view_keeps_clear_of_what_a_camera_is_close_to(tmp_path):
    """One camera has its nose at a blue board; the view is taken from one that sees the room."""
    board = quad([(-0.8, -1, 0), (-0.8, -1, 2), (-0.8, 1, 2), (-0.8, 1, 0)], BLUE, 8)
    poses = np.array([looking((-1, 0, 1), (2, 0, 1)), looking((-1, 0, 1), (-2, 0, 0.9))])
    render_preview(
        join(room(8), board),
        tmp_path / "p.png",
        trajectory=Trajectory(np.arange(2.0), poses),
        size=(160, 120),
    )
    camera, _ = panels(tmp_path / "p.png", (160, 120))
    assert is_like(camera[50, 80], GREEN)


def test_preview_errors_say_what_is_wrong(tmp_path):
    path, mesh = tmp_path / "p.png", room()
    cases = (
        (Mesh(mesh.vertices, mesh.faces[:0]), {}, "empty"),
        (Mesh(mesh.vertices * np.float32(np.nan), mesh.faces), {}, "empty"),
        (Mesh(mesh.vertices * 0, mesh.faces), {}, "no area"),
        (Mesh(mesh.vertices, mesh.faces + len(mesh.vertices)), {}, "but the mesh has"),
        (mesh.with_attribute("color", np.zeros(len(mesh.vertices))), {}, "'color' must be"),
        (
            mesh,
            {"views": ["overvew"]},
            "did you mean 'overview'.*choose one of camera, overview, opposite",
        ),
        (mesh, {"views": ["camera"]}, "needs a trajectory"),
    )
    for bad, options, message in cases:
        with pytest.raises(InputError, match=message):
            render_preview(bad, path, **options)
    with pytest.raises(PoseError, match="pose 0"):
        render_preview(mesh, path, trajectory=Trajectory(np.zeros(1), np.full((1, 4, 4), np.nan)))
    assert os.listdir(tmp_path) == []


# Real input


def test_preview_of_a_real_frame(tmp_path):
    folder = DATA / "7scenes-redkitchen"
    if not folder.is_dir():
        pytest.skip(f"no data at {folder}; set UNIFUSION_DATA")
    depth = cv2.imread(str(folder / "frame-000000.depth.png"), cv2.IMREAD_UNCHANGED).astype(
        np.float32
    )
    color = cv2.imread(str(folder / "frame-000000.color.jpg"), cv2.IMREAD_COLOR)[..., ::-1]
    T_world_camera = np.loadtxt(folder / "frame-000000.pose.txt")
    z = np.where(depth == 65535, 0, depth / 1000)[::2, ::2]
    v, u = 2.0 * np.mgrid[:240, :320]
    points = np.stack([(u - 320) / 585 * z, (v - 240) / 585 * z, z], axis=-1).reshape(-1, 3)
    index = np.arange(z.size).reshape(z.shape)
    a, b, c, d = (
        index[:-1, :-1].ravel(),
        index[:-1, 1:].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
    )
    faces = np.concatenate([np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)])
    corner = z.ravel()[faces]
    faces = faces[(corner.min(axis=1) > 0.3) & (np.ptp(corner, axis=1) < 0.05 * corner.min(axis=1))]
    mesh = Mesh(
        (points @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]).astype(np.float32),
        faces.astype(np.int32),
        None,
        {"color": (color[::2, ::2].reshape(-1, 3) / 255).astype(np.float32)},
    )
    render_preview(
        mesh,
        tmp_path / "p.png",
        trajectory=Trajectory(np.zeros(1), T_world_camera[None]),
        size=(320, 240),
    )
    camera, overview = panels(tmp_path / "p.png", (320, 240))
    assert drawn(camera).mean() > 0.4 and drawn(overview).mean() > 0.1
    cupboards = camera[70:110, 50:90].reshape(-1, 3).mean(axis=0)
    assert cupboards[0] > 2 * cupboards[1:].max()  # the red kitchen
