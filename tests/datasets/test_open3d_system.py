"""Recordings of Open3D's reconstruction system and of Redwood, in each of their forms."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dataset_writers import CAMERA, make_samples
from open3d_writer import TRAJECTORIES, log_text, write_recording

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import DatasetError, PoseError


@pytest.fixture
def samples():
    return make_samples(3)


def check_frames(dataset, samples):
    assert len(dataset) == len(samples)
    for frame, sample in zip(dataset, samples, strict=True):
        np.testing.assert_array_equal(frame.depth, sample.metres(1000))
        np.testing.assert_array_equal(frame.color, sample.color)
        np.testing.assert_allclose(frame.T_world_camera, sample.T_world_camera, atol=1e-9)
        assert frame.camera == CAMERA


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_every_trajectory_gives_the_same_frames(name, samples, tmp_path):
    folder = write_recording(tmp_path / "r", samples)
    (folder / name).parent.mkdir(exist_ok=True)
    (folder / name).write_text(TRAJECTORIES[name](samples))
    check_frames(open_dataset("open3d", folder), samples)


@pytest.mark.parametrize("color", ["color", "rgb", "image"])
def test_names_of_folders_and_of_the_camera(color, samples, tmp_path):
    folder = write_recording(tmp_path / "r", samples, color=color, camera="camera_intrinsic.json")
    (folder / "trajectory.log").write_text(log_text(samples))
    check_frames(open_dataset("open3d", folder), samples)


def test_redwoods_names_are_paired_by_the_number_before(samples, tmp_path):
    folder = write_recording(tmp_path / "r", samples)
    for i in range(3):
        (folder / "depth" / f"{i:06d}.png").rename(
            folder / "depth" / f"{i:06d}-{i * 33369:012d}.png"
        )
        (folder / "color" / f"{i:06d}.png").rename(
            folder / "color" / f"{i:06d}-{i * 41111:012d}.png"
        )
    (folder / "trajectory.log").write_text(log_text(samples))
    check_frames(open_dataset("open3d", folder), samples)
    (folder / "color" / "000001-000000041111.png").unlink()
    dataset = open_dataset("open3d", folder)
    assert dataset[1].color is None and "1 of 3 depth images have no colour" in dataset.warnings[0]


def test_what_is_missing_is_said(samples, tmp_path):
    folder = write_recording(tmp_path / "r", samples, camera="")
    with pytest.raises(DatasetError, match="no intrinsic.json here, and 16x12 is not"):
        open_dataset("open3d", folder)
    dataset = open_dataset("open3d", folder, camera=CAMERA)
    assert "no trajectory" in dataset.no_poses and dataset[0].T_world_camera is None
    (folder / "a.log").write_text(log_text(samples[:2]))
    with pytest.raises(PoseError, match="no pose for frame 2"):
        open_dataset("open3d", folder, camera=CAMERA)[2]
    (folder / "b.log").write_text(log_text(samples))
    with pytest.raises(DatasetError, match="trajectory=, of a.log, b.log"):
        open_dataset("open3d", folder, camera=CAMERA)
    check_frames(open_dataset("open3d", folder, camera=CAMERA, trajectory="b.log"), samples)
    with pytest.raises(DatasetError, match="no depth/ here"):
        open_dataset("open3d", tmp_path)


@pytest.mark.parametrize(
    ("file", "content", "told"),
    [
        ("intrinsic.json", "{}", "expected width, height and intrinsic_matrix"),
        ("intrinsic.json", "[" * 5000, "not valid JSON"),
        (
            "intrinsic.json",
            json.dumps(
                {"width": 16, "height": 12, "intrinsic_matrix": CAMERA.matrix.ravel().tolist()}
            ),
            "no principal point; is it row by row",
        ),
        ("trajectory.log", "0 0 1\n1 0 0 0\n", "2 lines are no trajectory"),
        ("trajectory.log", "0 0 1\n1 0 0 0\n0 1 0\n0 0 1 0\n0 0 0 1\n", "expected 4 rows of 4"),
        ("trajectory.json", "{}", "not a trajectory of Open3D"),
    ],
)
def test_files_that_are_wrong_are_said(file, content, told, samples, tmp_path):
    folder = write_recording(tmp_path / "r", samples)
    (folder / file).write_text(content)
    with pytest.raises(DatasetError, match=told):
        open_dataset("open3d", folder)
