"""A camera that is lost and goes on elsewhere: a second map begins, and joins the first where they
surely overlap.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from places import DEVICE
from scipy.spatial import cKDTree
from walk import Listed, bare, black, errors, verdicts

from taichi_unifusion.cli.following import following, settle
from taichi_unifusion.config import Config
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.maps.window_store import WindowStore
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.tracking import Verdict
from taichi_unifusion.tracking.online import OnlineFrames
from taichi_unifusion.tracking.rgbd import RgbdTracker

NEAR = 0.01  # [m] 4 mm are usual
DARK = 6  # frames


def blackout(*parts: range) -> list:
    """Frames of a loop through the room, with some that show nothing between the parts."""
    room = SyntheticRoom(frames=120, width=240, height=180)
    frames = []
    for part in parts:
        frames += [black(room[0])] * DARK * bool(frames) + [room[i] for i in part]
    return [replace(frame, index=i) for i, frame in enumerate(frames)]


class Walk(Listed):
    """Frames in memory, which have no poses if these are not wanted."""

    def without_poses(self):
        return Listed([bare(frame) for frame in self.items])


def tracked(frames):
    tracker = RgbdTracker()
    return tracker, [tracker.track(bare(frame)) for frame in frames]


@pytest.fixture(scope="module")
def meets():
    """Elsewhere after it was dark, then back to where it was."""
    frames = blackout(range(8), range(30, 3, -1))
    return frames, *tracked(frames)


def test_what_was_seen_after_the_camera_was_lost_joins(meets):
    frames, tracker, said = meets
    result = tracker.finish()
    assert errors(result, frames).max() < NEAR
    apart = [f.index for f in said if f.verdict is Verdict.APART]
    assert len(apart) > 5 and all(said[i].T_world_camera is None for i in apart)
    # what was apart then has its pose now, but for few frames right after it was dark
    assert all(result.frames[i].verdict is Verdict.TRACKED for i in apart)
    assert verdicts(result)[8 + DARK :].count("tracked") >= 20
    assert tracker.current_poses().joined.all()


def test_the_map_of_one_pass_holds_what_was_apart(meets):
    """Windows of the second map are kept, and fused when it joins."""
    frames, _, _ = meets
    config = Config(device=DEVICE, voxel_size=0.1, window=4)
    pipeline = Pipeline(config, keep=WindowStore())
    tracker = RgbdTracker(T_world_first=frames[0].T_world_camera)
    run = pipeline.run(OnlineFrames(Walk(frames), tracker, on_moved=following(pipeline)))
    tracker.finish()
    run = settle(pipeline, run, tracker.current_poses())
    assert all(kept.place is not None for kept in pipeline.follower.store.windows)
    used = {step.index for step in run.steps}
    assert len(used) + len(run.skipped) == len(frames) and len(used) >= 8 + 20
    direct = Pipeline(config)
    direct.run([frames[i] for i in sorted(used)])
    ours, theirs = (cKDTree(each.extract_mesh().vertices) for each in (pipeline, direct))
    for a, b in ((ours, theirs), (theirs, ours)):
        assert np.mean(a.query(b.data)[0] < 0.02) > 0.97


def test_poses_of_the_second_map_are_guesses_of_its_own_world(meets):
    frames, _, said = meets
    apart = [f for f in said if f.verdict is Verdict.APART]
    a, b = apart[0], apart[-1]
    there = np.linalg.inv(frames[a.index].T_world_camera) @ frames[b.index].T_world_camera
    ours = np.linalg.inv(a.T_apart_camera) @ b.T_apart_camera
    np.testing.assert_allclose(ours, there, atol=NEAR)


def test_a_second_map_that_never_meets_the_first_stays_apart():
    frames = blackout(range(6), range(60, 70))
    tracker, said = tracked(frames)
    result = tracker.finish()
    poses = tracker.current_poses()
    later = result.frames[6 + DARK + 3 :]
    assert {frame.verdict for frame in later} == {Verdict.APART}
    assert all(f.T_world_camera is None and "never surely met" in f.message for f in later)
    assert not poses.joined.all() and not poses.posed[6 + DARK :].any()
    assert result.details["islands"] == 1
    assert said[-1].T_apart_camera is not None


def test_a_camera_that_comes_back_to_where_it_was_needs_no_second_map():
    frames = blackout(range(8), range(7, 2, -1))
    tracker, _ = tracked(frames)
    result = tracker.finish()
    assert verdicts(result)[8 + DARK] in ("tracked", "relocalised")
    assert "islands" not in result.details
    assert errors(result, frames).max() < NEAR
