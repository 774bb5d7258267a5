"""Recordings of an Azure Kinect, the `.mkv` that `k4arecorder` writes: depth, active infrared,
colour and factory calibration.

Depth and infrared are tracks of 16-bit big-endian images, depth in millimetres with 0 for no
reading; colour is MJPEG, NV12 or YUY2; `calibration.json` is an attachment. Images are registered
with the factory calibration, distortion included: to the depth camera (`align="depth"`, the
default: depth keeps its pixels, colour is looked up), or to the colour camera (`align="color"`, as
the paper does: depth and infrared are carried over). Either way a pixel has depth only where both
cameras see its point. Infrared becomes the image "infrared", (H, W, 1), in units of 0..65535.

Poses: `NAME.txt` beside `NAME.mkv`, rows `timestamp tx ty tz qx qy qz qw` with the recording's
seconds, camera-to-world of the camera that is aligned to. Without such a file the first frame's
camera is the world, and other frames have no pose.
"""

from __future__ import annotations

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
from ..files.trajectories import Pose, read_stamped_poses
from ..geometry.time_stamps import check_max_difference, nearest
from ..types import Frame, PinholeCamera
from .dataset import Dataset
from .depth_registration import LensCamera, color_for_depth, splat_depth
from .k4a_calibration import read_calibration
from .plausibility import pose_warnings

DEPTH_SCALE = 1000.0
MAX_DIFFERENCE = 0.02  # [s] between a pose and a depth image
FINER = 1.5  # readings a pixel of the colour camera that keep depth free of holes there


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
        times = self.unit * np.array([capture.depth for capture in self.captures])
        self.poses = _read_poses(path.with_suffix(".txt"), times, max_difference)
        self.warnings = tuple(
            pose_warnings(
                [pose for pose in self.poses if pose.T_world_camera is not None or pose.problem]
            )
        )
        if any(pose.T_world_camera is None and not pose.problem for pose in self.poses):
            self.warnings = (
                f"there is no {path.with_suffix('.txt').name} with poses beside {path.name}: the first frame's "
                "camera is the world, and the other frames have no pose",
            )

    @property
    def camera(self) -> PinholeCamera:
        """The pinhole camera of the frames."""
        lens = self._color_lens() if self.align == "color" else self.calibration.depth
        return lens.pinhole

    def _color_lens(self) -> LensCamera:
        """The colour camera; a recording that shows colour, or is aligned to it, has one."""
        lens = self.calibration.color
        if lens is None:
            raise DatasetError(f"{self.path}: {CALIBRATION} knows no colour camera")
        return lens

    def __len__(self) -> int:
        return len(self.captures)

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
        infrared = (
            images[INFRARED].astype(np.float32)
            if INFRARED in images
            else np.zeros(raw.shape, np.float32)
        )
        register = self._to_color if self.align == "color" else self._to_depth
        depth, color, infrared = register(depth, images.get(COLOR), infrared)
        frame = Frame(
            depth, self.camera, color, T_world_camera, index, capture.depth * self.unit, where
        )
        return frame.with_image("infrared", infrared) if INFRARED in images else frame

    def _to_depth(
        self, depth: NDArray, color: NDArray | None, infrared: NDArray
    ) -> tuple[NDArray, NDArray | None, NDArray]:
        cameras, camera = self.calibration, self.camera
        depth = cameras.depth.undistort_depth(depth, camera)
        infrared = cameras.depth.undistort(infrared, camera)
        if color is not None:
            color, seen = color_for_depth(
                color, self._color_lens(), depth, camera, cameras.T_color_depth
            )
            depth[~seen] = 0
        return depth, color, infrared

    def _to_color(
        self, depth: NDArray, color: NDArray | None, infrared: NDArray
    ) -> tuple[NDArray, NDArray | None, NDArray]:
        cameras, lens, camera = self.calibration, self._color_lens(), self.camera
        own = cameras.depth.pinhole
        factor = int(np.ceil(FINER * max(camera.fx / own.fx, camera.fy / own.fy)))
        finer = own.resized(own.width * factor, own.height * factor)
        depth, infrared = splat_depth(
            cameras.depth.undistort_depth(depth, finer),
            cameras.depth.undistort(infrared, finer),
            finer,
            camera,
            cameras.T_color_depth,
        )
        depth[~lens.sees(camera)] = 0
        return depth, None if color is None else lens.undistort(color, camera), infrared


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


def _read_poses(file: Path, times: NDArray[np.float64], max_difference: float) -> list[Pose]:
    """The pose of every frame, by its time [s]; without a file the first frame is the origin and
    nothing is known of others.
    """
    if not file.exists():
        return [Pose("first frame", np.eye(4)), *(Pose(f"no {file.name}") for _ in times[1:])]
    rows = sorted(read_stamped_poses(file), key=lambda row: row.timestamp)
    stamps, nothing = (
        np.array([row.timestamp for row in rows]),
        f"no pose within {max_difference} s of the frame",
    )
    return [
        rows[i].pose
        if abs(stamps[i] - time) <= max_difference
        else Pose(str(file), problem=nothing)
        for i, time in zip(nearest(stamps, times), times, strict=True)
    ]
