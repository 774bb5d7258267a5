"""Pictures of a scene: layers, legends, marks, depth and normals, from any camera."""

from __future__ import annotations

import numpy as np
import pytest
from meshes import joined, parallelogram

from taichi_unifusion import Trajectory
from taichi_unifusion.datasets.synthetic import look_at
from taichi_unifusion.errors import InputError
from taichi_unifusion.rendering.look import Look
from taichi_unifusion.viewer.captions import add_legend, add_marks, numbers_of
from taichi_unifusion.viewer.render import Picturing, camera_of, plan_path
from taichi_unifusion.viewer.scene import Box, Label, Layer, Legend, Scene, SceneMesh

RED, BLUE = (200, 20, 20), (20, 20, 200)
SIZE = (160, 90)
CAMERA = camera_of(SIZE, 50)
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A floor and a wall at x = 2."""
    mesh = joined(
        parallelogram((-2, -2, 0), (4, 0, 0), (0, 4, 0)),
        parallelogram((2, -2, 0), (0, 0, 2), (0, 4, 0)),
    )
    wall = mesh.vertices[:, 0] > 2 - 1e-6
    layers = (
        Layer("color", np.where(wall[:, None], RED, BLUE).astype(np.uint8)),
        Layer.of_values("height", mesh.vertices[:, 2], Look("viridis", None, "height [m]")),
    )
    return Scene("corner", (SceneMesh("corner", mesh, layers),))


@pytest.fixture(scope="module")
def pose() -> np.ndarray:
    return look_at((-1, 0, 1), (2, 0, 1))


def test_layers_are_shown_in_their_colors_with_a_legend(scene, pose):
    plain = Picturing(scene, "color", CAMERA).picture(pose)
    assert plain.shape == (90, 160, 3) and plain.dtype == np.uint8
    assert plain[40, 80].argmax() == 0 and plain[85, 80].argmax() == 2
    larger = camera_of((640, 360), 50)
    height = Picturing(scene, "height", larger).picture(pose)
    bare = Picturing(scene, "height", larger, legend=False).picture(pose)
    changed = (height != bare).any(axis=2)
    rows, columns = np.nonzero(changed)
    assert rows.min() > 290 and columns.max() < 230  # at the lower left
    assert np.abs(bare[::4, ::4].astype(int) - plain).max() > 50


def test_a_layer_that_is_not_there_is_told(scene):
    with pytest.raises(InputError, match="no 'hight' .did you mean 'height'.* color, height"):
        Picturing(scene, "hight", CAMERA)


def test_an_answer_is_found_by_its_text(scene):
    mesh = scene.meshes[0]
    answer = Layer("query: sofa", mesh.layer("color").colors)
    asked = Scene("corner", (mesh.with_layers([answer]),))
    assert Picturing(asked, "sofa", CAMERA).layer == "query: sofa"


def test_depth_and_normals_are_exact(scene, pose):
    picturing = Picturing(scene, "color", CAMERA)
    depth, normals = picturing.depth(pose), picturing.normals(pose)
    v, u = np.mgrid[:90, :160]
    rays = CAMERA.rays(u, v)
    with np.errstate(divide="ignore", invalid="ignore"):
        floor = np.where(rays[..., 1] > 0, 1 / rays[..., 1], np.inf)
    expected = np.minimum(floor, 3.0)
    inside = (np.abs(rays[..., 0]) * 3 < 1.9) & (np.abs(rays[..., 1]) * 3 < 0.9)
    inside |= (floor < 2.9) & (np.abs(rays[..., 0]) * floor < 1.9)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(depth[inside], expected[inside], atol=MILLIMETRE)
    wall, ground = inside & (floor > 3.2), inside & (floor < 2.5)
    # the vertices of the edge between them belong to one of the two only
    assert np.abs(normals[wall].astype(int) - (128, 128, 255)).max() <= 1
    assert np.abs(normals[ground].astype(int) - (128, 255, 128)).max() <= 1
    away = Picturing(scene, "color", CAMERA).normals(look_at((0, 0, 1), (-1, 0, 3)))
    assert not away.any()


def test_boxes_and_labels_are_drawn_where_they_are(pose):
    blank = np.zeros((90, 160, 3), np.uint8)
    box = Box("b", np.array([[0.5, -0.3, 0.7], [1.0, 0.3, 1.3]]), (250, 0, 0))
    shown = add_marks(blank, CAMERA, pose, [box], [])
    corners = np.array(np.meshgrid(*box.corners.T)).reshape(3, -1).T
    seen = CAMERA.project((corners - pose[:3, 3]) @ pose[:3, :3])
    for u, v in seen.round().astype(int):
        assert shown[v - 1 : v + 2, u - 1 : u + 2, 0].max() > 100
    drawn = np.argwhere(shown.any(axis=2))
    assert (drawn.min(axis=0) >= seen[:, ::-1].min(axis=0) - 2).all()
    assert (drawn.max(axis=0) <= seen[:, ::-1].max(axis=0) + 2).all()
    labelled = add_marks(blank, CAMERA, pose, [], [Label("here", np.array([1.0, 0, 1]))])
    assert labelled[30:50, 75:130].any() and not labelled[60:].any()
    behind = Box("b", box.corners - (5, 0, 0)), [Label("gone", np.array([-3.0, 0, 1]))]
    assert not add_marks(blank, CAMERA, pose, [behind[0]], behind[1]).any()
    around = Box("a", np.array([[-2, -1, 0.5], [3, 1, 1.5]]))  # the camera is inside
    assert add_marks(blank, CAMERA, pose, [around], []).any()


def test_legends_of_every_kind_fit_into_any_picture():
    colors = np.arange(30, dtype=np.uint8)[:, None].repeat(3, axis=1)
    legends = [
        Legend("height [m]", np.repeat(np.arange(256, dtype=np.uint8)[:, None], 3, axis=1), -1, 2),
        Legend("normal: red, green and blue", np.zeros((0, 3), np.uint8), -1, 1),
        Legend("classes", colors, names=tuple(f"name {i}" for i in range(30))),
        Legend("a long sentence about what these values are and where they come from", colors),
    ]
    for height, width in ((1080, 1920), (90, 160), (20, 30)):
        picture = np.full((height, width, 3), 90, np.uint8)
        for legend in legends:
            shown = add_legend(picture, legend)
            assert shown.shape == picture.shape and (shown != picture).any()
            assert (picture == 90).all()
    assert numbers_of(Legend("", colors, -0.003, 2.149)) == ("0.00", "1.07", "2.15")
    assert numbers_of(Legend("", colors, 148, 3820)) == ("148", "1984", "3820")


def test_ways_through_a_scene(scene, pose):
    walk = np.stack([look_at((x, 0, 1), (x + 1, 0, 0.9)) for x in np.linspace(-1.5, 1, 12)])
    trajectory = Trajectory(np.arange(12.0), walk)
    assert len(plan_path(scene, trajectory, "trajectory", CAMERA, 10, seconds=2)) == 20
    usual = plan_path(scene, trajectory, "trajectory", CAMERA, 10)
    assert 60 < len(usual) < 90  # 2.5 m at 0.35 m/s
    still = Trajectory(np.zeros(1), pose[None])
    swaying = plan_path(scene, still, "trajectory", CAMERA, 5)
    assert len(swaying) == 60 and np.ptp(swaying[:, 1, 3]) > 0.5
    around = plan_path(scene, None, "circle", CAMERA, 2)
    assert len(around) == 24 and (around[:, 2, 3] > 2).all()
    with pytest.raises(InputError, match="no trajectory; take --path circle"):
        plan_path(scene, None, "trajectory", CAMERA, 10)
    with pytest.raises(InputError, match="between 1 and 150"):
        camera_of(SIZE, 180)
