"""`unifusion render`: videos and pictures of results, which read back as a recording."""

from __future__ import annotations

import os

import cv2
import numpy as np
import pytest
from colored_results import make_colored_results

from taichi_unifusion import open_dataset
from taichi_unifusion.cli import main as cli
from taichi_unifusion.files.trajectories import read_trajectory

SMALL = ["--size", "160x90", "--fps", "4"]


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    return make_colored_results(tmp_path_factory.mktemp("colored"))


def render(*words) -> int:
    return cli.main(["render", *map(str, words), *SMALL])


def test_a_folder_of_pictures_is_a_recording(results, tmp_path, capsys):
    out = tmp_path / "pictures"
    assert render(results.path, "--out", out, "--seconds", "1", "--depth", "--normals") == 0
    assert f"{out}: 4 pictures of 160x90" in capsys.readouterr().out
    assert sorted(os.listdir(out)) == ["camera.yaml", "color", "depth", "normals", "poses.txt"]
    frames = open_dataset("folder", out)
    assert len(frames) == 4 and frames.camera.size == (160, 90)
    for frame in frames:
        assert (frame.depth > 0).mean() > 0.3 and frame.color.std() > 5
        assert np.isclose(np.median(frame.depth[frame.depth > 0]), 2, atol=1.5)
    poses = np.stack([frame.T_world_camera for frame in frames])
    assert np.ptp(poses[:, :3, 3], axis=0).max() > 0.01
    normals = cv2.imread(str(out / "normals" / "000000.png")).astype(int)
    known = normals.any(axis=2)
    assert np.array_equal(known, frames[0].depth > 0)
    lengths = np.linalg.norm(2 * normals[known] / 255 - 1, axis=1)
    assert np.abs(np.median(lengths) - 1) < 0.02


def test_a_video_of_any_layer_and_of_an_answer(results, tmp_path, capsys):
    av = pytest.importorskip("av")

    def first_of(file):
        with av.open(str(file)) as container:
            return next(container.decode(video=0)).to_ndarray(format="rgb24").astype(int)

    shown = {}
    for layer in ("color", "saliency", "height"):
        file = tmp_path / f"{layer}.mp4"
        words = ["--path", "circle", "--layer", layer, "--seconds", "0.5"]
        assert render(results.path, "--out", file, *words) == 0
        shown[layer] = first_of(file)
    assert np.abs(shown["color"] - shown["height"]).mean() > 10
    assert np.abs(shown["color"] - shown["saliency"]).mean() > 10
    capsys.readouterr()
    file = tmp_path / "red.mp4"
    words = ["--query", "red", "--text", results.text, "--seconds", "0.5", "--path", "circle"]
    assert render(results.path, "--out", file, *words) == 0
    assert "red: " in capsys.readouterr().out
    assert np.abs(first_of(file) - shown["color"]).mean() > 5


def test_given_poses_and_two_results_side_by_side(results, tmp_path):
    out = tmp_path / "both"
    path = results.path / "trajectory.txt"
    assert render(results.path, results.path / "mesh.ply", "--out", out, "--path", path) == 0
    assert len(os.listdir(out / "color")) == len(read_trajectory(path))
    picture = cv2.imread(str(out / "color" / "000001.png"))
    left, right = picture[:, :74], picture[:, 86:160]
    assert (picture[:, 75:85] == 255).all() and np.array_equal(left, right)


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["--layer", "hight"], "did you mean 'height'?"),
        (["--path", "round"], "round: no such file; a path is trajectory or circle"),
        (["--size", "8x8"], "sides must be 16 to 8192 pixels"),
        (["--size", "big"], "size: expected WIDTHxHEIGHT"),
        (["--fps", "0"], "fps: must be above 0"),
        (["--seconds", "-1"], "seconds: must be above 0"),
        (["--samples", "9"], "samples: must be 1, 2 or 3"),
        (["--fov", "0"], "fov: must be between"),
        (["--up", "w"], "up: expected an axis"),
        (["--query", "red"], "give the text encoder"),
        (["--out", "x.gif"], "a video is written as .mp4"),
    ],
)
def test_what_cannot_be_rendered_is_told(results, tmp_path, capsys, words, told):
    out = [] if "--out" in words else ["--out", str(tmp_path / "out")]
    assert cli.main(["render", str(results.path), *out, *words]) == 2
    assert told in " ".join(capsys.readouterr().err.split())
    assert not (tmp_path / "out").exists()  # nor an empty folder


def test_no_results_are_told(tmp_path, capsys):
    assert render(tmp_path / "none", "--out", tmp_path / "out") == 2
    assert "none: no such file or folder" in capsys.readouterr().err
    assert cli.main(["render", "--out", str(tmp_path / "out")]) == 2
    assert "say what to show" in capsys.readouterr().err
