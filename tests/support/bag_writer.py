"""Writes small bags of ROS 1 and ROS 2 with rosbags, from ROS's own descriptions of the messages."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from dataset_writers import CAMERA, quaternion

from taichi_unifusion.types import PinholeCamera

DEPTH, COLOR = "/camera/depth/image_raw", "/camera/color/image_raw"
OPTICAL = "camera_optical_frame"
CONTAINERS = ("bag", "bag-bz2", "bag-lz4", "mcap", "mcap-zstd", "db3")


@dataclass(frozen=True)
class Message:
    """A message to be written, its time [s], and how to make it of a store's types."""

    topic: str
    kind: str
    time: float
    fields: dict[str, Any]


def stamp_of(time: float) -> dict[str, int]:
    nanoseconds = int(time) * 10**9 + round(time % 1 * 1e9)
    return {"sec": nanoseconds // 10**9, "nanosec": nanoseconds % 10**9}


def header(time: float, frame: str) -> dict[str, Any]:
    return {"stamp": stamp_of(time), "frame_id": frame}


def image(
    topic: str,
    array: np.ndarray,
    encoding: str,
    time: float,
    frame: str = OPTICAL,
    *,
    big_endian: bool = False,
    padding: int = 0,
) -> Message:
    """A raw image; `padding` bytes of noise end each row."""
    if big_endian:
        array = array.astype(array.dtype.newbyteorder(">"))
    rows = array.reshape(len(array), -1).view(np.uint8)
    noise = np.full((len(rows), padding), 0xAB, np.uint8)
    rows = np.ascontiguousarray(np.hstack([rows, noise]))
    fields = {
        "header": header(time, frame),
        "height": array.shape[0],
        "width": array.shape[1],
        "encoding": encoding,
        "is_bigendian": int(big_endian),
        "step": rows.shape[1],
        "data": rows.ravel(),
    }
    return Message(topic, "sensor_msgs/msg/Image", time, fields)


def compressed(topic: str, data: bytes, form: str, time: float, frame: str = OPTICAL) -> Message:
    fields = {
        "header": header(time, frame),
        "format": form,
        "data": np.frombuffer(data, np.uint8),
    }
    return Message(topic, "sensor_msgs/msg/CompressedImage", time, fields)


def depth_png(units: np.ndarray, a: float = 0.0, b: float = 0.0) -> bytes:
    """Units as compressed_depth_image_transport writes them."""
    return struct.pack("<iff", 0, a, b) + cv2.imencode(".png", units)[1].tobytes()


def depth_rvl(units: np.ndarray) -> bytes:
    """Units in RVL, number by number as its author's program writes them."""
    nibbles: list[int] = []

    def put(value: int) -> None:
        while True:
            value, nibble = value >> 3, value & 7
            nibbles.append(nibble | 8 if value else nibble)
            if not value:
                return

    pixels, at, before = units.ravel().tolist(), 0, 0
    while at < len(pixels):
        start = at
        while at < len(pixels) and pixels[at] == 0:
            at += 1
        put(at - start)
        start = at
        while at < len(pixels) and pixels[at] != 0:
            at += 1
        put(at - start)
        for pixel in pixels[start:at]:
            step = pixel - before
            put((step << 1) ^ (step >> 31))
            before = pixel
    nibbles += [0] * (-len(nibbles) % 8)
    words = [
        int("".join(f"{nibble:x}" for nibble in nibbles[i : i + 8]), 16)
        for i in range(0, len(nibbles), 8)
    ]
    head = struct.pack("<iff", 0, 0, 0) + struct.pack("<II", units.shape[1], units.shape[0])
    return head + struct.pack(f"<{len(words)}I", *words)


def camera_info(
    topic: str,
    time: float,
    frame: str = OPTICAL,
    camera: PinholeCamera = CAMERA,
    distortion: Iterable[float] = (),
    model: str = "plumb_bob",
) -> Message:
    K = camera.matrix.ravel()
    fields = {
        "header": header(time, frame),
        "height": camera.height,
        "width": camera.width,
        "distortion_model": model,
        "d": np.array([*distortion], np.float64),
        "k": K,
        "r": np.eye(3).ravel(),
        "p": np.hstack([camera.matrix, np.zeros((3, 1))]).ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": {
            "x_offset": 0,
            "y_offset": 0,
            "height": 0,
            "width": 0,
            "do_rectify": False,
        },
    }
    return Message(topic, "sensor_msgs/msg/CameraInfo", time, fields)


def _pose(T: np.ndarray, names: tuple[str, str]) -> dict[str, Any]:
    t, q = T[:3, 3], quaternion(T[:3, :3])
    return {
        names[0]: dict(zip("xyz", map(float, t), strict=True)),
        names[1]: dict(zip("xyzw", map(float, q), strict=True)),
    }


def transform(
    T_parent_child: np.ndarray, time: float, parent: str, child: str = OPTICAL, static: bool = False
) -> Message:
    fields = {
        "transforms": [
            {
                "header": header(time, parent),
                "child_frame_id": child,
                "transform": _pose(T_parent_child, ("translation", "rotation")),
            }
        ]
    }
    return Message("/tf_static" if static else "/tf", "tf2_msgs/msg/TFMessage", time, fields)


def odometry(T: np.ndarray, time: float, child: str, topic: str = "/odom") -> Message:
    zero = dict.fromkeys("xyz", 0.0)
    fields = {
        "header": header(time, "odom"),
        "child_frame_id": child,
        "pose": {"pose": _pose(T, ("position", "orientation")), "covariance": np.zeros(36)},
        "twist": {"twist": {"linear": zero, "angular": zero}, "covariance": np.zeros(36)},
    }
    return Message(topic, "nav_msgs/msg/Odometry", time, fields)


def pose_stamped(T: np.ndarray, time: float, topic: str = "/pose") -> Message:
    fields = {"header": header(time, "map"), "pose": _pose(T, ("position", "orientation"))}
    return Message(topic, "geometry_msgs/msg/PoseStamped", time, fields)


def text(topic: str, data: str, time: float = 0.0) -> Message:
    return Message(topic, "std_msgs/msg/String", time, {"data": data})


def recording(samples, *, depth_encoding: str = "16UC1") -> list[Message]:
    """Depth, colour, CameraInfo and a transform from map for every sample."""
    messages = []
    for sample in samples:
        time = sample.timestamp
        messages += [
            transform(sample.T_world_camera, time, "map"),
            camera_info("/camera/depth/camera_info", time),
            image(DEPTH, sample.units, depth_encoding, time),
            image(COLOR, sample.color, "rgb8", time + 0.004),
        ]
    return messages


def write_bag(path: Path, messages: Iterable[Message], container: str = "bag") -> Path:
    """Write messages; the path that is opened: `path` with a suffix, or the folder `path`."""
    pytest.importorskip("rosbags", reason="bags are written and read with rosbags, extra 'ros'")
    kind, _, compression = container.partition("-")
    if kind == "bag":
        return _write_ros1(path.with_suffix(".bag"), messages, compression)
    return _write_ros2(path, messages, kind, compression)


def _write_ros1(path: Path, messages: Iterable[Message], compression: str) -> Path:
    from rosbags.rosbag1 import Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC)
    text = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(text, "tf2_msgs/msg/TFMessage"))
    writer = Writer(path)
    if compression:
        writer.set_compression(getattr(Writer.CompressionFormat, compression.upper()))
    with writer:
        connections = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.kind, typestore=store
                )
            value = make(store, message.kind, message.fields)
            data = store.serialize_ros1(value, message.kind)
            writer.write(connections[message.topic], round(message.time * 1e9), data)
    return path


def _write_ros2(path: Path, messages: Iterable[Message], kind: str, compression: str) -> Path:
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.LATEST)
    plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
    writer = Writer(path, version=9, storage_plugin=plugin)
    if compression:
        mode = CompressionMode.MESSAGE if compression == "message" else CompressionMode.STORAGE
        writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {}
        for message in messages:
            if message.topic not in connections:
                connections[message.topic] = writer.add_connection(
                    message.topic, message.kind, typestore=store
                )
            value = make(store, message.kind, message.fields)
            data = store.serialize_cdr(value, message.kind)
            writer.write(connections[message.topic], round(message.time * 1e9), data)
    return path


def make(store, kind: str, fields: dict[str, Any]):
    """A message of a store's type from plain values: ROS 1 writes K for k, and counts headers."""
    from rosbags.interfaces import Nodetype

    values = {}
    for name, (node, inner) in store.fielddefs[kind][1]:
        if name == "seq":
            values[name] = 0
            continue
        value = fields[name] if name in fields else fields[name.lower()]
        if node == Nodetype.NAME:
            value = make(store, inner, value)
        elif node in (Nodetype.SEQUENCE, Nodetype.ARRAY) and inner[0][0] == Nodetype.NAME:
            value = [make(store, inner[0][1], each) for each in value]
        values[name] = value
    return store.types[kind](**values)
