"""A recording with its poses, their clock or its intrinsics taken in another way."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError, PoseError
from ..geometry import se3
from ..geometry.time_stamps import nearest
from ..types import Frame, check_rigid
from .color_camera import ColorCamera
from .dataset import Dataset, DatasetView
from .depth_camera import make_camera
from .mending import Mending
from .pose_readings import AS_READ, read_as

LONGEST_GAP = 1.0  # [s] between poses that are interpolated


class Mended(DatasetView):
    """Every frame of a data set, with what is mended."""

    def __init__(self, dataset: Dataset, mending: Mending) -> None:
        super().__init__(dataset, range(len(dataset)))
        self.mending = mending

    def load(self, index: int) -> Frame:
        frame = super().load(index)
        if self.mending.intrinsics is not None:
            height, width = frame.depth.shape
            camera = make_camera("intrinsics", (width, height), *self.mending.intrinsics)
            frame = replace(frame, camera=camera)
        if self.mending.depth_limit is not None:
            near = frame.depth <= self.mending.depth_limit
            frame = replace(frame, depth=np.where(near, frame.depth, np.float32(0)))
        if frame.T_world_camera is None and self.mending.clock_offset is None:
            return frame
        T = self._pose(*super().pose_at(index))
        if T is None:
            raise PoseError(f"{frame.label}: no pose at its time stamp plus the clock offset")
        return replace(frame, T_world_camera=T)

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        time, T = super().pose_at(index)
        return time, self._pose(time, T)

    def without_poses(self) -> Mended:
        return Mended(self.dataset.without_poses(), self._of_images)

    def with_color_camera(
        self, camera: ColorCamera | None, velocities: NDArray[np.float64] | None = None
    ) -> Self:
        view = copy(self)
        view.dataset = self.dataset.with_color_camera(
            camera, self.velocities() if velocities is None else velocities
        )
        view.registered = view.dataset.registered
        return view

    @property
    def _of_images(self) -> Mending:
        """What of the mending has nothing to do with poses."""
        return Mending(intrinsics=self.mending.intrinsics, depth_limit=self.mending.depth_limit)

    def _pose(
        self, time: float | None, T: NDArray[np.float64] | None
    ) -> NDArray[np.float64] | None:
        """The pose of a frame, or None where there is none."""
        if self.mending.clock_offset is not None:
            T = self._pose_at_time(time, self.mending.clock_offset)
        return None if T is None else self._read(T)

    def _read(self, T: NDArray[np.float64]) -> NDArray[np.float64]:
        read = read_as(self.mending.pose_reading or AS_READ, T[None])[0]
        read[:3, 3] *= self.mending.pose_scale or 1.0
        return check_rigid(read)

    def _pose_at_time(self, time: float | None, offset: float) -> NDArray[np.float64] | None:
        """The pose as recorded, interpolated between those of two frames."""
        if time is None:
            raise InputError(f"{self.name}: clock_offset needs frames that have time stamps")
        times, poses = self._timed
        return pose_at_time(times, poses, time + offset)

    @cached_property
    def _timed(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return timed_poses(self.dataset)


def timed_poses(dataset: Dataset) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ascending time stamps (N,) [s] and poses (N, 4, 4) of the frames that have both."""
    found: dict[float, NDArray[np.float64]] = {}
    for i in range(len(dataset)):
        try:
            time, T = dataset.pose_at(i)
        except FrameError:
            continue
        if time is not None and T is not None:
            found.setdefault(time, T)
    times = np.array(sorted(found), np.float64)
    return times, np.array([found[time] for time in times]).reshape(-1, 4, 4)


def pose_at_time(
    times: NDArray[np.float64], poses: NDArray[np.float64], time: float
) -> NDArray[np.float64] | None:
    """The pose at a time [s] between two known ones, at constant velocity; None outside, or in a
    longer gap than LONGEST_GAP.
    """
    if not len(times):
        return None
    at = int(nearest(times, np.array([time]))[0])
    if abs(times[at] - time) < 1e-6:
        return poses[at]
    after = int(np.searchsorted(times, time))
    if not 0 < after < len(times) or times[after] - times[after - 1] > LONGEST_GAP:
        return None
    T_a, T_b = poses[after - 1], poses[after]
    share = (time - times[after - 1]) / (times[after] - times[after - 1])
    return se3.normalized(T_a @ se3.exp(share * se3.log(se3.inverse(T_a) @ T_b)))
