"""Frames that are tracked while they are mapped: windows that wait for their final poses, and runs that go on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tiny_recording import CONFIG

from taichi_unifusion.cli.following import following, settle
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.errors import FrameError
from taichi_unifusion.maps import follower
from taichi_unifusion.maps.window_store import WindowStore
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.tracking import make_tracker
from taichi_unifusion.tracking.online import OnlineFrames

ROOM = SyntheticRoom(frames=60, width=160, height=120)[:10]


def mapped(*, later: bool) -> tuple[Pipeline, int]:
    """The pipeline of a run in one pass, and how many voxels it had before poses were final."""
    pipeline = Pipeline(replace(CONFIG, window=3), keep=WindowStore())
    pipeline.follower.budget = 0.0
    tracker = make_tracker("rgbd")
    frames = OnlineFrames(ROOM, tracker, on_moved=following(pipeline), later=later)
    run = pipeline.run(frames)
    tracker.finish()
    voxels = len(pipeline.surface)
    settle(pipeline, run, tracker.current_poses())
    return pipeline, voxels


def test_windows_that_wait_give_the_map_of_windows_that_moved(monkeypatch):
    monkeypatch.setattr(follower, "LEAST_MOVE", 1e-6)  # all but the first move
    (waited, before), (moved, early) = mapped(later=True), mapped(later=False)
    assert before == 0 < early
    for name, each in moved.maps.items():
        ours = waited.maps[name].voxels()
        for part, values in each.voxels().tensors.items():
            np.testing.assert_array_equal(ours.tensors[part], values)
    one, other = waited.follower.summary(), moved.follower.summary()
    assert one.moved == other.moved >= 2 and one.anew == other.anew == len(waited.follower.store)


def test_a_window_that_belongs_about_where_it_was_tracked_lies_there_to_the_bit():
    waited, _ = mapped(later=True)
    assert waited.follower.summary().moved == 0
    assert all(kept.place is kept.T_world_keyframe for kept in waited.follower.store.windows)


@pytest.mark.parametrize("every", [1, 2])
def test_a_run_that_goes_on_is_handed_the_same_frames(every):
    def poses(done: int) -> list[np.ndarray]:
        frames = OnlineFrames(ROOM, make_tracker("rgbd"), every, done=done)
        return [load().T_world_camera for load in frames.arriving()]

    whole = poses(0)
    assert len(whole) == len(range(0, 10, every))
    for a, b in zip(whole[3:], poses(3), strict=True):
        assert np.array_equal(a, b)


def test_a_run_that_is_stopped_while_it_tracks_once_more_ends_at_once():
    tracker = make_tracker("rgbd")
    frames = OnlineFrames(ROOM, tracker, done=5, stop=lambda: True)
    assert len(list(frames.arriving())) == 1 and not len(tracker.current_poses().frames)
    with pytest.raises(FrameError):
        next(iter(OnlineFrames(Dark(), make_tracker("rgbd")).arriving()))()


class Dark(SyntheticRoom):
    """A recording whose first frame shows nothing."""

    def load(self, index: int):
        frame = super().load(index)
        return replace(frame, depth=0 * frame.depth)
