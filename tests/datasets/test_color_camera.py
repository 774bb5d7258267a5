"""A colour camera beside the depth camera: its file, its use by recordings, what it does to frames."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from dataset_writers import CAMERA, make_samples, write_folder, write_image, write_sens
from two_cameras import TwoCameras, rig_beside

from taichi_unifusion.datasets import ColorCamera, open_dataset
from taichi_unifusion.datasets.color_camera import (
    kinect_color_camera,
    read_color_camera,
    write_color_camera,
)
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.errors import DatasetError, InputError, PoseError, SizeMismatch
from taichi_unifusion.geometry import se3
from taichi_unifusion.types import Frame, PinholeCamera

DEPTH_CAMERA = SyntheticRoom(frames=1, width=160, height=120).camera
RIG = rig_beside(DEPTH_CAMERA, turn=(1.0, -0.5, 0.5), move=(-0.06, 0.01, 0.0), focal=0.8)
FINE = replace(RIG, pinhole=RIG.pinhole.resized(640, 480))
TYPICAL = 4.0  # [grey levels] interpolation against rendering: textures are finer than pixels
VALUES = {
    "width": 640,
    "height": 480,
    "fx": 525.0,
    "fy": 526.0,
    "cx": 319.5,
    "cy": 239.0,
    "T_color_depth": np.eye(4).tolist(),
}


def test_a_file_is_read_back_as_written(tmp_path):
    camera = ColorCamera(RIG.pinhole, RIG.T_color_depth, (0.1, -0.2, 0.001), 0.004)
    write_color_camera(tmp_path / "color.yaml", camera)
    again = read_color_camera(tmp_path / "color.yaml")
    assert (again.pinhole, again.distortion) == (camera.pinhole, camera.distortion)
    assert again.clock_offset == camera.clock_offset
    np.testing.assert_array_equal(again.T_color_depth, camera.T_color_depth)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"fxx": 1.0}, "unknown key 'fxx' (did you mean 'fx'?)"),
        ({"fy": None}, "no fy in it"),
        ({"cx": 4000.0}, "principal point"),
        ({"T_color_depth": [[1, 0], [0, 1]]}, "T_color_depth must be 4 rows of 4 numbers"),
        ({"T_color_depth": [[1, 0], [0]]}, "T_color_depth must be 4 rows of 4 numbers"),
        ({"T_color_depth": (2 * np.eye(4)).tolist()}, "T_color_depth: last row"),
        ({"T_color_depth": np.diag([2.0, 2, 2, 1]).tolist()}, "T_color_depth: not a rotation"),
        ({"distortion": [0.1] * 9}, "distortion is at most 8 finite numbers"),
        ({"clock_offset": "soon"}, "clock_offset: expected a number, got 'soon'"),
    ],
)
def test_a_wrong_file_is_one_sentence_that_names_it(tmp_path, change, told):
    values = {key: value for key, value in {**VALUES, **change}.items() if value is not None}
    (tmp_path / "color.yaml").write_text(yaml.safe_dump(values))
    with pytest.raises(DatasetError) as error:
        read_color_camera(tmp_path / "color.yaml")
    assert str(error.value).startswith(str(tmp_path / "color.yaml")) and told in str(error.value)


def test_a_file_that_is_missing_is_told(tmp_path):
    with pytest.raises(DatasetError, match="none.yaml: no such file; a colour camera's file holds"):
        read_color_camera(tmp_path / "none.yaml")


def test_an_impossible_camera_is_refused():
    with pytest.raises(PoseError, match="T_color_depth"):
        ColorCamera(DEPTH_CAMERA, np.zeros((4, 4)))
    with pytest.raises(InputError, match="finite"):
        ColorCamera(DEPTH_CAMERA, np.eye(4), clock_offset=float("nan"))


@pytest.mark.parametrize("rig", [RIG, FINE], ids=["same size", "finer"])
def test_registered_colour_is_what_the_depth_camera_would_see(rig):
    recording = TwoCameras(rig, frames=12, noise=False)
    raw, frame = recording[3], recording.with_color_camera(rig)[3]
    truth = recording.room[3].color.astype(float)
    np.testing.assert_array_equal(frame.depth, raw.depth)  # geometry stays
    known = np.isfinite(frame.images["color"]).all(axis=2)
    assert 0.85 < known.mean() < 1  # a strip is hidden, or outside
    off = np.abs(frame.color.astype(float) - truth).mean(axis=2)
    assert np.median(off[known]) <= TYPICAL
    np.testing.assert_allclose(frame.images["color"][known], frame.color[known] / 255, atol=1e-6)
    if rig is RIG:
        before = np.abs(raw.color.astype(float) - truth).mean(axis=2)
        assert off[known].mean() < 0.5 * before[known].mean()


def test_what_something_nearer_hides_has_no_colour():
    """A board 1 m in front of a wall at 2 m: a colour camera 10 cm to the right does not see a strip
    of the wall to the left of it."""
    camera = PinholeCamera(160, 120, 150.0, 150.0, 79.5, 59.5)
    depth = np.full((120, 160), 2.0, np.float32)
    depth[:, 60:100] = 1.0
    color = np.full((120, 160, 3), 90, np.uint8)
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = -0.1
    frame = ColorCamera(camera, T_color_depth).register(Frame(depth, camera), color, None, "colour")
    hidden = np.isnan(frame.images["color"]).any(axis=2)[60]
    strip = 0.1 * 150 * (1 / 1.0 - 1 / 2.0)  # [pixels]
    assert abs(hidden[40:60].sum() - strip) <= 2 and not hidden[60:130].any()
    assert abs(hidden[:40].sum() - 0.1 * 150 / 2.0) < 2  # left of the colour image
    assert (frame.depth == depth).all()


def test_a_clock_offset_moves_the_camera_on():
    rig = rig_beside(DEPTH_CAMERA, offset=0.05)
    recording = TwoCameras(rig, frames=40, share=0.3, noise=False)
    late = recording.with_color_camera(replace(rig, clock_offset=0.0))[5]
    on_time = recording.with_color_camera(rig)[5]
    truth = recording.room[5].color.astype(float)

    def error(frame: Frame) -> float:
        known = np.isfinite(frame.images["color"]).all(axis=2)
        return float(np.abs(frame.color.astype(float) - truth)[known].mean())

    assert error(on_time) < 0.5 * error(late)


def test_views_hand_a_colour_camera_on():
    recording = TwoCameras(replace(RIG, clock_offset=0.02), frames=12)
    whole, view = (each.with_color_camera(recording.rig) for each in (recording, recording[2:9:3]))
    assert view.registered and not recording.registered
    np.testing.assert_array_equal(view[1].color, whole[5].color)
    still = recording[2:9:3].with_color_camera(recording.rig, np.zeros((3, 6)))
    assert (still[1].color != view[1].color).any()  # velocities are the view's own
    np.testing.assert_array_equal(view.with_color_camera(None)[1].color, recording[5].color)


def test_distortion_is_taken_out():
    bent = ColorCamera(DEPTH_CAMERA, np.eye(4), (0.2, 0.0, 0.0, 0.0))
    depth, dots = np.full((120, 160), 2.0, np.float32), np.zeros((120, 160, 3), np.uint8)
    ray = np.array([0.3, -0.2])
    radius = ray @ ray
    u, v = (ray * (1 + 0.2 * radius) * DEPTH_CAMERA.fx + (79.5, 59.5)).round().astype(int)
    cv2.circle(dots, (int(u), int(v)), 3, (255, 255, 255), -1)
    frame = bent.register(Frame(depth, DEPTH_CAMERA), dots, None, "colour")
    seen = np.argwhere(frame.color[..., 0] > 128).mean(axis=0)[::-1]
    np.testing.assert_allclose(seen, ray * DEPTH_CAMERA.fx + (79.5, 59.5), atol=1.0)


def test_a_folder_has_a_colour_camera_of_its_own(tmp_path):
    """Of another size and shape than depth, which only a calibration can bring together."""
    samples = make_samples(2)
    folder = write_folder(tmp_path / "rig", samples)
    for i in range(2):
        write_image(
            folder / "color" / f"{i:06d}.png", np.full((40, 80, 3), (200, 100, 50), np.uint8)
        )
    with pytest.raises(SizeMismatch, match="another shape"):
        open_dataset("folder", folder)[0]
    camera = ColorCamera(PinholeCamera(80, 40, 40.0, 40.0, 39.5, 19.5), np.eye(4))
    write_color_camera(folder / "color_camera.yaml", camera)
    recording = open_dataset("folder", folder)
    assert recording.registered and recording[0].color.shape == (12, 16, 3)
    inner = recording[0].color[4:8, 5:11]
    assert (inner == (200, 100, 50)).all()
    square = replace(camera, pinhole=PinholeCamera(64, 64, 40.0, 40.0, 31.5, 31.5))
    with pytest.raises(SizeMismatch, match="colour is 80x40 but the colour camera is 64x64"):
        recording.with_color_camera(square)[0]


def test_a_container_is_registered_too(tmp_path):
    recording = open_dataset("scannet", write_sens(tmp_path, make_samples(2)), camera=CAMERA)
    same = recording.with_color_camera(ColorCamera(CAMERA.resized(32, 24), np.eye(4)))
    assert same[0].color.shape == recording[0].color.shape and "color" in same[0].images


def test_times_and_poses_are_there_without_images(tmp_path):
    samples = make_samples(3)
    folder = write_folder(tmp_path, samples)
    for image in (folder / "depth").glob("*"):
        image.write_bytes(b"damaged") if image.stem != "000000" else None
    recording = open_dataset("folder", folder)
    time, pose = recording.pose_at(2)
    assert time == pytest.approx(2 / 30)  # the number in its name, at 30 Hz
    np.testing.assert_allclose(pose, samples[2].T_world_camera)
    moved = se3.log(se3.inverse(samples[0].T_world_camera) @ samples[2].T_world_camera) / (2 / 30)
    np.testing.assert_allclose(recording.velocities()[1], moved)
    assert recording.without_poses().pose_at(2)[1] is None


def test_a_rendered_recording_takes_no_colour_camera():
    room = SyntheticRoom(frames=1)
    assert room.with_color_camera(None) is room
    with pytest.raises(InputError, match="registered to depth already"):
        room.with_color_camera(kinect_color_camera())


def test_the_nominal_kinect_fits_images_of_any_size():
    camera = kinect_color_camera().resized(320, 240, "colour").pinhole
    assert (camera.fx, camera.cx) == (262.5, 159.5)
