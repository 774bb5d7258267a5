"""A recording whose poses are taken as the nearest rigid ones, where they are scaled or sheared."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, NotRigid
from ..geometry.checks import nearest_rigid
from ..types import Frame
from .dataset import Dataset, DatasetView


class Projected(DatasetView):
    """Every frame of a data set; a pose that is no rotation is the nearest one, with the translation
    as it is. One that mirrors or flattens still costs its frame.
    """

    def __init__(self, dataset: Dataset) -> None:
        super().__init__(dataset, range(len(dataset)))

    def load(self, index: int) -> Frame:
        try:
            return super().load(index)
        except NotRigid as error:
            T = nearest_rigid(error.T, error.name)
        return replace(self.dataset.without_poses().load(self.indices[index]), T_world_camera=T)

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        time, T = super().pose_at(index)
        if T is not None:
            return time, T
        try:  # what is wrong with it is known when it is loaded
            frame = self.load(index)
        except FrameError:
            return time, None
        return time, frame.T_world_camera
