"""ScanNet's `.sens` container, version 4: a header, then one record a frame; little-endian
throughout.

    u32 version, u64 length + sensor name,
    4 x (4x4 f32): intrinsic and extrinsic of colour, intrinsic and extrinsic of depth,
    i32 colour compression (0 raw RGB, 1 PNG, 2 JPEG),
    i32 depth compression (0 raw u16, 1 zlib u16, 2 Occipital's own),
    u32 colour width, height, u32 depth width, height, f32 depth units a metre, u64 frames;
    a frame: 4x4 f32 camera-to-world, u64 colour and u64 depth time stamp [us],
    u64 colour and u64 depth bytes, the two images.

Opening walks the records without reading images; every size is judged before anything is allocated
for it.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from .image_headers import MAX_PIXELS
from .images import decode_color
from .trajectories import Pose

VERSION = 4
COLOR_RAW, COLOR_PNG, COLOR_JPEG = 0, 1, 2
DEPTH_RAW, DEPTH_ZLIB, DEPTH_OCCIPITAL = 0, 1, 2
MAX_NAME_BYTES = 4096
MAX_FRAMES = 10_000_000  # four days at 30 Hz
FRAME_HEADER = struct.Struct("<16f4Q")
CALIBRATION = struct.Struct("<64f2i4IfQ")
OVERHEAD = 1 << 20  # [bytes] that a compressed image may need beyond its pixels' size


@dataclass(frozen=True)
class SensHeader:
    """What stands before the first frame; sizes are (width, height) [pixels]."""

    intrinsic_depth: NDArray[np.float64]  # (4, 4)
    extrinsic_depth: NDArray[np.float64]  # (4, 4)
    color_compression: int
    depth_compression: int
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    depth_scale: float  # units a metre
    frame_count: int


@dataclass(frozen=True)
class SensRecord:
    """Where one frame's images lie in the file, and its pose."""

    pose: Pose
    timestamp: float  # [s], of depth
    offset: int  # of the colour image; depth follows it
    color_bytes: int
    depth_bytes: int


def open_sens(path: Path) -> tuple[SensHeader, list[SensRecord], list[str]]:
    """Header, records and warnings of the file; DatasetError says why it cannot be used."""
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            header = _read_header(file, path)
            return header, *_read_records(file, path, header, size)
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read ({error.strerror})") from error


def read_images(path: Path, record: SensRecord) -> tuple[bytes, bytes]:
    """The bytes of a frame's colour and depth image; raises FrameError."""
    try:
        with open(path, "rb") as file:
            file.seek(record.offset)
            return file.read(record.color_bytes), file.read(record.depth_bytes)
    except OSError as error:
        raise FrameError(f"{path}: cannot be read ({error.strerror})") from error


def decode_sens_color(
    data: bytes, header: SensHeader, where: str, *, drop_alpha: bool = False
) -> NDArray[np.uint8]:
    """The bytes of a colour image -> (H, W, 3) RGB."""
    if header.color_compression != COLOR_RAW:
        return decode_color(data, where, drop_alpha=drop_alpha)
    width, height = header.color_size
    if len(data) != width * height * 3:
        raise FrameError(
            f"{where}: raw {width}x{height} RGB needs {width * height * 3} bytes, found {len(data)}"
        )
    return np.frombuffer(data, np.uint8).reshape(height, width, 3)


def decode_sens_depth(data: bytes, header: SensHeader, where: str) -> NDArray[np.uint16]:
    """The bytes of a depth image -> (H, W) units; never inflates more than the image needs."""
    width, height = header.depth_size
    wanted = width * height * 2
    if header.depth_compression == DEPTH_ZLIB:
        try:
            data = zlib.decompressobj().decompress(data, wanted + 1)
        except zlib.error as error:
            raise FrameError(f"{where}: damaged ({error})") from error
    if len(data) != wanted:
        raise FrameError(
            f"{where}: {width}x{height} pixels need {wanted} bytes, found "
            f"{'more' if len(data) > wanted else len(data)}"
        )
    return np.frombuffer(data, "<u2").reshape(height, width)


def _read_header(file: BinaryIO, path: Path) -> SensHeader:
    """Read and judge the header; DatasetError says what is wrong with it."""
    version, name_bytes = struct.unpack("<IQ", _exactly(file, 12, path))
    if version != VERSION:
        raise DatasetError(
            f"{path}: not a .sens file of version {VERSION} (it says version {version})"
        )
    if name_bytes > MAX_NAME_BYTES:
        raise DatasetError(
            f"{path}: damaged .sens header, the sensor's name would have {name_bytes} bytes"
        )
    _exactly(file, name_bytes, path)
    *matrices, color, depth, cw, ch, dw, dh, scale, count = CALIBRATION.unpack(
        _exactly(file, CALIBRATION.size, path)
    )
    if color not in (COLOR_RAW, COLOR_PNG, COLOR_JPEG):
        raise DatasetError(
            f"{path}: colour compression {color} is unknown; 0 (raw), 1 (PNG) and 2 (JPEG) can be read"
        )
    if depth not in (DEPTH_RAW, DEPTH_ZLIB):
        known = (
            "Occipital's own, which has no public decoder"
            if depth == DEPTH_OCCIPITAL
            else "unknown"
        )
        raise DatasetError(
            f"{path}: depth compression {depth} is {known}; 0 (raw) and 1 (zlib) can be read"
        )
    if not 0 < dw * dh <= MAX_PIXELS or cw * ch > MAX_PIXELS:
        raise DatasetError(
            f"{path}: damaged .sens header, depth of {dw}x{dh} and colour of {cw}x{ch} pixels"
        )
    if count > MAX_FRAMES:
        raise DatasetError(f"{path}: damaged .sens header, it promises {count} frames")
    _, _, intrinsic_depth, extrinsic_depth = np.array(matrices, dtype=np.float64).reshape(4, 4, 4)
    return SensHeader(
        intrinsic_depth, extrinsic_depth, color, depth, (cw, ch), (dw, dh), scale, count
    )


def _read_records(
    file: BinaryIO, path: Path, header: SensHeader, file_size: int
) -> tuple[list[SensRecord], list[str]]:
    """Walk the frames from the file's position, seeking over the images; (records, warnings).

    A file that ends early (an unfinished download) keeps the frames before its end; sizes that no
    image of the header's dimensions can have are a DatasetError.
    """
    color_limit = header.color_size[0] * header.color_size[1] * 3 + OVERHEAD
    depth_limit = header.depth_size[0] * header.depth_size[1] * 2 + OVERHEAD
    records, at = [], file.tell()
    while len(records) < header.frame_count and at + FRAME_HEADER.size <= file_size:
        where = f"{path} frame {len(records)}"
        file.seek(at)
        *numbers, _, stamp, color_bytes, depth_bytes = FRAME_HEADER.unpack(
            _exactly(file, FRAME_HEADER.size, path)
        )
        if color_bytes > color_limit or depth_bytes > depth_limit:
            raise DatasetError(
                f"{where}: damaged record, colour of {color_bytes} and depth of {depth_bytes} bytes"
            )
        at += FRAME_HEADER.size
        if at + color_bytes + depth_bytes > file_size:
            break
        pose = Pose(where, np.array(numbers, dtype=np.float64).reshape(4, 4))
        records.append(SensRecord(pose, stamp * 1e-6, at, color_bytes, depth_bytes))
        at += color_bytes + depth_bytes
    if not records:
        raise DatasetError(
            f"{path}: holds no whole frame (its header promises {header.frame_count})"
        )
    warnings = []
    if len(records) < header.frame_count:
        warnings.append(
            f"{path}: the file ends within frame {len(records)} of {header.frame_count}; frames before it are used"
        )
    if not np.allclose(header.extrinsic_depth, np.eye(4), atol=1e-3):
        warnings.append(
            f"{path}: depth's extrinsic is not the identity (not registered to colour), ignored"
        )
    return records, warnings


def _exactly(file: BinaryIO, count: int, path: Path) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise DatasetError(f"{path}: too short to be a .sens file")
    return data
