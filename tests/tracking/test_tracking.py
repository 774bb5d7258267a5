"""Trackers: poses from frames alone, refined or as given; what is lost is said, found again, and
never mapped.
"""

from __future__ import annotations

import csv
from dataclasses import replace

import numpy as np
import pytest
from tiny_recording import write_folder
from walk import Listed, bare, black, errors, first_frames, verdicts

from taichi_unifusion.config import Config
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.errors import FrameError, InputError, PoseError
from taichi_unifusion.geometry import se3
from taichi_unifusion.tracking import TrackedFrame, TrackingResult, TrackingSettings, Verdict
from taichi_unifusion.tracking.features import extract_features, locate, most_similar
from taichi_unifusion.tracking.given import GivenPoses
from taichi_unifusion.tracking.internal import InternalTracker
from taichi_unifusion.tracking.rgbd import RgbdTracker
from taichi_unifusion.tracking.sequence import PosedFrames, track_sequence, write_tracking
from taichi_unifusion.types import Trajectory

ATE = 0.005  # [m] of a noisy walk of 12 frames, 5 cm apart; 1 to 2 mm are usual
FOUND_AGAIN = 0.02  # [m] after relocalisation
CONSISTENT = 1e-9


@pytest.fixture(scope="module")
def walk():
    return first_frames(12)


@pytest.fixture(scope="module")
def tracked(walk):
    return track_sequence(Listed([bare(frame) for frame in walk]), RgbdTracker())


# --- From frames alone ----------------------------------------------------------------------------------------------


def test_rgbd_needs_no_poses(tracked, walk):
    assert verdicts(tracked) == ["tracked"] * len(walk)
    assert np.sqrt((errors(tracked, walk) ** 2).mean()) < ATE
    assert tracked.keyframes[0] == 0 and len(tracked.keyframes) > 2
    fits = [frame for frame in tracked.frames if frame.index]
    assert min(frame.fitness for frame in fits) > 0.5 and max(frame.rmse for frame in fits) < 0.02
    assert all(frame.keyframe in tracked.keyframes for frame in tracked.frames)


def test_rgbd_does_not_look_at_given_poses(tracked, walk):
    result = track_sequence(Listed(walk), RgbdTracker())
    for a, b in zip(tracked.frames, result.frames, strict=True):
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)


def test_the_world_of_the_first_camera_is_upright(tracked):
    up = -tracked.frames[0].T_world_camera[:3, 1]
    np.testing.assert_allclose(up, (0, 0, 1), atol=CONSISTENT)


def test_a_loop_is_found_and_taken_back():
    room = SyntheticRoom(frames=40, width=320, height=240)  # large steps: drift to take back
    frames = [room[i] for i in (*range(40), 0, 1)]
    frames = [replace(frame, index=i) for i, frame in enumerate(frames)]
    results = {
        loops: track_sequence(Listed(frames), RgbdTracker(TrackingSettings(loops=loops)))
        for loops in (True, False)
    }
    with_loops, without = (
        np.sqrt((errors(results[loops], frames) ** 2).mean()) for loops in (True, False)
    )
    assert results[True].loops and not results[False].loops
    assert with_loops < 0.01 and with_loops <= without


def test_F1_black_frames_are_lost_and_the_next_ones_go_on(walk):
    frames = [*walk[:5], black(walk[5]), black(walk[6]), *walk[7:]]
    result = track_sequence(Listed(frames), RgbdTracker())
    assert [i for i, frame in enumerate(result.frames) if frame.verdict is Verdict.LOST] == [5, 6]
    assert all(frame.T_world_camera is None for frame in result.frames[5:7])
    assert "usable depth" in result.frames[5].message
    assert errors(result, walk).max() < FOUND_AGAIN


def test_a_blank_wall_is_lost(walk):
    rng = np.random.default_rng(0)
    depth = (2 + rng.normal(0, 0.005, walk[0].depth.shape)).astype(np.float32)
    walls = [
        replace(frame, depth=depth, color=np.full_like(frame.color, 200)) for frame in walk[6:9]
    ]
    result = track_sequence(Listed([*walk[:6], *walls, *walk[9:]]), RgbdTracker())
    assert verdicts(result)[6:9] == ["lost"] * 3
    assert errors(result, walk).max() < FOUND_AGAIN


def test_S7_a_kidnapped_camera_is_said_and_found_again(walk):
    room = SyntheticRoom(frames=120, width=320, height=240)
    elsewhere = [replace(room[60 + i], index=6 + i) for i in range(3)]
    again = [replace(walk[i], index=i + 5) for i in (4, 5, 6, 7)]
    result = track_sequence(Listed([*walk[:6], *elsewhere, *again]), RgbdTracker())
    assert verdicts(result)[6:9] == ["lost"] * 3
    assert all(frame.T_world_camera is None for frame in result.frames[6:9])
    back = [(frame, walk[frame.index - 5]) for frame in result.frames[9:]]
    first = result.frames[0].T_world_camera, walk[0].T_world_camera
    for frame, truth in back:
        ours = se3.inverse(first[0]) @ frame.T_world_camera
        assert se3.distance(ours, se3.inverse(first[1]) @ truth.T_world_camera)[0] < FOUND_AGAIN


def test_a_first_frame_that_nothing_fits_is_left(walk):
    room = SyntheticRoom(frames=120, width=320, height=240)
    stray = replace(room[60], index=0)
    result = track_sequence(Listed([stray, *walk[1:6]]), RgbdTracker())
    assert (
        verdicts(result) == ["lost"] + ["tracked"] * 5 and result.frames[0].T_world_camera is None
    )
    assert errors(result, walk).max() < ATE


def test_nothing_but_bad_frames_is_no_crash(walk):
    result = track_sequence(
        Listed([black(walk[0]), FrameError("1.png: truncated"), black(walk[2])]), RgbdTracker()
    )
    assert verdicts(result) == ["lost", "unreadable", "lost"] and len(result.trajectory) == 0


def test_frames_without_colour_are_tracked_by_geometry(walk):
    result = track_sequence(
        Listed([replace(frame, color=None) for frame in walk[:6]]), RgbdTracker()
    )
    assert errors(result, walk).max() < 2 * ATE


def test_some_frames_without_colour_do_no_harm(walk):
    frames = [replace(frame, color=None) if i % 2 else frame for i, frame in enumerate(walk[:8])]
    result = track_sequence(Listed(frames), RgbdTracker())
    assert verdicts(result) == ["tracked"] * 8 and errors(result, walk).max() < 2 * ATE


@pytest.mark.parametrize("loop", [120, 24])
def test_small_images_are_tracked_at_small_and_large_steps(loop):
    # steps of 4 cm and 3 degrees; 21 cm and 13 degrees
    room = SyntheticRoom(frames=loop, width=160, height=120)
    frames = [room[i] for i in range(8)]
    result = track_sequence(Listed([bare(frame) for frame in frames]), RgbdTracker())
    assert verdicts(result) == ["tracked"] * 8 and errors(result, frames).max() < 2 * ATE


def test_a_stop_keeps_what_was_tracked(walk):
    seen = []
    result = track_sequence(
        Listed(walk),
        RgbdTracker(),
        stop=lambda: len(seen) == 3,
        on_frame=lambda *done: seen.append(done),
    )
    assert result.interrupted and len(result.frames) == 3 and seen[-1] == (3, 12)


# --- Features -------------------------------------------------------------------------------------------------------


def test_features_recognise_a_place_and_say_where_it_is(walk):
    room = SyntheticRoom(frames=120, width=320, height=240)
    features = [
        extract_features(frame, 0.3, 6.0) for frame in (walk[0], room[40], room[80], walk[3])
    ]
    assert most_similar(features[3], features[:3], 1) == [0]
    found = locate(features[3], features[0])
    distance, angle = se3.distance(
        found, se3.inverse(walk[0].T_world_camera) @ walk[3].T_world_camera
    )
    assert distance < 0.15 and np.degrees(angle) < 6  # where alignment takes over
    assert locate(features[1], features[0]) is None


def test_features_of_a_small_image_say_the_same():
    room = SyntheticRoom(frames=120, width=160, height=120)
    first, second = (extract_features(room[i], 0.3, 6.0) for i in (0, 3))
    distance, angle = se3.distance(
        locate(second, first), se3.inverse(room[0].T_world_camera) @ room[3].T_world_camera
    )
    assert distance < 0.15 and np.degrees(angle) < 6
    seen = first.camera.project(first.points)
    np.testing.assert_allclose(seen, first.pixels, atol=1e-3)


def test_features_of_a_frame_without_colour_or_texture_are_none(walk):
    assert len(extract_features(replace(walk[0], color=None), 0.3, 6.0)) == 0
    assert len(extract_features(black(walk[0]), 0.3, 6.0)) == 0
    assert most_similar(extract_features(black(walk[0]), 0.3, 6.0), [], 3) == []


# --- Refined --------------------------------------------------------------------------------------------------------


def disturbed(frames, millimetres: float, degrees: float, seed: int = 1):
    """The frames with poses that are off by about so much each."""
    rng = np.random.default_rng(seed)
    scale = np.repeat([millimetres / 1e3, np.radians(degrees)], 3) / np.sqrt(3)
    return [
        replace(frame, T_world_camera=frame.T_world_camera @ se3.exp(scale * rng.normal(size=6)))
        for frame in frames
    ]


def test_internal_tracking_refines_coarse_poses(walk):
    coarse = disturbed(walk, 15, 0.7)
    result = track_sequence(Listed(coarse), InternalTracker(GivenPoses()))
    assert verdicts(result)[1:] == ["refined"] * (len(walk) - 1)

    def roughness(poses):  # of the motion from frame to frame: what a surface suffers from
        truth = [frame.T_world_camera for frame in walk]
        return np.median(
            [
                se3.distance(
                    se3.inverse(poses[i]) @ poses[i + 1], se3.inverse(truth[i]) @ truth[i + 1]
                )[0]
                for i in range(len(walk) - 1)
            ]
        )

    before, after = (
        roughness([f.T_world_camera for f in coarse]),
        roughness([f.T_world_camera for f in result.frames]),
    )
    assert after < before / 3
    moved = [
        se3.distance(f.T_world_camera, g.T_world_camera)[0]
        for f, g in zip(result.frames, walk, strict=True)
    ]
    assert max(moved) < 0.03  # the whole stays where it was given


def test_internal_tracking_leaves_good_poses_good(walk):
    result = track_sequence(Listed(walk), InternalTracker(GivenPoses()))
    moved = [
        se3.distance(f.T_world_camera, g.T_world_camera)[0]
        for f, g in zip(result.frames, walk, strict=True)
    ]
    assert max(moved) < ATE


def test_a_refinement_that_strays_keeps_the_prior_and_says_so(walk):
    frames = [*walk[:5], *disturbed(walk[5:6], 300, 0.0), *walk[6:]]
    result = track_sequence(Listed(frames), InternalTracker(GivenPoses()))
    assert result.frames[5].verdict is Verdict.PRIOR_KEPT and result.frames[5].message
    black_one = track_sequence(Listed([*walk[:5], black(walk[5])]), InternalTracker(GivenPoses()))
    assert black_one.frames[5].verdict is Verdict.PRIOR_KEPT
    assert se3.distance(black_one.frames[5].T_world_camera, walk[5].T_world_camera)[0] < ATE


def test_internal_tracking_without_a_pose_has_none(walk):
    result = track_sequence(
        Listed([*walk[:3], bare(walk[3]), *walk[4:6]]), InternalTracker(GivenPoses())
    )
    assert verdicts(result)[3] == "no pose" and result.frames[3].T_world_camera is None


# --- Into the map ---------------------------------------------------------------------------------------------------


def test_posed_frames_carry_the_poses_found_and_refuse_the_rest(tracked, walk):
    lost = replace(
        tracked.frames[2], verdict=Verdict.LOST, T_world_camera=None, message="for the test"
    )
    frames = PosedFrames(
        Listed(walk), replace(tracked, frames=(*tracked.frames[:2], lost, *tracked.frames[3:]))
    )
    np.testing.assert_array_equal(frames[1].T_world_camera, tracked.frames[1].T_world_camera)
    with pytest.raises(PoseError, match="lost, for the test"):
        frames[2]
    assert len(frames[::2]) == 6


def test_broken_poses_of_a_recording_do_not_matter_to_rgbd(walk, tmp_path):
    folder = write_folder(tmp_path / "recording", walk[:4])
    (folder / "poses" / "2.txt").write_text("-inf " * 16)
    recording = open_dataset("folder", folder)
    with pytest.raises(PoseError):
        recording[2]
    assert (
        recording.without_poses()[2].T_world_camera is None
        and len(recording[1:].without_poses()) == 3
    )
    result = track_sequence(recording, RgbdTracker())
    assert verdicts(result) == ["tracked"] * 4
    assert PosedFrames(recording, result)[2].T_world_camera is not None
    given = track_sequence(recording, GivenPoses())
    assert verdicts(given) == ["given", "given", "no pose", "given"]


def test_tracking_csv_has_a_row_for_every_frame(tracked, tmp_path):
    write_tracking(tmp_path / "tracking.csv", tracked)
    with open(tmp_path / "tracking.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [int(row["frame"]) for row in rows] == list(range(12)) and {
        row["verdict"] for row in rows
    } == {"tracked"}
    assert (
        rows[0]["fitness"] == ""
        and 0 < float(rows[1]["fitness"]) <= 1
        and float(rows[1]["rmse_m"]) < 0.02
    )


@pytest.mark.parametrize(
    "change",
    [
        {"window": 0},
        {"keyframe_distance": 0.0},
        {"keyframe_fitness": 1.0},
        {"depth_max": 0.0},
        {"photometric_weight": -1.0},
        {"prior_angle": float("nan")},
    ],
)
def test_settings_that_make_no_sense(change):
    with pytest.raises(InputError, match="tracking"):
        TrackingSettings(**change)


def test_the_configuration_holds_the_settings():
    assert Config().tracking == TrackingSettings()


def test_trajectory_takes_frame_numbers_where_there_are_no_stamps():
    frames = tuple(TrackedFrame(i, Verdict.GIVEN, None if i == 1 else np.eye(4)) for i in range(3))
    trajectory = TrackingResult(frames).trajectory
    assert isinstance(trajectory, Trajectory) and trajectory.timestamps.tolist() == [0, 2]


def test_real_handheld_frames_in_TUM_format(data):
    frames = open_dataset("tum", data("tum-fr1desk9"))
    result = track_sequence(frames, RgbdTracker())
    truth = {i: frames[i] for i in range(len(frames))}
    assert set(verdicts(result)) == {"tracked"}
    # of 11 cm of motion; a rolling shutter, lens distortion ignored
    assert errors(result, truth).max() < 0.02
