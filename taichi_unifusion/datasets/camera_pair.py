"""A recording of a depth camera and a colour camera, whose images are registered when they are read."""

from __future__ import annotations

from abc import abstractmethod
from copy import copy
from dataclasses import replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.images import resize_color
from ..types import Frame
from .color_camera import ColorCamera
from .dataset import Dataset


class CameraPair(Dataset):
    """Frames whose colour comes as the colour camera took it.

    `color_camera` is that camera, None where colour is taken to fit depth as it is; `fit_color`
    then resamples colour of another size.
    """

    fit_color: bool = True
    color_camera: ColorCamera | None = None
    twists: NDArray[np.float64] | None = None  # (N, 6) a second, for a clock offset

    @abstractmethod
    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]: ...

    def with_color_camera(
        self, camera: ColorCamera | None, velocities: NDArray[np.float64] | None = None
    ) -> Self:
        other = copy(self)
        other.register_with(camera, velocities)
        return other

    def register_with(
        self, camera: ColorCamera | None, velocities: NDArray[np.float64] | None = None
    ) -> None:
        """Take the colour images as those of `camera`; for who makes a recording."""
        if camera is not None and camera.clock_offset and velocities is None:
            velocities = self.velocities()
        self.color_camera, self.twists, self.registered = camera, velocities, camera is not None

    def recorded_color(self, index: int) -> NDArray[np.uint8] | None:
        """The colour image of frame `index` as it was taken, (h, w, 3) RGB of any size; None where there is
        none.
        """
        raise InputError(f"{self.name}: its colour images cannot be had as they were taken")

    def with_color(self, frame: Frame, color: NDArray[np.uint8], where: str) -> Frame:
        """The frame, which has no colour yet, with the colour image that was taken with it."""
        if self.color_camera is None:
            if self.fit_color:
                color = resize_color(color, *frame.camera.size, where)
            return replace(frame, color=color)
        velocity = None if self.twists is None else self.twists[frame.index]
        return self.color_camera.register(frame, color, velocity, where)
