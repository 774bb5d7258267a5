"""Properties that share one encoding: every map is as if it had been fused alone."""

from __future__ import annotations

import numpy as np
import pytest
from reference import unpack_masks
from scenes import cloud_of, rough

from taichi_unifusion import PointCloud, PropertyMap, load_map
from taichi_unifusion.errors import CapacityError, InputError
from taichi_unifusion.kernels.patches import Values
from taichi_unifusion.maps import PropertyGroup
from taichi_unifusion.maps.binner import Binner, patches_of
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.maps.property_group import group_maps

# relative to values of the size of 3: another width of the right side may be summed in another
# order
SAME = 2e-5
CHANNELS = {"one": 1, "rgb": 3}
SMALL = {"voxel_size": 0.05, "encoder": EncoderSettings(rank=4)}  # compiles in half the time
SETTINGS = [
    {"sampling": "cells", "prior": "zero", "fusion": "mean", **SMALL},
    {"sampling": "points", "prior": "mean", "fusion": "information", **SMALL},
]


def maps_of(**settings) -> list[PropertyMap]:
    return [PropertyMap(name, channels, **settings) for name, channels in CHANNELS.items()]


def without(cloud: PointCloud, name: str) -> PointCloud:
    return cloud_of(
        cloud.points,
        cloud.normals,
        **{key: v for key, v in cloud.attributes.items() if key != name},
    )


def with_holes(cloud: PointCloud, name: str) -> PointCloud:
    cloud.attributes[name][::3] = np.nan
    return cloud


def assert_same(found: PropertyMap, wanted: PropertyMap) -> None:
    a, b = found.voxels(), wanted.voxels()
    for part in ("keys", "weights", "masks"):
        np.testing.assert_array_equal(getattr(a, part), getattr(b, part))
    np.testing.assert_allclose(a.latents, b.latents, rtol=0, atol=3 * SAME)


@pytest.mark.parametrize("settings", SETTINGS, ids=lambda settings: settings["sampling"])
def test_each_map_is_as_if_it_were_alone(settings):
    """Also where a frame lacks a property, or has values that are no numbers in one of them."""
    frames = [rough(1), without(rough(2), "rgb"), with_holes(rough(3), "rgb"), rough(4, count=5000)]
    group, alone = PropertyGroup(maps_of(**settings)), maps_of(**settings)
    for cloud in frames:
        done = group.integrate(cloud)
        for each in alone:
            if each.name in cloud.attributes:
                assert each.integrate(cloud) == done.pop(each.name)
        assert not done
    for found, wanted in zip(group.maps, alone, strict=True):
        assert_same(found, wanted)


def test_maps_of_a_group_are_saved_loaded_and_merged_alone(tmp_path):
    first, second = PropertyGroup(maps_of(voxel_size=0.05)), PropertyGroup(maps_of(voxel_size=0.05))
    both = PropertyGroup(maps_of(voxel_size=0.05))
    first.integrate(rough(1))
    second.integrate(rough(2))
    both.integrate(rough(1))
    both.integrate(rough(2))
    for a, b, wanted in zip(first.maps, second.maps, both.maps, strict=True):
        a.save(tmp_path / "map.safetensors")
        loaded = load_map(tmp_path / "map.safetensors")
        assert loaded.name == a.name and loaded.channels == a.channels
        points = rough(1).points
        np.testing.assert_array_equal(loaded.query(points), a.query(points))
        loaded.merge(b)
        assert_same(loaded, wanted)
        del loaded


def test_maps_are_grouped_by_their_settings():
    maps = [
        PropertyMap("one", 1, voxel_size=0.1),
        PropertyMap("five", 5),
        PropertyMap("rgb", 3, voxel_size=0.1),
    ]
    groups = group_maps(maps)
    assert [[each.name for each in group.maps] for group in groups] == [["one", "rgb"], ["five"]]
    assert groups[0].names_in(rough(1)) == ["one", "rgb"] and groups[0].names_in(
        without(rough(1), "one")
    ) == ["rgb"]
    with pytest.raises(InputError, match="property group: 'one' and 'five' have other settings"):
        PropertyGroup(maps[:2])
    empty = cloud_of(np.empty((0, 3)), np.empty((0, 3)), one=np.empty((0, 1)), rgb=np.empty((0, 3)))
    assert all(done.total_voxels == 0 for done in groups[0].integrate(empty).values())


def test_no_map_changes_where_one_of_them_is_full(monkeypatch):
    group = PropertyGroup(maps_of(voxel_size=0.05))
    group.integrate(rough(1))
    before = [each.voxels() for each in group.maps]

    def full(extra):
        raise CapacityError("full")

    monkeypatch.setattr(group.maps[1].grid, "reserve", full)
    with pytest.raises(CapacityError):
        group.integrate(rough(2))
    for each, old in zip(group.maps, before, strict=True):
        np.testing.assert_array_equal(each.voxels().latents, old.latents)


@pytest.mark.parametrize("parts", [2, 5])
def test_values_are_summed_in_cells_to_the_bit_as_one_array_is(parts):
    """Several arrays are one array side by side, whose twin is in reference.py."""
    cloud = rough(6, count=3000)
    grid = PropertyMap("rgb", 3, voxel_size=0.05).grid
    values = [cloud.attributes["rgb"], *[cloud.attributes["one"] * n for n in range(1, parts)]]
    patches, found = patches_of(cloud, "cpu"), []
    for together in (False, True):
        given = values if together else [np.hstack(values)]
        binned = Binner(grid, 0.05, 2 + parts).bin(
            patches, [Values(each, patches.counts) for each in given]
        )
        n, cells = binned.count, binned.cells.to_numpy()
        keys, (starts, totals, _) = binned.keys.to_numpy()[:n, :3], binned.rows.T
        order = np.lexsort(keys.T)  # blocks are numbered as threads come
        occupied = unpack_masks(binned.masks.to_numpy()[:n]).sum(axis=1)
        rows = [cells[start : start + m] for start, m in zip(starts, occupied, strict=True)]
        found.append((totals[order], np.concatenate([rows[b] for b in order])))
    assert found[0][0].sum() == len(cloud)
    for one, together in zip(*found, strict=True):
        np.testing.assert_array_equal(one, together)
