"""Recordings of the RealSense SDK: `.bag` (before version 2.58) and `.db3` (since), depth, colour and
calibration.

Depth has units of its own (`Depth_Units`, a millimetre if it does not say) and is not registered to
colour: that is done by the calibration in the file, as for an Azure Kinect, to the depth camera
(`align="depth"`, the default: depth keeps its pixels), or to the colour camera (`align="color"`: depth is
carried over). Either way a pixel has depth only where both cameras see its point.

Poses: `NAME.txt` beside the recording, rows `timestamp tx ty tz qx qy qz qw` with the recording's seconds,
camera-to-world of the camera that is aligned to. Without such a file `unifusion reconstruct` finds them from
the frames (`--tracking rgbd`); given are then the first frame's, whose camera is the world, and no others.
"""

from __future__ import annotations

import re
from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, PoseError, SizeMismatch, check_choice
from ..files.bags import Bag
from ..files.ros_images import read_color_message, read_depth_message
from ..files.trajectories import Pose
from ..geometry import se3
from ..geometry.quaternions import quaternion_to_rotation
from ..geometry.time_stamps import check_max_difference, nearest
from ..types import Frame, PinholeCamera, check_rigid
from .dataset import Dataset
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .file_recording import check_depth_scale
from .realsense_lens import sdk_distortion
from .sensor_rig import SensorRig, poses_beside

MAX_DIFFERENCE = 0.02  # [s] between a pose and a depth image
MILLIMETRES = 1000.0
DEPTH = re.compile(r"(/device_\d+/sensor_\d+/Depth_\d+)/image/data(/compressedDepth)?")
COLOR = re.compile(r"(/device_\d+/sensor_\d+/Color_\d+)/image/data(/compressed)?")
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


def open_realsense(
    path: Path,
    *,
    align: Literal["depth", "color"] = "depth",
    depth_scale: float | None = None,
    max_difference: float = MAX_DIFFERENCE,
) -> RealsenseFile:
    """The recording in file `path`; poses further than `max_difference` [s] from a depth image do not
    belong to it.
    """
    check_choice("align", align, ("depth", "color"))
    check_max_difference(max_difference)
    if depth_scale is not None:
        check_depth_scale(depth_scale, f"realsense {path}")
    bag = Bag(path)
    try:
        return RealsenseFile(bag, align, depth_scale, max_difference)
    except BaseException:
        bag.close()
        raise


@dataclass(frozen=True)
class Stream:
    """A stream of images in the file."""

    prefix: str  # /device_0/sensor_0/Depth_0
    topic: str
    lens: LensCamera
    T_stream_reference: NDArray[np.float64]  # (4, 4) from the point that all streams refer to
    times: NDArray[np.float64]  # (N,) [s] ascending
    order: NDArray[np.intp]  # (N,) numbers of the messages


class RealsenseFile(Dataset):
    """The frames of a RealSense recording, each read when asked for."""

    registered = True

    def __init__(
        self, bag: Bag, align: str, depth_scale: float | None, max_difference: float
    ) -> None:
        self.bag, self.path, self.align = bag, bag.path, align
        self.name = f"realsense {bag.path}"
        depth, color = _stream(bag, DEPTH), _stream(bag, COLOR)
        if depth is None:
            raise DatasetError(
                f"{bag.path}: no depth images of a RealSense (/device_N/sensor_N/Depth_N/image/data); a bag of "
                "ROS is format 'rosbag'"
            )
        if align == "color" and color is None:
            raise DatasetError(
                f"{bag.path}: align 'color' needs colour images, and this recording has none"
            )
        self.depth, self.color = depth, color
        self.depth_scale = _depth_scale(bag, depth) if depth_scale is None else depth_scale
        T_color_depth = None
        if color is not None:
            T_color_depth = color.T_stream_reference @ se3.inverse(depth.T_stream_reference)
        self.rig = SensorRig(depth.lens, color.lens if color else None, T_color_depth, align)
        self.partners = _partners(depth, color)
        beside = poses_beside(bag.path, depth.times, max_difference)
        self.poses, self.sensor_alone = beside.poses, beside.none
        self.warnings = (*bag.damage, *beside.warnings)

    @property
    def camera(self) -> PinholeCamera:
        """The pinhole camera of the frames."""
        return self.rig.camera

    def __len__(self) -> int:
        return len(self.depth.times)

    def without_poses(self) -> RealsenseFile:
        bare = copy(self)
        bare.poses, bare.warnings = tuple(Pose("") for _ in self.poses), tuple(self.bag.damage)
        return bare

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        return float(self.depth.times[index]), self.poses[index].usable

    def load(self, index: int) -> Frame:
        """Read and register frame `index`; FrameError (PoseError) names the file and the frame."""
        where, pose = f"{self.path} frame {index}", self.poses[index]
        known = pose.T_world_camera is not None or pose.problem
        T_world_camera = pose.checked() if known else None
        number = int(self.depth.order[index])
        message = self.bag.message(self.depth.topic, number)
        depth = read_depth_message(message, f"{where} depth", self.depth_scale)
        color, partner = None, int(self.partners[index])
        if self.color is not None and partner >= 0:
            message = self.bag.message(self.color.topic, partner)
            color = read_color_message(message, f"{where} color")
        for image, lens, what in (
            (depth, self.rig.depth, "depth"),
            (color, self.rig.color, "colour"),
        ):
            if image is not None and lens is not None and image.shape[1::-1] != lens.pinhole.size:
                raise SizeMismatch(
                    f"{where}: {what} is {image.shape[1]}x{image.shape[0]} but its calibration is for "
                    f"{lens.pinhole.width}x{lens.pinhole.height}"
                )
        depth, color, _ = self.rig.register(depth, color)
        time = float(self.depth.times[index])
        return Frame(depth, self.camera, color, T_world_camera, index, time, where)


def _stream(bag: Bag, pattern: re.Pattern[str]) -> Stream | None:
    """The first stream whose topic is of that pattern, with its calibration; None without images."""
    found = [
        match
        for name, topic in sorted(bag.topics.items())
        if (match := pattern.fullmatch(name)) and topic.type in IMAGE_TYPES
    ]
    if not found:
        return None
    prefix, topic = found[0][1], found[0][0]
    times, order = _stamps(bag, topic)
    where = f"{bag.path} {prefix}"
    return Stream(prefix, topic, _lens(bag, prefix, where), _extrinsics(bag, prefix), times, order)


def _stamps(bag: Bag, topic: str) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Times of the images [s], ascending, and their numbers: those at which they were recorded, which
    depth and colour share; the stamps are of two clocks.
    """
    times = bag.times(topic)
    times, first = np.unique(times, return_index=True)
    return times, first


def _lens(bag: Bag, prefix: str, where: str) -> LensCamera:
    """Intrinsics and distortion: CameraInfo of the first image, else the text that describes the stream."""
    for name in (f"{prefix}/info/camera_info", f"{prefix}/image/camera_info"):
        if name in bag.topics:
            info = bag.message(name, 0)
            K = np.asarray(getattr(info, "K", None) if hasattr(info, "K") else info.k, float)
            D = np.asarray(getattr(info, "D", None) if hasattr(info, "D") else info.d, float)
            values = (K[0], K[4], K[2], K[5])
            camera = make_camera(where, (int(info.width), int(info.height)), *values)
            return LensCamera(camera, _distortion(bag, prefix, info.distortion_model, D, where))
    fields = _fields(_text(bag, f"{prefix}/camera_info"))
    try:
        size = int(fields["width"]), int(fields["height"])
        values = (float(fields[key]) for key in ("fx", "fy", "ppx", "ppy"))
        camera = make_camera(where, size, *values)
    except (KeyError, ValueError) as error:
        if isinstance(error, DatasetError):
            raise
        raise DatasetError(f"{where}: the file holds no intrinsics of this stream") from None
    return LensCamera(camera, _distortion(bag, prefix, "", np.zeros(5), where))


def _distortion(bag: Bag, prefix: str, model: str, D: NDArray, where: str) -> tuple[float, ...]:
    """k1 k2 p1 p2 k3 and zeros, as OpenCV has them, of a stream."""
    said = _fields(_text(bag, f"{prefix}/camera_info"))
    model = said.get("model", model)
    if "coeffs" in said:
        D = np.array(
            [float(part) if _is_number(part) else np.nan for part in said["coeffs"].split(",")]
        )
    return sdk_distortion(model, D, where)


def _extrinsics(bag: Bag, prefix: str) -> NDArray[np.float64]:
    """T_stream_reference (4, 4): the SDK keeps how the reference's points look to the stream."""
    name = next((each for each in sorted(bag.topics) if each.startswith(f"{prefix}/tf/")), None)
    T = np.eye(4)
    if name is None:
        return T
    message: Any = bag.message(name, 0)
    if hasattr(message, "data"):  # text, rotation column by column
        fields = _fields(message.data)
        parts = [fields.get(key, "").split(",") for key in ("rotation", "translation")]
        if [len(part) for part in parts] != [9, 3] or not all(map(_is_number, sum(parts, []))):
            raise DatasetError(f"{bag.path}: {name} holds no rotation and translation")
        T[:3, :3] = np.array(parts[0], float).reshape(3, 3).T
        T[:3, 3] = np.array(parts[1], float)
    else:
        q, t = message.rotation, message.translation
        rotation = np.array([[q.x, q.y, q.z, q.w]])
        if not np.linalg.norm(rotation) > 0.5:
            raise DatasetError(f"{bag.path}: {name} holds no rotation")
        T[:3, :3] = quaternion_to_rotation(rotation)[0]
        T[:3, 3] = t.x, t.y, t.z
    try:
        return check_rigid(T, f"{bag.path} {name}")
    except PoseError as error:
        raise DatasetError(str(error)) from None


def _depth_scale(bag: Bag, depth: Stream) -> float:
    """Units a metre, by what the sensor said of its units."""
    sensor = depth.prefix.rpartition("/")[0]
    name = f"{sensor}/option/Depth_Units/value"
    if name not in bag.topics:
        name = f"{sensor}/option/Depth Units/value"
    if name not in bag.topics:
        return MILLIMETRES
    try:
        value = float(bag.message(name, 0).data)
    except (FrameError, ValueError):
        return MILLIMETRES
    if not (np.isfinite(value) and value > 0):
        raise DatasetError(f"{bag.path}: {name} is {value}, no length; give depth_scale")
    return round(1 / value, 6)


def _partners(depth: Stream, color: Stream | None) -> NDArray[np.intp]:
    """The number of the colour image of every depth image, -1 where none is within half a period."""
    if color is None:
        return np.full(len(depth.times), -1)
    half = np.median(np.diff(depth.times)) / 2 if len(depth.times) > 1 else np.inf
    near = nearest(color.times, depth.times)
    close = np.abs(color.times[near] - depth.times) <= half
    return np.where(close, color.order[near], -1)


def _text(bag: Bag, name: str) -> str:
    """The text of a topic's first message; empty where there is none."""
    if name not in bag.topics or bag.topics[name].type != "std_msgs/msg/String":
        return ""
    try:
        return str(bag.message(name, 0).data)
    except FrameError:
        return ""


def _fields(text: str) -> dict[str, str]:
    """key=value;key=value"""
    return dict(part.split("=", 1) for part in text.split(";") if "=" in part)


def _is_number(word: str) -> bool:
    try:
        return bool(np.isfinite(float(word)))
    except ValueError:
        return False
