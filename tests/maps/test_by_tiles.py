"""Maps in tiles that are asked at points: the answers of the whole map, to the bit, with a part of it in
memory.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from taichi_unifusion.errors import MapCorrupt
from taichi_unifusion.maps import FeatureMap, PropertyMap
from taichi_unifusion.maps.by_tiles import (
    TiledFeatures,
    TiledProperty,
    open_features,
    open_property,
)
from taichi_unifusion.maps.tile_merge import as_tiles
from taichi_unifusion.maps.voxel_data import VoxelData
from taichi_unifusion.types import ImageView, PinholeCamera, PointCloud

VOXEL, CHANNELS = 0.1, 20
SIZE = 64 * VOXEL  # [m] of a tile
CAMERA = PinholeCamera(24, 18, 22.0, 22.0, 11.5, 8.5)


def sheet(seed: int, place: float) -> PointCloud:
    """Points on a bent sheet around (place, 0, 0) with a feature image that sees them from in front."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.45, 0.45, (3000, 2))
    points = np.column_stack([xy[:, 0] + place, xy[:, 1], 0.3 * xy[:, 0] ** 2])
    values = rng.standard_normal((CAMERA.height, CAMERA.width, CHANNELS)).astype(np.float32)
    T_camera_world = np.eye(4)
    T_camera_world[:3, 3] = -place, 0, 1
    image = ImageView(values, CAMERA, T_camera_world)
    return PointCloud(points.astype(np.float32), features={"clip": image})


@pytest.fixture(scope="module")
def features(tmp_path_factory) -> tuple[FeatureMap, Path, np.ndarray]:
    """A map of features, the same in tiles, and points to ask: sheets where tiles meet, in places
    that are far apart, some points beside all voxels, and one that is nowhere.
    """
    whole = FeatureMap("clip", CHANNELS, voxel_size=VOXEL)
    points = []
    for place in (0, SIZE, 3 * SIZE, 5 * SIZE, 7 * SIZE):
        for seed in range(2):
            whole.integrate(sheet(seed, place))
        points.append(sheet(9, place).points[::10])
    folder = tmp_path_factory.mktemp("features")
    whole.save(folder / "clip.safetensors")
    tiles = as_tiles(folder / "clip.safetensors", folder / "clip")
    assert len(tiles.tiles) > 8
    nowhere = np.array([[np.nan, 0, 0], [1e6, 0, 0], [0.1, 0.1, 0.35]], np.float32)
    return whole, tiles.path, np.concatenate([*points, nowhere])


def test_questions_to_tiles_are_those_to_the_whole_map(features):
    whole, folder, points = features
    tiled = open_features(folder)
    assert isinstance(tiled, TiledFeatures)
    assert (tiled.channels, tiled.settings) == (whole.channels, whole.settings)
    texts = np.random.default_rng(0).standard_normal((3, CHANNELS))
    expected, known = whole.similarity(points, texts, return_valid=True)
    found, known_by_tiles = tiled.similarity(points, texts, return_valid=True)
    assert 0.5 < known.mean() < 1
    np.testing.assert_array_equal(found, expected)
    np.testing.assert_array_equal(known_by_tiles, known)
    np.testing.assert_array_equal(tiled.similarity(points, texts[0]), expected[:, 0])
    np.testing.assert_array_equal(tiled.uncertainty(points), whole.uncertainty(points))


def test_a_few_tiles_are_in_memory_at_a_time(features):
    whole, folder, points = features
    tiled = TiledFeatures(open_features(folder)._tiles.folder)
    held = []
    ask = tiled._map.similarity
    tiled._map.similarity = lambda *some, **more: held.append(len(tiled._map)) or ask(*some, **more)
    tiled.similarity(points, np.ones(CHANNELS))
    assert len(held) > 8 and max(held) < 0.5 * len(whole)


def test_no_point_has_no_answer(features):
    whole, folder, _ = features
    nothing = np.zeros((0, 3), np.float32)
    for each in (whole, open_features(folder)):
        assert each.similarity(nothing, np.ones((2, CHANNELS))).shape == (0, 2)


def test_a_file_opens_as_the_map_itself(features):
    _, folder, _ = features
    assert isinstance(open_features(folder.with_suffix(".safetensors")), FeatureMap)


def test_values_of_a_property_by_tiles_are_those_of_the_whole_map(tmp_path):
    rng, whole = np.random.default_rng(0), PropertyMap("x", 1, voxel_size=VOXEL)
    keys = np.unique(rng.integers(-100, 100, (4000, 3)).astype(np.int32) // (1, 1, 50), axis=0)
    fields = {
        each.name: rng.uniform(0.5, 1, (len(keys), *each.shape)).astype(each.dtype)
        for each in whole.grid.fields
    }
    whole.grid.add(VoxelData(keys.astype(np.int32), fields))
    asked = rng.uniform(-10.5, 10.5, (5000, 3)).astype(np.float32) * (1, 1, 0.03)
    whole.save(tmp_path / "x.safetensors")
    tiled = open_property(as_tiles(tmp_path / "x.safetensors", tmp_path / "x").path)
    assert isinstance(tiled, TiledProperty)
    found, expected = (each.query(asked, return_valid=True) for each in (tiled, whole))
    assert 0.1 < expected[1].mean() < 0.9
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_array_equal(found[1], expected[1])
    with pytest.raises(MapCorrupt, match="not 'latent'"):
        open_features(tmp_path / "x")
