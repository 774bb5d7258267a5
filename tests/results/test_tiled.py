"""A results folder whose maps lie in tiles: what is read from it is what one map would give."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mesh_laws import assert_welded, triangles
from windows import CONFIG, place_of, seen_from

from taichi_unifusion import load_map
from taichi_unifusion.config import MeshSettings
from taichi_unifusion.errors import FileError
from taichi_unifusion.files.images import read_color
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.mesh_stream import MeshStream
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results.inspection import inspect
from taichi_unifusion.results.run_folder import RunFolder
from taichi_unifusion.results.tiled import open_memory, picture_resolution
from taichi_unifusion.results.writer import write_results
from taichi_unifusion.types import Mesh

FRAMES = [
    seen_from(place_of(n), 6 * k + n + 1, origin=(place, 0, 0))
    for k, place in enumerate((0, 20, 0))
    for n in range(6)
]


def written(folder: Path, limit: str) -> Pipeline:
    mesh = replace(CONFIG.mesh, resolution=2, min_area=0.01)
    config = replace(CONFIG, map_memory=limit, mesh=mesh)
    pipeline = Pipeline(config, tiles=RunFolder(folder).map_folder)
    if limit:
        pipeline.memory.limit = 250_000  # bytes, which is less than anybody may ask for
    results = write_results(folder, pipeline, pipeline.run(FRAMES))
    assert not results.failures
    return pipeline


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[RunFolder, RunFolder]:
    tiled, whole = (tmp_path_factory.mktemp(name) for name in ("tiled", "whole"))
    written(tiled, "1MB")
    written(whole, "")
    return RunFolder(tiled), RunFolder(whole)


def test_the_mesh_file_is_that_of_the_whole_maps(folders):
    tiled, whole = (read_mesh(folder.mesh) for folder in folders)
    assert len(whole.faces) > 1000
    assert_welded(tiled.vertices, tiled.faces)
    assert len(tiled.vertices) == len(whole.vertices)
    np.testing.assert_array_equal(triangles(tiled), triangles(whole))
    np.testing.assert_array_equal(
        *(mesh.attributes["color"][np.lexsort(mesh.vertices.T)] for mesh in (tiled, whole))
    )


def test_pictures_show_the_mesh_or_fewer_cells_of_a_voxel_where_it_is_too_large(
    folders, monkeypatch
):
    tiled, whole = folders
    np.testing.assert_array_equal(*(read_color(each.preview) for each in (tiled, whole)))
    memory, settings = open_memory(tiled.maps), MeshSettings(resolution=4)
    assert picture_resolution(memory, settings) == 4
    voxels = memory.sets["surface"].folder.voxels
    monkeypatch.setattr("taichi_unifusion.results.tiled.PICTURE_TRIANGLES", 6 * voxels)
    assert picture_resolution(memory, settings) == 2
    monkeypatch.setattr("taichi_unifusion.results.tiled.PICTURE_TRIANGLES", 1)
    assert picture_resolution(memory, settings) == 1


def test_a_map_in_tiles_loads_as_one(folders):
    tiled, whole = folders
    assert tiled.maps.keys() == whole.maps.keys() == {"surface", "color"}
    for name in tiled.maps:
        assert tiled.maps[name].is_dir() and whole.maps[name].is_file()
        a, b = load_map(tiled.maps[name]).voxels(), load_map(whole.maps[name]).voxels()
        for part in a.tensors:
            np.testing.assert_array_equal(a.tensors[part], b.tensors[part])


def test_info_says_how_many_tiles_there_are(folders):
    found = inspect(folders[0].path)
    assert not found.problems and "in 6 tiles" in found.text, found.text


def test_a_run_without_tiles_takes_those_of_an_earlier_one_away(tmp_path):
    written(tmp_path, "1MB")
    mine = tmp_path / "maps" / "surface" / "mine.txt"
    mine.write_text("not the program's")
    written(tmp_path, "")
    assert not (tmp_path / "maps" / "color").exists() and mine.exists()
    assert all(path.is_file() for path in RunFolder(tmp_path).maps.values())
    written(tmp_path, "1MB")
    assert all(path.is_dir() for path in RunFolder(tmp_path).maps.values())


ONE_PART = np.zeros(4, np.int32), np.ones(1)  # of a strip, and its area


def strip(first: float) -> Mesh:
    """Two triangles between x = first and first + 1."""
    x = np.array([first, first, first + 1, first + 1], np.float32)
    vertices = np.column_stack([x, [0, 1, 0, 1], [0] * 4]).astype(np.float32)
    faces = np.array([[0, 1, 2], [2, 1, 3]], np.int32)
    return Mesh(vertices, faces, attributes={"color": np.full((4, 3), first / 8, np.float32)})


def test_pieces_are_welded_where_they_meet(tmp_path):
    with MeshStream(tmp_path / "mesh.ply") as stream:
        for slab in range(5):
            stream.add(strip(slab), np.ones(4, bool), slab, *ONE_PART)
        assert (stream.vertices, stream.triangles) == (12, 10)
        assert stream.write() == (12, 10)
    mesh = read_mesh(tmp_path / "mesh.ply")
    assert_welded(mesh.vertices, mesh.faces)
    np.testing.assert_allclose(
        mesh.attributes["color"][:, 0],
        [0] * 4 + [1 / 8] * 2 + [2 / 8] * 2 + [3 / 8] * 2 + [4 / 8] * 2,
        atol=1 / 255,
    )
    assert [path.name for path in tmp_path.iterdir()] == ["mesh.ply"]


def test_parts_can_be_left_out(tmp_path):
    with MeshStream(tmp_path / "mesh.ply") as stream:
        for slab in (0, 1, 4):
            stream.add(strip(slab), np.ones(4, bool), slab, *ONE_PART)
        assert stream.write(1.5) == (6, 4)
    assert read_mesh(tmp_path / "mesh.ply").vertices[:, 0].max() == 2


def test_parts_that_a_later_piece_connects_are_one(tmp_path):
    """Two strips of one piece, each too small, that the next piece joins, and one that stays alone."""
    apart, far = strip(0), strip(20)
    other = replace(apart, vertices=apart.vertices + np.float32([0, 1.5, 0]))
    several = [apart, other, far]
    piece = Mesh(
        np.concatenate([each.vertices for each in several]),
        np.concatenate([each.faces + 4 * n for n, each in enumerate(several)]),
    )
    bridge = Mesh(
        np.array([[1, 1, 0], [1, 1.5, 0], [2, 1, 0]], np.float32),
        np.array([[0, 2, 1]], np.int32),
    )
    with MeshStream(tmp_path / "mesh.ply") as stream:
        part = np.repeat(np.arange(3, dtype=np.int32), 4)
        stream.add(piece, np.ones(12, bool), 0, part, np.ones(3))
        stream.add(bridge, np.ones(3, bool), 0, np.zeros(3, np.int32), np.full(1, 0.25))
        assert stream.write(2.0) == (9, 5)
    mesh = read_mesh(tmp_path / "mesh.ply")
    assert mesh.vertices[:, 0].max() == 2 and mesh.vertices[:, 1].max() == 2.5
    assert_welded(mesh.vertices, mesh.faces)


def test_without_pieces_the_mesh_is_empty(tmp_path):
    with MeshStream(tmp_path / "mesh.ply") as stream:
        assert stream.write() == (0, 0)
    assert len(read_mesh(tmp_path / "mesh.ply").vertices) == 0


def test_a_folder_that_is_not_there_is_said(tmp_path):
    with pytest.raises(FileError, match="cannot write"):
        MeshStream(tmp_path / "gone" / "mesh.ply")
