"""What a tracker says of earlier frames while it goes on: their poses now, and that they moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from walk import Listed, bare, black, first_frames

from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.files.trajectories import write_trajectory
from taichi_unifusion.tracking import Verdict, make_tracker, pose_graph
from taichi_unifusion.tracking.rgbd import RgbdTracker
from taichi_unifusion.tracking.sequence import track_sequence
from taichi_unifusion.types import Trajectory

SAME = 1e-9  # poses that are computed the same way, but for the order of products


@pytest.fixture(scope="module")
def walk():
    return first_frames(6)


def by_frame(poses):
    return dict(zip(poses.frames.tolist(), poses.T_world_camera, strict=True))


def check_against(result, poses):
    """Every frame's pose is that of the result."""
    now = by_frame(poses)
    assert list(now) == [frame.index for frame in result.frames]
    for frame in result.frames:
        if frame.T_world_camera is None:
            assert np.isnan(now[frame.index]).all()
        else:
            np.testing.assert_allclose(now[frame.index], frame.T_world_camera, atol=SAME)


@pytest.mark.parametrize("mode", ["given", "external", "internal", "rgbd"])
def test_every_tracker_says_where_frames_are_now(walk, mode, tmp_path):
    trajectory = None
    if mode == "external":
        trajectory = tmp_path / "poses.txt"
        numbers = np.arange(len(walk), dtype=float)
        poses = np.array([frame.T_world_camera for frame in walk])
        write_trajectory(trajectory, Trajectory(numbers, poses))
    tracker = make_tracker(mode, trajectory=trajectory)
    assert (
        len(tracker.current_poses().frames) == 0
        and len(tracker.current_poses().T_world_camera) == 0
    )
    frames = [*walk[:4], bare(black(walk[4])), walk[5]]
    for frame in frames:
        before = tracker.version
        tracked = tracker.track(replace(frame, timestamp=None))
        poses = tracker.current_poses()
        assert poses.version == tracker.version >= before
        now = poses.T_world_camera[-1]
        assert poses.frames[-1] == frame.index
        if tracked.T_world_camera is None:
            assert np.isnan(now).all() and not poses.posed[-1]
        else:
            np.testing.assert_allclose(now, tracked.T_world_camera, atol=SAME)
    result = tracker.finish()
    check_against(result, tracker.current_poses())


def test_frames_move_with_their_keyframe_when_a_loop_closes(monkeypatch):
    monkeypatch.setattr(pose_graph, "CONTRADICTION", 0.0)  # the least loop moves keyframes at once
    room = SyntheticRoom(frames=40, width=160, height=120)
    frames = [replace(room[i % 40], index=i) for i in range(44)]
    tracker = RgbdTracker()
    moved = 0
    for frame in frames:
        before, version = tracker.current_poses(), tracker.version
        tracker.track(bare(frame))
        now = tracker.current_poses()
        old = now.T_world_camera[: len(before.frames)]
        if tracker.version == version:  # nothing is said, nothing has moved
            np.testing.assert_allclose(old, before.T_world_camera, atol=SAME)
            continue
        moved += 1
        assert np.abs(old - before.T_world_camera).max() > SAME
        # rows of `keyframe` that were there before are still the same, but for the newest frame
        same = now.keyframe[: len(before.frames)]
        np.testing.assert_array_equal(same, before.keyframe)
        np.testing.assert_allclose(
            now.T_keyframe_camera[: len(before.frames)], before.T_keyframe_camera, atol=0
        )
    assert moved


def test_a_pose_can_be_withdrawn(walk):
    room = SyntheticRoom(frames=120, width=320, height=240)
    tracker = RgbdTracker()
    assert tracker.track(replace(room[60], index=0)).verdict is Verdict.TRACKED
    assert tracker.current_poses().posed.tolist() == [True] and tracker.version == 0
    tracker.track(walk[1])
    assert tracker.current_poses().posed.tolist() == [False, True] and tracker.version > 0
    check_against(
        track_sequence(Listed([replace(room[60], index=0), walk[1]]), RgbdTracker()),
        tracker.current_poses(),
    )
