"""Maps of every kind in windows: properties that share an encoding, lack values, take single points,
features, or sums of all frames.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_kinds import SMALL
from windows import CONFIG, RUNS, SINGLE, assert_close, contents, seen_from, turned, walk

from taichi_unifusion import preprocess
from taichi_unifusion.config import Config
from taichi_unifusion.maps import FeatureMap, PropertyMap, SurfaceMap
from taichi_unifusion.maps.property_group import PropertyGroup
from taichi_unifusion.maps.settings import FeatureSettings, PropertySettings
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.properties import SurfaceProperty
from taichi_unifusion.properties.base import color_of

# relative: another width of the right side may be summed in another order
SAME = 2e-5
# relative: float32 sums of some frames in other parts, then a solve with noise 0.3
INFORMATION = 1e-4
WEIGHT = 1e-6  # relative: float32
SETTINGS = PropertySettings(voxel_size=0.1, **SMALL)
GROUPED = replace(CONFIG, property_map=SETTINGS)  # as the colours: one group


def green(frame) -> np.ndarray:
    return color_of(frame)[..., 1].astype(np.float32) / 255


def patchy(frame) -> np.ndarray:
    """Blue, but no number in a pattern, and in whole columns."""
    image = frame.color[..., 2].astype(np.float32) / 255
    image[::5, ::3], image[:, 20:24] = np.nan, np.nan
    return image


GREEN, PATCHY = SurfaceProperty("green", 1, green), SurfaceProperty("patchy", 1, patchy)


def run(frames, config: Config = GROUPED, *properties, encoder=None) -> Pipeline:
    pipeline = Pipeline(config, properties, encoder)
    for frame in frames:
        pipeline.step(frame)
    pipeline.flush()
    return pipeline


class Waves:
    """Features that are waves of the colours, at an eighth of the image's size."""

    name = "waves"

    def image_features(self, frame) -> np.ndarray:
        colors = frame.color[::8, ::8].astype(np.float32) / 255
        return np.concatenate([np.cos(k * colors) for k in (1, 2)], axis=2)


@pytest.fixture(scope="module")
def frames():
    """A window of four, and two frames more."""
    return walk(6)


def test_maps_of_a_group_are_as_if_each_were_alone(frames):
    """One whose values are not all numbers is encoded by itself."""
    together = run(frames, GROUPED, GREEN, PATCHY)
    (group,) = [group for group in together.groups if isinstance(group, PropertyGroup)]
    assert [each.name for each in group.maps] == ["color", "green", "patchy"]
    for alone in (GREEN, PATCHY):
        # other settings than the colours': in a group of its own
        apart = replace(alone, settings=replace(SETTINGS, blend=not SETTINGS.blend))
        other = run(frames, GROUPED, apart).maps[alone.name]
        assert_close(together.maps[alone.name], other, SAME)
    weights = {name: each.voxels().weights.sum() for name, each in together.maps.items()}
    assert (
        weights["green"] == weights["color"] and 0.8 < weights["patchy"] / weights["green"] < 0.95
    )


def test_a_window_of_one_frame_is_integrating_its_cloud_for_a_group():
    """With a pixel a point: a cloud has one count for all that a patch carries, also where some of
    its pixels have no number.
    """
    frames = [seen_from(turned(n), n) for n in range(3)]
    config = replace(
        SINGLE, property_map=SETTINGS, preprocess=replace(CONFIG.preprocess, patch_size=0)
    )
    pipeline = run(frames, config, GREEN, PATCHY)
    maps = {name: PropertyMap(name, 1, SETTINGS) for name in ("green", "patchy")}
    for frame in frames:
        frame = PATCHY.add_to(GREEN.add_to(frame))
        cloud = preprocess(frame, config.preprocess).transformed(frame.T_world_camera)
        for each in maps.values():
            each.integrate(cloud)
    for name, each in maps.items():
        assert_close(pipeline.maps[name], each, RUNS)
    assert np.isnan(cloud.attributes["patchy"]).any() and len(maps["patchy"]) > 200


def test_a_property_that_some_frames_lack_has_those_that_carry_it(frames):
    """Frames that carry something else are in another window."""
    some = SurfaceProperty("some", 1, green, settings=SETTINGS)
    colorless = replace(frames[2], color=None)
    pipeline = Pipeline(GROUPED, [some])
    lengths = []
    for frame in (frames[0], frames[1], colorless, frames[3], frames[4]):
        step = pipeline.step(frame)
        lengths.append(len(pipeline.fusion.window))
        assert ("some" in step.lacking) == ("some" not in step.integrations) == (frame is colorless)
    assert lengths == [1, 2, 1, 1, 2]
    others = Pipeline(GROUPED, [some])
    for frame in (frames[0], frames[1], frames[3], frames[4]):
        if frame is frames[3]:
            others.flush()
        others.step(frame)
    for name in ("some", "color"):
        assert contents(pipeline)[name] == contents(others)[name]
    assert pipeline.surface.voxels().weights.sum() > others.surface.voxels().weights.sum()


def test_maps_of_single_points_are_fused_at_once_whatever_the_window(frames):
    """As published; beside a map in cells, which waits."""
    points = replace(SETTINGS, sampling="points")
    config = replace(GROUPED, color=points)
    pipeline = Pipeline(config)
    for n, frame in enumerate(frames[:3]):
        done = pipeline.step(frame).integrations
        assert done["color"].total_voxels == len(pipeline.maps["color"].grid) > 0
        assert pipeline.maps["color"].waiting is None and len(pipeline.fusion.window) == n + 1
    single = run(frames[:3], replace(config, window=1))
    assert contents(pipeline)["color"] == contents(single)["color"]
    target = PropertyMap("color", 3, points)
    for frame in frames[:3]:
        cloud = preprocess(frame, replace(config.preprocess, patch_size=0.0))
        target.integrate(cloud.transformed(frame.T_world_camera))
    assert_close(pipeline.maps["color"], target, 0.0)


def test_a_surface_of_single_points_votes_with_every_frame():
    frames = [seen_from(turned(n), n) for n in range(3)]
    config = replace(CONFIG, surface=replace(CONFIG.surface, sampling="points"))
    pipeline, surface = run(frames, config), SurfaceMap(config.surface)
    for frame in frames:
        cloud = preprocess(frame, replace(config.preprocess, patch_size=0.0))
        surface.integrate(cloud.transformed(frame.T_world_camera))
    assert_close(pipeline.surface, surface, 0.0)
    np.testing.assert_array_equal(pipeline.surface.voxels().evidence, surface.voxels().evidence)


def test_features_are_fused_frame_by_frame_whatever_the_window(frames):
    settings = FeatureSettings(voxel_size=0.2)
    config = replace(GROUPED, feature_map=settings)
    windows, single = (
        run(frames, replace(config, window=size), encoder=Waves()) for size in (4, 1)
    )
    found, wanted = (each.maps["features"] for each in (windows, single))
    assert isinstance(found, FeatureMap) and len(found) > 50
    a, b = found.voxels().tensors, wanted.voxels().tensors
    assert a.keys() == b.keys()
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


def test_sums_of_all_frames_are_the_same_whatever_the_window(frames):
    """One regression over all frames is linear in what it sums: windows only part the sum. Frames
    from one place, whose colours differ: so each touches all voxels, and none has too few points.
    """
    config = replace(CONFIG, color=replace(SETTINGS, fusion="information"))
    still = [
        replace(frames[0], color=np.roll(frames[0].color, n, axis=1), index=n + 1) for n in range(6)
    ]
    target, *others = (
        run(still, replace(config, window=size)).maps["color"].voxels() for size in (4, 1, 6)
    )
    for other in others:
        for part in ("keys", "masks"):
            np.testing.assert_array_equal(getattr(target, part), getattr(other, part))
        # a cell's count is the square of its root
        np.testing.assert_allclose(target.weights, other.weights, rtol=WEIGHT)
        for part in ("sums", "latents"):
            x, y = getattr(target, part), getattr(other, part)
            np.testing.assert_allclose(x, y, atol=INFORMATION * np.abs(y).max())
    assert len(target) > 200
