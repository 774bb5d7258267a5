"""Poses of other programs: their files, their gaps, and how they are joined to frames."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from walk import Listed, bare, first_frames, verdicts

from taichi_unifusion.errors import DatasetError, InputError
from taichi_unifusion.files.trajectories import write_trajectory
from taichi_unifusion.geometry import se3
from taichi_unifusion.geometry.quaternions import rotation_to_quaternion
from taichi_unifusion.tracking import (
    TRACKERS,
    Mode,
    TrackedFrame,
    Verdict,
    check_poses,
    make_tracker,
    track,
)
from taichi_unifusion.tracking.external import gaps, interpolate
from taichi_unifusion.tracking.rgbd import RgbdTracker
from taichi_unifusion.tracking.sequence import track_sequence
from taichi_unifusion.tracking.trajectory_files import read_poses

CONSISTENT = 1e-9


@pytest.fixture(scope="module")
def walk():
    return first_frames(12)


def tum_line(stamp, T):
    return " ".join(
        map(
            repr,
            [
                float(stamp),
                *map(float, T[:3, 3]),
                *map(float, rotation_to_quaternion(T[None, :3, :3])[0]),
            ],
        )
    )


@pytest.mark.parametrize("kind", ["tum", "kitti", "replica", "scannet", "7scenes"])
def test_trajectories_of_other_programs(kind, walk, tmp_path):
    poses = [frame.T_world_camera for frame in walk]
    path = tmp_path / "poses"
    if kind == "tum":
        lines = [
            tum_line(frame.timestamp + 0.004, frame.T_world_camera) for frame in reversed(walk)
        ]
        path.write_text("\r\n".join(["# a comment", *lines]))
    elif kind in ("kitti", "replica"):
        np.savetxt(path, [pose[: 3 if kind == "kitti" else 4].ravel() for pose in poses])
    else:
        path.mkdir()
        for i, pose in enumerate(poses):
            np.savetxt(
                path / (f"{i}.txt" if kind == "scannet" else f"frame-{i:06d}.pose.txt"), pose
            )
    result = track_sequence(
        Listed([bare(frame) for frame in walk]), make_tracker("external", trajectory=path)
    )
    assert verdicts(result) == ["given"] * len(walk)
    np.testing.assert_allclose([f.T_world_camera for f in result.frames], poses, atol=1e-6)


@pytest.mark.parametrize("name", ["frame-{:06d}.depth.png", "{}.png", "depth{:06d}.png"])
def test_poses_of_a_folder_belong_to_the_numbers_in_names(name, walk, tmp_path):
    """A cut of a recording, or every fifth of its files: places in it are not the numbers."""
    for i, frame in enumerate(walk):
        np.savetxt(tmp_path / f"frame-{100 + i:06d}.pose.txt", frame.T_world_camera)
    kept = [
        replace(bare(frame), name="somewhere/" + name.format(100 + i))
        for i, frame in enumerate(walk)
    ][3::4]
    result = track_sequence(Listed(kept), make_tracker("external", trajectory=tmp_path))
    np.testing.assert_allclose(
        [f.T_world_camera for f in result.frames], [f.T_world_camera for f in walk[3::4]], atol=1e-6
    )


def test_our_own_trajectory_file_reads_back_without_time_stamps(walk, tmp_path):
    frames = [replace(frame, timestamp=None) for frame in walk[:6]]
    result = track_sequence(Listed(frames), RgbdTracker())
    write_trajectory(tmp_path / "trajectory.txt", result.trajectory)
    again = track_sequence(
        Listed(frames)[1::2], make_tracker("external", trajectory=tmp_path / "trajectory.txt")
    )
    assert [frame.index for frame in again.frames] == [1, 3, 5] and verdicts(again) == ["given"] * 3
    np.testing.assert_allclose(
        again.frames[1].T_world_camera, result.frames[3].T_world_camera, atol=1e-7
    )


def test_S3_gaps_are_named_and_filled_only_when_asked(walk, tmp_path, caplog):
    path = tmp_path / "poses.txt"
    path.write_text(
        "\n".join(
            tum_line(frame.timestamp, frame.T_world_camera) for frame in [*walk[:4], *walk[7:11]]
        )
    )
    plain = track_sequence(Listed(walk), make_tracker("external", trajectory=path))
    assert plain.details["gaps"] == ["4-6", "11"] and "3" not in plain.details["gaps"]
    assert any(
        "4 of 12 frames are not mapped (no pose): 4-6, 11" in record.message
        for record in caplog.records
    )
    filled = track_sequence(
        Listed(walk), make_tracker("external", trajectory=path, interpolate=True)
    )
    assert verdicts(filled)[4:7] == ["interpolated"] * 3 and filled.details["gaps"] == ["11"]
    moved = [
        se3.distance(filled.frames[i].T_world_camera, walk[i].T_world_camera)[0] for i in (4, 5, 6)
    ]
    assert max(moved) < 0.01


def test_long_gaps_are_never_filled(walk, tmp_path):
    path = tmp_path / "poses.txt"
    late = [
        replace(frame, timestamp=frame.timestamp + 10 * (i > 5)) for i, frame in enumerate(walk)
    ]
    path.write_text(
        "\n".join(tum_line(frame.timestamp, frame.T_world_camera) for frame in late[::3])
    )
    result = track_sequence(
        Listed([*late[:5], replace(late[5], timestamp=5.0)]),
        make_tracker("external", trajectory=path, interpolate=True),
    )
    assert result.frames[5].verdict is Verdict.MISSING and "away" in result.frames[5].message


def test_interpolation_is_constant_motion():
    T_a, T_b = (
        se3.exp(np.array([0, 0, 0, 0, 0, 0.2])),
        se3.exp(np.array([1.0, 0.5, 0, 0.1, 0, 0.6])),
    )
    np.testing.assert_allclose(interpolate(T_a, T_b, 0), T_a, atol=CONSISTENT)
    np.testing.assert_allclose(interpolate(T_a, T_b, 1), T_b, atol=CONSISTENT)
    half = interpolate(T_a, T_b, 0.5)
    np.testing.assert_allclose(half @ se3.inverse(T_a) @ half, T_b, atol=1e-8)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "holds no poses"),
        ("# nothing\n", "holds no poses"),
        ("1 2 3\n", "line 1: expected 8 columns"),
        ("0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n", "line 2"),
        ("x 0 0 0 0 0 0 1\n", "'x' is not a time stamp"),
        ("0 0 0 0 0 0 0 2\n", "quaternion's length is 2"),
        ("0 0 0 nan 0 0 0 1\n", "no usable pose"),
        (
            " ".join(["1"] * 12) + "\n1 0\n",
            "line 2: expected 12 columns (the first 3 rows of a 4x4 matrix), found 2",
        ),
        (" ".join(["1"] * 16), "no usable pose"),
    ],
)
def test_P7_bad_trajectories_are_one_clear_error(content, told, tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text(content)
    with pytest.raises(DatasetError, match="poses.txt") as caught:
        read_poses(path)
    assert told in str(caught.value)


@pytest.mark.parametrize("mode", ["external", "internal"])
def test_a_broken_pose_is_left_out_and_said(mode, walk, tmp_path, caplog):
    """Said when tracking starts and in the result, whoever reads the file."""
    path = tmp_path / "poses.txt"
    lines = [tum_line(frame.timestamp, frame.T_world_camera) for frame in walk[:3]]
    lines[1] = " ".join([*lines[1].split()[:-1], "1.32"])
    path.write_text("\n".join(lines))
    posed = track(Listed(walk[:3]), mode=mode, trajectory=path, interpolate=True)
    sentence = posed.tracking.details["warnings"][0]
    assert sentence.startswith(f"{path}: 1 of 3 poses left out (first: {path}, line 2: ")
    assert [record.message for record in caplog.records].count(sentence) == 1


def test_warnings_about_given_poses_outlive_them(walk, caplog):
    """The map gets other poses and cannot say what was odd about these."""

    class Odd(Listed):
        warnings = ("depth looks odd", "poses look odd")

        def without_poses(self):
            bare_ones = Listed([bare(frame) for frame in self.items])
            bare_ones.warnings = self.warnings[:1]
            return bare_ones

    posed = track(Odd(walk[:2]), mode="given")
    assert posed.tracking.details["warnings"] == ["poses look odd"]
    assert caplog.text.count("poses look odd") == 1
    assert posed.warnings == ("depth looks odd",)  # left for the map's run to say
    assert track(Odd(walk[:2]), mode="rgbd").tracking.details["warnings"] == []


def test_modes_are_the_trackers():
    assert get_args(Mode) == tuple(TRACKERS)


def test_modes_that_need_poses_refuse_a_recording_without(walk, tmp_path):
    frames = Listed([bare(frame) for frame in walk[:1]])
    frames.no_poses = "nowhere: no poses.txt"
    for mode in ("given", "internal"):
        with pytest.raises(DatasetError, match="no poses.txt, so the frames have no poses"):
            track(frames, mode=mode)
    for mode, trajectory in (("rgbd", None), ("external", tmp_path), ("internal", tmp_path)):
        check_poses(frames, mode, trajectory)


def test_a_trajectory_of_another_recording_is_an_error_with_both_ranges(walk, tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text(tum_line(1e6, np.eye(4)))
    with pytest.raises(DatasetError, match="none of its 1 poses belongs to a frame") as caught:
        track_sequence(Listed(walk), make_tracker("external", trajectory=path))
    assert "1e+06" in str(caught.value)


@pytest.mark.parametrize(
    ("mode", "options", "told"),
    [
        ("slam", {}, "choose one of given, external, internal, rgbd"),
        ("external", {}, "--trajectory"),
        ("rgbd", {"trajectory": "x"}, "which 'rgbd' does not read"),
        ("given", {"interpolate": True}, "--interpolate fills gaps"),
        ("external", {"trajectory": "nowhere"}, "no such file"),
    ],
)
def test_tracker_options_that_make_no_sense(mode, options, told):
    with pytest.raises((InputError, DatasetError), match=told):
        make_tracker(mode, **options)


def test_gaps_are_runs():
    poses = [None, np.eye(4), None, None, np.eye(4), None]
    assert gaps([TrackedFrame(i, Verdict.GIVEN, pose) for i, pose in enumerate(poses)]) == [
        "0",
        "2-3",
        "5",
    ]
