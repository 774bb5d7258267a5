"""The shared page: what it holds is what the scene holds, in a size that can be sent, and nothing
that comes from outside runs in it.
"""

from __future__ import annotations

import base64
import gzip
import json
import re
import struct
from dataclasses import dataclass

import numpy as np
import pytest
from meshes import rectangle

from taichi_unifusion import Mesh
from taichi_unifusion.errors import InputError
from taichi_unifusion.rendering.look import Look
from taichi_unifusion.viewer.decimation import decimate
from taichi_unifusion.viewer.page import GRID, STEPS, write_page
from taichi_unifusion.viewer.results_scene import open_scene
from taichi_unifusion.viewer.scene import Box, Label, Layer, Scene, SceneMesh

# the world's y points down; the floor lies at y = 1.5
T_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
ROUNDED = 2e-6  # of numbers in the header


@dataclass(frozen=True)
class Page:
    """What the program of a page reads from it."""

    header: dict
    blob: bytes

    @classmethod
    def of(cls, text: str) -> Page:
        data = re.search(r'<script id="data" type="text/plain">(.*?)</script>', text)[1]
        unpacked = gzip.decompress(base64.b64decode(data))
        length = struct.unpack("<I", unpacked[:4])[0]
        return cls(json.loads(unpacked[4 : 4 + length]), unpacked[4 + length :])

    def integers(self, place: list[int]) -> np.ndarray:
        start, count, planes = place
        data = np.frombuffer(self.blob, np.uint8, count * planes, start).reshape(planes, count)
        folded = (data.astype(np.int64) << (8 * np.arange(planes))[:, None]).sum(axis=0)
        return np.cumsum(np.where(folded % 2, -(folded + 1) // 2, folded // 2))

    def small_numbers(self, place: list[int]) -> np.ndarray:
        return np.cumsum(np.frombuffer(self.blob, np.uint8, place[1], place[0]), dtype=np.uint8)

    def points(self, mesh: dict) -> np.ndarray:
        steps = np.stack([self.integers(place) for place in mesh["positions"]], axis=1)
        return np.array(mesh["low"]) + steps * np.array(mesh["scale"])

    def faces(self, mesh: dict) -> np.ndarray:
        a, b, c = (self.integers(place) for place in mesh["faces"])
        return np.stack([a, a + b, a + c], axis=1)


def wavy(steps: int) -> Mesh:
    """A floor with waves, of 2 steps^2 triangles."""
    mesh = rectangle((0, 0), (4, 3), 0.0, steps=steps)
    x, y, _ = mesh.vertices.T
    return Mesh(np.stack([x, y, 0.1 * np.sin(3 * x) * np.sin(2 * y)], axis=1), mesh.faces)


def scene_of(mesh: Mesh, **more) -> Scene:
    rng = np.random.default_rng(5)
    colors = rng.integers(0, 256, (len(mesh.vertices), 3), np.uint8)
    values = np.where(np.arange(len(mesh.vertices)) % 7, mesh.vertices[:, 0], np.nan)
    classes = np.arange(len(mesh.vertices)) % 3 - 1
    table = np.array([[200, 0, 0], [0, 200, 0]], np.uint8)
    layers = (
        Layer("color", colors),
        Layer.of_values("x", values, Look("viridis", (0.0, 4.0), "x [m]")),
        Layer.of_labels("class", classes, ("left", "right"), table),
    )
    return Scene("floor", (SceneMesh("floor", mesh, layers),), **more)


def match(points: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """For each of the wanted (N, 3), the row of the nearest of the points."""
    return np.linalg.norm(points[None] - wanted[:, None], axis=2).argmin(axis=1)


def test_a_page_holds_the_mesh_and_its_layers(tmp_path):
    scene = scene_of(wavy(12), T_up_world=T_UP)
    write_page(scene, tmp_path / "page.html")
    page, shown = Page.of((tmp_path / "page.html").read_text()), scene.meshes[0]
    mesh = page.header["meshes"][0]
    points = page.points(mesh)
    upright = shown.mesh.vertices @ T_UP[:3, :3].T + T_UP[:3, 3]
    rows = match(points, upright)
    step = np.ptp(upright, axis=0) / GRID
    assert (np.abs(points[rows] - upright) <= 0.51 * step + ROUNDED).all()
    # the same triangles, seen from the same sides
    turned = {tuple(np.roll(face, -face.argmin())) for face in rows[shown.mesh.faces]}
    assert turned == set(map(tuple, page.faces(mesh).tolist()))
    color, x, classes = mesh["layers"]
    read = np.stack([page.small_numbers(place) for place in color["colors"]], axis=1)
    assert np.array_equal(read[rows], shown.layer("color").colors)
    steps, values = page.small_numbers(x["steps"])[rows], shown.layer("x").values[:, 0]
    assert np.array_equal(steps == 0, np.isnan(values))
    known = steps > 0
    assert np.abs((steps[known] - 1.0) / STEPS * 4 - values[known]).max() <= 0.51 * 4 / STEPS
    assert "colors" not in x and x["legend"]["label"] == "x [m]"
    names = classes["legend"]["names"]
    said = [
        names[step - 1] if step else "unknown"
        for step in page.small_numbers(classes["steps"])[rows]
    ]
    layer = shown.layer("class")
    assert said == [layer.describe(value) for value in layer.values]


def test_poses_boxes_and_labels_stand_upright(tmp_path):
    box = Box("chair 1", np.array([[0.0, 0.5, 0.0], [1.0, 1.5, 1.0]]))
    scene = scene_of(
        wavy(4),
        T_up_world=T_UP,
        boxes=(box,),
        labels=(Label("chair 1", np.array([0.0, 1.5, 2.0])),),
    )
    write_page(scene, tmp_path / "page.html")
    header = Page.of((tmp_path / "page.html").read_text()).header
    heights = np.array(header["boxes"][0]["corners"])[:, 2]
    assert (heights.min(), heights.max()) == (0.0, 1.0)
    assert header["labels"][0] == {"text": "chair 1", "at": [0.0, 2.0, 0.0]}


def test_a_page_keeps_to_its_size_and_says_what_it_left_out(tmp_path):
    scene = scene_of(wavy(150))
    said = write_page(scene, tmp_path / "page.html", 250_000)
    assert (tmp_path / "page.html").stat().st_size <= 250_000
    assert "of 45,000 triangles are shown" in said and "mm off" in said
    note = Page.of((tmp_path / "page.html").read_text()).header["meshes"][0]["note"]
    assert note in said
    with pytest.raises(InputError, match="allow more"):
        write_page(scene, tmp_path / "page.html", 20_000)


def test_a_results_folder_becomes_a_page(results, tmp_path):
    scene = open_scene(results.path)
    write_page(scene, tmp_path / "page.html")
    header = Page.of((tmp_path / "page.html").read_text()).header
    assert header["layers"] == list(scene.layer_names)
    assert [camera["name"] for camera in header["cameras"]] == ["frame 0", "frame 1", "frame 2"]


def test_texts_of_a_scene_cannot_become_program(tmp_path):
    evil = "</script><script>alert(1)</script>"
    scene = scene_of(wavy(2))
    layer = Layer(evil, scene.meshes[0].layers[0].colors)
    scene = Scene(evil, (SceneMesh(evil, scene.meshes[0].mesh, (layer,)),))
    write_page(scene, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "alert(1)" not in text.replace("&lt;script&gt;alert(1)", "")
    assert "default-src 'none'" in text and not re.search(r"(src|href)=\"?http", text)


def test_nothing_to_show_is_said(tmp_path):
    empty = Mesh(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32))
    with pytest.raises(InputError, match="no triangle"):
        write_page(scene_of(empty), tmp_path / "page.html")


def test_fewer_triangles_keep_shape_colours_and_values():
    whole = wavy(60)
    layer = Layer.of_values("x", whole.vertices[:, 0], Look(range=(0.0, 4.0)))
    few = decimate(SceneMesh("floor", whole, (layer,)), 1500)
    flat = decimate(SceneMesh("flat", rectangle((0, 0), (4, 3), 0.0, steps=60), (layer,)), 1500)
    assert "under 0.1 mm off the whole mesh" in flat.note and "99 % within 0.1 mm" in flat.note
    assert len(few.mesh.faces) <= 1.05 * 1500 and "of 7,200 triangles are shown" in few.note
    x, y, z = few.mesh.vertices.T
    assert np.abs(z - 0.1 * np.sin(3 * x) * np.sin(2 * y)).max() < 0.01
    # the value of the nearest vertex of the whole mesh, which stands half a cell away at most
    assert np.abs(few.layer("x").values[:, 0] - x).max() <= 4 / 60
    same = SceneMesh("floor", whole, (layer,))
    assert decimate(same, 7200) is same
