"""`unifusion reconstruct --tracking`: what a user without poses gets."""

from __future__ import annotations

import csv
import json
import shutil

import numpy as np
import pytest
from dataset_writers import make_samples, write_replica
from k4a_writer import write_k4a
from tiny_recording import FLAGS, write_folder

from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli.options import TrackingOptions
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.files.trajectories import read_trajectory, write_trajectory
from taichi_unifusion.geometry import se3
from taichi_unifusion.results import RunFolder
from taichi_unifusion.results.ownership import mark_unfinished
from taichi_unifusion.types import Trajectory

FEW = ["reconstruct", "synthetic", "--end", "3", *FLAGS]
NEAR = 0.01  # [m] of three frames of noisy depth


def written(out) -> tuple[dict, list[dict], np.ndarray]:
    """Metrics, rows of tracking.csv and poses of a results folder."""
    with open(out / "tracking.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    return (
        json.loads((out / "metrics.json").read_text()),
        rows,
        read_trajectory(out / "trajectory.txt").T_world_camera,
    )


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "rgbd"
    assert cli.main([*FEW, "--tracking", "rgbd", "--out", str(out)]) == 0
    return out


def test_frames_alone_give_poses_a_map_and_a_report(found):
    metrics, rows, poses = written(found)
    assert metrics["tracking"]["mode"] == "rgbd" and metrics["tracking"]["verdicts"] == {
        "tracked": 3
    }
    assert (
        metrics["frames"]["used"] == 3
        and metrics["mesh"]["triangles"] > 1000
        and "tracking.csv" in metrics["files"]
    )
    assert [row["verdict"] for row in rows] == ["tracked"] * 3
    truth = SyntheticRoom().T_world_camera[:3]
    ours, theirs = se3.inverse(poses[0]) @ poses, se3.inverse(truth[0]) @ truth
    assert np.abs(ours - theirs)[:, :3, 3].max() < NEAR


def test_a_summary_says_how_poses_were_found(capsys, tmp_path):
    assert cli.main([*FEW, "--tracking", "internal", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "tracking internal: 2 refined, 1 given" in said


def test_external_poses_and_a_gap(tmp_path, capsys):
    room = SyntheticRoom()
    write_trajectory(
        tmp_path / "slam.txt", Trajectory(np.array([0, 2 / 30]), room.T_world_camera[[0, 2]])
    )
    arguments = [*FEW, "--tracking", "external", "--trajectory", str(tmp_path / "slam.txt")]
    assert cli.main([*arguments, "--out", str(tmp_path / "plain")]) == 0
    metrics, rows, _ = written(tmp_path / "plain")
    assert (
        metrics["frames"]["used"] == 2
        and metrics["tracking"]["gaps"] == ["1"]
        and rows[1]["verdict"] == "no pose"
    )
    assert "1 of 3 frames are not mapped (no pose): 1" in capsys.readouterr().err
    assert cli.main([*arguments, "--interpolate", "--out", str(tmp_path / "filled")]) == 0
    metrics, rows, _ = written(tmp_path / "filled")
    assert metrics["frames"]["used"] == 3 and rows[1]["verdict"] == "interpolated"


def test_a_broken_pose_of_a_trajectory_is_said(tmp_path, capsys):
    path, room = tmp_path / "slam.txt", SyntheticRoom()
    write_trajectory(path, Trajectory(np.arange(3) / 30, room.T_world_camera[:3]))
    lines = path.read_text().splitlines()
    broken = len(lines) - 2
    lines[broken] = " ".join([*lines[broken].split()[:-1], "1.32"])
    path.write_text("\n".join(lines))
    arguments = ["--tracking", "external", "--trajectory", str(path), "--interpolate"]
    assert cli.main([*FEW, *arguments, "--out", str(tmp_path / "out")]) == 0
    sentence = f"{path}: 1 of 3 poses left out (first: {path}, line {broken + 1}: "
    assert sentence in capsys.readouterr().err
    metrics, rows, _ = written(tmp_path / "out")
    assert metrics["tracking"]["warnings"][0].startswith(sentence)
    assert [row["verdict"] for row in rows] == ["given", "interpolated", "given"]


def test_every_thins_the_map_and_not_the_tracking(tmp_path):
    assert cli.main([*FEW, "--every", "2", "--tracking", "rgbd", "--out", str(tmp_path)]) == 0
    metrics, rows, mapped = written(tmp_path)
    assert len(rows) == 3 and metrics["frames"]["used"] == len(mapped) == 2
    # all poses are kept
    np.testing.assert_allclose(
        read_trajectory(tmp_path / "tracking.txt").T_world_camera[::2], mapped
    )


def test_frames_left_out_are_compared_at_the_poses_found_where_a_recording_has_none(
    tmp_path, capsys
):
    folder = write_folder(tmp_path / "room", list(SyntheticRoom(width=160, height=120)[:3]))
    for poses in folder.glob("poses*"):
        shutil.rmtree(poses) if poses.is_dir() else poses.unlink()
    words = ["reconstruct", "folder", str(folder), "--every", "2", "--tracking", "rgbd"]
    assert cli.main([*words, "--out", str(tmp_path / "out"), *FLAGS]) == 0
    capsys.readouterr()
    assert cli.main(["evaluate", "rendering", str(tmp_path / "out"), "--json"]) == 0
    told = capsys.readouterr()
    score = json.loads(told.out)
    assert "errors of poses do not show" in told.err and score["used_by_the_run"] == []
    assert score["coverage"] > 0.5 and score["depth_l1_cm"] < 5
    (tmp_path / "out" / "tracking.csv").write_text("frame,timestamp\nx,y\n")
    assert cli.main(["evaluate", "rendering", str(tmp_path / "out")]) == 2
    assert "not a table of tracked frames" in capsys.readouterr().err


def test_results_of_tracking_do_not_outlive_it(found, tmp_path):
    earlier = RunFolder(tmp_path).tracking_files
    for file in earlier:
        file.write_text("of an earlier run")
    mark_unfinished(RunFolder(tmp_path), [file.name for file in earlier])
    assert cli.main([*FEW, "--out", str(tmp_path)]) == 0
    assert not any(file.exists() for file in earlier)


@pytest.mark.parametrize("mode", ["given", "internal"])
def test_S2_a_recording_without_poses_is_one_sentence_that_says_what_is_missing(
    mode, tmp_path, capsys
):
    folder = write_replica(tmp_path / "office", make_samples(2))
    (folder / "traj.txt").unlink()
    assert (
        cli.main(
            [
                "reconstruct",
                "replica",
                str(folder),
                "--tracking",
                mode,
                "--out",
                str(tmp_path / "out"),
            ]
        )
        == 2
    )
    said = capsys.readouterr().err.strip().splitlines()
    assert (
        len(said) == 1
        and f"{folder / 'traj.txt'}: no such file" in said[0]
        and "--tracking rgbd" in said[0]
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--tracking", "slam"], "rgbd"),
        (["--tracking", "external"], "external needs a trajectory file"),
        (["--tracking", "external", "--trajectory", "nowhere.txt"], "nowhere.txt: no such file"),
        (
            ["--trajectory", "x.txt"],
            "--trajectory names a trajectory file, which 'given' does not read",
        ),
        (["--tracking.window", "0"], "window >= 1"),
    ],
)
def test_V4_options_that_make_no_sense(options, told, tmp_path, capsys):
    assert cli.main([*FEW, *options, "--out", str(tmp_path / "out")]) == 2
    assert told in " ".join(capsys.readouterr().err.replace("│", " ").split())


def test_of_a_sensors_file_without_poses_they_are_found_from_the_frames(tmp_path, caplog):
    """Its format has no place for poses, so nothing is wrong there; of others their lack is told."""
    pytest.importorskip(
        "av", reason="recordings of an Azure Kinect are read with PyAV, extra 'k4a'"
    )
    file = write_k4a(tmp_path / "walk.mkv")
    recording = open_dataset("k4a", file)
    with caplog.at_level("INFO"):
        assert TrackingOptions().for_recording(recording).mode == "rgbd"
    assert "a sensor's file holds no poses" in caplog.text
    assert TrackingOptions().for_recording(recording[1:]).tracked
    assert TrackingOptions("given").for_recording(recording).mode == "given"
    assert TrackingOptions().for_recording(SyntheticRoom()).mode == "given"
    bare = recording.without_poses()
    assert bare.warnings == () and all(frame.T_world_camera is None for frame in bare)
    file.with_suffix(".txt").write_text("0.463 1 2 3 0 0 0 1\n")
    assert not TrackingOptions().for_recording(open_dataset("k4a", file)).tracked
