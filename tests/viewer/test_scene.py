"""Scenes: what a results folder gives to see, layers as colours and values, up, and several side by
side.
"""

from __future__ import annotations

import json
import logging
import shutil
from dataclasses import replace

import numpy as np
import pytest
from meshes import box, rectangle

from taichi_unifusion import Mesh
from taichi_unifusion.cli import main as cli
from taichi_unifusion.errors import FileError, InputError
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.meshes import write_mesh
from taichi_unifusion.maps import SurfaceMap
from taichi_unifusion.rendering.look import Look
from taichi_unifusion.viewer import source as source_module
from taichi_unifusion.viewer.picking import Picker
from taichi_unifusion.viewer.results_scene import SceneOptions, open_scene
from taichi_unifusion.viewer.scene import Box, Layer, Scene, SceneMesh
from taichi_unifusion.viewer.several import beside, overlaid, with_shared_scales
from taichi_unifusion.viewer.source import ResultsSource

EIGHT_BITS = 0.5 / 255 + 1e-6
FLOOR = 0.01  # [m] off, of a floor that a Kinect saw
EXACT = 1e-5  # [m] of float32 coordinates of a room
ZERO, ONE = (0.0,) * 3, (1.0,) * 3


@pytest.fixture(scope="module")
def scene(results) -> Scene:
    return open_scene(results.path)


def plain(mesh: Mesh, name: str = "thing") -> SceneMesh:
    return SceneMesh(name, mesh, (Layer("color", np.full((len(mesh.vertices), 3), 7, np.uint8)),))


def test_a_results_folder_gives_every_layer_that_it_holds(scene, results):
    names = ("color", "saliency", "normals", "height", "weight", "evidence")
    assert scene.layer_names == names
    mesh = read_mesh(results.path / "mesh.ply")
    shown = scene.meshes[0]
    assert np.array_equal(shown.mesh.vertices, mesh.vertices)
    color = shown.layer("color")
    assert np.abs(color.colors / 255 - mesh.attributes["color"]).max() <= EIGHT_BITS
    assert np.array_equal(shown.layer("saliency").values, mesh.attributes["saliency"])
    assert (
        shown.layer("saliency").legend.label and len(shown.layer("saliency").legend.colors) == 256
    )
    assert np.allclose(scene.T_up_world[:3, :3], np.eye(3))  # the floor's normal
    assert abs(scene.T_up_world[2, 3]) < FLOOR
    heights = mesh.vertices[:, 2] + scene.T_up_world[2, 3]
    assert np.allclose(shown.layer("height").values[:, 0], heights, atol=EXACT)
    assert np.allclose(shown.layer("normals").values, mesh.normals, atol=EXACT)


def test_weight_and_evidence_are_those_of_the_voxel_and_cell_that_a_vertex_lies_in(scene, results):
    surface, shown = SurfaceMap.load(results.path / "maps" / "surface.safetensors"), scene.meshes[0]
    data, size = surface.voxels(), surface.voxel_size
    rows = {tuple(key): row for row, key in enumerate(data.keys.tolist())}
    checked = 0
    for v in range(0, len(shown.mesh.vertices), 97):
        x = shown.mesh.vertices[v] / size
        row = rows.get(tuple(np.floor(x).astype(int).tolist()))
        if row is None:
            assert np.isnan(shown.layer("weight").values[v, 0])
            continue
        cell = np.floor((x - np.floor(x)) * 4).astype(int) @ (16, 4, 1)
        assert shown.layer("weight").values[v, 0] == data.weights[row]
        assert shown.layer("evidence").values[v, 0] == data.evidence[row, cell]
        checked += 1
    assert checked > 10


def test_the_cameras_are_those_of_the_trajectory_with_what_they_saw(results):
    few = open_scene(results.path, SceneOptions(cameras=2)).cameras
    assert [camera.name for camera in few] == ["frame 0", "frame 2"]
    assert few[0].image is None and few[0].camera.size == (160, 120)
    source = ResultsSource(results.path, SceneOptions(image_width=40))
    seen = source.with_images(source.open()).cameras
    assert len(seen) == 3 and seen[1].image.shape == (30, 40, 3)
    assert seen[1].image.std() > 1


def test_a_mesh_extracted_in_pieces_is_the_whole(results, monkeypatch):
    monkeypatch.setattr(source_module, "PIECE", 3)
    source, told = ResultsSource(results.path), []
    scene = source.open()
    again = source.extract(scene, scene.meshes[0], 4, lambda *done: told.append(done)).mesh
    whole = scene.meshes[0].mesh  # as the run wrote it
    assert len(told) > 2 and told[-1][0] == told[-1][1]
    assert len(again.faces) == len(whole.faces)
    # where the surface passes through a corner of the grid, two vertices of the whole may lie at one
    # place, which pieces that are joined by their places have one of
    order = [np.unique(mesh.vertices, axis=0, return_index=True)[1] for mesh in (again, whole)]
    assert len(order[0]) == len(again.vertices) >= len(whole.vertices) - 3
    assert np.array_equal(again.vertices[order[0]], whole.vertices[order[1]])
    color, saliency = (again.attributes[name][order[0]] for name in ("color", "saliency"))
    stored, same = (whole.attributes[name][order[1]] for name in ("color", "saliency"))
    assert np.abs(np.clip(color, 0, 1) - stored).max() <= EIGHT_BITS
    assert np.array_equal(saliency, same)
    centers = [
        np.sort(mesh.vertices[mesh.faces].mean(axis=1).sum(axis=1)) for mesh in (again, whole)
    ]
    assert np.abs(centers[0] - centers[1]).max() < EXACT


def test_cameras_stay_where_the_recording_is_gone(results, tmp_path):
    moved = shutil.copytree(results.path, tmp_path / "moved")
    record = json.loads((moved / "metrics.json").read_text())
    record["recording"]["path"] = str(tmp_path / "gone")
    (moved / "metrics.json").write_text(json.dumps(record))
    source = ResultsSource(moved)
    cameras = source.with_images(source.open()).cameras
    assert len(cameras) == 3 and all(camera.image is None for camera in cameras)


def test_answers_and_segmentation_in_the_folder_are_layers(results, tmp_path, caplog):
    asked = shutil.copytree(results.path, tmp_path / "asked")
    names = tmp_path / "names.txt"
    names.write_text("red\ngreen\nblue\n")
    text = ["--text", results.text]
    assert cli.main(["query", str(asked), "red", *text]) == 0
    assert cli.main(["segment", str(asked), "--labels", str(names), *text]) == 0
    scene = open_scene(asked)
    assert {"query: red", "segmentation"} <= set(scene.layer_names)
    answer, classes = (scene.meshes[0].layer(name) for name in ("query: red", "segmentation"))
    stored = read_mesh(asked / "query-red.ply").attributes
    assert np.array_equal(answer.values, stored["relevance"])
    assert np.abs(answer.colors / 255 - stored["color"]).max() <= EIGHT_BITS
    assert set(classes.legend.names) <= {"red", "green", "blue"} and classes.legend.names
    # answers to another mesh are not shown
    stale = read_mesh(asked / "query-red.ply")
    write_mesh(asked / "query-red.ply", replace(stale, vertices=stale.vertices + 1))
    with caplog.at_level(logging.WARNING):
        assert "query: red" not in open_scene(asked).layer_names
    assert "another mesh" in caplog.text


def test_distances_to_another_mesh_are_a_layer(tmp_path):
    floor = rectangle((0, 0), (1, 1), 0.0, steps=4)
    write_mesh(tmp_path / "floor.ply", floor)
    write_mesh(tmp_path / "below.ply", rectangle((-1, -1), (2, 2), -0.25))
    scene = open_scene(tmp_path / "floor.ply", SceneOptions(compare=tmp_path / "below.ply"))
    layer = scene.meshes[0].layer("distance to below.ply")
    assert np.allclose(layer.values, 0.25, atol=EXACT)
    assert layer.legend.label == "distance to below.ply [m]"
    assert (layer.legend.low, layer.legend.high) == pytest.approx((0, 0.25), abs=EXACT)


@pytest.mark.parametrize(
    "name, error", [("none.ply", FileError), ("empty.ply", InputError), ("folder", FileError)]
)
def test_what_has_no_mesh_is_said(tmp_path, name, error):
    empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    write_mesh(tmp_path / "empty.ply", empty)
    (tmp_path / "folder").mkdir()
    with pytest.raises(error, match=name):
        open_scene(tmp_path / name)


def test_the_folder_above_results_names_them(tmp_path):
    (tmp_path / "demo").mkdir()
    write_mesh(tmp_path / "demo" / "mesh.ply", rectangle((0, 0), (1, 1), 0.0))
    with pytest.raises(FileError, match=r"is no results folder; those in it are .*/demo$"):
        open_scene(tmp_path)


def test_values_become_the_colours_of_their_look_and_unknown_ones_grey():
    values = np.array([0.0, 0.5, 1.0, np.nan])
    layer = Layer.of_values("heat", values, Look("gray", (0.0, 1.0), "heat [K]"))
    assert layer.colors[:3].tolist() == [[0] * 3, [128] * 3, [255] * 3]
    assert layer.describe(layer.values[3]) == "unknown" and len(set(layer.colors[3].tolist())) > 1
    assert (layer.legend.label, layer.legend.low, layer.legend.high) == ("heat [K]", 0.0, 1.0)
    assert [layer.describe(np.array([v])) for v in (-3e-13, 0.481, 2.0)] == ["0", "0.481", "2"]
    with pytest.raises(InputError, match="2 channels"):
        Layer.of_values("pair", np.zeros((4, 2)), Look())


def test_a_legend_names_the_classes_that_occur_the_commonest_first():
    colors = np.array([[1, 1, 1], [2, 2, 2], [3, 3, 3]], np.uint8)
    layer = Layer.of_labels("class", np.array([2, 2, 0, -1]), ("a", "b", "c"), colors)
    assert layer.legend.names == ("c", "a")
    assert layer.colors[:3].tolist() == [[3] * 3, [3] * 3, [1] * 3]
    assert [layer.describe(value) for value in layer.values] == ["c", "c", "a", "unknown"]


def test_heights_and_up_follow_the_upright_frame():
    # a world whose y points down, as a camera's, with the floor at y = 1.5
    T = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    room = Mesh(np.float32([[0, 1.5, 0], [1, 1.5, 0], [0, -0.5, 2]]), np.int32([[0, 1, 2]]))
    scene = Scene("room", (plain(room),), T_up_world=T)
    assert scene.up.tolist() == [0, -1, 0]
    assert scene.heights() == (0.0, 2.0)
    eye, center = scene.overview()
    assert scene.heights_of(eye[None])[0] > scene.heights_of(center[None])[0]


def test_scenes_beside_each_other_do_not_touch_and_say_where_they_were():
    cubes = [Scene(name, (plain(box(ZERO, ONE), name),)) for name in "abc"]
    scene = beside(cubes)
    eye, center = scene.overview()
    right = np.cross(center - eye, scene.up)
    right /= np.linalg.norm(right)
    spans = [mesh.mesh.vertices @ right for mesh in scene.meshes]
    for left, other in zip(spans, spans[1:], strict=False):
        assert left.max() < other.min()
    for mesh in scene.meshes:
        assert np.allclose(mesh.in_map().vertices, box(ZERO, ONE).vertices, atol=EXACT)
    assert all(np.array_equal(mesh.T_scene_map, np.eye(4)) for mesh in overlaid(cubes).meshes)


def test_scenes_of_worlds_with_another_up_stand_upright_beside_each_other():
    T = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])  # y points down
    room = rectangle((0, 0), (2, 1), 1.0, steps=2)
    other = Mesh(((room.vertices - T[:3, 3]) @ T[:3, :3]).astype(np.float32), room.faces)
    marks = {"boxes": (Box("a", np.array([[0.0, 0.3, 0], [1, 0.5, 1]])),)}
    scene = beside([Scene("a", (plain(room),)), Scene("b", (plain(other),), **marks, T_up_world=T)])
    one, two = (scene.heights_of(mesh.mesh.vertices) for mesh in scene.meshes)
    assert np.allclose(one, 1, atol=EXACT) and np.allclose(two, 1, atol=EXACT)
    assert np.allclose(scene.meshes[1].in_map().vertices, other.vertices, atol=EXACT)
    assert np.allclose(scene.heights_of(scene.boxes[0].corners), [1.0, 1.2], atol=EXACT)
    hit = Picker(scene.meshes[1]).pick(
        scene.meshes[1].mesh.vertices.mean(axis=0) + [0, 0, 1], np.array([0.1, 0.1, -1])
    )
    assert np.allclose(hit.normal_in_map, [0, -1, 0], atol=EXACT)
    assert hit.point_in_map[1] == pytest.approx(0.5, abs=EXACT)


def of_values(name: str, values, look: Look, classes: dict) -> Scene:
    """A floor with a layer of values, one of classes, and one that is always the same."""
    mesh = rectangle((0, 0), (1, 1), 0.0)
    colors = np.array(list(classes.values()), np.uint8)
    layers = (
        Layer("color", np.full((4, 3), 7, np.uint8)),
        Layer.of_values("number", np.array(values), look),
        Layer.of_values("vector", np.outer(values, (1, 0, 0)), Look(range=None)),
        Layer.of_values("fixed", np.zeros(4), Look(range=(0.0, 1.0))),
        Layer.of_labels("class", np.array([0, 0, 1, -1]), tuple(classes), colors),
    )
    return Scene(name, (SceneMesh(name, mesh, layers),))


@pytest.mark.parametrize("colormap", ["viridis", "diverging"])
@pytest.mark.parametrize("together", [beside, overlaid, with_shared_scales])
def test_results_that_are_seen_together_have_one_legend(together, colormap):
    look = Look(colormap, None, "number [m]")
    low = of_values("low", [0.0, 1, 2, np.nan], look, {"a": (9, 0, 0), "b": (0, 9, 0)})
    high = of_values("high", [-1.0, 5, 6, 2], look, {"c": (0, 0, 9), "b": (0, 8, 0)})
    shown = together([low, high])
    meshes = shown.meshes if isinstance(shown, Scene) else [each.meshes[0] for each in shown]
    for name in ("number", "vector", "class"):
        one, two = (mesh.layer(name) for mesh in meshes)
        assert one.legend is two.legend and one.legend.label.endswith("one scale for all")
        by_value = {}
        for layer in (one, two):
            for value, color in zip(layer.values.tolist(), layer.colors.tolist(), strict=True):
                assert by_value.setdefault(str(value), color) == color
    number, classes = meshes[0].layer("number"), meshes[0].layer("class")
    assert number.legend.low <= -0.9 and number.legend.high >= 5.9
    share = (2 - number.legend.low) / (number.legend.high - number.legend.low)
    row = number.legend.colors[round(255 * share)].astype(int)
    assert np.abs(number.colors[2] - row).max() <= 2
    assert classes.legend.names == ("a", "b", "c") and classes.describe(classes.values[2]) == "b"
    assert meshes[1].layer("class").colors[:3].tolist() == [[0, 0, 9], [0, 0, 9], [0, 9, 0]]
    assert "one scale" not in meshes[0].layer("fixed").legend.label
    assert low.legend("number").high < 2.1  # alone it keeps its own


def test_a_part_holds_the_triangles_inside_with_their_values():
    mesh = rectangle((0, 0), (1, 1), 0.0, steps=10)
    layer = Layer.of_values("x", mesh.vertices[:, 0], Look(range=(0.0, 1.0)))
    part = SceneMesh("floor", mesh, (layer,)).part(mesh.vertices[:, 0] <= 0.31)
    assert len(part.mesh.faces) == 3 * 10 * 2
    assert np.array_equal(part.layer("x").values[:, 0], part.mesh.vertices[:, 0])


def test_a_layer_of_another_mesh_is_refused():
    with pytest.raises(InputError, match="4 vertices"):
        SceneMesh(
            "floor",
            rectangle((0, 0), (1, 1), 0.0),
            (Layer("color", np.zeros((5, 3), np.uint8)),),
        )
