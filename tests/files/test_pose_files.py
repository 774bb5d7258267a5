"""Poses as other programs write them: read for `folder`, and for --tracking external."""

from __future__ import annotations

import json

import numpy as np
import pose_writers as write
import pytest
from dataset_writers import make_samples, write_folder
from tiny_recording import FLAGS

from taichi_unifusion.cli import main as cli
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import DatasetError
from taichi_unifusion.files.pose_files import read_pose_list
from taichi_unifusion.geometry import se3
from taichi_unifusion.tracking.trajectory_files import read_poses

POSES = [se3.exp(np.array([0.1 * i, -0.2, 0.3 * i, 0.2 * i, 0.5, -0.1 * i])) for i in range(4)]
NAMES = [f"shot_{10 * i:04}.jpg" for i in range(4)]
EXACT = 1e-9
WRITERS = {  # file -> writer, keys that the poses have
    "images.txt": (lambda path: write.colmap_text(path, POSES, NAMES), [0, 10, 20, 30]),
    "images.bin": (lambda path: write.colmap_binary(path, POSES, NAMES), [0, 10, 20, 30]),
    "transforms.json": (lambda path: write.transforms(path, POSES, NAMES), [0, 10, 20, 30]),
    "data.csv": (
        lambda path: write.euroc(path, POSES),
        [(write.START + i * write.STEP) / 1e9 for i in range(4)],
    ),
    "kitti.txt": (lambda path: write.kitti(path, POSES), [0, 1, 2, 3]),
    "trajectory.log": (lambda path: write.log(path, POSES), [0, 1, 2, 3]),
}


@pytest.mark.parametrize("name", WRITERS)
def test_poses_come_back(tmp_path, name):
    writer, keys = WRITERS[name]
    writer(tmp_path / name)
    body_camera = tmp_path / "sensor.yaml" if name == "data.csv" else None
    write.sensor_yaml(tmp_path / "sensor.yaml")
    poses = read_poses(tmp_path / name, body_camera)
    assert poses.keys == pytest.approx(keys, abs=1e-6, rel=0) and poses.by_time == (
        name == "data.csv"
    )
    np.testing.assert_allclose(poses.T_world_camera, POSES, atol=EXACT)


def test_a_folder_of_colmap_is_its_list_of_images(tmp_path):
    write.colmap_text(tmp_path / "images.txt", POSES, NAMES)
    poses = read_poses(tmp_path)
    np.testing.assert_allclose(poses.T_world_camera, POSES, atol=EXACT)
    assert "unit is taken as a metre" in poses.warnings[0]


def test_without_its_place_the_body_is_taken_for_the_camera_and_that_is_said(tmp_path):
    write.euroc(tmp_path / "data.csv", POSES)
    poses = read_poses(tmp_path / "data.csv")
    moved = poses.T_world_camera @ write.T_BODY_CAMERA
    np.testing.assert_allclose(moved, POSES, atol=EXACT)
    assert "are a body's and are taken as the camera's" in poses.warnings[0]


def test_the_place_of_a_camera_as_rows(tmp_path):
    write.euroc(tmp_path / "data.csv", POSES)
    np.savetxt(tmp_path / "T.txt", write.T_BODY_CAMERA, fmt="%.17g")
    poses = read_poses(tmp_path / "data.csv", tmp_path / "T.txt")
    np.testing.assert_allclose(poses.T_world_camera, POSES, atol=EXACT)


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("images.bin", b"\x02" + bytes(7) + bytes(200), "not a list of images of COLMAP"),
        ("images.bin", b"", "not a list of images of COLMAP"),
        ("a.log", b"0 0 1\n1 0 0 0\n", "2 lines are no trajectory"),
        ("a.log", b"3 3 4\n" + b"1 0 0 0\n" * 4, "entry 0 is for frame 3"),
        ("a.json", b"[1]", "expected an object in braces"),
        ("a.json", b'{"frames": []}', "holds no frames"),
        ("a.json", b"[" * 100_000, "not a JSON file"),
        ("data.csv", b"1403636579763555584,1,2,3,1,0,0,0\nx,1\n", "line 2: expected nanoseconds"),
        ("a.txt", b"", "holds no poses"),
    ],
)
def test_what_is_no_list_of_poses_is_said(tmp_path, name, content, told):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(DatasetError, match=told):
        read_pose_list(tmp_path / name)


def test_only_a_body_has_a_place_for_a_camera(tmp_path):
    write.kitti(tmp_path / "kitti.txt", POSES)
    write.sensor_yaml(tmp_path / "sensor.yaml")
    with pytest.raises(DatasetError, match="is for EuRoC's data.csv alone"):
        read_pose_list(tmp_path / "kitti.txt", tmp_path / "sensor.yaml")


def test_images_of_one_number_are_refused(tmp_path):
    write.colmap_text(tmp_path / "images.txt", POSES[:2], ["left_1.jpg", "right_1.jpg"])
    with pytest.raises(DatasetError, match="'right_1' and 'left_1' have one number"):
        read_poses(tmp_path)


@pytest.mark.parametrize(
    "name", ["images.txt", "images.bin", "transforms.json", "data.csv", "kitti.txt"]
)
def test_folder_takes_them_by_name_time_or_place(tmp_path, name):
    samples = make_samples(4)
    folder = write_folder(tmp_path / "scene", samples)
    images = sorted(path.name for path in (folder / "color").iterdir())
    for writer in (write.colmap_text, write.colmap_binary, write.transforms):
        file = {write.colmap_text: "images.txt", write.colmap_binary: "images.bin"}
        writer(folder / file.get(writer, "transforms.json"), POSES, images)
    write.kitti(folder / "kitti.txt", POSES)
    write.euroc(folder / "data.csv", POSES)
    write.sensor_yaml(folder / "sensor.yaml")
    settings = (folder / "camera.yaml").read_text() + f"poses: {name}\n"
    if name == "data.csv":
        settings += "body_camera: sensor.yaml\n"
        for kind in ("depth", "color"):
            for i, path in enumerate(sorted((folder / kind).iterdir())):
                path.rename(path.with_name(f"{write.START + i * write.STEP}{path.suffix}"))
    (folder / "camera.yaml").write_text(settings)
    found = [frame.T_world_camera for frame in open_dataset("folder", folder)]
    np.testing.assert_allclose(found, POSES, atol=1e-6)


def test_external_poses_of_colmap_at_the_command_line(tmp_path):
    from tiny_recording import make_frames
    from tiny_recording import write_folder as write_frames

    frames = make_frames(3)
    folder = write_frames(tmp_path / "scene", frames)
    names = sorted(path.name for path in (folder / "color").iterdir())
    model = tmp_path / "sparse"
    model.mkdir()
    write.colmap_binary(model / "images.bin", [frame.T_world_camera for frame in frames], names)
    out = tmp_path / "out"
    arguments = ["reconstruct", "folder", str(folder), *FLAGS, "--out", str(out)]
    assert cli.main([*arguments, "--tracking", "external", "--trajectory", str(model)]) == 0
    assert json.loads((out / "metrics.json").read_text())["frames"]["used"] == 3
