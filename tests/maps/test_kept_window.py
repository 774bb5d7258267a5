"""Windows that are kept: what is taken out leaves what was there before, and can be put back."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_kinds import SMALL
from windows import CONFIG, contents, stepped, walk

from taichi_unifusion.maps import BaseMap
from taichi_unifusion.maps.kept_window import KeptWindow
from taichi_unifusion.maps.settings import PropertySettings
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.properties import SurfaceProperty

# relative: what is left is a difference of float32 numbers, and a voxel's weight may be a tenth
DIFFERENCE, WEIGHT = 5e-5, 1e-5
GROUPED = replace(CONFIG, property_map=PropertySettings(voxel_size=0.1, **SMALL))
GREEN = SurfaceProperty("green", 1, lambda frame: frame.color[..., 1].astype(np.float32) / 255)


@pytest.fixture(scope="module")
def frames():
    """Three windows of four frames."""
    return walk(12)


def kept_run(frames, config=CONFIG, *properties) -> tuple[Pipeline, list[KeptWindow]]:
    """A pipeline after these frames, and its windows."""
    kept: list[KeptWindow] = []
    pipeline = Pipeline(config, properties, keep=kept.append)
    for frame in frames:
        pipeline.step(frame)
    pipeline.flush()
    return pipeline, kept


def assert_left(found: BaseMap, wanted: BaseMap) -> None:
    """Same voxels, weights and latents up to rounding."""
    x, y = found.voxels(), wanted.voxels()
    np.testing.assert_array_equal(x.keys, y.keys)
    np.testing.assert_allclose(x.weights, y.weights, rtol=WEIGHT)
    np.testing.assert_allclose(x.latents, y.latents, atol=DIFFERENCE * np.abs(y.latents).max())


def test_keeping_windows_changes_nothing(frames):
    pipeline, kept = kept_run(frames)
    assert contents(pipeline) == contents(stepped(frames))
    assert [len(each.depth) for each in kept] == [4, 4, 4]
    assert all(each.nbytes > each.depth.nbytes for each in kept)
    np.testing.assert_array_equal(kept[1].T_world_keyframe, frames[4].T_world_camera)


@pytest.mark.parametrize("fusion", ["mean", "information"])
def test_the_last_window_taken_out_leaves_what_was_there_before(frames, fusion):
    config = replace(CONFIG, surface=replace(CONFIG.surface, fusion=fusion))
    pipeline, kept = kept_run(frames, config)
    before, after = stepped(frames[:8], config), len(pipeline.surface)
    pipeline.fusion.take_out(kept[2])
    for name, each in pipeline.maps.items():
        assert_left(each, before.maps[name])
    found, wanted = pipeline.surface.voxels(), before.surface.voxels()
    np.testing.assert_array_equal(found.evidence, wanted.evidence)
    np.testing.assert_array_equal(found.masks, wanted.masks)
    assert len(pipeline.surface) < after  # it had brought voxels


def test_a_window_in_the_middle_taken_out_leaves_the_others(frames):
    pipeline, kept = kept_run(frames)
    without = stepped([*frames[:4], *frames[8:]])
    pipeline.fusion.take_out(kept[1])
    for name, each in pipeline.maps.items():
        assert_left(each, without.maps[name])
    # the others voted while it was there
    found, wanted = (each.surface.voxels().evidence.astype(int) for each in (pipeline, without))
    assert np.abs(found - wanted).max() <= 8 and (found != wanted).mean() < 0.1


def test_a_window_that_is_put_back_is_as_if_it_had_stayed(frames):
    pipeline, kept = kept_run(frames)
    pipeline.fusion.take_out(kept[2])
    again = pipeline.fusion.put_back(kept[2])
    stayed = stepped(frames)
    for name, each in pipeline.maps.items():
        assert_left(each, stayed.maps[name])
    found, wanted = (each.surface.voxels().evidence for each in (pipeline, stayed))
    assert (found != wanted).mean() < 1e-3  # at thresholds
    pipeline.fusion.take_out(again)
    assert_left(pipeline.surface, stepped(frames[:8]).surface)


def test_properties_that_share_an_encoding_are_taken_out_of_each(frames):
    pipeline, kept = kept_run(frames[:8], GROUPED, GREEN)
    assert ("color", "green") in kept[1].cells
    before, _ = kept_run(frames[:4], GROUPED, GREEN)
    pipeline.fusion.take_out(kept[1])
    for name in ("surface", "color", "green"):
        assert_left(pipeline.maps[name], before.maps[name])
