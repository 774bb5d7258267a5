"""A depth camera and a colour camera whose calibration is known, as sensors that are both have it in their
recordings: images registered to either of them, distortion included; and the poses beside a recording.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.trajectories import Pose, read_stamped_poses
from ..geometry.time_stamps import nearest
from ..types import PinholeCamera
from .depth_registration import LensCamera, color_for_depth, splat_depth
from .plausibility import pose_warnings

FINER = 1.5  # readings a pixel of the colour camera that keep depth free of holes there


@dataclass(frozen=True)
class SensorRig:
    """Both cameras; `align` says whose pixels the frames have, "depth" or "color"."""

    depth: LensCamera
    color: LensCamera | None
    T_color_depth: NDArray[np.float64] | None  # (4, 4); None without a colour camera
    align: str

    @property
    def camera(self) -> PinholeCamera:
        """The pinhole camera of the frames."""
        return self._pair()[0].pinhole if self.align == "color" else self.depth.pinhole

    def register(
        self, depth: NDArray[np.float32], color: NDArray | None, infrared: NDArray | None = None
    ) -> tuple[NDArray[np.float32], NDArray | None, NDArray | None]:
        """Depth [m], colour and infrared as the camera of the frames sees them; depth is 0 where not
        both cameras see its point.
        """
        if self.align == "color":
            return self._to_color(depth, color, infrared)
        return self._to_depth(depth, color, infrared)

    def _pair(self) -> tuple[LensCamera, NDArray[np.float64]]:
        """The colour camera and where it stands; asked for only where there is one."""
        if self.color is None or self.T_color_depth is None:
            raise InputError("align 'color' needs a colour camera, and this recording has none")
        return self.color, self.T_color_depth

    def _to_depth(
        self, depth: NDArray, color: NDArray | None, infrared: NDArray | None
    ) -> tuple[NDArray[np.float32], NDArray | None, NDArray | None]:
        camera = self.camera
        depth = self.depth.undistort_depth(depth, camera)
        if infrared is not None:
            infrared = self.depth.undistort(infrared, camera)
        if color is not None:
            lens, T_color_depth = self._pair()
            color, seen = color_for_depth(color, lens, depth, camera, T_color_depth)
            depth[~seen] = 0
        return depth, color, infrared

    def _to_color(
        self, depth: NDArray, color: NDArray | None, infrared: NDArray | None
    ) -> tuple[NDArray[np.float32], NDArray | None, NDArray | None]:
        lens, T_color_depth = self._pair()
        camera, own = lens.pinhole, self.depth.pinhole
        factor = int(np.ceil(FINER * max(camera.fx / own.fx, camera.fy / own.fy)))
        finer = own.resized(own.width * factor, own.height * factor)
        values = np.zeros_like(depth) if infrared is None else infrared
        depth, moved = splat_depth(
            self.depth.undistort_depth(depth, finer),
            self.depth.undistort(values, finer),
            finer,
            camera,
            T_color_depth,
        )
        depth[~lens.sees(camera)] = 0
        color = None if color is None else lens.undistort(color, camera)
        return depth, color, None if infrared is None else moved


@dataclass(frozen=True)
class PosesBeside:
    """Poses of a sensor's recording, which has no place for them itself."""

    poses: tuple[Pose, ...]  # of every frame
    warnings: tuple[str, ...]
    none: bool  # there is no file of them, and there is more than one frame


def poses_beside(recording: Path, times: NDArray[np.float64], max_difference: float) -> PosesBeside:
    """The pose of every frame by its time [s], from rows `timestamp tx ty tz qx qy qz qw` in the text file
    of the recording's name. Without that file the first frame is the origin and nothing is known of others.
    """
    file = recording.with_suffix(".txt")
    if not file.exists():
        poses = (Pose("first frame", np.eye(4)), *(Pose(f"no {file.name}") for _ in times[1:]))
        said = (
            f"there is no {file.name} with poses beside {recording.name}: the first frame's "
            "camera is the world, and the other frames have no pose (--tracking rgbd finds them)"
        )
        several = len(times) > 1
        return PosesBeside(poses, (said,) * several, several)
    rows = sorted(read_stamped_poses(file), key=lambda row: row.timestamp)
    stamps = np.array([row.timestamp for row in rows])
    nothing = f"no pose within {max_difference} s of the frame"
    poses = tuple(
        rows[i].pose
        if abs(stamps[i] - time) <= max_difference
        else Pose(str(file), problem=nothing)
        for i, time in zip(nearest(stamps, times), times, strict=True)
    )
    return PosesBeside(poses, tuple(pose_warnings(poses)), False)
