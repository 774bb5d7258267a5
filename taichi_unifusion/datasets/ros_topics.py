"""Which topics of a bag are the depth images, the colour images and the cameras that took them."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import DatasetError, FrameError, InputError
from ..files.bags import Bag
from ..files.ros_images import is_color, is_depth, read_color_message, read_depth_message
from ..types import PinholeCamera
from .depth_registration import LensCamera

IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
INFO_TYPE = "sensor_msgs/msg/CameraInfo"
TRANSPORTS = ("compressedDepth", "compressed", "image_raw", "image_rect_raw", "image_rect", "image")
NO_DEPTH = re.compile(r"infra|(^|[/_])ir([/_]|$)|disparity|confidence|theora", re.IGNORECASE)
REGISTERED = re.compile(r"aligned|registered|depth_to_(color|rgb)", re.IGNORECASE)
DISTORTED = ("plumb_bob", "rational_polynomial", "")  # models of OpenCV with up to 8 numbers
TRIES = 5  # messages to look at before a topic counts as unreadable


@dataclass(frozen=True)
class ImageTopic:
    """A topic of images, and what its first readable message says."""

    name: str
    size: tuple[int, int]  # (width, height)
    frame: str  # of its coordinates
    count: int
    rectified: bool  # by its name: distortion is taken out

    @property
    def base(self) -> str:
        """The name without how the images are transported."""
        return re.sub(r"/compressed(Depth)?$", "", self.name)

    def __str__(self) -> str:
        return f"{self.name} ({self.size[0]}x{self.size[1]}, {self.count} images)"


def find_depth(bag: Bag, wanted: str | None) -> ImageTopic:
    """The topic of depth images that is named, else the one there is; DatasetError lists them where that
    is not clear.
    """
    if wanted is not None:
        return _named(bag, wanted, "depth_topic")
    found = [
        topic for name in _image_names(bag, NO_DEPTH) if (topic := _look(bag, name, depth=True))
    ]
    if not found:
        raise DatasetError(
            f"{bag.path}: no topic of depth images (16UC1, 32FC1, mono16 or compressedDepth); it has "
            f"{_listed(sorted(bag.topics))}"
        )
    found = _without_copies(found)
    registered = [topic for topic in found if REGISTERED.search(topic.name)]
    return _only(bag, registered or found, "depth", "depth_topic")


def find_color(bag: Bag, wanted: str | None, depth: ImageTopic) -> ImageTopic | None:
    """The topic of colour images that is named, else the one that belongs to the depth images; None
    where there is none.
    """
    if wanted is not None:
        return None if wanted == "none" else _named(bag, wanted, "color_topic")
    names = [name for name in _image_names(bag, None) if name != depth.name]
    found = [topic for name in names if (topic := _look(bag, name, depth=False))]
    if not found:
        return None
    found = _without_copies(found)
    shown = [topic for topic in found if not NO_DEPTH.search(topic.name)] or found
    shown = [topic for topic in shown if topic.frame == depth.frame] or shown
    near = max(_shared(topic.name, depth.name) for topic in shown)
    shown = [topic for topic in shown if _shared(topic.name, depth.name) == near]
    colored = [topic for topic in shown if re.search(r"colou?r|rgb", topic.base)] or shown
    return _only(bag, colored, "colour", "color_topic")


def find_lens(bag: Bag, images: ImageTopic, wanted: str | None = None) -> LensCamera | None:
    """The camera of an image topic, with its distortion, from the CameraInfo beside it or the one that is
    named; None where there is none.
    """
    infos = sorted(name for name, topic in bag.topics.items() if topic.type == INFO_TYPE)
    if wanted is not None and wanted not in infos:
        raise DatasetError(
            f"{bag.path}: no CameraInfo under '{wanted}'; there are {_listed(infos) or 'none'}"
        )
    beside = [name for name in infos if _folder(name) == _folder(images.base)]
    near = beside or infos
    if not beside and len(infos) > 1:
        frames = {name: _first(bag, name) for name in infos}
        near = [
            name
            for name, info in frames.items()
            if info is not None and info.header.frame_id.lstrip("/") == images.frame
        ]
    chosen = wanted or (near[0] if len(near) == 1 else None)
    info = _first(bag, chosen) if chosen else None
    return None if chosen is None or info is None else _lens(info, images, f"{bag.path} {chosen}")


def _lens(info: Any, images: ImageTopic, where: str) -> LensCamera:
    K, D, P = (
        np.asarray(getattr(info, name, getattr(info, name.lower(), ()))) for name in ("K", "D", "P")
    )
    rectified = images.rectified and len(P) == 12 and P[0] > 0
    matrix = P.reshape(3, 4)[:, :3] if rectified else K.reshape(3, 3)
    distortion = () if rectified or not np.any(D) else tuple(float(k) for k in D)
    if distortion and (info.distortion_model not in DISTORTED or len(distortion) > 8):
        raise DatasetError(
            f"{where}: the lens is '{info.distortion_model[:40]}' with {len(distortion)} numbers, which cannot be "
            "undone here; use a rectified topic (image_rect)"
        )
    size = int(info.width) or images.size[0], int(info.height) or images.size[1]
    try:
        camera = PinholeCamera(
            *size,
            float(matrix[0, 0]),
            float(matrix[1, 1]),
            float(matrix[0, 2]),
            float(matrix[1, 2]),
        )
    except InputError as error:
        raise DatasetError(f"{where}: {error}") from error
    return LensCamera(camera, (*distortion, *[0.0] * (8 - len(distortion))))


def _image_names(bag: Bag, refused: re.Pattern[str] | None) -> list[str]:
    return [
        name
        for name, topic in sorted(bag.topics.items())
        if topic.type in IMAGE_TYPES and not (refused and refused.search(name))
    ]


def _named(bag: Bag, name: str, option: str) -> ImageTopic:
    known = _image_names(bag, None)
    if name not in known:
        raise DatasetError(f"{bag.path}: {option} '{name}' is none of {_listed(known)}")
    topic = _look(bag, name, depth=option == "depth_topic", strict=True)
    if topic is None:
        kind = "depth" if option == "depth_topic" else "colour"
        raise DatasetError(f"{bag.path}: {option} '{name}' holds no {kind} images that can be read")
    return topic


def _look(bag: Bag, name: str, *, depth: bool, strict: bool = False) -> ImageTopic | None:
    """What a topic's first readable message says, None if that is of the other kind."""
    suits, read = (
        (is_depth, lambda message, where: read_depth_message(message, where, 1000.0))
        if depth
        else (is_color, read_color_message)
    )
    for index in range(min(bag.count(name), TRIES)):
        try:
            message = bag.message(name, index)
            if not suits(message, name):
                return None
            height, width = read(message, f"{bag.path} {name}").shape[:2]
        except FrameError:
            continue
        rectified = "rect" in name.rsplit("/", 2)[-1] or "rect" in os.path.basename(_base(name))
        return ImageTopic(
            name, (width, height), message.header.frame_id.lstrip("/"), bag.count(name), rectified
        )
    return None


def _first(bag: Bag, name: str) -> Any:
    for index in range(min(bag.count(name), TRIES)):
        try:
            return bag.message(name, index)
        except FrameError:
            continue
    return None


def _without_copies(topics: Sequence[ImageTopic]) -> list[ImageTopic]:
    """One of the topics that hold the same images: the one with the most, raw before compressed."""
    best: dict[str, ImageTopic] = {}
    for topic in topics:
        other = best.get(topic.base)
        if other is None or (topic.count, -len(topic.name)) > (other.count, -len(other.name)):
            best[topic.base] = topic
    return list(best.values())


def _only(bag: Bag, found: Sequence[ImageTopic], kind: str, option: str) -> ImageTopic:
    if len(found) > 1:
        raise DatasetError(
            f"{bag.path}: {len(found)} topics hold {kind} images; name one with --option {option}=, of "
            f"{_listed([str(topic) for topic in found])}"
        )
    return found[0]


def _base(name: str) -> str:
    return re.sub(r"/compressed(Depth)?$", "", name)


def _folder(name: str) -> str:
    return name.rpartition("/")[0]


def _shared(a: str, b: str) -> int:
    """How many parts of their names two topics begin with in common."""
    return len(os.path.commonprefix([a.split("/"), b.split("/")]))


def _listed(names: Sequence[str], most: int = 20) -> str:
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
