"""A recording whose poses or intrinsics are taken in another way than its format says: what
`unifusion check` proposes, for every format.
"""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, Self, get_type_hints

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError, PoseError, convert
from ..geometry import se3
from ..geometry.time_stamps import nearest
from ..types import Frame, check_rigid
from .color_camera import ColorCamera
from .dataset import Dataset, DatasetView
from .depth_camera import make_camera
from .pose_readings import AS_READ, check_reading, read_as

LONGEST_GAP = 1.0  # [s] between poses that are interpolated
LONGEST_OFFSET = 3600.0  # [s]


def _says(default: Any, sentence: str) -> Any:
    return field(default=default, metadata={"sentence": sentence})


@dataclass(frozen=True)
class Mending:
    """What to change, as options of `open_dataset` in every format; the defaults change nothing."""

    pose_reading: str | None = _says(
        None, "How poses are written, as w2c, opengl or w-first+w2c; a wrong one lists the words."
    )
    pose_scale: float | None = _says(None, "Metres in a unit of the poses' translations.")
    clock_offset: float | None = _says(
        None, "Seconds to add to a frame's time stamp before its pose is looked up."
    )
    intrinsics: tuple[float, float, float, float] | None = _says(
        None, "fx/fy/cx/cy of the depth images in pixels, instead of the recording's."
    )

    def __post_init__(self) -> None:
        if self.pose_reading is not None:
            check_reading(self.pose_reading)
        if self.pose_scale is not None and not 0 < self.pose_scale < float("inf"):
            raise InputError(f"pose_scale: must be a positive number, got {self.pose_scale}")
        if self.clock_offset is not None and not abs(self.clock_offset) <= LONGEST_OFFSET:
            raise InputError(
                f"clock_offset: must lie within {LONGEST_OFFSET:g} s, got {self.clock_offset}"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Mending:
        """Those of `options` that are kinds of mending, texts converted."""
        types = get_type_hints(cls)
        return cls(
            **{
                name: convert(_listed(value), types[name], f"option '{name}'")
                for name, value in options.items()
                if name in types
            }
        )

    @property
    def changes(self) -> bool:
        """Whether there is anything to change."""
        return any(getattr(self, each.name) is not None for each in fields(self))


MENDINGS = {each.name: each.metadata["sentence"] for each in fields(Mending)}


def _listed(value: Any) -> Any:
    """A tuple as a list, and numbers between commas as between slashes."""
    if isinstance(value, tuple):
        return list(value)
    return value.replace(",", "/") if isinstance(value, str) else value


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
        if frame.T_world_camera is None and self.mending.clock_offset is None:
            return frame
        T = self._pose(index, frame.timestamp, frame.T_world_camera)
        if T is None:
            raise PoseError(f"{frame.label}: no pose at its time stamp plus the clock offset")
        return replace(frame, T_world_camera=T)

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        time, T = super().pose_at(index)
        return time, self._pose(index, time, T)

    def without_poses(self) -> Mended:
        return Mended(self.dataset.without_poses(), Mending(intrinsics=self.mending.intrinsics))

    def with_color_camera(
        self, camera: ColorCamera | None, velocities: NDArray[np.float64] | None = None
    ) -> Self:
        view = copy(self)
        view.dataset = self.dataset.with_color_camera(
            camera, self.velocities() if velocities is None else velocities
        )
        view.registered = view.dataset.registered
        return view

    def _pose(
        self, index: int, time: float | None, T: NDArray[np.float64] | None
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
