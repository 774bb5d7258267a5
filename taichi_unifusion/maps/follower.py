"""MapFollower: windows follow the trajectory, in every map (Fig. 5, Sec. IV-E).

A window whose keyframe moved is taken out where it lay and put back where it belongs, those that
moved most first. Sums of latents are exact, so that a map which followed is that which would have
been fused at these poses in the first place. Two things are settled in the end alone: the votes of
rays, since what a ray says depends on the surface that it meets; and maps of features, whose rows
are quantised: they are fused again.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..geometry.se3 import distance
from .base_map import BaseMap
from .feature_map import FeatureMap
from .kept_window import KeptViews, KeptWindow, placed
from .property_group import MapGroup, group_maps
from .surface_map import SurfaceMap
from .value_scale import steps_for
from .window import WindowFusion
from .window_store import Kept, WindowStore

LEAST_MOVE, LEAST_TURN = 0.005, 0.25  # [m, degrees] a window that moved by less stays
BUDGET = 15.0  # [ms] a frame, in the mean, for windows that move while frames come in
ANEW = (
    0.5  # share of the windows that wait to move, from which on it is quicker to fuse all of them
)
Pose = NDArray[np.float64]


@dataclass(frozen=True)
class Followed:
    """What following the trajectory took."""

    windows: int = 0  # that were kept
    moved: int = 0  # of them, those that do not lie where they were fused first
    moves: int = 0  # how often a window was taken out, put back, or both
    anew: int = 0  # windows that were fused in the end, all of them, since most had moved or waited
    farthest: float = 0.0  # [m] that a window lies from where it was fused first
    seconds: float = 0.0
    settled: float = 0.0  # [s] of them, for votes and features in the end


class Fusing(Protocol):
    """What fuses windows into maps: a pipeline."""

    fusion: WindowFusion
    groups: list[MapGroup]  # of the maps, once these were asked for

    @property
    def maps(self) -> dict[str, BaseMap]: ...


class GivenMaps:
    """Maps without what made their values, into which windows are fused."""

    def __init__(self, maps: Iterable[BaseMap]) -> None:
        self.maps: dict[str, BaseMap] = {each.name: each for each in maps}
        self.groups: list[MapGroup] = group_maps(self.maps.values())
        self.fusion = WindowFusion(1)


class MapFollower:
    """Keeps the maps of a pipeline at the poses that its windows have now.

    follower = MapFollower(pipeline, store)
    follower.follow(poses)                     # by place in the recording: of frames so far
    follower.work()                            # between windows: some of them, within the budget
    follower.finish()                          # all others; votes and features
    """

    def __init__(self, fusing: Fusing, store: WindowStore, budget: float = BUDGET) -> None:
        self.fusing, self.store, self.budget = fusing, store, budget
        self.done = Followed()
        self._poses: Mapping[int, Pose] = {}  # of frames, by place in the recording
        self._wanted: dict[int, Pose | None] = {}  # by number of a window, where that is elsewhere
        self._looked = 0  # windows whose place was compared with the poses
        self._credit, self._price = 0.0, 0.0  # [ms] to spend, and of the last window
        # told of every window that is fused in the end, and how many there are
        self.on_window: Callable[[int, int], None] = lambda done, total: None
        self.settled = True  # False: windows moved since all views voted and features were fused

    def follow(self, T_world_camera: Mapping[int, Pose]) -> None:
        """Take note of the poses of all frames so far; frames that are missing have none (any more)."""
        self._poses, self._looked, self._wanted = T_world_camera, 0, {}

    def move_to(self, places: Mapping[int, Pose | None]) -> None:
        """Take note of where windows belong, by number; None: in no map."""
        self._wanted.update(places)

    def add(self, window: KeptWindow, T_world_keyframe: Pose) -> None:
        """Fuse a window at a pose, as of another store; `settle` then lets its views vote."""
        self._fuse(window, T_world_keyframe, 1)
        self.store(window)
        self.store.place({len(self.store) - 1: T_world_keyframe})
        self.settled = False

    def earn(self) -> None:
        """A frame came in: there is more time for windows that move."""
        if self._wanted or self._looked < len(self.store):
            self._credit += self.budget

    def work(self, milliseconds: float | None = None) -> int:
        """Move windows while there is time left, what was earned or what is given, most moved first;
        returns how many. To be called where no window is open, as after one was closed.
        """
        if milliseconds is not None:
            self._credit, self._price = milliseconds, 0.0
        if not self._credit:
            return 0
        count, waiting = 0, self._waiting() if self._credit >= self._price else []
        for number in waiting:
            if self._credit < self._price:
                break
            started = time.perf_counter()
            self._move(number, self._wanted.pop(number))
            self._price = 1e3 * (time.perf_counter() - started)
            self._credit -= self._price
            count += 1
        if count:
            self._compact()
        if not self._wanted:
            self._credit = 0.0
        return count

    def finish(self, *, alone: bool = False) -> Followed:
        """Move all windows that still lie elsewhere, then settle; returns what all of it took. Where
        maps hold these windows `alone`, they may be fused anew instead: the maps are then the same.
        """
        self.fusing.fusion.flush()
        waiting = self._waiting()
        if alone and len(waiting) > ANEW * len(self.store):
            self._fuse_anew()
        else:
            for number in waiting:
                self._move(number, self._wanted.pop(number), vote=False)
        self._compact()
        # maps of features have what lies nowhere, too: they take every frame at once
        if not self.settled or any(kept.place is None for kept in self.store.windows):
            self.settle()
        return self.summary()

    def summary(self) -> Followed:
        """What following took so far."""
        apart = [
            distance(kept.T_world_keyframe, kept.place)[0]
            for kept in self.store.windows
            if kept.place is not None and kept.place is not kept.T_world_keyframe
        ]
        return replace(
            self.done,
            windows=len(self.store),
            moved=len(apart),
            farthest=max(apart, default=0.0),
        )

    def settle(self) -> None:
        """Let all views vote anew on the surface as it is, and fuse features anew."""
        started = time.perf_counter()
        self.fusing.fusion.flush()
        surfaces, features = self.surfaces, self.features
        for surface in surfaces:
            surface.grid["evidence"].fill(0)
        for each in features:
            each.clear()
        for number in self.store.resident() if surfaces or features else ():
            self._vote(number, surfaces, features)
        spent = time.perf_counter() - started
        self.done = replace(
            self.done, seconds=self.done.seconds + spent, settled=self.done.settled + spent
        )
        self.settled = True

    @property
    def surfaces(self) -> list[SurfaceMap]:
        """The maps in which rays vote."""
        return [
            each
            for each in self.fusing.maps.values()
            if isinstance(each, SurfaceMap) and each.settings.carve
        ]

    @property
    def features(self) -> list[FeatureMap]:
        """The maps that are fused anew."""
        return [each for each in self.fusing.maps.values() if isinstance(each, FeatureMap)]

    def _vote(
        self,
        number: int,
        surfaces: Sequence[SurfaceMap],
        features: Sequence[FeatureMap],
    ) -> None:
        place = self.store.windows[number].place
        assert place is not None
        if not features:  # nothing else is read
            _let_vote(surfaces, self.store.views(number), place, 1)
            return
        window = self.store[number]
        _let_vote(surfaces, window.views, place, 1)
        motion = window.motion(place)
        for kept in window.features:
            for each in features:
                if each.name == kept.name:
                    each.integrate_kept(kept, motion)

    def _waiting(self) -> list[int]:
        """Windows that belong elsewhere, most moved first."""
        for number in range(self._looked, len(self.store)):
            self._compare(number)
        self._looked = len(self.store)
        return sorted(self._wanted, key=lambda n: (-self._amount(n), n))

    def _compare(self, number: int) -> None:
        kept = self.store.windows[number]
        if not self._poses:
            return
        target = placed(kept.frames, kept.T_keyframe_camera, self._poses)
        if target is None and kept.place is None:
            return
        if target is not None:
            at = kept.T_world_keyframe if kept.place is None else kept.place
            moved, turned = distance(at, target)
            if moved <= LEAST_MOVE and np.degrees(turned) <= LEAST_TURN:
                if kept.place is not None:
                    return
                target = at  # its cells are those of the map there
        self._wanted[number] = target

    def _amount(self, number: int) -> float:
        """How far a window is from where it belongs, in the least moves that count."""
        place, target = self.store.windows[number].place, self._wanted[number]
        if place is None or target is None:
            return np.inf
        moved, turned = distance(place, target)
        return max(moved / LEAST_MOVE, np.degrees(turned) / LEAST_TURN)

    def _fuse_anew(self) -> None:
        """Empty the maps, and fuse every window where it belongs."""
        started = time.perf_counter()
        for each in self.fusing.maps.values():
            each.grid.clear()
        places: dict[int, Pose | None] = {}
        for number, kept in enumerate(self.store.windows):
            target = self._wanted.pop(number, kept.place)
            if target is not None:
                window = self.store[number]
                target = self._at_home(kept, window, target)
                self._fuse(window, target, 1)
            places[number] = target
            self.on_window(number + 1, len(self.store))
        self.store.place(places)
        self.settled = False
        spent = time.perf_counter() - started
        self.done = replace(
            self.done, anew=self.done.anew + len(self.store), seconds=self.done.seconds + spent
        )

    def _at_home(self, kept: Kept, window: KeptWindow, target: Pose) -> Pose:
        """The pose itself, or where the window lay at first, to the bit, where that is the same."""
        return kept.T_world_keyframe if window.motion(target) is None else target

    def _move(self, number: int, target: Pose | None, *, vote: bool = True) -> None:
        """Take a window out, and put it back elsewhere; without `vote`, rays vote in the end alone."""
        started = time.perf_counter()
        kept, window = self.store.windows[number], self.store[number]
        surfaces = self.surfaces if vote else ()
        if target is not None:
            target = self._at_home(kept, window, target)
        if kept.place is not None:
            _let_vote(surfaces, window.views, kept.place, -1)
            self._fuse(window, kept.place, -1)
        if target is not None:
            self._fuse(window, target, 1)
            _let_vote(surfaces, window.views, target, 1)
        self.store.place({number: target})
        self.settled = False
        spent = time.perf_counter() - started
        self.done = replace(self.done, moves=self.done.moves + 1, seconds=self.done.seconds + spent)

    def _fuse(self, window: KeptWindow, T_world_keyframe: Pose, sign: int) -> None:
        """Fuse the local LIMs of a window at a pose, or take them out."""
        motion = window.motion(T_world_keyframe)
        assert self.fusing.maps  # they are made when they are asked for
        for names, cells in window.cells.items():
            part, arrays = self.fusing.fusion.part(names, self.fusing.groups)
            for each in part.maps:
                each.grid.sum_exactly(steps_for(cells.exponents))
            local = part.encoder.encode(cells.binned(part.binner, arrays, motion))
            if sign > 0:
                part.reserve(local.count)  # what does not fit is said before a map changes
                part.fuse(local)
            else:
                part.take_out(local)

    def _compact(self) -> None:
        for each in self.fusing.maps.values():
            each.grid.compact()


def _let_vote(
    surfaces: Sequence[SurfaceMap], views: KeptViews, T_world_keyframe: Pose, sign: int
) -> None:
    """Let the views of a window, at a pose, vote on the surface as it is."""
    if surfaces:
        depth, T = views.meters, views.T_camera_world(T_world_keyframe)
        for surface in surfaces:
            if surface.grid.count:
                surface.vote(depth, views.camera, T, (0, surface.grid.count), sign)
