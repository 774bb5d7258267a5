"""2D-3D-S: rooms, a camera for every image, and what a missing or damaged file costs."""

from __future__ import annotations

import json

import numpy as np
import pytest
from dataset_writers import CAMERA, make_samples, write_image, write_stanford

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import DatasetError, FrameError, InputError, PoseError
from taichi_unifusion.types import PinholeCamera


@pytest.fixture
def area(tmp_path):
    """Three images of an office and two of a hallway, whose camera is another one."""
    samples = make_samples(5)
    folder = write_stanford(tmp_path / "area_3", samples[:3], "office_1")
    wide = PinholeCamera(CAMERA.width, CAMERA.height, 9.0, 9.0, 7.5, 5.5)
    return write_stanford(folder, samples[3:], "hallway_2", wide), samples


def test_an_area_has_rooms_and_every_image_a_camera(area):
    folder, samples = area
    frames = open_dataset("2d3ds", folder)
    assert frames.rooms == ("hallway_2", "office_1") and len(frames) == 5
    assert [frame.camera.fx for frame in frames] == [9, 9, 15, 15, 15]
    office = open_dataset("2d3ds", folder / "data", room="office_1")
    assert len(office) == 3 and office.name.endswith("office_1")
    np.testing.assert_array_equal(office[1].color, samples[1].color)
    # as a file of features of that image is named
    assert office[1].name.endswith("1_office_1_frame_1_domain_rgb.png")
    with pytest.raises(InputError, match="did you mean 'office_1'"):
        open_dataset("2d3ds", folder, room="ofice_1")


def test_panoramas_are_no_frames(area):
    folder, _ = area
    name = "camera_00_office_1_frame_equirectangular_domain_depth.png"
    write_image(folder / "pano" / "depth" / name, np.ones((4, 8), np.uint16))
    write_image(folder / "data" / "depth" / name, np.ones((4, 8), np.uint16))
    assert len(open_dataset("2d3ds", folder)) == 5
    with pytest.raises(DatasetError, match="_domain_depth.png here"):
        open_dataset("2d3ds", folder / "pano")


def test_opacity_is_ignored_unless_asked(area):
    folder, samples = area
    file = next((folder / "data" / "rgb").glob("*office_1_frame_0*"))
    write_image(file, np.dstack([samples[0].color[..., ::-1], np.full((12, 16), 255, np.uint8)]))
    frame = open_dataset("2d3ds", folder, room="office_1")[0]
    assert frame.color.shape == (12, 16, 3)
    with pytest.raises(FrameError, match="3 channels"):
        open_dataset("2d3ds", folder, room="office_1", drop_alpha=False)[0]


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        (lambda values: values.pop("camera_rt_matrix"), FrameError, "no 'camera_rt_matrix' in it"),
        (lambda values: values["camera_rt_matrix"].pop(), PoseError, "must be 3x4, got"),
        (
            lambda values: values.update(camera_rt_matrix=np.eye(4)[:3] * 2.0),
            PoseError,
            "not a rotation",
        ),
        (lambda values: values.update(camera_k_matrix=[[0.0] * 3] * 3), FrameError, "fx"),
        (lambda values: values.update(camera_k_matrix=[1.0]), FrameError, "must be 3x3"),
    ],
)
def test_a_wrong_pose_costs_its_frame(area, change, error, said):
    folder, _ = area
    file = next((folder / "data" / "pose").glob("*office_1_frame_1*"))
    values = json.loads(file.read_text())
    change(values)
    file.write_text(json.dumps(values, default=lambda array: array.tolist()))
    frames = open_dataset("2d3ds", folder, room="office_1")
    with pytest.raises(error, match=said):
        frames[1]
    assert frames[0].T_world_camera is not None


def test_missing_files_are_named(area):
    folder, _ = area
    for domain in ("pose", "rgb"):
        file = next((folder / "data" / domain).glob("*office_1_frame_2*"))
        file.unlink()
        with pytest.raises(FrameError, match=file.name):
            open_dataset("2d3ds", folder, room="office_1")[2]


def test_frames_without_poses(area):
    folder, _ = area
    bare = open_dataset("2d3ds", folder, room="office_1").without_poses()
    assert bare[0].T_world_camera is None and bare[0].camera == CAMERA
    for file in (folder / "data" / "pose").iterdir():
        file.unlink()
    frames = open_dataset("2d3ds", folder, camera=CAMERA)
    assert "no poses" in frames.warnings[0] and frames[0].T_world_camera is None
