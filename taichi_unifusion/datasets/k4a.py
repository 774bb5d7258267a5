"""Recordings of an Azure Kinect, the `.mkv` that `k4arecorder` writes: depth, active infrared,
colour and factory calibration.

Depth and infrared are tracks of 16-bit big-endian images, depth in millimetres with 0 for no
reading; colour is MJPEG, NV12 or YUY2; `calibration.json` is an attachment. Images are registered
with the factory calibration, distortion included: to the depth camera (`align="depth"`, the
default: depth keeps its pixels, colour is looked up), or to the colour camera (`align="color"`, as
the paper does: depth and infrared are carried over). Either way a pixel has depth only where both
cameras see its point. Infrared becomes the image "infrared", (H, W, 1), in units of 0..65535.

Poses: `NAME.txt` beside `NAME.mkv`, rows `timestamp tx ty tz qx qy qz qw` with the recording's
seconds, camera-to-world of the camera that is aligned to. Without such a file `unifusion reconstruct`
finds them from the frames (`--tracking rgbd`); given are then the first frame's, whose camera is the
world, and no others.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, check_choice
from ..files.images import depth_to_metres
from ..files.k4a_container import (
    CALIBRATION,
    COLOR,
    DEPTH,
    INFRARED,
    read_contents,
    read_images,
)
from ..files.trajectories import Pose
from ..geometry.time_stamps import check_max_difference, nearest
from ..types import Frame, PinholeCamera
from .dataset import Dataset
from .k4a_calibration import read_calibration
from .sensor_rig import SensorRig, poses_beside

DEPTH_SCALE = 1000.0
MAX_DIFFERENCE = 0.02  # [s] between a pose and a depth image


def open_k4a(
    path: Path,
    *,
    align: Literal["depth", "color"] = "depth",
    depth_scale: float | None = None,
    max_difference: float = MAX_DIFFERENCE,
) -> K4aFile:
    """The recording in file `path`; poses further than `max_difference` [s] from a depth image do
    not belong to it.
    """
    check_choice("align", align, ("depth", "color"))
    check_max_difference(max_difference)
    return K4aFile(path, align, DEPTH_SCALE if depth_scale is None else depth_scale, max_difference)


@dataclass(frozen=True)
class Capture:
    """Time stamps of the images of one frame, in the file's unit; None: the recording lacks that
    one.
    """

    depth: int
    color: int | None
    infrared: int | None

    @property
    def stamps(self) -> dict[str, int]:
        """Title of the track -> time stamp, of the images that are there."""
        stamps = {DEPTH: self.depth, COLOR: self.color, INFRARED: self.infrared}
        return {title: stamp for title, stamp in stamps.items() if stamp is not None}


class K4aFile(Dataset):
    """The frames of an Azure Kinect recording, each read when asked for."""

    registered = True

    def __init__(self, path: Path, align: str, depth_scale: float, max_difference: float) -> None:
        self.name, self.path, self.align, self.depth_scale = f"k4a {path}", path, align, depth_scale
        contents = read_contents(path)
        self.calibration = read_calibration(
            contents.calibration,
            f"{path}: {CALIBRATION}",
            contents.sizes[DEPTH],
            contents.sizes.get(COLOR),
        )
        self.sizes, self.unit = contents.sizes, contents.unit
        self.captures = _captures(contents.stamps)
        if not self.captures:
            raise DatasetError(f"{path}: holds no depth image")
        if align == "color" and self.calibration.color is None:
            raise DatasetError(
                f"{path}: align 'color' needs a colour track, and this recording has none"
            )
        known = self.calibration
        self.rig = SensorRig(known.depth, known.color, known.T_color_depth, align)
        if known.color is None and COLOR in contents.sizes:
            raise DatasetError(f"{path}: {CALIBRATION} knows no colour camera")
        times = self.unit * np.array([capture.depth for capture in self.captures])
        beside = poses_beside(path, times, max_difference)
        self.poses, self.warnings, self.sensor_alone = beside.poses, beside.warnings, beside.none

    @property
    def camera(self) -> PinholeCamera:
        """The pinhole camera of the frames."""
        return self.rig.camera

    def __len__(self) -> int:
        return len(self.captures)

    def without_poses(self) -> K4aFile:
        bare = copy(self)
        bare.poses, bare.warnings = tuple(Pose("") for _ in self.poses), ()
        return bare

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        return self.captures[index].depth * self.unit, self.poses[index].usable

    def load(self, index: int) -> Frame:
        """Read and register frame `index`; FrameError (PoseError) names the file and the frame."""
        capture, where = self.captures[index], f"{self.path} frame {index}"
        pose = self.poses[index]
        T_world_camera = (
            None if pose.T_world_camera is None and not pose.problem else pose.checked()
        )
        images = read_images(self.path, capture.stamps, where)
        raw = images[DEPTH]
        depth = depth_to_metres(raw, f"{where} depth", self.depth_scale, ())
        infrared = images[INFRARED].astype(np.float32) if INFRARED in images else None
        depth, color, infrared = self.rig.register(depth, images.get(COLOR), infrared)
        frame = Frame(
            depth, self.camera, color, T_world_camera, index, capture.depth * self.unit, where
        )
        return frame if infrared is None else frame.with_image("infrared", infrared)


def _captures(stamps: dict[str, NDArray[np.int64]]) -> list[Capture]:
    """A frame for every depth image, with the colour and infrared images that belong to it: within
    half a period.
    """
    depth = stamps[DEPTH]
    half = np.median(np.diff(depth)) / 2 if len(depth) > 1 else np.inf
    found: dict[str, list[int | None]] = {}
    for title in (COLOR, INFRARED):
        of = stamps.get(title, np.empty(0, np.int64))
        near = (
            of[nearest(of, depth)]
            if len(of) and len(depth)
            else np.full(len(depth), np.iinfo(np.int64).max)
        )
        found[title] = [
            int(stamp) if len(of) and abs(int(stamp) - int(at)) <= half else None
            for stamp, at in zip(near, depth, strict=True)
        ]
    return [
        Capture(int(at), color, infrared)
        for at, color, infrared in zip(depth, found[COLOR], found[INFRARED], strict=True)
    ]
