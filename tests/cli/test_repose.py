"""One pass of tracking and mapping, and a finished map at other poses, from the command line."""

from __future__ import annotations

import json

import numpy as np
import pytest

from taichi_unifusion.cli.main import main
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.trajectories import read_trajectory, write_trajectory
from taichi_unifusion.geometry.se3 import exp
from taichi_unifusion.results.record import read_record
from taichi_unifusion.results.summary import describe_origin
from taichi_unifusion.types import Trajectory

RECORDING = ["--option", "frames=120", "--option", "width=240", "--option", "height=180"]
SMALL = ["--end", "12", "--voxel-size", "0.1", "--window", "4", "--device", "cpu"]
VOTES = 0.005  # [m] in the mean: all rays vote anew, now that all surface is there
SHIFTED = 0.02  # [m] windows that a turn moves off the lattice of their cells are averaged anew


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("one-pass") / "results"
    code = main(
        [
            "reconstruct",
            "synthetic",
            *RECORDING,
            *SMALL,
            "--tracking",
            "rgbd",
            "--tracking-passes",
            "1",
            "--out",
            str(folder),
        ]
    )
    assert code == 0
    return folder


def test_frames_are_tracked_and_mapped_in_one_pass(results):
    record = json.loads((results / "metrics.json").read_text())
    assert record["tracking"]["passes"] == 1 and record["frames"]["used"] == 12
    assert record["tracking"]["following"]["windows"] == 3
    assert "windows.log" in record["files"]
    assert len(read_trajectory(results / "tracking.txt")) == 12
    assert not list(results.glob(".*"))


def test_the_origin_is_said_as_it_is(results):
    first = read_trajectory(results / "trajectory.txt").T_world_camera[0]
    right, down, forwards = first[:3, :3].T
    np.testing.assert_allclose([right, forwards, -down], np.eye(3), atol=1e-6)
    np.testing.assert_allclose(first[:3, 3], 0, atol=1e-6)
    said = "x to its right, y forwards, z up if it was held level"
    assert describe_origin(read_record(results / "metrics.json")).endswith(said)


def test_a_map_moves_with_a_trajectory_without_its_images(results, tmp_path, capsys):
    T = exp(np.array([0.5, -0.2, 0.1, 0.0, 0.3, 0.1]))
    before = read_trajectory(results / "trajectory.txt")
    keyframes = slice(0, None, 5)  # the others move with the nearest
    new = Trajectory(before.timestamps[keyframes], T @ before.T_world_camera[keyframes])
    write_trajectory(tmp_path / "new.txt", new)
    old_mesh = read_mesh(results / "mesh.ply")
    out = tmp_path / "moved"
    assert (
        main(["repose", str(results), "--trajectory", str(tmp_path / "new.txt"), "--out", str(out)])
        == 0
    )
    said = capsys.readouterr().out
    assert "3 of 3 windows moved" in said and "3 of 12 frames" in said
    after = read_trajectory(out / "trajectory.txt").T_world_camera
    np.testing.assert_allclose(after, T @ before.T_world_camera, atol=1e-6)
    wanted, found = old_mesh.transformed(T).vertices, read_mesh(out / "mesh.ply").vertices
    np.testing.assert_allclose(found.mean(axis=0), wanted.mean(axis=0), atol=SHIFTED)
    np.testing.assert_allclose(found.std(axis=0), wanted.std(axis=0), atol=SHIFTED)
    was, record = (read_record(folder / "metrics.json") for folder in (results, out))
    assert describe_origin(record) == f"where the poses of {tmp_path / 'new.txt'} have it"
    height = (np.array(record.T_up_world) @ T)[2]  # above the floor, of the old world
    np.testing.assert_allclose(height, was.T_up_world[2], atol=1e-6)
    assert main(["repose", str(out), "--trajectory", str(results / "trajectory.txt")]) == 0
    back = read_mesh(out / "mesh.ply").vertices
    np.testing.assert_allclose(back.mean(axis=0), old_mesh.vertices.mean(axis=0), atol=VOTES)


def test_a_folder_without_windows_says_how_to_keep_them(tmp_path, capsys):
    (tmp_path / "t.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert main(["repose", str(tmp_path), "--trajectory", str(tmp_path / "t.txt")]) == 2
    said = capsys.readouterr().err
    assert "windows.log" in said and "--keep-windows" in said
