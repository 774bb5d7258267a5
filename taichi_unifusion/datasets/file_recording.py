"""A recording of one depth image, one colour image and one pose for each frame, all in files: what
most formats are.

The modules of the formats list the files; loading them is the same for all.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from numbers import Real
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, InputError
from ..files.images import (
    INVALID_DEPTH,
    depth_file_size,
    holds_floats,
    read_color,
    read_depth,
    read_infrared,
    resize_image,
)
from ..files.trajectories import Pose
from ..geometry.velocities import FRAME_RATE
from ..types import Frame, PinholeCamera
from .camera_pair import CameraPair
from .color_camera import ColorCamera
from .plausibility import camera_warnings, pose_warnings

SIZE_SAMPLES = 5  # depth headers to read; the size that most have counts


@dataclass(frozen=True)
class FrameFiles:
    """Files that a frame should have; None: the recording has no such files at all."""

    depth: Path
    color: Path | None = None
    pose: Pose | None = None
    timestamp: float | None = None  # [s]
    infrared: Path | None = None


class Recording(CameraPair):
    """Frames read from files when indexed.

    `depth_scale` is in units a metre, `float_scale` the same for arrays of floats, `invalid` the
    units that mean no reading, `fit_color` resamples colour of another size, `no_poses` says what
    is missing where no frame has a pose. `color_camera` is the colour camera's own, where colour is
    not registered to depth yet.
    """

    def __init__(
        self,
        name: str,
        frames: Sequence[FrameFiles],
        camera: PinholeCamera,
        depth_scale: float,
        *,
        invalid: Collection[int] = INVALID_DEPTH,
        fit_color: bool = False,
        drop_alpha: bool = False,
        warnings: Iterable[str] = (),
        no_poses: str = "",
        color_camera: ColorCamera | None = None,
        float_scale: float = 1.0,
    ) -> None:
        self.name, self.frames, self.camera = name, tuple(frames), camera
        self.depth_scale = check_depth_scale(depth_scale, name)
        self.float_scale = check_depth_scale(float_scale, name)
        self.invalid, self.fit_color, self.drop_alpha = tuple(invalid), fit_color, drop_alpha
        poses = [frame.pose for frame in self.frames if frame.pose is not None]
        self.no_poses = no_poses
        self.pose_warnings = (
            (f"{no_poses}, so the frames have no poses",)
            if no_poses
            else tuple(pose_warnings(poses))
        )
        self.warnings = (*warnings, *camera_warnings(camera), *self.pose_warnings)
        self.register_with(color_camera)

    def __len__(self) -> int:
        return len(self.frames)

    def without_poses(self) -> Recording:
        """The same frames, their poses left out; so are the warnings about those."""
        bare = copy(self)
        bare.twists = None  # nothing that follows from poses
        bare.frames = tuple(replace(frame, pose=None) for frame in self.frames)
        bare.warnings = tuple(
            warning for warning in self.warnings if warning not in self.pose_warnings
        )
        return bare

    def depth_only(self) -> Recording:
        """The same frames without their colour and infrared."""
        bare = copy(self)
        bare.frames = tuple(replace(each, color=None, infrared=None) for each in self.frames)
        return bare

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        files = self.frames[index]
        time = files.timestamp
        if time is None and (number := re.search(r"\d+", files.depth.name)):
            time = int(number[0]) / FRAME_RATE
        return time, files.pose.usable if files.pose else None

    def recorded_color(self, index: int) -> NDArray[np.uint8] | None:
        file = self.frames[index].color
        return None if file is None else read_color(file, drop_alpha=self.drop_alpha)

    def scale_of(self, index: int) -> float:
        """Units of frame `index` that make a metre; FrameError where its depth cannot be read."""
        return self.float_scale if holds_floats(self.frames[index].depth) else self.depth_scale

    def load(self, index: int) -> Frame:
        """Read frame `index`; FrameError (PoseError, SizeMismatch) names the faulty file."""
        files = self.frames[index]
        T_world_camera = files.pose.checked() if files.pose else None
        size = self.camera.width, self.camera.height
        depth = read_depth(
            files.depth, self.depth_scale, self.invalid, size, float_scale=self.float_scale
        )
        frame = Frame(
            depth,
            self.camera,
            None,
            T_world_camera,
            index,
            files.timestamp,
            str(files.depth),
        )
        if files.color is not None:
            color = read_color(files.color, drop_alpha=self.drop_alpha)
            frame = self.with_color(frame, color, str(files.color))
        # infrared may be missing for single frames
        if files.infrared is None or not files.infrared.exists():
            return frame
        infrared = read_infrared(files.infrared)
        return frame.with_image(
            "infrared", resize_image(infrared, depth.shape[1], depth.shape[0], str(files.infrared))
        )


def check_depth_scale(depth_scale: float, source: str) -> float:
    """The scale in units a metre, or InputError if it is no positive number."""
    if not (isinstance(depth_scale, Real) and math.isfinite(depth_scale) and depth_scale > 0):
        raise InputError(
            f"{source}: depth_scale must be a positive number of units a metre, got {depth_scale}"
        )
    return float(depth_scale)


def depth_size(frames: Sequence[FrameFiles]) -> tuple[int, int]:
    """(width, height) that most of a few depth images have, from their headers; DatasetError if
    none can be read.
    """
    sizes, problem = Counter(), None
    for frame in frames:
        try:
            sizes[depth_file_size(frame.depth)] += 1
        except FrameError as error:
            problem = problem or error
        if sizes.total() == SIZE_SAMPLES:
            break
    if not sizes:
        raise DatasetError(f"none of {len(frames)} depth images can be read (first: {problem})")
    return sizes.most_common(1)[0][0]
