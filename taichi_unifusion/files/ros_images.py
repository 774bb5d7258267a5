"""Images in messages of ROS: raw, compressed, and depth as compressed_depth_image_transport writes it.

Depth is metres, 0 where there is no reading: 32FC1 holds metres, 16UC1 and mono16 hold units of which
`depth_scale` make one. Rows may be padded (`step`), bytes in either order (`is_bigendian`).
"""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from .image_headers import MAX_PIXELS
from .images import INVALID_DEPTH, decode_image, depth_to_metres

DEPTH_ENCODINGS = ("16UC1", "mono16", "32FC1", "16SC1", "Z16")
COLORS = {  # encoding -> channels, conversion to RGB
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8UC3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8UC4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8UC1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),  # OpenCV names the second row's pixels
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}
DEPTH_HEAD = struct.Struct(
    "<iff"
)  # of compressed depth: its kind, two numbers that quantise floats
RVL_HEAD = struct.Struct("<II")  # columns, rows


def is_compressed(message: Any) -> bool:
    """Whether this is a CompressedImage rather than an Image."""
    return not hasattr(message, "encoding")


def _color_encoding(message: Any) -> str:
    """The encoding as ROS spells it: the RealSense SDK writes some in capitals."""
    return message.encoding if message.encoding in COLORS else message.encoding.lower()


def is_depth(message: Any, topic: str = "") -> bool:
    """Whether an Image or CompressedImage holds depth, by its encoding and its topic's name."""
    if is_compressed(message):
        form = message.format
        return "compressedDepth" in form or topic.endswith("/compressedDepth")
    return message.encoding in DEPTH_ENCODINGS


def is_color(message: Any, topic: str = "") -> bool:
    """Whether an Image or CompressedImage holds a picture."""
    if is_compressed(message):
        return not is_depth(message, topic) and not message.format.startswith(DEPTH_ENCODINGS)
    return _color_encoding(message) in COLORS


def read_depth_message(message: Any, where: str, depth_scale: float) -> NDArray[np.float32]:
    """(H, W) metres of an Image or CompressedImage; FrameError says what is wrong with it."""
    if is_compressed(message):
        raw = _compressed_depth(bytes(memoryview(message.data)), message.format, where)
    else:
        if message.encoding not in DEPTH_ENCODINGS:
            raise FrameError(
                f"{where}: encoding '{message.encoding[:40]}' holds no depth; expected one of "
                f"{', '.join(DEPTH_ENCODINGS)}"
            )
        raw = _pixels(message, "f4" if message.encoding == "32FC1" else "u2", 1, where)
    if raw.dtype == np.uint16:
        return depth_to_metres(raw, where, depth_scale, INVALID_DEPTH)
    return np.where(np.isfinite(raw) & (raw > 0), raw, np.float32(0))


def read_color_message(message: Any, where: str) -> NDArray[np.uint8]:
    """(H, W, 3) RGB of an Image or CompressedImage; FrameError says what is wrong with it."""
    if is_compressed(message):
        image = decode_image(bytes(memoryview(message.data)), where)
        if image.dtype != np.uint8:
            raise FrameError(f"{where}: colour must be 8 bits a channel, got {image.dtype}")
        kinds = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
        return np.asarray(
            cv2.cvtColor(image, kinds[1 if image.ndim == 2 else image.shape[2]]), np.uint8
        )
    if _color_encoding(message) not in COLORS:
        raise FrameError(
            f"{where}: encoding '{message.encoding[:40]}' is no colour that is known; expected one of "
            f"{', '.join(COLORS)}"
        )
    channels, conversion = COLORS[_color_encoding(message)]
    image = np.ascontiguousarray(_pixels(message, "u1", channels, where))
    if conversion is None:
        return image
    try:
        return np.asarray(cv2.cvtColor(image, conversion), np.uint8)
    except cv2.error as error:
        raise FrameError(
            f"{where}: {message.encoding} cannot be converted ({error.err})"
        ) from error


def _pixels(message: Any, kind: str, channels: int, where: str) -> NDArray[Any]:
    """(H, W) or (H, W, c) of an Image, in this machine's order of bytes."""
    dtype = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    height, width, step = int(message.height), int(message.width), int(message.step)
    row = width * channels * dtype.itemsize
    step = step or row
    data = np.frombuffer(memoryview(message.data), np.uint8)
    needed = step * (height - 1) + row
    if not 0 < width * height <= MAX_PIXELS or step < row or len(data) < needed:
        raise FrameError(
            f"{where}: {len(data)} bytes do not hold {width}x{height} pixels of '{message.encoding[:40]}' "
            f"in rows of {step} bytes"
        )
    rows = np.lib.stride_tricks.as_strided(data, (height, row), (step, 1))
    shape = (height, width) if channels == 1 else (height, width, channels)
    return np.ascontiguousarray(rows).view(dtype).reshape(shape).astype(np.dtype(kind))


def _compressed_depth(data: bytes, form: str, where: str) -> NDArray[Any]:
    """(H, W) uint16 units, or float32 metres, of what compressed_depth_image_transport writes."""
    if len(data) <= DEPTH_HEAD.size:
        raise FrameError(f"{where}: compressed depth of {len(data)} bytes is cut off")
    _, a, b = DEPTH_HEAD.unpack_from(data)
    content = data[DEPTH_HEAD.size :]
    if content[1:4] != b"PNG" and data[1:4] == b"PNG":  # written without the head
        content = data
    raw = decode_rvl(content, where) if "rvl" in form.lower() else decode_image(content, where)
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise FrameError(f"{where}: compressed depth is not one channel of 16 bits")
    if not form.startswith("32FC1"):
        return raw
    if not (np.isfinite(a) and np.isfinite(b) and a > 0):
        raise FrameError(f"{where}: the head of its compressed depth is damaged")
    inverse = raw.astype(np.float32) - np.float32(b)  # the encoder keeps A / z + B
    return np.where((raw > 0) & (inverse > 0), np.float32(a) / np.where(inverse > 0, inverse, 1), 0)


def decode_rvl(data: bytes, where: str) -> NDArray[np.uint16]:
    """(H, W) of a depth image in RVL (Wilson 2017), after its head of columns and rows.

    The stream is nibbles, three bits of a number each, the last of a number without the fourth: how
    many pixels are 0, how many are not, and of these the steps from one to the next.
    """
    if len(data) < RVL_HEAD.size:
        raise FrameError(f"{where}: RVL depth is cut off")
    width, height = RVL_HEAD.unpack_from(data)
    size = width * height
    if not 0 < size <= MAX_PIXELS:
        raise FrameError(f"{where}: RVL depth says {width}x{height} pixels, refused")
    words = np.frombuffer(data[RVL_HEAD.size : len(data) - (len(data) - RVL_HEAD.size) % 4], "<u4")
    nibbles = (
        (words[:, None] >> np.arange(28, -1, -4, dtype=np.uint32) & 15).astype(np.int64).ravel()
    )
    ends = np.flatnonzero(nibbles < 8)
    if not len(ends):
        raise FrameError(f"{where}: RVL depth is damaged")
    starts = np.concatenate([[0], ends[:-1] + 1])
    place = np.arange(ends[-1] + 1) - np.repeat(starts, ends - starts + 1)  # within its number
    digits = (nibbles[: ends[-1] + 1] & 7) << np.minimum(3 * place, 60)
    numbers = np.add.reduceat(digits, starts)
    pixels, at, filled = np.zeros(size, np.int64), 0, 0
    is_step = np.zeros(len(numbers), bool)
    while filled < size and at + 1 < len(numbers):
        zeros, others = int(numbers[at]), int(numbers[at + 1])
        start = filled + zeros
        if start + others > size or at + 2 + others > len(numbers):
            raise FrameError(f"{where}: RVL depth is damaged or cut off")
        pixels[start : start + others] = 1
        is_step[at + 2 : at + 2 + others] = True
        at, filled = at + 2 + others, start + others
        if not zeros + others:
            raise FrameError(f"{where}: RVL depth is damaged")
    if filled < size:
        raise FrameError(f"{where}: RVL depth is cut off")
    steps = numbers[is_step]
    pixels[pixels == 1] = np.cumsum((steps >> 1) ^ -(steps & 1))
    return pixels.astype(np.uint16).reshape(height, width)
