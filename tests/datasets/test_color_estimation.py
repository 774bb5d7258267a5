"""The colour camera that a recording tells of by itself: found where it is off, left alone where it
is not, refused where it explains nothing.
"""

from __future__ import annotations

import numpy as np
import pytest
from two_cameras import TwoCameras, rig_beside

from taichi_unifusion.datasets import estimate_color_camera
from taichi_unifusion.datasets.color_rig import PARAMETERS, Rig, residuals_of, shrunk
from taichi_unifusion.datasets.color_sightings import (
    MEMBERS,
    Sightings,
    choose_groups,
    find_sightings,
)
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.geometry import se3

CAMERA = SyntheticRoom(frames=1, width=160, height=120).camera
# what 60 noisy frames of 160x120 pixels leave open: a pixel is 0.4 degrees, 1.4 cm at 2 m
TURN, MOVE, FOCAL, CLOCK = 0.6, 0.02, 0.01, 0.004  # [degrees], [m], share, [s]
LINEAR = 0.1  # of a difference's spread: images are rounded to whole grey levels


@pytest.mark.parametrize(
    "truth",
    [
        {"turn": (0.5, -1.0, 1.0), "move": (0.025, 0, 0), "focal": 0.9},
        {"focal": 0.97, "offset": 0.02},
        {"turn": (2.0, 0, 0), "move": (0, 0.05, 0)},
    ],
    ids=["as a Kinect", "focal length and clock", "far off"],
)
def test_a_rig_is_found(truth):
    rig = rig_beside(CAMERA, **truth)
    recording = TwoCameras(rig, frames=50)
    estimate = estimate_color_camera(recording)
    found = estimate.camera
    assert found is not None and estimate.gain_db > 1 and estimate.frames > 10
    off = se3.log(se3.inverse(rig.T_color_depth) @ found.T_color_depth)
    assert np.degrees(np.abs(off[3:])).max() < TURN and np.abs(off[:3]).max() < MOVE
    assert abs(found.pinhole.fx / rig.pinhole.fx - 1) < FOCAL
    assert abs(found.clock_offset - rig.clock_offset) < CLOCK
    assert f"{estimate.gain_db:+.1f} dB on {estimate.frames} frames left out" in estimate.verdict


@pytest.mark.parametrize("noise", [True, False])
def test_colour_that_fits_is_left_alone(noise):
    estimate = estimate_color_camera(TwoCameras(rig_beside(CAMERA), frames=40, noise=noise))
    assert estimate.camera is None and estimate.verdict == "registered"


def test_what_is_registered_is_not_looked_at(monkeypatch):
    room = SyntheticRoom(frames=30)
    monkeypatch.setattr(SyntheticRoom, "load", None)
    assert estimate_color_camera(room).verdict == "registered by the recording itself"


class Shuffled(TwoCameras):
    """Its colour images belong to other frames: no camera explains them."""

    def color_of(self, index):
        return super().color_of((17 * index) % len(self))


def test_thinned_frames_are_said_to_be_thinned():
    """All of them tell what every fifth does not."""
    recording = TwoCameras(rig_beside(CAMERA, focal=0.9), frames=50)
    thinned = estimate_color_camera(recording[::5])
    assert thinned.camera is None and "10 frames, 5 apart in their recording" in thinned.verdict
    assert estimate_color_camera(recording[:50:1]).camera is not None


def test_an_answer_that_explains_nothing_is_refused():
    estimate = estimate_color_camera(Shuffled(rig_beside(CAMERA), frames=40))
    assert estimate.camera is None and estimate.verdict.startswith("left as recorded")


def test_frames_left_out_decide(monkeypatch):
    """The frames that are used agree on a rig which those left out contradict."""

    def sightings(recording):
        rigs = [TwoCameras(rig_beside(CAMERA, turn=(0, side, 0)), frames=25) for side in (-2, 2)]
        return [group for pair in zip(*map(find_sightings, rigs), strict=True) for group in pair]

    monkeypatch.setattr("taichi_unifusion.datasets.color_estimation.find_sightings", sightings)
    estimate = estimate_color_camera(TwoCameras(rig_beside(CAMERA), frames=2))
    assert estimate.camera is None and estimate.gain_db < 0
    assert "frames left out by -" in estimate.verdict


@pytest.mark.parametrize("what", ["few frames", "stands still", "no poses", "no colour", "grey"])
def test_too_little_tells_nothing(what):
    recording = TwoCameras(rig_beside(CAMERA, turn=(0, 2, 0)), frames=40)
    if what == "few frames":
        recording = recording[:9]
    elif what == "stands still":
        recording.told[:] = recording.told[0]
    elif what == "no poses":
        recording.pose_at = lambda index: (None, None)
    elif what == "no colour":
        recording.with_color = lambda frame, color, where: frame
    else:
        recording.color_of = lambda index: np.full((120, 160, 3), 128, np.uint8)
    estimate = estimate_color_camera(recording)
    assert estimate.camera is None
    assert estimate.verdict == "registered" if what == "grey" else "to tell" in estimate.verdict


def test_derivatives_are_those_of_the_residuals():
    """On images without detail, between whose pixels a line is right."""
    rng = np.random.default_rng(0)
    v, u = np.mgrid[:120, :160] / 40.0
    waves = [128 + 60 * np.sin(u + v + k) + 60 * np.cos(2 * u - v - k) for k in range(3)]
    points = rng.uniform((-0.6, -0.4, 1.0), (0.6, 0.4, 3.0), (3, 500, 3)).astype(np.float32)
    group = Sightings(
        CAMERA,
        tuple(np.dstack([wave] * 3).astype(np.uint8) for wave in waves),
        points,
        np.ones((3, 500), bool),
        rng.uniform(-0.5, 0.5, (3, 6)),
    )
    images = [shrunk(color, 2) for color in group.colors]
    rig = Rig(CAMERA, np.eye(3), np.zeros(3)).moved(np.full(PARAMETERS, 0.02))
    _, used, J = residuals_of(group, images, 2, rig, derivatives=True)
    for k, step in enumerate(np.diag([0.01] * 6 + [0.01, 0.01])):
        ahead, behind = (residuals_of(group, images, 2, rig.moved(s * step)) for s in (1, -1))
        slope, expected = (ahead[0] - behind[0]) / 2, J[..., k] * step[k]
        for frame in range(3):  # its median, the exposure, is taken out of residuals alone
            both = (used & ahead[1] & behind[1]).all(axis=0)
            wrong = (slope - expected)[frame][both]
            assert both.sum() > 300
            assert (wrong - np.median(wrong)).std() < LINEAR * expected[frame][both].std()


def test_groups_follow_the_motion():
    T = [np.eye(4) for _ in range(300)]
    for i, pose in enumerate(T):
        pose[0, 3] = 0.0101 * i
    groups = choose_groups(T)
    assert groups[0] == [0, 5, 10, 15, 20] and all(len(group) == MEMBERS for group in groups)
    assert len(choose_groups(T[:3])) == 0 and len(choose_groups([None] * 50)) == 0
    long = [se3.exp(np.array([0.1 * i, 0, 0, 0, 0, 0])) for i in range(5000)]
    assert len(choose_groups(long)) == 16 and choose_groups(long)[-1][-1] == 4999


def test_the_same_recording_gives_the_same_points():
    recording = TwoCameras(rig_beside(CAMERA), frames=40)
    once, again = (next(find_sightings(recording)) for _ in range(2))
    np.testing.assert_array_equal(once.points, again.points)
    np.testing.assert_array_equal(once.seen, again.seen)
