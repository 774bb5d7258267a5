"""Keyframes: what is kept of the frames that others are aligned to."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .features import Features
from .pyramid import ReducedFrame, SurfelPyramid, build_pyramid

LIVE_PYRAMIDS = 24  # 3 MB each; older ones are built again from their images when needed


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that others are aligned to."""

    index: int                    # place in its recording
    reduced: ReducedFrame
    features: Features


class Keyframes:
    """Keyframes by number, in order, with their poses as known now; builds pyramids when they are asked for."""

    def __init__(self) -> None:
        self.items: list[Keyframe] = []
        self.T_world_keyframe: list[NDArray[np.float64]] = []
        self.pyramids: OrderedDict[int, SurfelPyramid] = OrderedDict()

    def __len__(self) -> int:
        return len(self.items)

    def add(self, keyframe: Keyframe, pyramid: SurfelPyramid, T_world_keyframe: NDArray) -> int:
        """Keep a keyframe; returns its number."""
        self.items.append(keyframe)
        self.T_world_keyframe.append(T_world_keyframe)
        self._remember(len(self.items) - 1, pyramid)
        return len(self.items) - 1

    def pyramid(self, number: int) -> SurfelPyramid:
        """The surfel pyramid of keyframe `number`."""
        found = self.pyramids.pop(number, None) or build_pyramid(self.items[number].reduced)
        self._remember(number, found)
        return found

    def _remember(self, number: int, pyramid: SurfelPyramid) -> None:
        self.pyramids[number] = pyramid
        while len(self.pyramids) > LIVE_PYRAMIDS:
            self.pyramids.popitem(last=False)
