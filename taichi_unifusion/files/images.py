"""Colour and depth image files -> RGB bytes and metres; every failure to read one is a FrameError
that names the file. Pictures are written as PNG.

Files are read unchanged and their type checked: with OpenCV's default flag a 16-bit depth image
becomes 8-bit silently.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, SizeMismatch
from .atomic import atomic_write
from .image_headers import MAX_PIXELS, ImageHeader, check_whole, read_header

OPAQUE = 255  # alpha
INVALID_DEPTH = (0, 65535)  # no reading; 65535 is also what 16 bits saturate at
SAME_ASPECT = 0.01  # relative difference of width/height up to which colour is resized to depth
HEADER_BYTES = 4096  # the size in a PNG or PGM header stands within these


def read_color(path: Path, *, drop_alpha: bool = False) -> NDArray[np.uint8]:
    """The 8-bit colour image at `path` as (H, W, 3) RGB, grey as R = G = B; an alpha channel that is not
    opaque everywhere is an error unless `drop_alpha`.
    """
    return decode_color(_read_bytes(path), str(path), drop_alpha=drop_alpha)


def decode_color(data: bytes, where: str, *, drop_alpha: bool = False) -> NDArray[np.uint8]:
    """The bytes of a PNG or JPEG file as (H, W, 3) RGB; `where` names them in messages."""
    image = decode_image(data, where, _check_color_header)
    channels = 1 if image.ndim == 2 else image.shape[2]
    if channels == 1:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), np.uint8)
    if channels == 4 and (drop_alpha or (image[..., 3] == OPAQUE).all()):
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGRA2RGB), np.uint8)
    if channels != 3:
        advice = (
            "the fourth is not opaque everywhere; pass drop_alpha=True to ignore it"
            if channels == 4
            else "convert it to RGB"
        )
        raise FrameError(f"{where}: colour must have 3 channels, got {channels}; {advice}")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_depth(
    path: Path,
    depth_scale: float,
    invalid: Collection[int] = INVALID_DEPTH,
    size: tuple[int, int] | None = None,
    *,
    float_scale: float = 1.0,
) -> NDArray[np.float32]:
    """The depth image at `path` as (H, W) metres, 0 where there is no reading.

    PNG and PGM hold 16-bit integers, `depth_scale` units a metre, `invalid` among them. NPY holds
    integers of any size, the same units, or floats, `float_scale` of them a metre. With the `size`
    (width, height) of the camera, an image of another is a SizeMismatch before it is decoded.
    """
    if size is not None and (found := depth_file_size(path)) != size:
        raise SizeMismatch(
            f"{path}: depth is {found[0]}x{found[1]} but the camera is {size[0]}x{size[1]}"
        )
    if path.suffix.lower() != ".npy":
        image = decode_image(_read_bytes(path), str(path), _check_depth_header)
        return depth_to_metres(image, str(path), depth_scale, invalid)
    array = _one_plane(_open_npy(path), path)
    scale = float_scale if array.dtype.kind == "f" else depth_scale
    depth = np.array(array, np.float64 if array.dtype.itemsize > 2 else np.float32)
    bad = ~(np.isfinite(depth) & (depth > 0))
    for value in invalid:
        bad |= depth == value
    with np.errstate(over="ignore"):
        depth = (depth / scale).astype(np.float32)
    depth[bad | ~np.isfinite(depth)] = 0
    return depth


def holds_floats(path: Path) -> bool:
    """Whether the depth image at `path` is an array of floats, which are metres unless a scale is
    given; FrameError where it cannot be read.
    """
    return path.suffix.lower() == ".npy" and _open_npy(path).dtype.kind == "f"


def _one_plane(array: NDArray, path: Path) -> NDArray:
    """An array of depth as (H, W), also where a first or last axis of length 1 is left."""
    shape = array.shape
    if array.ndim == 3 and 1 in (shape[0], shape[2]):
        array = array[..., 0] if shape[2] == 1 else array[0]
    if array.ndim != 2 or array.dtype.kind not in "fiu" or array.dtype.itemsize < 2:
        raise FrameError(
            f"{path}: depth must be (H, W) numbers of 16 bits or more, got {shape} {array.dtype}; "
            "an 8-bit or coloured picture of depth holds no distances"
        )
    return array


def read_scaled_depth(path: Path, depth_scale: float) -> NDArray[np.float32]:
    """`read_depth`, where `depth_scale` counts for floats too."""
    depth = read_depth(path, depth_scale)
    if path.suffix.lower() == ".npy" and _open_npy(path).dtype.kind == "f":
        depth /= np.float32(depth_scale)
    return depth


def _check_color_header(header: ImageHeader, where: str) -> None:
    if header.bits != 8:
        raise FrameError(
            f"{where}: colour must be 8 bits a channel, got uint16; is this a depth image?"
        )


def _check_depth_header(header: ImageHeader, where: str) -> None:
    if (header.channels, header.bits) != (1, 16):
        raise FrameError(
            f"{where}: depth must be one channel of 16 bits, got {header.channels} of uint{header.bits}; "
            "an 8-bit or coloured picture of depth holds no distances"
        )


def depth_to_metres(
    raw: NDArray, where: str, depth_scale: float, invalid: Collection[int]
) -> NDArray[np.float32]:
    """(H, W) uint16 sensor units -> (H, W) float32 metres, 0 where the unit is one of `invalid`."""
    if raw.ndim != 2 or raw.dtype != np.uint16:
        channels = 1 if raw.ndim == 2 else raw.shape[-1]
        raise FrameError(
            f"{where}: depth must be one channel of 16 bits, got {channels} of {raw.dtype}; "
            "an 8-bit or coloured picture of depth holds no distances"
        )
    depth = raw.astype(np.float32)
    depth /= np.float32(depth_scale)
    for value in invalid:
        if value:
            depth[raw == value] = 0
    return depth


def read_infrared(path: Path) -> NDArray[np.float32]:
    """The infrared image at `path`, one channel of 8 or 16 bits, as (H, W) float32 of 0..65535."""
    image = decode_image(_read_bytes(path), str(path))
    if image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise FrameError(
            f"{path}: infrared must be one channel of 8 or 16 bits, got {channels} of {image.dtype}; convert it "
            "to grey values"
        )
    # 255 * 257 = 65535
    return image.astype(np.float32) * np.float32(257 if image.dtype == np.uint8 else 1)


def read_levels(path: Path) -> NDArray[np.uint8]:
    """The 8-bit picture of one channel at `path`, (H, W), such as of confidence."""
    image = decode_image(_read_bytes(path), str(path))
    if image.ndim != 2 or image.dtype != np.uint8:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise FrameError(f"{path}: must be one channel of 8 bits, got {channels} of {image.dtype}")
    return np.asarray(image, np.uint8)


def read_values(path: Path) -> NDArray[np.float32]:
    """The numbers at `path` as (H, W, c) float32: a `.npy` array as it is, a picture of 8 or 16
    bits (RGB) as [0, 1].
    """
    if path.suffix.lower() == ".npy":
        array = np.array(_open_npy(path))
        if array.ndim not in (2, 3) or array.dtype.kind not in "fiub":
            raise FrameError(
                f"{path}: must hold (H, W) or (H, W, c) numbers, got {array.shape} {array.dtype}"
            )
        return np.ascontiguousarray(array.reshape(*array.shape[:2], -1), np.float32)
    image = decode_image(_read_bytes(path), str(path))
    if image.dtype not in (np.uint8, np.uint16):
        raise FrameError(f"{path}: a picture must have 8 or 16 bits a channel, got {image.dtype}")
    image = image.reshape(*image.shape[:2], -1)
    if image.shape[2] >= 3:  # OpenCV has blue first
        image = image[..., [2, 1, 0, *range(3, image.shape[2])]]
    return np.ascontiguousarray(image, np.float32) / np.float32(np.iinfo(image.dtype).max)


def depth_file_size(path: Path) -> tuple[int, int]:
    """(width, height) of the depth image at `path`, from its header alone."""
    if path.suffix.lower() == ".npy":
        array = _one_plane(_open_npy(path), path)
        return array.shape[1], array.shape[0]
    header = read_header(_read_bytes(path, HEADER_BYTES), str(path))
    return header.width, header.height


def color_file_size(path: Path) -> tuple[int, int]:
    """(width, height) of the picture at `path`, from its header."""
    header = read_header(_read_bytes(path), str(path))
    return header.width, header.height


def resize_color(
    color: NDArray[np.uint8], width: int, height: int, where: str
) -> NDArray[np.uint8]:
    """Colour resampled to the depth image's size, or SizeMismatch where the shapes differ by more
    than 1 %.
    """
    return resize_image(color, width, height, where, "colour")


def resize_image(
    image: NDArray, width: int, height: int, where: str, what: str = "the image"
) -> NDArray:
    """An image (H, W[, c]) resampled to the depth image's size, or SizeMismatch where the shapes
    differ by more than 1 %.
    """
    image_height, image_width = image.shape[:2]
    if (image_width, image_height) == (width, height):
        return image
    if abs(image_width * height / (image_height * width) - 1) > SAME_ASPECT:
        raise SizeMismatch(
            f"{where}: {what} is {image_width}x{image_height} but depth is {width}x{height}, another shape; "
            f"register {what} to depth first"
        )
    return cv2.resize(
        image,
        (width, height),
        interpolation=cv2.INTER_AREA if width < image_width else cv2.INTER_LINEAR,
    )


def write_png(path: str | os.PathLike[str], image: NDArray[np.uint8]) -> None:
    """Write an RGB picture (H, W, 3) atomically; raises FileError where that fails."""
    content = cv2.imencode(".png", image[..., ::-1])[1]
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.tobytes())


def write_depth_png(path: str | os.PathLike[str], depth: NDArray[np.floating]) -> None:
    """Write depth (H, W) [m] as a PNG of 16-bit millimetres, 0 where there is none or it is farther
    than 65.534 m; raises FileError where that fails.
    """
    millimetres = np.where(depth < 65.5345, 1000 * depth + 0.5, 0).astype(np.uint16)
    content = cv2.imencode(".png", millimetres)[1]
    with atomic_write(path) as temporary:
        temporary.write_bytes(content.tobytes())


def encode_png(image: NDArray) -> bytes:
    """A PNG file of grey (H, W) of 8 or 16 bits, or of blue, green and red (H, W, 3) of 8."""
    return cv2.imencode(".png", np.ascontiguousarray(image))[1].tobytes()


def _read_bytes(path: Path, count: int = -1) -> bytes:
    try:
        with open(path, "rb") as file:
            return file.read(count)
    except FileNotFoundError:
        raise FrameError(f"{path}: no such file") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in a name that a list of images gave
        raise FrameError(
            f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})"
        ) from error


def decode_image(
    data: bytes, where: str, check: Callable[[ImageHeader, str], None] | None = None
) -> NDArray:
    """The bytes of a PNG, JPEG or PGM file as OpenCV decodes them, unchanged; FrameError otherwise.
    `check` may refuse it by its header before memory is taken.
    """
    header = read_header(data, where)
    if check is not None:
        check(header, where)
    check_whole(data, header, where)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise FrameError(
            f"{where}: the {header.kind} file cannot be decoded ({error.err})"
        ) from error
    if image is None:
        raise FrameError(f"{where}: the {header.kind} file is damaged and cannot be decoded")
    return image


def _open_npy(path: Path) -> NDArray:
    """The array in `path`, mapped and not yet read: a header that promises more than the file holds
    is refused here.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise FrameError(f"{path}: no such file") from None
    except Exception as error:  # NumPy parses the header as Python: any error escapes
        raise FrameError(f"{path}: not a readable .npy array ({error})") from error
    if not isinstance(array, np.ndarray) or array.size > MAX_PIXELS:
        raise FrameError(f"{path}: not one .npy array of at most {MAX_PIXELS} pixels")
    return array
