"""Maps in tiles: what is in memory and what lies on disk together are the whole map, to the bit."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from mesh_laws import triangles
from windows import CONFIG, place_of, seen_from, stepped, with_value

from taichi_unifusion.errors import FileError, InputError, MapCorrupt
from taichi_unifusion.files.tiles import TileFolder
from taichi_unifusion.maps.settings import parse_bytes
from taichi_unifusion.maps.stored import read_tile
from taichi_unifusion.maps.tile_places import (
    TILE,
    code_of,
    codes_between,
    key_codes,
    place_codes,
    tile_of,
    tiles_around,
)
from taichi_unifusion.maps.voxel_data import VoxelData
from taichi_unifusion.pipeline import Pipeline

PLACES = (
    0,
    20,
    40,
    0,
    20,
)  # [m] along x of the box that frames are taken in: it is left and seen again
FRAMES = 6  # in each
LIMITED = replace(CONFIG, map_memory="1MB")
LIMIT = 250_000  # bytes, which is less than anybody may ask for


def frames(places=PLACES) -> list:
    return [
        with_value(seen_from(place_of(n), FRAMES * k + n + 1, origin=(place, 0, 0)), "x")
        for k, place in enumerate(places)
        for n in range(FRAMES)
    ]


def in_tiles(folder: Path, config=LIMITED, places=PLACES) -> Pipeline:
    config = replace(config, properties=())
    pipeline = Pipeline(config, tiles=folder)
    pipeline.memory.limit = LIMIT
    for frame in frames(places):
        pipeline.step(frame)
    pipeline.flush()
    return pipeline


def all_voxels(folder: Path, name: str) -> VoxelData:
    """The voxels of all tiles of a map, sorted as a map exports them."""
    tiles = TileFolder.open(folder / name)
    parts = [read_tile(tiles, tile) for tile in tiles.tiles]
    keys = np.concatenate([part.keys for part in parts])
    order = np.lexsort(keys.T[::-1])
    fields = {
        name: np.concatenate([part.fields[name] for part in parts])[order]
        for name in parts[0].fields
    }
    return VoxelData(keys[order], fields)


@pytest.fixture(scope="module")
def whole() -> Pipeline:
    pipeline = stepped(frames())
    pipeline.flush()
    return pipeline


@pytest.fixture(scope="module")
def tiled(tmp_path_factory) -> tuple[Path, Pipeline]:
    folder = tmp_path_factory.mktemp("tiles")
    pipeline = in_tiles(folder)
    assert pipeline.memory is not None
    pipeline.memory.save()
    return folder, pipeline


def test_tiles_together_are_the_whole_map(whole, tiled):
    folder, _ = tiled
    for name, each in whole.maps.items():
        expected, found = each.voxels(), all_voxels(folder, name)
        np.testing.assert_array_equal(found.keys, expected.keys)
        for field, values in expected.fields.items():
            np.testing.assert_array_equal(found.fields[field], values, err_msg=f"{name} {field}")


def test_tiles_were_dropped_and_came_back(whole, tiled):
    folder, pipeline = tiled
    for name, each in whole.maps.items():
        there = len(pipeline.maps[name].grid)
        assert 0 < there < 0.8 * len(each)
        on_disk = TileFolder.open(folder / name)
        assert on_disk.voxels == len(each)


def test_the_mesh_by_tiles_is_the_mesh_of_the_whole(whole, tiled):
    _, pipeline = tiled
    expected, found = whole.extract_mesh(2), pipeline.extract_mesh(2)
    assert len(found.faces) > 1000 and len(found.vertices) == len(expected.vertices)
    np.testing.assert_array_equal(triangles(found), triangles(expected))
    order = [np.lexsort(mesh.vertices.T) for mesh in (found, expected)]
    colors = [
        mesh.attributes["color"][rows] for mesh, rows in zip((found, expected), order, strict=True)
    ]
    np.testing.assert_array_equal(*colors)


def test_bounds_cut_the_mesh_of_tiles_as_that_of_the_whole(whole, tiled):
    bounds = ((-2, -0.5, -2), (20.5, 1, 2))
    expected, found = (each.extract_mesh(2, bounds=bounds) for each in (whole, tiled[1]))
    assert 100 < len(expected.faces) < len(whole.extract_mesh(2).faces)
    np.testing.assert_array_equal(triangles(found), triangles(expected))


def test_memory_stays_within_the_limit_and_is_used_again(tmp_path, monkeypatch):
    """Nine rooms take no more of pools and index than the first ones did, where the index is crowded."""
    monkeypatch.setattr("taichi_unifusion.maps.voxel_grid.CROWDED", 0)
    pipeline = Pipeline(LIMITED, tiles=tmp_path)
    pipeline.memory.limit = LIMIT
    leaves, held = [], []
    for frame in frames([20 * n for n in range(9)]):
        pipeline.step(frame)
        live = pipeline.surface.grid.runtime
        leaves.append(sum(live.leaves[each.grid.index] for each in pipeline.maps.values()))
        held.append(sum(each.bytes for each in pipeline.memory.sets.values()))
    assert leaves[-1] < 1.2 * max(leaves[: 4 * FRAMES])
    assert max(held) < LIMIT + 2 * max(held[:FRAMES])


def test_without_a_folder_it_is_refused():
    with pytest.raises(InputError, match="name a folder"):
        Pipeline(LIMITED)


@pytest.mark.parametrize(
    ("text", "count"), [("2GB", 2e9), ("500 MB", 5e8), ("1.5g", 1.5e9), ("2000000", 2e6)]
)
def test_sizes_are_read_as_people_write_them(text, count):
    assert parse_bytes(text, "x") == count


@pytest.mark.parametrize("text", ["", "much", "2XB", "-1GB", "1kB", "9e9"])
def test_other_sizes_are_refused(text):
    with pytest.raises(InputError, match="as 2GB or 500MB"):
        parse_bytes(text, "map_memory")


def test_codes_of_tiles_are_one_to_one():
    tiles = [(-128, 0, 127), (0, 0, 0), (-1, -1, -1), (5, -7, 9)]
    assert [tile_of(code_of(tile)) for tile in tiles] == tiles
    keys = np.array([[-1, 0, TILE], [TILE - 1, -TILE, 2 * TILE]], np.int32)
    assert [tile_of(code) for code in key_codes(keys)] == [(-1, 0, 1), (0, -1, 2)]
    assert len(set(tiles_around([code_of((0, 0, 0))]))) == 27


def unchecked(file, manifest) -> None:
    """Any arrays will do."""


def one_tile(n: int = 3) -> dict[str, np.ndarray]:
    return {
        "keys": np.arange(3 * n, dtype=np.int32).reshape(n, 3),
        "weights": np.ones(n, np.float32),
    }


def test_a_tile_is_replaced_as_a_whole(tmp_path):
    folder = TileFolder.create(tmp_path / "map", {"kind": "x"})
    folder.write({(0, 0, 0): one_tile(), (1, 0, -1): one_tile(5)}.items())
    folder.write({(0, 0, 0): one_tile(4)}.items())
    again = TileFolder.open(tmp_path / "map")
    assert again.voxels == 9 and len(list(again.path.iterdir())) == 3
    assert len(again.read((0, 0, 0), unchecked)[0]["keys"]) == 4
    again.write({(1, 0, -1): one_tile(0)}.items())
    assert set(TileFolder.open(tmp_path / "map").tiles) == {(0, 0, 0)}
    assert len(list(again.path.iterdir())) == 2


def test_a_tile_is_on_disk_before_the_next_is_asked_for(tmp_path):
    """So whoever writes many holds one."""
    folder = TileFolder.create(tmp_path / "map", {"kind": "x"})

    def tiles():
        for n in range(3):
            assert len(list(folder.path.glob("*.safetensors"))) == n
            yield (n, 0, 0), one_tile()

    folder.write(tiles())
    assert len(TileFolder.open(folder.path).tiles) == 3


def test_what_cannot_be_written_leaves_the_tiles_as_they_were(tmp_path, monkeypatch):
    folder = TileFolder.create(tmp_path / "map", {"kind": "x"})
    folder.write({(0, 0, 0): one_tile()}.items())

    def full(*_):
        raise FileError("the disk is full")

    monkeypatch.setattr("taichi_unifusion.files.tiles.write_text", full)
    with pytest.raises(FileError, match="full"):
        folder.write({(0, 0, 0): one_tile(4), (2, 0, 0): one_tile(4)}.items())
    assert set(folder.tiles) == {(0, 0, 0)} and len(list(folder.path.iterdir())) == 2
    assert len(TileFolder.open(tmp_path / "map").read((0, 0, 0), unchecked)[0]["keys"]) == 3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"format": "other"}, "not the index"),
        ({"format_version": 2}, "version 2"),
        (
            {"tiles": [{"tile": [0, 0, 0], "file": "../x.1.safetensors", "voxels": 1, "bytes": 1}]},
            "damaged",
        ),
        (
            {"tiles": [{"tile": [0, 0], "file": "0_0_0.1.safetensors", "voxels": 1, "bytes": 1}]},
            "damaged",
        ),
        ({"tiles": 5}, "damaged"),
        ({"map": []}, "damaged"),
    ],
)
def test_a_bad_index_is_refused(tmp_path, change, message):
    folder = TileFolder.create(tmp_path, {"kind": "x"})
    folder.write({(0, 0, 0): one_tile()}.items())
    values = json.loads((tmp_path / "index.json").read_text()) | change
    (tmp_path / "index.json").write_text(json.dumps(values))
    with pytest.raises(MapCorrupt, match=message):
        TileFolder.open(tmp_path)


def test_a_tile_under_another_name_is_refused(tmp_path):
    folder = TileFolder.create(tmp_path, {"kind": "x"})
    folder.write({(0, 0, 0): one_tile(), (1, 0, 0): one_tile()}.items())
    folder.tiles[0, 0, 0] = folder.tiles[1, 0, 0]
    with pytest.raises(MapCorrupt, match="holds tile"):
        folder.read((0, 0, 0), unchecked)


def test_no_folder_is_no_tiled_map(tmp_path):
    assert not TileFolder.is_one(tmp_path)
    with pytest.raises(FileError, match="no such file"):
        TileFolder.open(tmp_path)


def test_the_tiles_around_points_are_those_of_every_corner_of_their_boxes():
    voxels = np.random.default_rng(3).uniform(-200, 200, (500, 3))
    voxels[:200] = 64 * np.rint(voxels[:200] / 64) + voxels[:200] % 5  # at borders, corners too
    halo = 2
    steps = [halo * np.array(step) for step in product((-1, 0, 1), repeat=3)]
    corners = {code for step in steps for code in place_codes(voxels + step).tolist()}
    found = set(codes_between(place_codes(voxels - halo), place_codes(voxels + halo)))
    assert found == corners and len(found) > len(set(place_codes(voxels).tolist()))
