"""Bags of ROS 1 and ROS 2: a file or a folder of them, its topics, and its messages picked by number.

rosbags, which reads bags from front to end, gives the types of messages; where messages lie is found here,
so that a frame is read by itself, whatever the bag's size, and a bag that was cut off gives what is in it.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from .chunked_bag import BagTopic, missing_rosbags, zstd
from .frame_files import in_order
from .mcap_container import Mcap
from .packed_files import PACKED, Scratch
from .rosbag1_container import Rosbag1
from .sqlite_bag import SqliteBag

CONTAINERS = {".bag": Rosbag1, ".db3": SqliteBag, ".mcap": Mcap}
LARGEST_MESSAGE = 1 << 30  # bytes once decompressed
HEADED = frozenset(  # types that begin with a header
    f"{package}/msg/{name}"
    for package, names in {
        "sensor_msgs": ("Image", "CompressedImage", "CameraInfo"),
        "nav_msgs": ("Odometry",),
        "geometry_msgs": ("PoseStamped", "PoseWithCovarianceStamped", "TransformStamped"),
    }.items()
    for name in names
)


class Container(Protocol):
    """A file of a bag."""

    path: Path
    damage: str
    topics: dict[str, BagTopic]

    def times(self, topic: str) -> NDArray[np.int64]: ...
    def places(self, topic: str) -> NDArray[np.int64]: ...
    def read(self, topic: str, index: int, count: int | None = None) -> bytes: ...
    def close(self) -> None: ...


class Bag:
    """A bag, opened: `topics` by name, `damage` says where it was cut off."""

    def __init__(self, path: Path) -> None:
        self.path, self._scratch = path, Scratch()
        files, self._packed = _files_of(path)
        self._parts: list[Container] = []
        problems: list[str] = []
        for file in files:
            try:
                file, problem = self._scratch.unpacked(file)
                problems += [problem] if problem else []
                self._parts.append(CONTAINERS[file.suffix.lower()](file))
            except DatasetError as error:  # one part of a recording may be lost
                problems.append(str(error))
        if not self._parts:
            raise DatasetError(problems[0])
        self.damage = (*problems, *(part.damage for part in self._parts if part.damage))
        self.topics: dict[str, BagTopic] = {}
        for part in self._parts:
            for name, topic in part.topics.items():
                self.topics.setdefault(name, topic)
        if not self.topics:
            others = sorted({kind for part in self._parts for kind in getattr(part, "refused", ())})
            said = [f"its messages are {', '.join(others)[:80]}"] if others else []
            raise DatasetError("; ".join([f"{path}: holds no message of ROS", *said, *self.damage]))
        self._starts = {  # topic -> number of the first message of every part
            name: np.cumsum(
                [0, *(len(p.times(name)) if name in p.topics else 0 for p in self._parts)]
            )
            for name in self.topics
        }
        self._decode = _Decoder(self.topics)

    def count(self, topic: str) -> int:
        """How many messages a topic has."""
        return int(self._starts[topic][-1])

    def times(self, topic: str) -> NDArray[np.float64]:
        """When the messages of a topic were received [s]."""
        parts = [part.times(topic) for part in self._parts if topic in part.topics]
        return np.concatenate(parts) / 1e9

    def read(self, topic: str, index: int, count: int | None = None) -> bytes:
        """The bytes of a message, or the first `count` of them; FrameError where it is damaged."""
        starts = self._starts[topic]
        part = int(np.searchsorted(starts, index, side="right")) - 1
        own = index - int(starts[part])
        if not self._packed:
            return self._parts[part].read(topic, own, count)
        data = self._parts[part].read(topic, own)
        try:
            data = zstd().ZstdDecompressor().decompress(data, LARGEST_MESSAGE)
        except Exception as error:  # of the decompressor: any
            raise FrameError(f"{self.path}: message {index} of {topic} is damaged") from error
        return data[:count]

    def message(self, topic: str, index: int) -> Any:
        """A message, its fields as attributes; FrameError where it is damaged."""
        return self._decode(self.topics[topic], self.read(topic, index), self._where(topic, index))

    def stamp(self, topic: str, index: int) -> float:
        """The time [s] in a message's header; where that is empty, when it was received."""
        found = 0
        if self.topics[topic].type in HEADED:
            found = header_stamp(self.read(topic, index, 16), self.topics[topic].ros1)
        if not found:
            found = self._received(topic, index)
        return found // 10**9 + 1e-9 * (found % 10**9)  # as exactly as seconds can be

    def as_they_lie(self, topics: Iterable[str]) -> Iterator[tuple[str, int]]:
        """Topic and number of all messages of these topics, as they lie in the file."""
        topics = list(topics)
        for part, container in enumerate(self._parts):
            places = [
                (int(chunk), int(offset), name, int(self._starts[name][part]) + i)
                for name in topics
                if name in container.topics
                for i, (chunk, offset) in enumerate(container.places(name))
            ]
            for _, _, name, index in sorted(places):
                yield name, index

    def close(self) -> None:
        """Give the files back."""
        for part in self._parts:
            part.close()
        self._scratch.close()

    def _received(self, topic: str, index: int) -> int:
        part = int(np.searchsorted(self._starts[topic], index, side="right")) - 1
        return int(self._parts[part].times(topic)[index - int(self._starts[topic][part])])

    def _where(self, topic: str, index: int) -> str:
        return f"{self.path}: message {index} of {topic}"


def header_stamp(data: bytes, ros1: bool) -> int:
    """The time [ns] in the header that a message begins with; 0 where there is none."""
    if len(data) < 12:
        return 0
    order = "<" if ros1 or data[1] & 1 else ">"
    seconds, rest = struct.unpack_from(f"{order}II", data, 4)
    return seconds * 10**9 + rest if rest < 10**9 else 0


class _Decoder:
    """Turns the bytes of messages into messages, by rosbags and ROS's own definitions of their types; those in
    the bag may be damaged, and are of types that are not read here.
    """

    def __init__(self, topics: Mapping[str, BagTopic]) -> None:
        try:
            from rosbags.typesys import Stores, get_types_from_msg, get_typestore
        except ImportError:
            raise missing_rosbags() from None
        ros1 = any(topic.ros1 for topic in topics.values())
        self.store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.LATEST)
        for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
            if name not in self.store.fielddefs:
                text = "geometry_msgs/TransformStamped[] transforms"
                self.store.register(get_types_from_msg(text, name))

    def __call__(self, topic: BagTopic, data: bytes, where: str) -> Any:
        try:
            if topic.ros1:
                return self.store.deserialize_ros1(data, topic.type)
            return self.store.deserialize_cdr(data, topic.type)
        except Exception as error:  # of the generated code: any
            raise FrameError(
                f"{where} cannot be read as {topic.type} ({type(error).__name__})"
            ) from error


def _files_of(path: Path) -> tuple[list[Path], bool]:
    """The files of a bag in their order, and whether each message is compressed by itself."""
    if not os.path.isdir(path):
        if bare_name(path.name) is None:
            raise DatasetError(
                f"{path}: a bag is a .bag, .db3 or .mcap file, packed by zstd or not, or a folder that holds such files"
            )
        return [path], False
    # one that is unpacked already comes before the packed one
    found = {
        bare: path / name
        for name in sorted(os.listdir(path), reverse=True)
        if (bare := bare_name(name)) is not None
    }
    if not found:
        raise DatasetError(f"{path}: no .bag, .db3 or .mcap file here")
    packed = _compression(path / "metadata.yaml") == "message"
    return [found[name] for name in in_order(found)], packed  # x_2 before x_10


def bare_name(name: str) -> str | None:
    """The name of a bag's file without what says that it is packed; None for other files."""
    bare = Path(name).with_suffix("") if Path(name).suffix.lower() in PACKED else Path(name)
    return str(bare) if bare.suffix.lower() in CONTAINERS else None


def _compression(description: Path) -> str:
    """What `ros2 bag` says that it compressed: file, message or none."""
    try:
        text = description.read_text(errors="replace")
    except OSError:  # there is none: the files themselves say enough
        return "none"
    found = re.search(r"^\s*compression_mode:\s*['\"]?(\w*)", text, re.MULTILINE)
    return found[1].lower() if found else "none"
