"""Recordings of a RealSense: both containers of the SDK, with a scene that both of its cameras see exactly."""

from __future__ import annotations

import bag_writer as bags
import cv2
import numpy as np
import pytest
from dataset_writers import quaternion

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.realsense_lens import inverse_distortion
from taichi_unifusion.errors import DatasetError, FrameError
from taichi_unifusion.types import PinholeCamera

pytest.importorskip(
    "rosbags", reason="recordings of a RealSense are read with rosbags, extra 'ros'"
)

DEPTH_CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
COLOR_CAMERA = PinholeCamera(128, 72, 110.0, 110.0, 63.5, 35.5)
T_COLOR_DEPTH = np.eye(4)
T_COLOR_DEPTH[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.02, 0.2]))[0]
T_COLOR_DEPTH[:3, 3] = 0.015, 0.002, 0.001
DISTORTION = (0.1, -0.05, 0.001, 0.002, 0.01)  # of the colour camera
WALL = 1.5  # [m]
EXACT = 1e-3  # [m] of a plane seen from the side, rounded to the units of the file


def scene_color(inverse: bool) -> np.ndarray:
    """What the colour camera sees: red grows with the wall's x in the depth camera, green with its y."""
    pixels = np.stack(np.meshgrid(np.arange(128), np.arange(72)), axis=-1).reshape(-1, 1, 2)
    pixels = pixels.astype(float)
    if inverse:  # the SDK's model leads from the image to the ray
        x, y = ((pixels[:, 0] - (63.5, 35.5)) / 110).T
        k1, k2, p1, p2, k3 = DISTORTION
        r2 = x * x + y * y
        f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        rays = np.stack(
            [x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)]
            + [y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y), np.ones_like(x)],
            axis=1,
        )
    else:
        flat = cv2.undistortPoints(pixels, COLOR_CAMERA.matrix, np.array(DISTORTION))[:, 0]
        rays = np.hstack([flat, np.ones((len(flat), 1))])
    T = np.linalg.inv(T_COLOR_DEPTH)
    direction, origin = rays @ T[:3, :3].T, T[:3, 3]
    points = origin + (WALL - origin[2]) / direction[:, 2:] * direction
    values = np.clip(128 + 100 * points, 0, 255).round().astype(np.uint8)
    values[:, 2] = 7
    return values.reshape(72, 128, 3)


def describe(camera: PinholeCamera, model: str, coefficients) -> str:
    numbers = ",".join(f"{k:g}" for k in coefficients)
    return (
        f"width={camera.width};height={camera.height};fx={camera.fx};ppx={camera.cx};fy={camera.fy};"
        f"ppy={camera.cy};model={model};coeffs={numbers}"
    )


def write_realsense(path, container: str = "db3", *, inverse: bool = True, units: float = 0.001):
    """Three frames, as the SDK lays them out: since 2.58 in a `.db3`, before in a `.bag`."""
    depth = np.full((48, 64), round(WALL / units), np.uint16)
    depth[:2] = 0
    color = scene_color(inverse)
    new, sensors = container == "db3", ("/device_0/sensor_0", "/device_0/sensor_1")
    streams = (f"{sensors[0]}/Depth_0", f"{sensors[1]}/Color_0")
    kind = "Inverse Brown Conrady" if inverse else "Brown Conrady"
    calibration = ((DEPTH_CAMERA, "Brown Conrady", (0,) * 5), (COLOR_CAMERA, kind, DISTORTION))
    messages = []
    if new:
        messages.append(bags.text(f"{sensors[0]}/option/Depth_Units/value", f"{units:f}"))
    else:
        messages.append(
            bags.Message(
                f"{sensors[0]}/option/Depth_Units/value", "std_msgs/msg/Float32", 0, {"data": units}
            )
        )
    for stream, (camera, model, numbers), T in zip(
        streams, calibration, (np.eye(4), T_COLOR_DEPTH), strict=True
    ):
        if new:
            R, t = (",".join(f"{v:.9f}" for v in x) for x in (T[:3, :3].T.ravel(), T[:3, 3]))
            messages.append(bags.text(f"{stream}/camera_info", describe(camera, model, numbers)))
            messages.append(bags.text(f"{stream}/tf/ref_1", f"rotation={R};translation={t}"))
        else:
            moved = {
                "translation": dict(zip("xyz", map(float, T[:3, 3]), strict=True)),
                "rotation": dict(zip("xyzw", map(float, quaternion(T[:3, :3])), strict=True)),
            }
            messages.append(bags.Message(f"{stream}/tf/0", "geometry_msgs/msg/Transform", 0, moved))
            info = bags.camera_info(
                f"{stream}/info/camera_info", 0, "0", camera, numbers, model=model
            )
            messages.append(info)
    for n in range(3):
        time = n / 30
        if new:
            png = cv2.imencode(".png", color[..., ::-1])[1].tobytes()
            form = "16UC1; compressedDepth png"
            topic = f"{streams[0]}/image/data/compressedDepth"
            messages.append(bags.compressed(topic, bags.depth_png(depth), form, time, "Depth"))
            topic = f"{streams[1]}/image/data/compressed"
            form = "rgb8; png compressed bgr8"
            messages.append(bags.compressed(topic, png, form, time + 0.01, "Color"))
        else:
            messages.append(bags.image(f"{streams[0]}/image/data", depth, "mono16", time, "0"))
            messages.append(bags.image(f"{streams[1]}/image/data", color, "rgb8", time + 0.01, "0"))
    return bags.write_bag(path, messages, container)


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
    if inverse and container == "bag":
        pytest.skip("CameraInfo of the older files names no model")
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
    path.with_suffix(".txt").write_text("0.0333 1 2 3 0 0 0 1\n")
    dataset = open_dataset("realsense", path)
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
