"""Keyframes: what is kept of the frames that others are aligned to."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .depth_bias import factors, terms
from .features import Features
from .pyramid import ReducedFrame, SurfelPyramid, build_pyramid

GRID = 16  # [px] between the points by which the overlap of two keyframes is estimated
NEAR = 0.05  # [m] nothing nearer to a camera is compared
SAME_DEPTH = 0.1  # share of the depth by which a point and a reading may differ
LIVE_PYRAMIDS = 24  # of 3 MB each; older ones are built again from their images when needed


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A frame that others are aligned to."""

    index: int  # place in its recording
    reduced: ReducedFrame
    features: Features

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """(N, 3) points on a coarse grid of its pixels, in its camera [m]."""
        camera, inverse = self.reduced.camera, self.reduced.inverse
        v, u = np.mgrid[GRID // 2 : camera.height : GRID, GRID // 2 : camera.width : GRID]
        q = inverse[v, u]
        return camera.rays(u, v)[q > 0] / q[q > 0][:, None]

    def overlap(self, other: Keyframe, T_other_self: NDArray) -> float:
        """Share of its points at which the other keyframe measured the depth expected there."""
        if not len(self.points):
            return 0.0
        points = (T_other_self[:3, :3] @ self.points.T + T_other_self[:3, 3:]).T  # in `other`
        q, seen = other.reduced.camera.look_up(other.reduced.inverse, points, NEAR)
        return float((np.abs(points[seen, 2] * q - 1) < SAME_DEPTH).sum() / len(self.points))


def corrected_keyframe(keyframe: Keyframe, bias: NDArray[np.float64]) -> Keyframe:
    """A keyframe as it should have been read."""
    reduced, features = keyframe.reduced, keyframe.features
    inverse = reduced.inverse / factors(reduced.camera, bias)
    factor = 1 + terms(features.camera, features.pixels[:, 0], features.pixels[:, 1]) @ bias
    points = (features.points * factor[:, None]).astype(np.float32)
    there = Features(features.descriptors, features.pixels, points, features.camera)
    return Keyframe(keyframe.index, replace(reduced, inverse=inverse), there)


class Keyframes:
    """Keyframes by number, in order, with their present poses; builds pyramids when they are asked
    for.
    """

    def __init__(self) -> None:
        self.items: list[Keyframe] = []
        self.islands: list[
            int
        ] = []  # the sub-map that each belongs to; 0: the first, whose is the world
        self.T_world_keyframe: list[NDArray[np.float64]] = []
        self.pyramids: OrderedDict[int, SurfelPyramid] = OrderedDict()

    def __len__(self) -> int:
        return len(self.items)

    def add(
        self,
        keyframe: Keyframe,
        pyramid: SurfelPyramid,
        T_world_keyframe: NDArray,
        island: int = 0,
    ) -> int:
        """Keep a keyframe of a sub-map; returns its number."""
        number = self.append(keyframe, T_world_keyframe, island)
        self._remember(number, pyramid)
        return number

    def append(self, keyframe: Keyframe, T_world_keyframe: NDArray, island: int = 0) -> int:
        """Keep a keyframe whose pyramid is built when it is asked for; returns its number."""
        self.items.append(keyframe)
        self.islands.append(island)
        self.T_world_keyframe.append(T_world_keyframe)
        return len(self.items) - 1

    def of_first_map(self) -> Keyframes:
        """Those of the first sub-map, whose is the world, with those of all that joined it."""
        found = Keyframes()
        for number, island in enumerate(self.islands):
            if not island:
                found.append(self.items[number], self.T_world_keyframe[number])
        return found

    def correct(self, bias: NDArray[np.float64]) -> None:
        """Correct the depth of all keyframes, as `DepthBias` found it to be wrong."""
        self.items = [corrected_keyframe(each, bias) for each in self.items]
        self.pyramids.clear()

    def same_island(self, number: int, others: range) -> list[int]:
        """Those of `others` that belong to the sub-map of keyframe `number`."""
        return [other for other in others if self.islands[other] == self.islands[number]]

    def pyramid(self, number: int) -> SurfelPyramid:
        """The surfel pyramid of keyframe `number`."""
        found = self.pyramids.pop(number, None) or build_pyramid(self.items[number].reduced)
        self._remember(number, found)
        return found

    def _remember(self, number: int, pyramid: SurfelPyramid) -> None:
        self.pyramids[number] = pyramid
        while len(self.pyramids) > LIVE_PYRAMIDS:
            self.pyramids.popitem(last=False)
