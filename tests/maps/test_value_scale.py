"""Properties of any size come back: sums in cells are whole numbers, scaled by powers of two."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.config import Config
from taichi_unifusion.maps import PropertyGroup, PropertyMap
from taichi_unifusion.maps.settings import PropertySettings, SurfaceSettings
from taichi_unifusion.maps.value_scale import exponent_of
from taichi_unifusion.maps.window_store import WindowStore
from taichi_unifusion.types import Frame, PinholeCamera, PointCloud, largest_magnitude

FLOAT32 = 2e-5  # relative: a regression of float32 numbers that are all the same
SETTINGS = PropertySettings(voxel_size=0.1)
SIZES = [1e-12, 1e-8, 1e-7, 1e-3, 0.5, 255.0, 65535.0, 1.7e9, 1e12]


def plane(values: float | np.ndarray, count: int = 4000, half: float = 0.5) -> PointCloud:
    points = np.random.default_rng(0).uniform(-half, half, (count, 3)).astype(np.float32)
    points[:, 2] = 0
    return PointCloud(points, None, {"c": np.full((count, 1), values, np.float32)})


@pytest.mark.parametrize("value", [sign * size for size in SIZES for sign in (1, -1)])
def test_a_constant_comes_back(value):
    cloud, made = plane(value), PropertyMap("c", 1, SETTINGS)
    made.integrate(cloud)
    np.testing.assert_allclose(made.query(cloud.points), value, rtol=FLOAT32)
    made.remove(cloud)
    assert len(made) == 0


def test_many_points_in_one_cell_have_room():
    usual, large = (PropertyMap("c", 1, SETTINGS) for _ in range(2))
    usual.integrate(plane(1e12 / 2**24, 100_000, 0.01))
    cloud = plane(1e12, 100_000, 0.01)
    large.integrate(cloud)
    points = cloud.points[:100]
    np.testing.assert_array_equal(large.query(points), 2.0**24 * usual.query(points))


@pytest.mark.parametrize("exponent", [-40, -30, 30, 50])
def test_scaled_values_give_scaled_maps(exponent):
    """Multiplying by a power of two is exact, all the way."""
    cloud, values = plane(0.0), np.random.default_rng(1).uniform(0.5, 1, (4000, 1))
    plain = largest = None
    for e in (17, 17 + exponent):  # beyond what is summed as it is, so that both are scaled
        carried = np.float32(values) * np.float32(2.0**e)
        made = PropertyMap("c", 1, SETTINGS)
        made.integrate(replace(cloud, attributes={"c": carried}))
        found = made.query(cloud.points) / np.float32(2.0**e)
        plain = found if plain is None else plain
        largest = float(np.abs(found).max())
    np.testing.assert_array_equal(found, plain)
    assert 0.4 < largest < 1.1


def test_labels_keep_apart():
    """Whole numbers of two objects, 40 cm apart."""
    cloud = plane(0.0)
    side = cloud.points[:, 0] > 0
    cloud = cloud.take(np.flatnonzero(np.abs(cloud.points[:, 0]) > 0.2))
    side = cloud.points[:, 0] > 0
    for labels in ((3, 4095), (7, 123456), (1, 16777216)):
        values = np.where(side, labels[1], labels[0]).astype(np.float32)[:, None]
        made = PropertyMap("c", 1, SETTINGS)
        made.integrate(replace(cloud, attributes={"c": values}))
        found = made.query(cloud.points)
        np.testing.assert_allclose(found[side], labels[1], rtol=FLOAT32)
        np.testing.assert_allclose(found[~side], labels[0], atol=1 / 2)


def test_maps_of_one_encoding_have_scales_of_their_own():
    """Five properties, which the kernel takes three arrays at a time."""
    sizes = {"a": 1e12, "b": 1e-9, "c": 0.5, "d": 1.7e9, "e": 1e-12}
    maps = [PropertyMap(name, 1, SETTINGS) for name in sizes]
    cloud = plane(0.0)
    values = {name: np.full((4000, 1), size, np.float32) for name, size in sizes.items()}
    PropertyGroup(maps).integrate(replace(cloud, attributes=values))
    for each in maps:
        np.testing.assert_allclose(each.query(cloud.points), sizes[each.name], rtol=FLOAT32)


def frame_of(index: int, **values: float) -> Frame:
    """A wall 2 m away that carries constants."""
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    color = np.full((48, 64, 3), 128, np.uint8)
    depth = np.full((48, 64), 2.0, np.float32)
    frame = Frame(depth, camera, color, np.eye(4), index)
    for name, value in values.items():
        frame = frame.with_image(name, np.full((48, 64), value))
    return frame


class Carried:
    """A property that frames carry already."""

    def __init__(self, name: str) -> None:
        self.name = name

    def with_settings(self, settings, scale=1.0):
        return self

    def make_map(self, frame=None):
        return PropertyMap(self.name, 1, SETTINGS)

    def add_to(self, frame: Frame) -> Frame:
        return frame


@pytest.mark.parametrize("window", [1, 4])
def test_frames_of_a_window_carry_numbers_of_any_size(window):
    config = Config(
        device=DEVICE,
        window=window,
        surface=SurfaceSettings(voxel_size=0.1),
        color=PropertySettings(voxel_size=0.1),
    )
    pipeline = uf.Pipeline(config, [Carried("time"), Carried("small")])
    for i in range(6):
        pipeline.step(frame_of(i, time=1.7e9 + 256 * i, small=1e-8))
    points = pipeline.extract_mesh().vertices
    time, small = (pipeline.properties[name].query(points) for name in ("time", "small"))
    np.testing.assert_allclose(time, 1.7e9 + 256 * 2.5, rtol=1e-6)
    np.testing.assert_allclose(small, 1e-8, rtol=FLOAT32)


@pytest.mark.parametrize("values", [[0, 1e-9, 1.0, 1e9], [1e12, 1.0, 1e-9, 0]])
def test_a_window_ends_where_sizes_do_not_go_together(values):
    """Each frame counts, whatever came before: the mean of all is that of the largest."""
    config = Config(device=DEVICE, window=4, surface=SurfaceSettings(voxel_size=0.1))
    pipeline = uf.Pipeline(config, [Carried("c")])
    alone = PropertyMap("c", 1, SETTINGS)
    for i, value in enumerate(values):
        frame = frame_of(i, c=value)
        pipeline.step(frame)
        alone.integrate(uf.preprocess(frame))
    points = pipeline.extract_mesh().vertices
    np.testing.assert_allclose(
        pipeline.properties["c"].query(points), max(values) / len(values), rtol=1e-3
    )
    np.testing.assert_allclose(alone.query(points), max(values) / len(values), rtol=1e-3)


def test_colour_that_is_no_longer_in_0_to_1_does_not_mix_with_bytes():
    """A float image "color" of great range, then frames with ordinary colour."""
    config = Config(device=DEVICE, window=4, color=PropertySettings(voxel_size=0.1))
    pipeline = uf.Pipeline(config)
    bright = frame_of(0).with_image("color", np.full((48, 64, 3), 2.0**18))
    for frame in (bright, frame_of(1), frame_of(2)):
        pipeline.step(frame)
    points = pipeline.extract_mesh().vertices
    expected = (2.0**18 + 2 * 128 / 255) / 3
    np.testing.assert_allclose(pipeline.maps["color"].query(points), expected, rtol=1e-3)


def test_a_window_of_large_values_is_taken_out_exactly():
    config = Config(device=DEVICE, window=2, surface=SurfaceSettings(voxel_size=0.1))
    pipeline = uf.Pipeline(config, [Carried("c")], keep=WindowStore())
    for i in range(4):
        pipeline.step(frame_of(i, c=1e12 if i < 2 else 3e12))
    pipeline.flush()
    pipeline.follower.move_to({1: None})
    pipeline.follower.finish()
    points = pipeline.extract_mesh().vertices
    np.testing.assert_allclose(pipeline.properties["c"].query(points), 1e12, rtol=1e-4)


def test_usual_values_are_summed_as_they_are():
    """So that maps of colour, infrared and masks stay what they were, to the bit."""
    assert {exponent_of(size) for size in (0.0, 1 / 255, 0.3, 1.0, 255.0, 4096.0, 65535.0)} == {0}
    assert exponent_of(1e38) > 0 > exponent_of(1e-38) >= -120


def test_the_largest_magnitude_leaves_out_what_is_no_number():
    assert largest_magnitude(np.float32([1, -3, 2])) == 3
    assert largest_magnitude(np.float32([np.nan, -3, np.inf])) == 3
    assert largest_magnitude(np.float32([np.nan])) == 0 == largest_magnitude(np.empty(0, "f4"))
