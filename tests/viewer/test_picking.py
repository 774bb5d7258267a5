"""What rays and rectangles meet in a scene, and what a box holds."""

from __future__ import annotations

import numpy as np
import pytest
from meshes import box, rectangle

from taichi_unifusion import Mesh
from taichi_unifusion.errors import InputError
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.rendering.look import Look
from taichi_unifusion.viewer.parts import (
    box_around,
    measure_box,
    rectangle_camera,
    write_part,
)
from taichi_unifusion.viewer.picking import Picker, camera_along
from taichi_unifusion.viewer.scene import Layer, SceneMesh

EXACT = 1e-5  # [m] of float32 coordinates of a room


def along_x(by: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = by
    return T


def floor(steps: int = 10) -> SceneMesh:
    """A square metre at z = 0 that faces up, with its x as values."""
    mesh = rectangle((0, 0), (1, 1), 0.0, steps=steps)
    mesh = mesh.with_attribute("across", mesh.vertices[:, 0])
    halves = (mesh.vertices[:, 0] > 0.5).astype(int)
    table = np.array([[9, 9, 9], [8, 8, 8]], np.uint8)
    return SceneMesh(
        "floor",
        mesh,
        (
            Layer("color", np.full((len(mesh.vertices), 3), 7, np.uint8)),
            Layer.of_values("x", mesh.vertices[:, 0], Look(range=(0.0, 1.0))),
            Layer.of_labels("half", halves, ("left", "right"), table),
        ),
    )


@pytest.mark.parametrize("x, y", [(0.23, 0.41), (0.5, 0.5), (0.913, 0.087)])
def test_a_ray_meets_the_surface_and_its_values(x, y):
    shown = floor()
    origin = np.array([0.2, 0.9, 1.7])
    hit = Picker(shown).pick(origin, np.array([x, y, 0.0]) - origin)
    assert np.allclose(hit.point, (x, y, 0), atol=EXACT)
    assert np.allclose(hit.normal, (0, 0, 1), atol=EXACT)
    assert hit.values(shown.layer("x"))[0] == pytest.approx(x, abs=EXACT)
    assert hit.values(shown.layer("color")) is None
    assert hit.color(shown.layer("color")).tolist() == [7, 7, 7]
    half = shown.layer("half")
    if abs(x - 0.5) > 0.1:
        assert half.describe(hit.values(half)) == ("right" if x > 0.5 else "left")


def test_backs_and_what_is_cut_away_are_not_met():
    shown = SceneMesh("box", box((0.0,) * 3, (1.0,) * 3), floor_layers(8))
    inside, up = np.array([0.5, 0.5, 0.5]), np.array([0.0, 0.0, 1.0])
    assert Picker(shown).pick(inside, up) is None  # the box faces outwards
    above = np.array([0.4, 0.3, 3.0])
    assert Picker(shown).pick(above, -up).point[2] == pytest.approx(1.0, abs=EXACT)
    low = shown.mesh.vertices[shown.mesh.faces][:, :, 2].mean(axis=1) < 0.9
    assert Picker(shown, low).pick(above, -up) is None
    assert Picker(shown, np.zeros(12, bool)).pick(above, -up) is None


def floor_layers(count: int) -> tuple[Layer, ...]:
    return (Layer("color", np.zeros((count, 3), np.uint8)),)


def test_what_stands_aside_is_met_there_and_known_in_its_own_world():
    moved = floor().placed(along_x(10.0))
    hit = Picker(moved).pick(np.array([10.5, 0.5, 2.0]), np.array([0.0, 0.0, -1.0]))
    assert np.allclose(hit.point, (10.5, 0.5, 0), atol=EXACT)
    assert np.allclose(hit.point_in_map, (0.5, 0.5, 0), atol=EXACT)


def test_a_rectangle_of_a_view_becomes_a_box_around_what_it_shows():
    # a camera 2 m above the middle, whose view is 2 m high and 4 m wide there
    T = camera_along(np.array([0.5, 0.5, 2.0]), np.array([0.0, 0.0, -1.0]))
    camera, mask = rectangle_camera(np.array([[0.4, 0.4], [0.55, 0.6]]), 2 * np.arctan(0.5), 2.0)
    points = Picker(floor()).seen(camera, T, mask)
    right, down = T[:3, 0], T[:3, 1]
    across, along = (points - T[:3, 3]) @ right, (points - T[:3, 3]) @ down
    pixel = 4 / camera.width
    assert abs(across.min() + 0.4) <= pixel and abs(across.max() - 0.2) <= pixel
    assert abs(along.min() + 0.2) <= pixel and abs(along.max() - 0.2) <= pixel
    corners = box_around(points)
    sides = np.sort((corners[1] - corners[0])[:2])
    assert sides == pytest.approx((0.4, 0.6), abs=0.06)
    assert box_around(np.zeros((0, 3))) is None


def test_a_box_holds_its_share_of_the_surface():
    corners = np.array([[-0.01, -0.01, -0.5], [0.51, 0.31, 0.5]])
    measured = measure_box([floor(), floor().placed(along_x(10.0))], corners, np.eye(4))
    assert measured.area == pytest.approx(0.5 * 0.3, abs=EXACT)
    assert measured.volume == pytest.approx(0.52 * 0.32 * 1.0)
    assert measured.triangles == 5 * 3 * 2


def test_boxes_stand_upright_whatever_the_world():
    # up is the world's -y
    T_up_scene = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    wall = floor()  # z = 0 of the world is a wall, from height 0 down to -1
    corners = np.array([[-0.01, -0.1, -0.31], [0.51, 0.1, 0.01]])
    measured = measure_box([wall], corners, T_up_scene)
    assert measured.area == pytest.approx(0.5 * 0.3, abs=EXACT)


def test_a_part_is_written_in_its_own_world_with_its_values(tmp_path):
    moved = floor().placed(along_x(10.0))
    corners = np.array([[9.99, -0.01, -0.5], [10.51, 0.31, 0.5]])
    write_part(tmp_path / "part.ply", moved, corners, np.eye(4))
    part: Mesh = read_mesh(tmp_path / "part.ply")
    assert len(part.faces) == 5 * 3 * 2 and part.vertices[:, 0].max() <= 0.5 + EXACT
    assert np.allclose(part.attributes["across"][:, 0], part.vertices[:, 0], atol=EXACT)
    with pytest.raises(InputError, match="no triangle"):
        write_part(tmp_path / "none.ply", moved, corners + 100, np.eye(4))
    assert not (tmp_path / "none.ply").exists()
