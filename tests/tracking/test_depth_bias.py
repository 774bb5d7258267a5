"""Depth that is wrong by its place in the image is found from views that overlap, and corrected."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from taichi_unifusion.geometry import se3
from taichi_unifusion.tracking import TrackingResult, TrackingSettings, track
from taichi_unifusion.tracking.depth_bias import LEAST_AMOUNT, DepthBias, amount, factors, terms
from taichi_unifusion.tracking.odometry import KeyframeOdometry
from taichi_unifusion.tracking.pyramid import build_pyramid, reduce_frame
from taichi_unifusion.tracking.registration import register
from taichi_unifusion.tracking.rgbd import RgbdTracker
from taichi_unifusion.tracking.sequence import PosedFrames, with_poses

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import tracking_scenes as scenes

RANGE = 0.1, 6.0  # [m]
LEFT = 0.6  # of the distortion after the first correction


@pytest.fixture(scope="module")
def frames():
    return scenes.loop(60, 160)[:16:2]


def found(frames) -> DepthBias:
    """What pairs of frames say, aligned from where they were."""
    bias, pyramids = DepthBias(), [build_pyramid(reduce_frame(frame, *RANGE)) for frame in frames]
    for i, frame in enumerate(frames):
        for k in range(max(0, i - 3), i):
            guess = se3.inverse(frames[k].T_world_camera) @ frame.T_world_camera
            T = register(pyramids[i], pyramids[k], guess).T_target_source
            bias.add(pyramids[i], pyramids[k], T)
    return bias


def test_a_distortion_is_found_by_pairs_and_nothing_where_there_is_none(frames):
    camera = frames[0].camera
    assert amount(camera, found(frames).likeliest) < LEAST_AMOUNT
    bias = found(scenes.distorted(frames))
    assert bias.surely() is None  # by so few pairs
    more = bias.likeliest
    assert amount(camera, more) > LEAST_AMOUNT
    v, u = np.mgrid[: camera.height, : camera.width]
    x, y = u / (camera.width - 1) * 2 - 1, v / (camera.height - 1) * 2 - 1
    true = 1 + 0.014 * (x * x + y * y - 1) + 0.006 * x  # as in `distorted`
    assert np.std(true * factors(camera, more)) < LEFT * np.std(true)


def test_the_amount_is_that_of_the_terms(frames):
    camera = frames[0].camera
    bias = np.array([0.01, 0.0, 0.02, -0.01, 0.0])
    v, u = np.mgrid[: camera.height, : camera.width]
    assert amount(camera, bias) == pytest.approx(np.std(terms(camera, u, v) @ bias), rel=0.15)
    assert abs(np.mean(terms(camera, u, v), axis=(0, 1))).max() < 1e-3


def test_frames_and_keyframes_are_corrected_alike(frames):
    tracker = RgbdTracker()
    odometry: KeyframeOdometry = tracker.odometry
    prepared = odometry.prepare(frames[0])
    odometry.add_keyframe(prepared, np.eye(4), None)
    bias = np.array([0.01, 0.0, 0.02, -0.01, 0.015])
    odometry.keyframes.correct(bias)
    odometry.bias.correct(bias)
    again, corrected = odometry.prepare(frames[0]), odometry.keyframes.items[0]
    both = (again.reduced.inverse > 0) & (corrected.reduced.inverse > 0)
    assert both.mean() > 0.9
    ratio = again.reduced.inverse[both] / corrected.reduced.inverse[both]
    assert np.abs(ratio - 1).max() < 1e-4
    np.testing.assert_allclose(again.features.points, corrected.features.points, rtol=2e-3)


def test_frames_are_mapped_as_they_were_tracked(frames):
    bias = np.array([0.01, 0.0, 0.02, -0.01, 0.015])
    recording = scenes.Listed(frames[:1])
    result = TrackingResult(
        with_poses(recording, {0: np.eye(4)}).tracking.frames,
        details={"depth_bias": bias.tolist()},
    )
    depth = PosedFrames(recording, result)[0].depth
    np.testing.assert_allclose(depth, frames[0].depth * factors(frames[0].camera, bias))


def test_what_is_found_is_said_once_or_corrected(frames, caplog, monkeypatch):
    """What pairs of keyframes say is made up."""
    bias = np.array([0.01, 0.0, 0.02, -0.01, 0.015])
    monkeypatch.setattr("taichi_unifusion.tracking.odometry.LEAST_PAIRS", 1)
    monkeypatch.setattr(DepthBias, "surely", lambda self: None if self.known.any() else bias)
    monkeypatch.setattr(DepthBias, "likeliest", np.zeros(5))
    details = {}
    for mode in ("off", "say", "correct"):
        caplog.clear()
        settings = TrackingSettings(depth_bias=mode, keyframe_distance=0.02)
        details[mode] = track(scenes.Listed(frames[:4]), settings, mode="rgbd").tracking.details
        said = [each for each in caplog.messages if "by its place in the image" in each]
        assert len(said) == (mode != "off")
        assert all(("seems to be off" in each) == (mode == "say") for each in said)
    assert details["correct"]["depth_bias"] == bias.tolist()
    assert "depth_bias" not in details["say"]
