"""What every data set is: a sequence of frames, each loaded when indexed; slices are views."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from copy import copy
from typing import TYPE_CHECKING, Self, overload

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError, shortened
from ..geometry.velocities import FRAME_RATE, velocities
from ..types import Frame

if TYPE_CHECKING:
    from .color_camera import ColorCamera


class Dataset(ABC, Sequence[Frame]):
    """Frames of one recording: `dataset[i]` loads frame i (or raises FrameError), `dataset[a:b:n]`
    is a view.

    `name` is the format and the path, for messages. Opening is cheap: it lists files, reads poses
    and intrinsics, and raises DatasetError where there is nothing to read. `warnings` holds
    sentences about what is unusual but usable.
    """

    name: str
    warnings: tuple[str, ...] = ()
    no_poses: str = ""  # why no frame has a pose; empty if some have one
    # a sensor's own file, whose format has no place for poses, and none lie beside it
    sensor_alone: bool = False
    # loading launches kernels, and two threads must not launch kernels at once
    runs_kernels: bool = False
    # colour is known to fit depth pixel by pixel: it was rendered, or registered by a calibration
    registered: bool = False
    # the direction against gravity in the world of its poses, where a recording says so
    up: tuple[float, float, float] | None = None

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def load(self, index: int) -> Frame:
        """Load frame `index` of 0..len-1."""

    def without_poses(self) -> Dataset:
        """A view without poses, so that frames with broken poses still load. Default: unchanged."""
        return self

    def depth_only(self) -> Dataset:
        """A view for who needs no colour, so that it need not be read. Default: unchanged."""
        return self

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        """When frame `index` was taken [s] and its pose, without its images where these need not be
        read; None for what is not known.
        """
        try:
            frame = self[index]
        except FrameError:
            return None, None
        return frame.timestamp, frame.T_world_camera

    def velocities(self) -> NDArray[np.float64]:
        """Twists a second (N, 6) of all frames in their cameras' own coordinates, [m/s] and
        [rad/s], from the poses of their neighbours; 0 where these are not known.
        """
        return velocities_of([self.pose_at(i) for i in range(len(self))])

    def with_color_camera(
        self, camera: ColorCamera | None, velocities: NDArray[np.float64] | None = None
    ) -> Self:
        """The same frames, their colour registered to depth as images of `camera`; None: colour as
        it was recorded.

        `velocities` (N, 6) are the twists a second of the frames, which a clock offset asks for;
        without them they come from the recording's poses. Raises InputError for a recording whose
        colour fits already.
        """
        if camera is None:
            return self
        raise InputError(
            f"{self.name}: its colour is registered to depth already; leave out the colour camera"
        )

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> DatasetView: ...

    def __getitem__(self, index):
        if isinstance(index, slice):
            return DatasetView(self, range(len(self))[index])
        if not isinstance(index, int | np.integer):
            raise InputError(
                f"{self.name}: frames are chosen by a whole number or a slice, got {shortened(index)}"
            )
        if not -len(self) <= index < len(self):
            raise IndexError(f"{self.name}: frame {index} of {len(self)}")
        return self.load(int(index) % len(self))

    def __iter__(self) -> Iterator[Frame]:
        return (self.load(i) for i in range(len(self)))


def velocities_of(
    times_poses: Sequence[tuple[float | None, NDArray[np.float64] | None]],
) -> NDArray[np.float64]:
    """Twists a second (N, 6) of frames by what `pose_at` says of each; where a time is not known
    they count as a camera's of 30 Hz.
    """
    times = [time for time, _ in times_poses]
    known = [time for time in times if time is not None]
    if len(known) < len(times):
        known = [i / FRAME_RATE for i in range(len(times))]
    return velocities(np.array(known), [T for _, T in times_poses])


class DatasetView(Dataset):
    """Some frames of another data set, loaded from it when asked for."""

    def __init__(self, dataset: Dataset, indices: range) -> None:
        self.dataset, self.indices = dataset, indices
        self.name, self.warnings, self.no_poses = dataset.name, dataset.warnings, dataset.no_poses
        self.registered, self.up = dataset.registered, dataset.up
        self.sensor_alone = dataset.sensor_alone

    def __len__(self) -> int:
        return len(self.indices)

    def load(self, index: int) -> Frame:
        return self.dataset.load(self.indices[index])

    def without_poses(self) -> DatasetView:
        return DatasetView(self.dataset.without_poses(), self.indices)

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        return self.dataset.pose_at(self.indices[index])

    def with_color_camera(
        self, camera: ColorCamera | None, velocities: NDArray[np.float64] | None = None
    ) -> Self:
        every = velocities
        if velocities is not None:
            every = np.zeros((len(self.dataset), 6))
            every[self.indices] = velocities
        view = copy(self)
        view.dataset = self.dataset.with_color_camera(camera, every)
        view.registered = view.dataset.registered
        return view
