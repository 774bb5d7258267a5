"""Sub-maps that begin where the camera was lost, and join the others at the first sure overlap."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from .features import locate, most_similar
from .loop_closure import believable
from .odometry import KeyframeOdometry
from .pose_graph import Edge
from .registration import register

CANDIDATES = 3  # keyframes of other sub-maps that a keyframe is compared with
# [m, rad] by which two keyframes may differ on where their sub-map lies: what drift between them is
SAME_PLACE = 0.05, np.radians(2.5)
Reachable = Callable[[int, NDArray[np.float64]], bool]  # a place in the world of a sub-map


@dataclass(frozen=True, eq=False)
class Sighting:
    """A keyframe that shows what a keyframe of another sub-map shows, and where its own then lies."""

    number: int  # of the keyframe
    island: int
    other: int  # sub-map that it was seen from, too
    T_other_island: NDArray[np.float64]  # (4, 4)
    edge: Edge


class Islands:
    """What keyframes of sub-maps have seen of each other."""

    def __init__(self, odometry: KeyframeOdometry, photometric_weight: float) -> None:
        self.odometry, self.weight = odometry, photometric_weight
        self.sightings: list[Sighting] = []
        self.begun = 0  # sub-maps besides the first

    def begin(self) -> int:
        """The number of a new sub-map."""
        self.begun += 1
        return self.begun

    def look(self, number: int, reachable: Reachable) -> Sighting | None:
        """Compare a keyframe with those of other sub-maps that look like it; what was seen, if the
        camera can have come there.
        """
        keyframes = self.odometry.keyframes
        island = keyframes.islands[number]
        others = [k for k, each in enumerate(keyframes.islands) if each != island and k != number]
        features = keyframes.items[number].features
        stored = [keyframes.items[k].features for k in others]
        for other in (others[i] for i in most_similar(features, stored, CANDIDATES)):
            guess = locate(features, keyframes.items[other].features)
            if guess is None:
                continue
            found = register(
                keyframes.pyramid(number), keyframes.pyramid(other), guess, self.weight
            )
            T = keyframes.T_world_keyframe[other] @ found.T_target_source
            if believable(found, guess) and reachable(keyframes.islands[other], T):
                sighting = Sighting(
                    number,
                    island,
                    keyframes.islands[other],
                    se3.normalized(T @ se3.inverse(keyframes.T_world_keyframe[number])),
                    Edge.of(other, number, found, robust=True, loop=True),
                )
                self.sightings.append(sighting)
                return sighting
        return None

    def agreeing(self, newest: Sighting) -> list[Sighting]:
        """What says the same as the newest sighting, that included."""
        T_camera = self.odometry.keyframes.T_world_keyframe[newest.number]
        here = newest.T_other_island @ T_camera
        return [each for each in self._of(newest) if _same(each.T_other_island @ T_camera, here)]

    def contradicted(self, newest: Sighting) -> bool:
        """Whether more of what was seen of this sub-map says that it lies elsewhere."""
        return 2 * len(self.agreeing(newest)) <= len(self._of(newest))

    def join(self, agreeing: list[Sighting]) -> None:
        """Let the sub-map of some sightings become a part of the other one."""
        newest = agreeing[-1]
        edges = [each.edge for each in agreeing]
        self.odometry.join(newest.island, newest.other, newest.T_other_island, edges)
        gone = newest.island
        self.sightings = [s for s in self.sightings if gone not in (s.island, s.other)]

    def _of(self, newest: Sighting) -> list[Sighting]:
        pair = newest.island, newest.other
        return [each for each in self.sightings if (each.island, each.other) == pair]


def _same(a: NDArray, b: NDArray) -> bool:
    distance, angle = se3.distance(a, b)
    return bool(distance < SAME_PLACE[0] and angle < SAME_PLACE[1])
