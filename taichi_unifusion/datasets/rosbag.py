"""Bags of ROS 1 (`.bag`) and ROS 2 (`.db3`, `.mcap`, or the folder of one): a robot's recording.

Depth images are found among the topics (16UC1, mono16, 32FC1, raw or compressedDepth; one that is
registered to colour comes first), colour and CameraInfo beside them; where it is not clear which is meant,
they are listed, and an option names one. Lens distortion is taken out. Depth and colour of one frame of
coordinates are registered to each other; else colour is, by tf and its own CameraInfo, where these are
there. 16 bits are millimetres unless `depth_scale` says else.

Poses: transforms (tf) from the root of the tree to the depth image's frame, else a topic of Odometry,
PoseStamped or the like with the transforms that lead on to the camera; interpolated at the image's stamp.
Images are read when asked for; opening reads the stamps of all and the poses.
"""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, SizeMismatch
from ..files.bags import Bag
from ..files.images import SAME_ASPECT
from ..files.ros_images import read_color_message, read_depth_message
from ..files.trajectories import Pose
from ..geometry.time_stamps import check_max_difference, nearest
from ..types import Frame, PinholeCamera
from .camera_pair import CameraPair
from .color_camera import ColorCamera
from .depth_registration import LensCamera
from .file_recording import check_depth_scale
from .plausibility import camera_warnings, pose_warnings
from .ros_poses import CameraPath, TransformTree, camera_path
from .ros_topics import ImageTopic, find_color, find_depth, find_lens

DEPTH_SCALE = 1000.0  # REP 118
MAX_DIFFERENCE = 0.05  # [s]: drivers stamp both images of a pair within a frame at 20 Hz


def open_rosbag(
    path: Path,
    *,
    depth_topic: str | None = None,
    color_topic: str | None = None,
    camera_topic: str | None = None,
    pose_topic: str | None = None,
    world_frame: str | None = None,
    depth_scale: float | None = None,
    camera: PinholeCamera | None = None,
    max_difference: float = MAX_DIFFERENCE,
) -> RosbagRecording:
    """The bag in file or folder `path`; stamps further apart than `max_difference` [s] do not belong
    together.
    """
    check_max_difference(max_difference)
    scale = check_depth_scale(DEPTH_SCALE if depth_scale is None else depth_scale, f"rosbag {path}")
    bag = Bag(path)
    try:
        depth = find_depth(bag, depth_topic)
        color = find_color(bag, color_topic, depth)
        lens = _depth_lens(bag, depth, color, camera_topic, camera)
        tree = TransformTree(bag)
        poses = camera_path(bag, tree, depth.frame, pose_topic, world_frame)
        recording = RosbagRecording(bag, depth, color, lens, poses, scale, max_difference)
        recording.join_color(tree)
    except BaseException:
        bag.close()
        raise
    return recording


def _depth_lens(
    bag: Bag,
    depth: ImageTopic,
    color: ImageTopic | None,
    camera_topic: str | None,
    camera: PinholeCamera | None,
) -> LensCamera:
    """The camera of the depth images: given, or from the CameraInfo beside them, or beside the colour
    images that they are registered to.
    """
    if camera is not None:
        return LensCamera(camera, (0.0,) * 8)
    found = find_lens(bag, depth, camera_topic)
    if found is None and color is not None and color.frame == depth.frame:
        found = find_lens(bag, color)
    if found is None:
        raise DatasetError(
            f"{bag.path}: no CameraInfo for {depth.name}; name its topic with --option camera_topic=, or in Python "
            "pass camera=PinholeCamera(...)"
        )
    return found


class RosbagRecording(CameraPair):
    """The frames of a bag, each read when asked for."""

    def __init__(
        self,
        bag: Bag,
        depth: ImageTopic,
        color: ImageTopic | None,
        lens: LensCamera,
        path: CameraPath | None,
        depth_scale: float,
        max_difference: float,
    ) -> None:
        self.bag, self.path = bag, bag.path
        self.name = f"rosbag {bag.path}"
        self.depth_topic, self.color_topic, self.lens = depth, color, lens
        self.depth_scale = depth_scale
        self.fit_color = True
        self.times, self.order = _stamps(bag, depth)
        self.partners = np.full(len(self.times), -1)
        alone: tuple[str, ...] = ()
        if color is not None:
            times, order = _stamps(bag, color)
            near = nearest(times, self.times)
            close = np.abs(times[near] - self.times) <= max_difference
            self.partners = np.where(close, order[near], -1)
            if not close.all():
                alone = (
                    f"{np.sum(~close)} of {len(close)} depth images have no colour image of {color.name} within "
                    f"{max_difference} s",
                )
        self.poses = tuple(_pose(path, time, max_difference) for time in self.times)
        if path is None:
            self.no_poses = f"{bag.path}: no transforms (tf) and no topic with poses of the camera"
        self.pose_warnings = (
            (f"{self.no_poses}, so the frames have no poses",)
            if self.no_poses
            else tuple(pose_warnings([pose for pose in self.poses if pose is not None]))
        )
        self.warnings = (
            *bag.damage,
            *camera_warnings(lens.pinhole),
            *self._size_warning(),
            *alone,
            *self.pose_warnings,
        )

    def join_color(self, tree: TransformTree) -> None:
        """Find out how colour belongs to depth: in one frame of coordinates, or by tf."""
        color, depth = self.color_topic, self.depth_topic
        if color is None:
            return
        if color.frame == depth.frame:
            self.registered = True
            return
        T_color_depth = tree.constant(color.frame, depth.frame)
        lens = None if T_color_depth is None else find_lens(self.bag, color)
        if T_color_depth is None or lens is None:
            self.warnings = (
                *self.warnings,
                f"how {color.name} (frame '{color.frame}') lies to {depth.name} (frame '{depth.frame}') is not in the "
                "bag; colour is taken as it is unless --color-camera knows more",
            )
            return
        self.register_with(ColorCamera(lens.pinhole, T_color_depth, lens.distortion))

    @property
    def camera(self) -> PinholeCamera:
        """The camera of depth images of the usual size."""
        return self.lens.pinhole

    def __len__(self) -> int:
        return len(self.times)

    def without_poses(self) -> RosbagRecording:
        bare = copy(self)
        bare.twists = None
        bare.poses = (None,) * len(self)
        bare.warnings = tuple(each for each in self.warnings if each not in self.pose_warnings)
        return bare

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        pose = self.poses[index]
        return float(self.times[index]), pose.usable if pose else None

    def load(self, index: int) -> Frame:
        """Read frame `index`; FrameError (PoseError) names the bag, the topic and the message."""
        number, where = (
            int(self.order[index]),
            self._where(self.depth_topic, int(self.order[index])),
        )
        pose = self.poses[index]
        T_world_camera = pose.checked() if pose else None
        message = self.bag.message(self.depth_topic.name, number)
        depth = read_depth_message(message, where, self.depth_scale)
        lens = _resized(self.lens, (depth.shape[1], depth.shape[0]), where)
        if any(lens.distortion):
            depth = lens.undistort_depth(depth, lens.pinhole)
        frame = Frame(
            depth, lens.pinhole, None, T_world_camera, index, float(self.times[index]), where
        )
        color = self.recorded_color(index)
        if color is None:
            return frame
        if self.registered and self.color_camera is None and any(lens.distortion):
            own = _resized(self.lens, (color.shape[1], color.shape[0]), where)
            color = np.asarray(own.undistort(color, own.pinhole), np.uint8)
        return self.with_color(frame, color, where)

    def recorded_color(self, index: int) -> NDArray[np.uint8] | None:
        topic, partner = self.color_topic, int(self.partners[index])
        if topic is None or partner < 0:
            return None
        return read_color_message(
            self.bag.message(topic.name, partner), self._where(topic, partner)
        )

    def _where(self, topic: ImageTopic, number: int) -> str:
        return f"{self.path} {topic.name} message {number}"

    def _size_warning(self) -> tuple[str, ...]:
        """A sentence if the camera is for another size than the first images, or sizes change."""
        sizes = {self.depth_topic.size: 0}
        for index in {len(self) // 3, len(self) // 2, len(self) - 1}:
            try:
                message = self.bag.message(self.depth_topic.name, int(self.order[index]))
                shape = read_depth_message(message, "", self.depth_scale).shape
            except FrameError:
                continue
            sizes.setdefault((shape[1], shape[0]), index)
        if len(sizes) > 1:
            said = ", ".join(
                f"{width}x{height} from about frame {index}"
                for (width, height), index in sizes.items()
            )
            return (
                f"the size of the depth images of {self.depth_topic.name} changes ({said}); intrinsics are scaled "
                "for each",
            )
        width, height = self.depth_topic.size
        if (width, height) == self.camera.size:
            return ()
        return (
            f"CameraInfo is for {self.camera.width}x{self.camera.height} images but {self.depth_topic.name} has "
            f"{width}x{height}; intrinsics are scaled",
        )


def _stamps(bag: Bag, topic: ImageTopic) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Times of the images of a topic [s], ascending, and their numbers; of equal times the first."""
    times = np.full(bag.count(topic.name), np.nan)
    for name, index in bag.as_they_lie([topic.name]):
        try:
            times[index] = bag.stamp(name, index)
        except FrameError:
            continue
    order = np.flatnonzero(np.isfinite(times))
    times, first = np.unique(times[order], return_index=True)
    if not len(times):
        raise DatasetError(f"{bag.path}: no image of {topic.name} can be read")
    return times, order[first]


def _pose(path: CameraPath | None, time: float, max_difference: float) -> Pose | None:
    if path is None:
        return None
    T = path.at(float(time), max_difference)
    if T is not None:
        return Pose(path.source, T)
    return Pose(path.source, problem=f"no pose near {time:.3f} s (a gap, or before or after all)")


def _resized(lens: LensCamera, size: tuple[int, int], where: str) -> LensCamera:
    """The lens for images of another size and the same shape."""
    own = lens.pinhole
    if own.size == size:
        return lens
    if abs(size[0] * own.height / (size[1] * own.width) - 1) > SAME_ASPECT:
        raise SizeMismatch(
            f"{where}: the image is {size[0]}x{size[1]} but its camera {own.width}x{own.height}, another shape"
        )
    return replace(lens, pinhole=own.resized(*size))
