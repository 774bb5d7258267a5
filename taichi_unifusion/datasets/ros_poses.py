"""Poses in bags: the tree of transforms (tf), and topics that hold poses.

/tf and /tf_static hold transforms from a frame to its parent; the camera's pose is the product of those
from its optical frame (OpenCV's axes) up to the root, each interpolated at the time of the image. Odometry,
PoseStamped and their like hold one pose of one frame, from which transforms that do not change lead on to
the camera.
"""

from __future__ import annotations

from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from ..files.bags import Bag
from ..geometry import se3
from ..geometry.pose_tracks import PoseTrack

TF = "tf2_msgs/msg/TFMessage"
TF_TYPES = (TF, "tf/msg/tfMessage")
POSE_TYPES = {  # type -> attributes that lead to the pose
    "nav_msgs/msg/Odometry": ("pose", "pose"),
    "geometry_msgs/msg/PoseStamped": ("pose",),
    "geometry_msgs/msg/PoseWithCovarianceStamped": ("pose", "pose"),
    "geometry_msgs/msg/TransformStamped": ("transform",),
}
LONGEST_CHAIN = 64  # transforms from a camera to the root; more is a circle


@dataclass(frozen=True)
class Link:
    """How a frame moves in its parent."""

    parent: str
    track: PoseTrack
    static: bool  # holds at all times

    def at(self, time: float, max_difference: float) -> NDArray[np.float64] | None:
        """T_parent_child then, None where that is not known."""
        return self.track.T_a_b[0] if self.static else self.track.at(time, max_difference)


@dataclass(frozen=True)
class CameraPath:
    """Where the camera was: a chain of links from the world down to it."""

    source: str  # for messages
    links: tuple[Link, ...]

    def at(self, time: float, max_difference: float) -> NDArray[np.float64] | None:
        """T_world_camera (4, 4) then, None where a link is not known."""
        T = np.eye(4)
        for link in self.links:
            step = link.at(time, max_difference)
            if step is None:
                return None
            T = T @ step
        return se3.normalized(T)


class TransformTree:
    """The transforms of a bag, by frame."""

    def __init__(self, bag: Bag) -> None:
        rows: dict[tuple[str, str, bool], array] = {}
        topics = {name: t for name, t in bag.topics.items() if t.type in TF_TYPES}
        for name, index in bag.as_they_lie(topics):
            try:
                transforms = bag.message(name, index).transforms
            except FrameError:  # a damaged message costs itself
                continue
            static = name.endswith("static")
            for each in transforms:
                edge = bare(each.child_frame_id), bare(each.header.frame_id), static
                time = seconds(each.header.stamp)
                rows.setdefault(edge, array("d")).extend((time, *numbers(each.transform)))
        self.links: dict[str, Link] = {}
        for (child, parent, static), values in sorted(rows.items(), key=lambda item: len(item[1])):
            if (track := PoseTrack.of(np.array(values))) is not None and child != parent:
                self.links[child] = Link(parent, track, static)  # the one with the most stays

    def chain(self, frame: str, root: str | None = None) -> tuple[str, tuple[Link, ...]]:
        """The frame above it at the top, or `root`, and the links from there down to it."""
        links: list[Link] = []
        while frame in self.links and frame != root and len(links) < LONGEST_CHAIN:
            links.append(self.links[frame])
            frame = self.links[frame].parent
        return frame, tuple(reversed(links))

    def constant(self, frame: str, other: str) -> NDArray[np.float64] | None:
        """T_frame_other (4, 4) where it does not change, None where it does or is not known."""
        above, below = self._static_ancestors(frame), self._static_ancestors(other)
        common = next((name for name in above if name in below), None)
        if common is None:
            return None
        return se3.inverse(above[common]) @ below[common]

    def _static_ancestors(self, frame: str) -> dict[str, NDArray[np.float64]]:
        """The frames above one that it keeps its place in, with T_above_frame."""
        T, found = np.eye(4), {frame: np.eye(4)}
        while frame in self.links and len(found) < LONGEST_CHAIN:
            link = self.links[frame]
            if not link.static and (link.track.moves or len(link.track.times) == 1):
                break
            T = link.track.T_a_b[0] @ T
            frame = link.parent
            found[frame] = T
        return found


def pose_topics(bag: Bag) -> list[str]:
    """Topics that hold poses, Odometry first."""
    order = list(POSE_TYPES)
    found = [name for name, topic in bag.topics.items() if topic.type in POSE_TYPES]
    return sorted(found, key=lambda name: (order.index(bag.topics[name].type), name))


def camera_path(
    bag: Bag, tree: TransformTree, camera_frame: str, topic: str | None, world: str | None
) -> CameraPath | None:
    """Where the camera was by the topic that is named ("tf": by transforms); without a name by
    transforms, else by the only topic with poses. None where there are no poses; DatasetError where a name
    is wrong or it is not clear which to take.
    """
    candidates = pose_topics(bag)
    if topic not in (None, "tf", *candidates):
        raise DatasetError(
            f"{bag.path}: topic '{topic}' holds no poses; there are {', '.join(['tf', *candidates])}"
        )
    if topic in (None, "tf"):
        root, links = tree.chain(camera_frame, world)
        if world is not None and root != world:
            raise DatasetError(
                f"{bag.path}: no transforms lead from '{world}' to the camera's frame '{camera_frame}', only "
                f"from '{root}'"
            )
        if links and not all(link.static for link in links):
            return CameraPath(f"{bag.path} tf {root} -> {camera_frame}", links)
        if topic == "tf":
            raise DatasetError(
                f"{bag.path}: no transforms that change lead to the camera's frame '{camera_frame}'"
            )
    if topic is None and len(candidates) > 1:
        raise DatasetError(
            f"{bag.path}: {len(candidates)} topics hold poses; name one with --option pose_topic=, of "
            f"{', '.join(candidates)}"
        )
    chosen = topic or (candidates[0] if candidates else None)
    return None if chosen is None else _from_topic(bag, tree, camera_frame, chosen)


def _from_topic(bag: Bag, tree: TransformTree, camera_frame: str, topic: str) -> CameraPath | None:
    rows, child, world = array("d"), "", ""
    for index in range(bag.count(topic)):
        try:
            message = bag.message(topic, index)
        except FrameError:
            continue
        child, world = bare(getattr(message, "child_frame_id", "")), bare(message.header.frame_id)
        pose: Any = message
        for attribute in POSE_TYPES[bag.topics[topic].type]:
            pose = getattr(pose, attribute)
        rows.extend((seconds(message.header.stamp), *numbers(pose)))
    track = PoseTrack.of(np.array(rows))
    if track is None:
        return None
    links = [Link(world, track, static=False)]
    if child and child != camera_frame:
        T_child_camera = tree.constant(child, camera_frame)
        if T_child_camera is None:
            raise DatasetError(
                f"{bag.path}: {topic} holds poses of '{child}', and no transforms lead from there to the camera's "
                f"frame '{camera_frame}'; record /tf_static too, or take the poses of another program with "
                "--trajectory"
            )
        links.append(Link(child, PoseTrack(np.zeros(1), T_child_camera[None]), static=True))
    return CameraPath(f"{bag.path} {topic}", tuple(links))


def bare(frame: str) -> str:
    """A frame's name as ROS 2 writes it."""
    return frame.lstrip("/")


def seconds(stamp: Any) -> float:
    """A time of ROS in seconds."""
    return stamp.sec + 1e-9 * stamp.nanosec


def numbers(pose: Any) -> Iterable[float]:
    """tx ty tz qx qy qz qw of a Pose or a Transform."""
    t, q = (
        (pose.translation, pose.rotation)
        if hasattr(pose, "translation")
        else (pose.position, pose.orientation)
    )
    return t.x, t.y, t.z, q.x, q.y, q.z, q.w
