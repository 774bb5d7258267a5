"""Any recording as a folder: what is written is what was read."""

from __future__ import annotations

import bag_writer as bags
import numpy as np
import pytest
from dataset_writers import (
    CAMERA,
    make_pose,
    make_samples,
    write_seven_scenes,
    write_tum,
)

from taichi_unifusion.cli.main import main
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.folder_writing import write_folder
from taichi_unifusion.errors import DatasetError, FileError, FrameError
from taichi_unifusion.types import Frame, PinholeCamera

POSE = 1e-8  # of a pose that is written with nine digits


@pytest.fixture
def samples():
    return make_samples(4)


def check_equal(written, frames):
    assert len(written) == len(frames)
    for a, b in zip(written, frames, strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_array_equal(a.color, b.color)
        np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=POSE)
        assert a.camera == b.camera
        if b.timestamp is not None:
            assert a.timestamp == pytest.approx(b.timestamp, abs=1e-6)


def test_numbered_frames_come_back(samples, tmp_path):
    frames = open_dataset("7scenes", write_seven_scenes(tmp_path / "r", samples))
    written = write_folder(frames, tmp_path / "out")
    assert (written.frames, written.poses, written.depth_scale) == (4, 4, 1000)
    assert not written.named_by_time and not written.skipped
    check_equal(open_dataset("folder", tmp_path / "out"), frames)


def test_time_stamps_and_units_come_back(samples, tmp_path):
    frames = open_dataset("tum", write_tum(tmp_path / "r", samples), camera=CAMERA)
    written = write_folder(frames, tmp_path / "out")
    assert written.named_by_time and written.depth_scale == 5000
    check_equal(open_dataset("folder", tmp_path / "out"), frames)


def test_a_bag_comes_back_also_without_poses(samples, tmp_path):
    pytest.importorskip("rosbags")
    frames = open_dataset("rosbag", bags.write_bag(tmp_path / "r", bags.recording(samples)))
    write_folder(frames, tmp_path / "out")
    check_equal(open_dataset("folder", tmp_path / "out"), frames)
    written = write_folder(frames.without_poses(), tmp_path / "bare")
    assert written.poses == 0 and not (tmp_path / "bare" / "poses.txt").exists()
    assert open_dataset("folder", tmp_path / "bare")[0].T_world_camera is None


def test_a_colour_camera_comes_back_with_its_images(tmp_path):
    finer = PinholeCamera(64, 40, 60.0, 60.0, 31.5, 19.5)
    T = np.eye(4)
    T[0, 3] = -0.1
    rng = np.random.default_rng(3)
    messages = [bags.transform(np.linalg.inv(T), 1.0, "depth", "color", static=True)]
    for i in range(2):
        time = 1.0 + i / 30
        units = rng.integers(800, 1200, (12, 16), dtype=np.uint16)
        color = rng.integers(0, 255, (40, 64, 3), dtype=np.uint8)
        messages += [
            bags.transform(make_pose(i), time, "map", "depth"),
            bags.camera_info("/camera/depth/camera_info", time, "depth"),
            bags.camera_info("/camera/color/camera_info", time, "color", finer),
            bags.image(bags.DEPTH, units, "16UC1", time, "depth"),
            bags.image(bags.COLOR, color, "rgb8", time, "color"),
        ]
    frames = open_dataset("rosbag", bags.write_bag(tmp_path / "r", messages))
    write_folder(frames, tmp_path / "out")
    again = open_dataset("folder", tmp_path / "out")
    check_equal(again, frames)
    assert again.color_camera.pinhole == finer
    np.testing.assert_array_equal(again.recorded_color(1), color)
    write_folder(again, tmp_path / "twice")
    check_equal(open_dataset("folder", tmp_path / "twice"), frames)


class Faulty(list):
    """Frames of which some cannot be read."""

    name = "faulty"

    def __getitem__(self, i):
        frame = super().__getitem__(i)
        if isinstance(frame, Exception):
            raise frame
        return frame


def plain_frame(camera=CAMERA, value=1.0):
    return Frame(np.full((camera.height, camera.width), value, np.float32), camera)


def test_frames_that_cannot_be_written_are_left_out_and_said(tmp_path):
    frames = Faulty([plain_frame(), FrameError("broken"), plain_frame()])
    written = write_folder(frames, tmp_path / "out")
    assert written.frames == 2 and written.skipped == ("broken",)
    with pytest.raises(DatasetError, match=r"no frame to write \(first: broken\)"):
        write_folder(Faulty([FrameError("broken")]), tmp_path / "none")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out"]


def test_frames_of_another_camera_are_resampled(tmp_path):
    """A wall that is tilted keeps its place: depth follows the rays, to the nearest pixel."""
    finer = CAMERA.resized(64, 48)
    x = finer.rays()[..., 0]
    tilted = (1 / (1 + 0.1 * x)).astype(np.float32)  # z of the plane z + 0.1 x = 1
    color = np.full((48, 64, 3), 90, np.uint8)
    frames = Faulty([plain_frame(), Frame(tilted, finer, color)])
    written = write_folder(frames, tmp_path / "out")
    assert written.frames == 2 and written.resampled == 1
    depth = open_dataset("folder", tmp_path / "out")[1].depth
    expected = 1 / (1 + 0.1 * CAMERA.rays()[..., 0])
    assert np.abs(depth - expected).max() < 0.1 / 2 / finer.fx + 1e-3


def test_nothing_is_left_where_writing_fails(tmp_path):
    with pytest.raises(ZeroDivisionError):
        write_folder(Faulty([plain_frame(), ZeroDivisionError()]), tmp_path / "out")
    assert not list(tmp_path.iterdir())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    with pytest.raises(FileError, match="exists already"):
        write_folder(Faulty([plain_frame()]), tmp_path / "out")
    assert (tmp_path / "out" / "mine.txt").read_text() == "mine"


def test_depth_out_of_reach_is_no_reading(tmp_path):
    frame = plain_frame()
    frame.depth[0, :4] = 70.0, np.nan, np.inf, -1
    written = write_folder(Faulty([frame]), tmp_path / "out", depth_scale=1000)
    depth = open_dataset("folder", tmp_path / "out")[0].depth
    assert written.depth_scale == 1000 and (depth[0, :4] == 0).all() and (depth[1] == 1).all()


def test_the_command_says_what_it_wrote(samples, tmp_path, capsys):
    source, out = write_seven_scenes(tmp_path / "r", samples), tmp_path / "out"
    assert main(["convert", "7scenes", str(source), "--every", "2", "--out", str(out)]) == 0
    told = capsys.readouterr().out
    assert "2 of 2 frames, 2 with a pose, named by number; depth has 1000 units a metre" in told
    assert f"unifusion reconstruct folder {out}" in told
    assert len(open_dataset("folder", out)) == 2
    assert main(["convert", "7scenes", str(source), "--out", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err
