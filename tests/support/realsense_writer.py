"""Writes small recordings as the RealSense SDK's, of a wall that both of its cameras see exactly."""

from __future__ import annotations

from pathlib import Path

import bag_writer as bags
import cv2
import numpy as np
from dataset_writers import quaternion

from taichi_unifusion.types import PinholeCamera

DEPTH_CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
COLOR_CAMERA = PinholeCamera(128, 72, 110.0, 110.0, 63.5, 35.5)
T_COLOR_DEPTH = np.eye(4)
T_COLOR_DEPTH[:3, :3] = cv2.Rodrigues(np.array([0.01, -0.02, 0.2]))[0]
T_COLOR_DEPTH[:3, 3] = 0.015, 0.002, 0.001
DISTORTION = (0.1, -0.05, 0.001, 0.002, 0.01)  # of the colour camera
WALL = 1.5  # [m]


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


def write_realsense(
    path: Path, container: str = "db3", *, inverse: bool = True, units: float = 0.001
) -> Path:
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
