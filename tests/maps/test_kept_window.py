"""Windows that are kept: taken out, they leave what the others make; put back, they are as if they
had always been there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_kinds import SMALL
from windows import CONFIG, contents, stepped, walk, with_value

from taichi_unifusion.errors import FileError
from taichi_unifusion.geometry.se3 import exp
from taichi_unifusion.maps.kept_cells import Levels
from taichi_unifusion.maps.settings import FeatureSettings, PropertySettings
from taichi_unifusion.maps.window_store import WindowStore
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.properties import SurfaceProperty

GROUPED = replace(CONFIG, property_map=PropertySettings(voxel_size=0.1, **SMALL))
INFORMATION = replace(CONFIG, surface=replace(CONFIG.surface, fusion="information"))
GREEN = SurfaceProperty("green", 1, lambda frame: frame.color[..., 1].astype(np.float32) / 255)
# [m, rad] to where a loop moves windows
ELSEWHERE = {
    1: exp(np.array([0.02, -0.01, 0.015, 0.01, 0.0, -0.02])),
    2: exp(np.array([0.05, 0.03, -0.02, 0.0, 0.03, 0.01])),
}
CYCLES = 50  # a thousand of them: benchmarks/loops.py --cycles 1000
KEPT = 0.02  # [voxels] that quantised averages move the surface by, at most


@pytest.fixture(scope="module")
def frames():
    """Three windows of four frames."""
    return walk(12)


def kept_run(frames, config=CONFIG, *properties, store=None) -> Pipeline:
    """A pipeline after these frames that keeps its windows."""
    pipeline = Pipeline(config, properties, keep=WindowStore() if store is None else store)
    for frame in frames:
        pipeline.step(frame)
    pipeline.flush()
    return pipeline


def home(pipeline: Pipeline) -> dict[int, np.ndarray]:
    """Where the windows of a pipeline were fused first."""
    return {n: kept.T_world_keyframe for n, kept in enumerate(pipeline.follower.store.windows)}


def moved(pipeline: Pipeline) -> dict[int, np.ndarray]:
    """Where they belong after a loop."""
    return {n: T @ home(pipeline)[n] for n, T in ELSEWHERE.items()}


def put(pipeline: Pipeline, places) -> Pipeline:
    """The pipeline after its windows were moved, and their views have voted."""
    pipeline.follower.move_to(places)
    pipeline.follower.work(np.inf)
    pipeline.follower.settle()
    return pipeline


def fused_at(pipeline: Pipeline, config, *properties) -> Pipeline:
    """Maps that are fused from nothing, of a pipeline's windows where these are now."""
    fresh = Pipeline(config, properties, keep=WindowStore())
    source = pipeline.follower.store
    for number in source.resident():
        fresh.follower.add(source[number], source.windows[number].place)
    fresh.follower.settle()
    return fresh


def test_keeping_windows_hardly_changes_a_map(frames):
    pipeline, usual = kept_run(frames), stepped(frames)
    points = usual.extract_mesh().vertices
    found, there = pipeline.surface.sdf(points)
    assert there.mean() > 0.99
    assert np.median(np.abs(found[there])) < KEPT * pipeline.surface.voxel_size
    color = [each.maps["color"].query(points) for each in (pipeline, usual)]
    np.testing.assert_allclose(color[0], color[1], atol=2 / 255)


def test_the_store_says_what_it_holds(frames):
    store = kept_run(frames).follower.store
    assert [kept.frames for kept in store.windows] == [tuple(range(n, n + 4)) for n in (1, 5, 9)]
    window = store[1]
    np.testing.assert_array_equal(window.T_world_keyframe, frames[4].T_world_camera)
    assert window.views.depth.shape == (4, 24, 32)
    np.testing.assert_allclose(window.views.meters[1], frames[5].depth[::2, ::2], atol=6e-4)
    assert store.nbytes < sum(store[n].nbytes for n in range(3))


@pytest.mark.parametrize("config", [CONFIG, INFORMATION], ids=["mean", "information"])
def test_windows_that_moved_are_as_if_fused_there_in_the_first_place(frames, config):
    pipeline = kept_run(frames, config)
    put(pipeline, moved(pipeline))
    assert contents(pipeline) == contents(fused_at(pipeline, config))
    assert contents(pipeline) != contents(kept_run(frames, config))


@pytest.mark.parametrize("alone", [False, True])
def test_in_the_end_windows_move_one_by_one_or_all_are_fused_anew(frames, alone):
    pipeline = kept_run(frames)
    pipeline.follower.move_to(moved(pipeline))
    done = pipeline.follower.finish(alone=alone)
    assert (done.moves, done.anew) == ((0, 3) if alone else (2, 0))
    assert contents(pipeline) == contents(fused_at(pipeline, CONFIG))


def test_a_false_loop_that_is_withdrawn_leaves_no_trace(frames):
    pipeline = kept_run(frames)
    pipeline.follower.settle()
    before = contents(pipeline)
    put(pipeline, moved(pipeline))
    assert contents(pipeline) != before
    put(pipeline, home(pipeline))
    assert contents(pipeline) == before


def test_a_window_without_a_pose_is_taken_out_and_may_come_back(frames):
    pipeline = kept_run(frames)
    before = contents(put(pipeline, {}))
    put(pipeline, {1: None})
    assert list(pipeline.follower.store.resident()) == [0, 2]
    assert contents(pipeline) == contents(fused_at(pipeline, CONFIG))
    assert contents(put(pipeline, {1: home(pipeline)[1]})) == before


def test_many_moves_leave_no_drift(frames):
    pipeline = kept_run(frames[:8])
    before = contents(put(pipeline, {}))
    there = home(pipeline)[1]
    for _ in range(CYCLES):
        for places in ({1: ELSEWHERE[1] @ there}, {1: there}):
            pipeline.follower.move_to(places)
            pipeline.follower.work(np.inf)
    pipeline.surface.grid.compact(least=1)
    assert contents(put(pipeline, {})) == before
    assert pipeline.surface.grid.empty == 0


def test_properties_that_share_an_encoding_follow(frames):
    pipeline = kept_run(frames, GROUPED, GREEN)
    assert ("color", "green") in pipeline.follower.store[1].cells
    put(pipeline, moved(pipeline))
    fresh = fused_at(pipeline, GROUPED, GREEN)
    assert contents(pipeline) == contents(fresh) and "green" in contents(fresh)


def test_a_property_with_holes_follows(frames):
    holed = [with_value(frame, holes=True) for frame in frames[:8]]
    x = SurfaceProperty("x", 1, lambda frame: frame.images["x"])
    pipeline = kept_run(holed, GROUPED, x)
    put(pipeline, {1: ELSEWHERE[1] @ home(pipeline)[1]})
    assert contents(pipeline) == contents(fused_at(pipeline, GROUPED, x))


class Fixed:
    """An encoder whose features tell the place in the image."""

    name, channels = "fixed", 16

    def encode(self, image):
        v, u = np.mgrid[0:6, 0:8].astype(np.float32)
        features = np.stack([np.sin((k + 1) * (u + 2 * v) / 9) for k in range(16)], axis=2)
        return features.astype(np.float32)


def test_features_follow(frames):
    """They are fused again in the end: so their rounding is that of a map that was fused there."""
    config = replace(CONFIG, feature_map=FeatureSettings(voxel_size=0.2))
    pipeline = Pipeline(config, keep=WindowStore())
    image = Fixed().encode(None)
    features = FeatureMapOf(pipeline, config)
    for frame in frames[:8]:
        pipeline.step(frame.with_features("features", image))
    pipeline.flush()
    put(pipeline, {1: ELSEWHERE[1] @ home(pipeline)[1]})
    fresh = Pipeline(config, keep=WindowStore())
    again = FeatureMapOf(fresh, config)
    source = pipeline.follower.store
    for number in source.resident():
        fresh.follower.add(source[number], source.windows[number].place)
    fresh.follower.settle()
    a, b = features.voxels(), again.voxels()
    assert len(a) > 50
    for name in ("keys", *a.fields):
        np.testing.assert_array_equal(a.tensors[name], b.tensors[name])


def FeatureMapOf(pipeline, config):
    """A map of features of 16 channels in a pipeline."""
    from taichi_unifusion.maps import FeatureMap

    pipeline.maps["features"] = made = FeatureMap("features", 16, config.feature_map)
    pipeline.groups = [*pipeline.groups]
    return made


def test_a_store_in_a_file_is_read_back_and_goes_on(frames, tmp_path):
    path = tmp_path / "windows.log"
    store = WindowStore(path)
    pipeline = kept_run(frames, store=store)
    put(pipeline, moved(pipeline))
    store.close()
    read = WindowStore.open(path)
    assert [kept.frames for kept in read.windows] == [kept.frames for kept in store.windows]
    np.testing.assert_array_equal(read.windows[2].place, pipeline.follower.store.windows[2].place)
    fresh = Pipeline(CONFIG, keep=WindowStore())
    for number in read.resident():
        fresh.follower.add(read[number], read.windows[number].place)
    fresh.follower.settle()
    assert contents(fresh) == contents(pipeline)
    size = path.stat().st_size
    with path.open(
        "r+b"
    ) as file:  # as after a power cut: the last window was not written to its end
        file.truncate(size - 5)
    again = WindowStore(path)
    assert len(again) == 3 and again.windows[2].place is not None
    again(read[0])
    again.close()
    assert len(WindowStore.open(path)) == 4


def test_a_changed_byte_of_a_store_is_found(frames, tmp_path):
    path = tmp_path / "windows.log"
    store = WindowStore(path)
    kept_run(frames[:4], store=store)
    store.close()
    whole = path.read_bytes()

    def changed(at: int):
        data = bytearray(whole)
        data[at] ^= 0xFF
        path.write_bytes(data)
        return WindowStore.open(path)

    with pytest.raises(FileError, match=r"windows\.log: not a file of records"):
        changed(3)
    assert len(changed(200)) == 0  # a header that does not fit its sum: as if it was not written
    with pytest.raises(FileError, match=r"windows\.log: damaged"):
        changed(-2000)[0]


def test_a_file_of_another_kind_is_no_store(tmp_path):
    path = tmp_path / "windows.log"
    path.write_bytes(b"something else altogether")
    with pytest.raises(FileError, match="not a file of records"):
        WindowStore.open(path)
    with pytest.raises(FileError, match="no such file|folder does not exist"):
        WindowStore.open(tmp_path / "none.log")


@pytest.mark.parametrize("high", [0.9, 1e9])
def test_values_are_kept_to_a_thousandth_of_a_percent(high):
    values = np.random.default_rng(0).uniform(-0.1, high, (500, 2)).astype(np.float32)
    assert np.abs(Levels.between(values).values - values).max() < 1e-5 * high
    colors = np.random.default_rng(0).uniform(0, 1, (500, 3)).astype(np.float32)
    assert np.abs(Levels.between(colors).values - colors).max() < 0.51 / 255
