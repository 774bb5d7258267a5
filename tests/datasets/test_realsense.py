"""Recordings of a RealSense: both containers of the SDK, with a scene that both of its cameras see exactly."""

from __future__ import annotations

import bag_writer as bags
import cv2
import numpy as np
import pytest
from realsense_writer import DISTORTION, T_COLOR_DEPTH, WALL, write_realsense

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.realsense_lens import inverse_distortion
from taichi_unifusion.errors import DatasetError, FrameError

pytest.importorskip(
    "rosbags", reason="recordings of a RealSense are read with rosbags, extra 'ros'"
)

EXACT = 1e-3  # [m] of a plane seen from the side, rounded to the units of the file


def check_scene(frame, align: str) -> None:
    """Points lie on the wall, coloured by where they are on it."""
    v, u = np.nonzero(frame.depth)
    z = frame.depth[v, u].astype(float)
    points = frame.camera.rays(u, v) * z[:, None]
    if align == "color":
        T = np.linalg.inv(T_COLOR_DEPTH)
        points = points @ T[:3, :3].T + T[:3, 3]
    assert len(points) > 0.3 * frame.depth.size
    assert np.abs(points[:, 2] - WALL).max() < (EXACT if align == "depth" else 20 * EXACT)
    colors = frame.color[v, u].astype(float)
    # a level of colour is a centimetre; depth carried over is up to half a pixel beside its ray
    allowed = 1.5 if align == "depth" else 3
    assert np.abs(colors[:, :2] - (128 + 100 * points[:, :2])).max() < allowed


@pytest.mark.parametrize("align", ["depth", "color"])
@pytest.mark.parametrize("container", ["bag", "db3"])
@pytest.mark.parametrize("inverse", [False, True])
def test_depth_and_colour_are_registered(container, align, inverse, tmp_path):
    dataset = open_dataset(
        "realsense", write_realsense(tmp_path / "r", container, inverse=inverse), align=align
    )
    assert len(dataset) == 3 and dataset.registered
    check_scene(dataset[1], align)
    np.testing.assert_allclose([frame.timestamp for frame in dataset], np.arange(3) / 30, atol=1e-6)


def test_units_of_depth_are_the_sensors(tmp_path):
    dataset = open_dataset("realsense", write_realsense(tmp_path / "r", "bag", units=0.0001))
    assert dataset.depth_scale == pytest.approx(10_000, rel=1e-6)
    assert abs(dataset[0].depth.max() - WALL) < EXACT
    assert open_dataset("realsense", dataset.path, depth_scale=1e3)[0].depth.max() > 10


def test_poses_beside_the_recording(tmp_path):
    path = write_realsense(tmp_path / "r", "bag")
    dataset = open_dataset("realsense", path)
    np.testing.assert_array_equal(dataset[0].T_world_camera, np.eye(4))
    assert dataset[1].T_world_camera is None and "no r.txt with poses" in dataset.warnings[-1]
    assert dataset.sensor_alone and dataset[::2].sensor_alone
    assert dataset.without_poses().warnings == ()
    path.with_suffix(".txt").write_text("0.0333 1 2 3 0 0 0 1\n")
    dataset = open_dataset("realsense", path)
    assert not dataset.sensor_alone
    np.testing.assert_array_equal(dataset[1].T_world_camera[:3, 3], (1, 2, 3))
    with pytest.raises(FrameError, match="no pose within"):
        dataset[0]


def test_a_bag_of_ros_is_sent_on(tmp_path):
    path = bags.write_bag(tmp_path / "b", [bags.text("/chatter", "hello")])
    with pytest.raises(DatasetError, match=r"no depth images of a RealSense .* format 'rosbag'"):
        open_dataset("realsense", path)


def test_a_lens_is_turned_round():
    """The rays that the SDK's model gives to pixels come back to them, within a hundredth of a pixel."""
    turned = inverse_distortion(np.array(DISTORTION))
    x, y = 0.4, -0.3
    k1, k2, p1, p2, k3 = DISTORTION
    r2 = x * x + y * y
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    ray = [x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)]
    ray += [y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y), 1.0]
    back = cv2.projectPoints(np.array([ray]), np.zeros(3), np.zeros(3), np.eye(3), np.array(turned))
    np.testing.assert_allclose(back[0].ravel(), (x, y), atol=1e-4)


def test_the_sdks_own_file(data):
    dataset = open_dataset("realsense", data("formats") / "realsense-bag" / "software_device.db3")
    assert len(dataset) == 5 and dataset.camera.size == (160, 120)
    np.testing.assert_allclose(dataset.rig.T_color_depth[:3, 3], (0.015, 0, 0))
    assert all((frame.depth > 0).mean() > 0.9 for frame in dataset)
