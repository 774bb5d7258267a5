"""`--color-camera`: colour is registered without being told, the run keeps how, evaluation does it too."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from tiny_recording import FLAGS, write_folder
from two_cameras import TwoCameras, rig_beside

from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli.color_camera import found_color, given_color
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.color_camera import read_color_camera, write_color_camera
from taichi_unifusion.datasets.loading import recording_of
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.geometry import se3
from taichi_unifusion.results import read_run
from taichi_unifusion.results.ownership import mark_unfinished
from taichi_unifusion.results.run_folder import RunFolder
from taichi_unifusion.tracking import TrackedFrame, TrackingResult, Verdict
from taichi_unifusion.tracking.sequence import PosedFrames

CAMERA = SyntheticRoom(frames=1, width=160, height=120).camera
RIG = rig_beside(CAMERA, turn=(0.5, -1.0, 0.5), move=(0.025, 0, 0), focal=0.9)
FRAMES = 45
MAPPED = ["--every", "5", "--end", "20"]


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A folder whose colour is not registered, and that does not say so."""
    folder = tmp_path_factory.mktemp("rig") / "recording"
    return write_folder(folder, list(TwoCameras(RIG, frames=FRAMES)))


@pytest.fixture(scope="module")
def made(recording, tmp_path_factory):
    """A run that was told nothing of it."""
    out = tmp_path_factory.mktemp("results") / "auto"
    arguments = ["reconstruct", "folder", str(recording), "--every", "5", *FLAGS]
    assert cli.main([*arguments, "--out", str(out)]) == 0
    return out


def scores(capsys, *arguments) -> dict:
    capsys.readouterr()
    assert cli.main(["evaluate", "rendering", *map(str, arguments), *FLAGS[:2], "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_camera_is_found_and_kept(made):
    color = json.loads((made / "metrics.json").read_text())["recording"]["color"]
    assert color["choice"] == "auto" and color["verdict"].startswith("estimated: turned by")
    assert color["gain_db"] > 1 and color["frames"] > 10
    kept = read_color_camera(made / "color_camera.yaml")
    assert abs(kept.pinhole.fx / RIG.pinhole.fx - 1) < 0.02
    run = read_run(made)
    assert run.source.color.choice == "auto"
    np.testing.assert_allclose(run.recording.color_camera.T_color_depth, kept.T_color_depth)


def test_info_says_how_colour_was_registered(made, capsys):
    assert cli.main(["info", str(made)]) == 0
    assert "colour  estimated: turned by" in capsys.readouterr().out


def test_evaluation_compares_with_images_of_the_same_camera(made, capsys):
    registered, raw = scores(capsys, made), scores(capsys, made, "--color-camera", "none")
    again = scores(capsys, made, "--color-camera", made / "color_camera.yaml")
    found = scores(capsys, made, "--color-camera", "auto")
    assert registered["psnr_db"] > raw["psnr_db"] + 1
    assert registered["psnr_db"] == again["psnr_db"] == pytest.approx(found["psnr_db"], abs=1e-6)
    assert registered["depth_l1_cm"] == raw["depth_l1_cm"]  # of depth nothing changes


def test_a_mesh_file_is_compared_with_images_as_they_are(made, recording, capsys):
    arguments = [made / "mesh.ply", "folder", recording, "--end", "20"]
    raw, registered = (
        scores(capsys, *arguments, *more)
        for more in ([], ["--color-camera", made / "color_camera.yaml"])
    )
    assert registered["psnr_db"] > raw["psnr_db"]


def test_colour_stays_as_recorded_where_asked(recording, tmp_path, capsys):
    arguments = ["reconstruct", "folder", str(recording), *MAPPED, *FLAGS]
    write_color_camera(tmp_path / "color_camera.yaml", RIG)
    mark_unfinished(RunFolder(tmp_path), ["color_camera.yaml"])
    assert cli.main([*arguments, "--color-camera", "none", "--out", str(tmp_path)]) == 0
    color = json.loads((tmp_path / "metrics.json").read_text())["recording"]["color"]
    assert color["choice"] == "none" and color["camera"] is None
    assert not (tmp_path / "color_camera.yaml").exists()  # of an earlier run
    assert "colour   " not in capsys.readouterr().out


@pytest.mark.parametrize("choice", ["kinect", "FILE"])
def test_a_camera_that_is_given_is_used(choice, recording, tmp_path, capsys):
    write_color_camera(tmp_path / "mine.yaml", replace(RIG, clock_offset=0.01))
    choice = str(tmp_path / "mine.yaml") if choice == "FILE" else choice
    arguments = ["reconstruct", "folder", str(recording), *MAPPED, *FLAGS, "--tracking", "rgbd"]
    out = tmp_path / "out"
    assert cli.main([*arguments, "--color-camera", choice, "--out", str(out)]) == 0
    assert f"colour   registered with {choice}" in capsys.readouterr().out
    kept = read_color_camera(out / "color_camera.yaml")
    assert kept.clock_offset == (0 if choice == "kinect" else 0.01)


def test_the_recordings_own_camera_comes_first(tmp_path, capsys):
    folder = write_folder(tmp_path / "recording", list(TwoCameras(RIG, frames=FRAMES)[:6]))
    write_color_camera(folder / "color_camera.yaml", RIG)
    out = tmp_path / "out"
    arguments = ["reconstruct", "folder", str(folder), "--every", "3", *FLAGS, "--out", str(out)]
    assert cli.main(arguments) == 0
    color = json.loads((out / "metrics.json").read_text())["recording"]["color"]
    assert color["verdict"] == "registered by the recording itself"
    assert scores(capsys, out)["psnr_db"] > scores(capsys, out, "--color-camera", "none")["psnr_db"]


@pytest.mark.parametrize("choice", ["auto", "FILE"])
def test_a_clock_offset_goes_by_the_poses_that_are_found(choice, tmp_path):
    """Of the recording's own camera, and of one that is given; not by poses that nobody was to use."""
    late, frames = replace(RIG, clock_offset=0.02), list(TwoCameras(RIG, frames=FRAMES)[:3])
    folder = write_folder(tmp_path / "recording", frames)
    write_color_camera(tmp_path / "late.yaml", late)
    if choice == "auto":
        write_color_camera(folder / "color_camera.yaml", late)
    given, record = given_color(
        open_dataset("folder", folder),
        choice if choice == "auto" else str(tmp_path / "late.yaml"),
    )
    assert recording_of(given.without_poses()).twists is None
    moved = [se3.exp(np.array([0.01 * i, 0, 0, 0, 0, 0])) for i in range(3)]
    tracked = [TrackedFrame(i, Verdict.TRACKED, T) for i, T in enumerate(moved)]
    posed, _ = found_color(PosedFrames(given, TrackingResult(tuple(tracked))), record)
    found = recording_of(posed).twists
    np.testing.assert_allclose(found, np.tile([0.3, 0, 0, 0, 0, 0], (3, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("choice", "told"),
    [
        ("nne", "--color-camera: 'nne' is neither auto, kinect nor none, nor a file"),
        ("none.yaml", "none.yaml: no such file; a colour camera's file holds"),
    ],
)
def test_a_wrong_choice_is_told(choice, told, recording, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["reconstruct", "folder", str(recording), "--out", str(out)]
    assert cli.main([*arguments, "--color-camera", choice]) == 2
    assert told in capsys.readouterr().err and not out.exists()


def test_a_rendered_recording_needs_none(tmp_path, capsys):
    arguments = ["reconstruct", "synthetic", "--end", "1", "--out", str(tmp_path / "out")]
    assert cli.main([*arguments, "--color-camera", "kinect"]) == 2
    assert "synthetic room: its colour is registered to depth already" in capsys.readouterr().err
