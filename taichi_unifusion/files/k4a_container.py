"""The Matroska files of an Azure Kinect: tracks of images by title, and the attached calibration.

Depth and infrared are tracks of 16-bit big-endian images, colour is MJPEG, NV12 or YUY2.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, MissingDependency
from .images import decode_color

DEPTH, COLOR, INFRARED = TRACKS = ("DEPTH", "COLOR", "IR")  # titles
CALIBRATION = "calibration.json"


@dataclass(frozen=True)
class K4aContents:
    """What a recording holds, by title of the track: DEPTH, and COLOR and IR where they are."""

    sizes: dict[str, tuple[int, int]]  # (width, height) [pixels]
    stamps: dict[str, NDArray[np.int64]]  # of images, ascending, in the file's unit
    unit: float  # [s] of a time stamp, the same for all tracks
    calibration: bytes  # calibration.json


def read_contents(path: Path) -> K4aContents:
    """Read everything but the images; DatasetError where this is no such recording."""
    with _opened(path) as container:
        streams = _tracks(container, path)
        attached = next(
            (s.data for s in container.streams.attachments if s.name == CALIBRATION), None
        )
        if attached is None:
            raise DatasetError(
                f"{path}: no {CALIBRATION} is attached; was the recording converted by another program?"
            )
        stamps: dict[str, list[int]] = {title: [] for title in streams}
        for packet in container.demux(*streams.values()):
            if packet.pts is not None:
                stamps[_title(packet.stream)].append(packet.pts)
        return K4aContents(
            {title: (stream.width, stream.height) for title, stream in streams.items()},
            {title: np.array(sorted(values), np.int64) for title, values in stamps.items()},
            float(streams[DEPTH].time_base),
            attached,
        )


def read_images(path: Path, wanted: Mapping[str, int], where: str) -> dict[str, NDArray[Any]]:
    """The images with these time stamps by title of their track, as they are in the file: (H, W)
    uint16, colour (H, W, 3) RGB; FrameError where one cannot be read.
    """
    images: dict[str, NDArray[Any]] = {}
    with _opened(path) as container:
        streams = _tracks(container, path)
        container.seek(min(wanted.values()), stream=streams[DEPTH], backward=True)
        for packet in container.demux(*(streams[title] for title in wanted)):
            title = _title(packet.stream)
            if packet.pts == wanted[title]:
                images[title] = _decode(packet, title, f"{where} {title.lower()}")
            if len(images) == len(wanted) or packet.pts is None:
                break
    for title in wanted:
        if title not in images:
            raise FrameError(
                f"{where}: its {title.lower()} image cannot be read; the recording is damaged there"
            )
    return images


def _decode(packet: Any, title: str, where: str) -> NDArray[Any]:
    """The image in a packet: (H, W) uint16, or (H, W, 3) RGB for the colour track."""
    stream = packet.stream
    if title != COLOR:  # 16-bit big-endian, whatever the machine
        if packet.size != 2 * stream.width * stream.height:
            raise FrameError(
                f"{where}: holds {packet.size} bytes, not those of {stream.width}x{stream.height} 16-bit pixels"
            )
        return (
            np.frombuffer(bytes(packet), ">u2")
            .reshape(stream.height, stream.width)
            .astype(np.uint16)
        )
    if stream.codec_context.name == "mjpeg":
        return decode_color(bytes(packet), where)
    frames = packet.decode()
    if not frames:
        raise FrameError(f"{where}: cannot be decoded")
    return frames[0].to_ndarray(format="rgb24")


def _title(stream: Any) -> str:
    return stream.metadata.get("title", "").upper()


def _tracks(container: Any, path: Path) -> dict[str, Any]:
    """Title -> video stream of the tracks that are there; depth must be."""
    streams = {
        _title(stream): stream for stream in container.streams.video if _title(stream) in TRACKS
    }
    if DEPTH not in streams:
        raise DatasetError(
            f"{path}: has no track DEPTH (it has {', '.join(map(_title, container.streams.video)) or 'no images'}); "
            "give the .mkv file of an Azure Kinect"
        )
    for title, stream in streams.items():
        if stream.codec_context is None:
            raise DatasetError(f"{path}: track {title} is of a codec that is not known here")
        if title != COLOR and stream.codec_context.pix_fmt != "gray16be":
            raise DatasetError(
                f"{path}: track {title} is {stream.codec_context.pix_fmt}, not 16-bit big-endian"
            )
    return streams


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The file as a PyAV container; what PyAV cannot read becomes a DatasetError."""
    av = _import_av()
    try:
        with av.open(str(path), metadata_errors="replace") as container:
            yield container
    except av.error.FFmpegError as error:
        raise DatasetError(
            f"{path}: not a readable Matroska recording ({error.strerror})"
        ) from error


def _import_av() -> ModuleType:
    try:
        import av
    except ImportError:
        raise MissingDependency(
            "recordings of an Azure Kinect are read with PyAV: pip install 'taichi-unifusion[k4a]'"
        ) from None
    return av
