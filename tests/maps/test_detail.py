"""Voxel sizes by what frames see: rooms keep theirs, a table gets smaller ones, words count more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import DEVICE

from taichi_unifusion import Config, Frame, PinholeCamera, Pipeline
from taichi_unifusion.errors import InputError
from taichi_unifusion.maps.detail import ROOM, STEPS, choose_voxel_size, sight_of
from taichi_unifusion.maps.settings import PropertySettings, SurfaceSettings
from taichi_unifusion.properties import make_property

CAMERA = PinholeCamera(64, 48, 57.5, 57.5, 31.5, 23.5)
KINECT = PinholeCamera(640, 480, 575.0, 575.0, 319.5, 239.5)


def wall(distance: float, camera: PinholeCamera = KINECT, index: int = 0) -> Frame:
    depth = np.full((camera.height, camera.width), distance, np.float32)
    color = np.full((camera.height, camera.width, 3), 128, np.uint8)
    return Frame(depth, camera, color, np.eye(4), index)


@pytest.mark.parametrize("distance", [1.3, 1.6, 2.0, 3.1, 4.9])
def test_a_room_keeps_its_sizes(distance):
    config = Config().settled([wall(distance)])
    assert (config.surface.voxel_size, config.color.voxel_size) == (0.05, 0.025)
    assert config.feature_map.voxel_size == 0.1 and config.scale == 1


@pytest.mark.parametrize(
    ("distance", "size"), [(0.2, 0.005), (0.4, 0.01), (0.65, 0.02), (1.1, 0.04)]
)
def test_what_is_near_gets_small_voxels(distance, size):
    config = Config().settled([wall(distance)])
    assert (config.surface.voxel_size, config.color.voxel_size) == (size, size / 2)


def test_sizes_grow_with_distance_and_are_few():
    sizes = [choose_voxel_size(sight_of([wall(z)], 0.1, 5)) for z in np.linspace(0.15, 5, 60)]
    assert sizes == sorted(sizes) and set(sizes) <= set(STEPS)


@pytest.mark.parametrize(
    ("distance", "width", "size"),
    [(8.4, 640, 0.1), (8.4, 320, 0.1), (8.4, 160, 0.2), (14.0, 640, 0.15), (4.9, 160, 0.05)],
)
def test_voxels_of_a_hall_span_some_pixels_and_those_of_a_room_stay(distance, width, size):
    f = 575 / 640 * width
    camera = PinholeCamera(width, width * 3 // 4, f, f, width / 2 - 0.5, width * 3 / 8 - 0.5)
    assert choose_voxel_size(sight_of([wall(distance, camera)], 0.1, 20)) == size


def test_coarse_pixels_take_larger_voxels():
    assert choose_voxel_size(sight_of([wall(0.4, CAMERA)], 0.1, 5)) == ROOM


def test_the_middle_of_the_frames_decides_and_those_without_readings_do_not_count():
    frames = [wall(0.4), wall(0.41), wall(3.0), wall(0.0), wall(np.nan), wall(9.0)]
    sight = sight_of(frames, 0.1, 5.0)
    assert sight is not None and sight.depth == pytest.approx(0.41)
    assert sight_of(frames[3:], 0.1, 5.0) is None
    assert Config().settled(frames[3:]).voxel_size == ROOM


def test_words_choose_other_sizes_and_sizes_count_more():
    near = [wall(0.4)]
    assert Config(detail="fine").settled(near).surface.voxel_size == 0.005
    assert Config(detail="coarse").settled([wall(2.0)]).surface.voxel_size == 0.1
    config = Config(voxel_size=0.03, detail="fine").settled(near)
    assert (config.surface.voxel_size, config.color.voxel_size) == (0.03, 0.015)
    mine = Config(surface=SurfaceSettings(voxel_size=0.05)).settled(near)
    assert (mine.surface.voxel_size, mine.color.voxel_size) == (0.05, 0.005)
    assert config.settled([wall(3.0)]) == config  # settled once and for all


@pytest.mark.parametrize("wrong", [{"detail": "finest"}, {"voxel_size": -1.0}, {"voxel_size": 1e3}])
def test_what_does_not_fit_is_told(wrong):
    with pytest.raises(InputError, match=next(iter(wrong))):
        Config(**wrong)


@pytest.mark.parametrize(
    ("name", "size"),
    [("saliency", 0.1), ("style=sketch", 0.02), ("infrared", 0.02), ("normal", 0.05)],
)
def test_properties_have_sizes_of_their_own(name, size):
    none, given = PropertySettings(), PropertySettings(voxel_size=0.07)
    made = make_property(name)
    assert made.with_settings(none).settings.voxel_size == size
    assert made.with_settings(none, 0.2).settings.voxel_size == pytest.approx(0.2 * size)
    assert make_property(name, given).with_settings(none).settings.voxel_size == 0.07
    said = make_property(f"{name},voxel_size=0.03", given)
    assert said.with_settings(given, 0.2).settings.voxel_size == 0.03


def test_the_pipeline_makes_its_maps_with_the_first_frame_that_shows_something():
    config = Config(device=DEVICE, window=1, voxel_size=0.0)
    pipeline = Pipeline(config)
    assert not pipeline.settle([wall(0.0, CAMERA)])
    frame = replace(wall(0.4), camera=KINECT)
    assert pipeline.settle([frame])
    assert (pipeline.surface.voxel_size, pipeline.properties["color"].voxel_size) == (0.01, 0.005)
    assert pipeline.config.surface.voxel_size == 0.01 and pipeline.config.voxel_size == 0.01
    assert pipeline.settle([wall(3.0)]) and pipeline.surface.voxel_size == 0.01
    assert Pipeline(config).surface.voxel_size == 0.05  # nothing seen: a room
