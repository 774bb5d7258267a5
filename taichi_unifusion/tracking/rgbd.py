"""The built-in RGB-D tracker: poses from frames alone.

Every frame is aligned to the last keyframe, starting from a constant-motion guess; keyframes are
aligned to all others that see the same surface, loops included, and a pose graph distributes the
drift. A frame that fits nowhere gets no pose; the next ones are relocalised by their features, or
begin a second map, which joins the first at the first sure overlap.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..preprocessing import PreprocessSettings
from ..types import Frame
from .base import (
    CurrentPoses,
    PoseSource,
    TrackedFrame,
    Tracker,
    TrackingResult,
    TrackingSettings,
    Verdict,
)
from .features import locate, most_similar
from .fixed_part import FixedPart, without
from .islands import Islands
from .keyframes import Keyframes
from .loop_closure import believable
from .odometry import (
    FRAME_AGREEMENT,
    SURE_AGREEMENT,
    KeyframeOdometry,
    Placement,
    PreparedFrame,
    problem_of,
)
from .pyramid import build_pyramid
from .registration import Registration, register

REACH, FASTEST = 0.3, 0.15  # [m], [m a frame] a camera is not faster than
NOT_LOADED = Verdict.UNREADABLE, Verdict.MISSING
FIXED = (
    "tracking: %.0f%% of the image is fixed to the camera (a part of what carries it?) and is left out of "
    "tracking; leave it out of the map with --preprocess.depth-min, or without those readings in the recording"
)
CANDIDATES = 3  # keyframes that a lost frame is compared with
LOST_FOR = 3  # frames, after which those that fit each other begin a second map
APART_KEYFRAMES = 10  # frames of it from one keyframe to the next at most
LEAST_SIGHTINGS = 2  # keyframes of it that must say the same before it joins another
# The world of a recording without poses: origin at the first camera, z up if that camera is level.
T_WORLD_FIRST = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


logger = logging.getLogger(__name__)


class RgbdTracker(Tracker):
    """Frame-to-keyframe alignment, loop closing, relocalisation; needs no poses."""

    uses_given_poses = False

    @classmethod
    def make(
        cls, settings: TrackingSettings, preprocess: PreprocessSettings, source: PoseSource
    ) -> RgbdTracker:
        return cls(settings, preprocess)

    def __init__(
        self,
        settings: TrackingSettings | None = None,
        preprocess: PreprocessSettings | None = None,
        T_world_first: NDArray = T_WORLD_FIRST,
    ) -> None:
        self.settings = settings or TrackingSettings()
        self.preprocess = preprocess or PreprocessSettings()
        self.odometry = KeyframeOdometry(self.settings, self.preprocess)
        self.T_world_first = np.array(T_world_first, np.float64)
        self.fixed = FixedPart()
        self._forget()

    def _forget(self) -> None:
        """Where the camera is and how it moves: of a tracker that has seen nothing."""
        self.motion = np.eye(4)  # T_before_last: of the last frame in the frame before it
        self.T_world_camera = self.T_world_first  # of the last frame that was tracked
        self.lost = False
        self.known_motion = False  # whether `motion` was observed
        self.before: PreparedFrame | None = None  # the last frame, where it was tracked
        self.missed = 0  # frames since then
        self.islands = Islands(self.odometry, self.settings.photometric_weight)
        self.frames = 0  # that were tracked or tried
        # by sub-map: the last frame there was this one, and lay there
        self.seen: dict[int, tuple[int, NDArray[np.float64]]] = {}
        self.candidate: PreparedFrame | None = None  # a lost frame that may begin a second map

    def track(self, frame: Frame) -> TrackedFrame:
        if self.fixed.looking and self.fixed.look(frame):
            return self._begin_again()
        if self.fixed.mask is not None:
            frame = replace(frame, depth=without(frame, self.fixed.mask))
        self.frames += 1
        tracked = self._track(frame)
        self.missed = self.missed + 1 if self.lost else 0
        return tracked

    def _begin_again(self) -> TrackedFrame:
        """Track the first frames once more, without what is fixed to the camera."""
        skipped = [p for p in self.odometry.placements if p.tracked.verdict in NOT_LOADED]
        self.odometry = KeyframeOdometry(self.settings, self.preprocess, self.odometry.version + 1)
        self._forget()
        assert self.fixed.mask is not None
        logger.warning(FIXED, 100 * self.fixed.mask.mean())
        tracked = []
        for frame in self.fixed.seen:
            while skipped and skipped[0].tracked.index < frame.index:
                self.odometry.placements.append(skipped.pop(0))
            tracked.append(self.track(frame))
        self.fixed.seen.clear()
        return tracked[-1]

    def _track(self, frame: Frame) -> TrackedFrame:
        odometry = self.odometry
        prepared = odometry.prepare(frame)
        if prepared.blank:
            return self._give_up(frame, prepared.blank)
        if not len(odometry.keyframes):
            return self._start(prepared)
        found, problem = self._align(prepared)
        if found is None and self._promote_last():
            found, _ = self._align(prepared)
        if found is not None:
            return self._accept(prepared, found, Verdict.TRACKED)
        # what contradicted the last keyframe was left out of it
        prepared = replace(prepared, pyramid=build_pyramid(prepared.reduced))
        if (place := self._relocalise(prepared)) is not None:
            odometry.reference, found = place
            return self._accept(prepared, found, Verdict.RELOCALISED)
        if sum(placement.keyframe is not None for placement in odometry.placements) == 1:
            return self._restart(prepared, problem)
        if (found := self._fits_candidate(prepared)) is not None:
            self._begin_island()
            return self._accept(prepared, found, Verdict.TRACKED)
        self.candidate = prepared
        return self._give_up(frame, problem)

    def skip(self, index: int, error: Exception) -> TrackedFrame:
        tracked = super().skip(index, error)
        return self.odometry.give_up(index, None, tracked.verdict, tracked.message)

    @property
    def version(self) -> int:
        return self.odometry.version

    def current_poses(self) -> CurrentPoses:
        return self.odometry.current_poses()

    def keyframes(self) -> Keyframes:
        return self.odometry.keyframes.of_first_map()

    def finish(self) -> TrackingResult:
        return self.odometry.result()

    def _start(self, prepared: PreparedFrame) -> TrackedFrame:
        self.odometry.add_keyframe(prepared, self.T_world_first, None)
        self.T_world_camera = self.T_world_first
        self.seen[0] = self.frames, self.T_world_first
        return self.odometry.place(prepared, Verdict.TRACKED, np.eye(4))

    def _restart(self, prepared: PreparedFrame, problem: str) -> TrackedFrame:
        """Start over here: no frame could be aligned to the first keyframe, because of `problem`; its frames
        become LOST.
        """
        before = self.odometry
        self.odometry = KeyframeOdometry(self.settings, self.preprocess, before.version + 1)
        for placement in before.placements:
            lost = placement.tracked
            if placement.keyframe is not None:
                lost = replace(
                    lost,
                    verdict=Verdict.LOST,
                    T_world_camera=None,
                    keyframe=None,
                    message=f"no other frame fits it: {problem}",
                )
            self.odometry.placements.append(Placement(lost))
        self._forget()
        return self._start(prepared)

    def _align(self, prepared: PreparedFrame) -> tuple[Registration | None, str]:
        """Alignment to the reference keyframe from several guesses, the likeliest first; or None
        and why the first of them failed.
        """
        problem = ""
        guesses = [
            lambda: self.T_world_camera @ self.motion,
            lambda: self.T_world_camera,
            lambda: self._by_features(prepared),
        ]
        # after a loss the motion is unknown: features first, then the last known pose
        for guess in guesses[:0:-1] if self.lost else guesses:
            if (T_world_camera := guess()) is None:
                continue
            found, wrong = self.odometry.align(
                prepared,
                T_world_camera,
                self.settings.window,
                SURE_AGREEMENT if self.lost else FRAME_AGREEMENT,
                self.T_world_camera @ self.motion if self.known_motion else None,
            )
            if not wrong:
                return found, ""
            problem = problem or wrong
        return None, problem

    def _promote_last(self) -> bool:
        """Make the frame before a keyframe, which is nearer than the one that it was aligned to."""
        last, placements = self.before, self.odometry.placements
        if last is None or not placements or placements[-1].tracked.index != last.frame.index:
            return False
        at, reference = placements[-1], self.odometry.reference
        itself = self.odometry.keyframes.items[reference].index == last.frame.index
        if itself or at.keyframe != reference or at.registration is None:
            return False
        number = self.odometry.add_keyframe(last, self.T_world_camera, at.registration)
        self.odometry.link_keyframe(number, by_appearance=False)
        self.T_world_camera = self.odometry.keyframes.T_world_keyframe[number]
        return True

    def _by_features(self, prepared: PreparedFrame) -> NDArray | None:
        reference = self.odometry.reference
        keyframes = self.odometry.keyframes
        guess = locate(prepared.features, keyframes.items[reference].features)
        return None if guess is None else keyframes.T_world_keyframe[reference] @ guess

    def _relocalise(self, prepared: PreparedFrame) -> tuple[int, Registration] | None:
        """The keyframe that shows the same place as a lost frame, and the alignment to it."""
        keyframes = self.odometry.keyframes
        for number in most_similar(
            prepared.features, [keyframe.features for keyframe in keyframes.items], CANDIDATES
        ):
            guess = locate(prepared.features, keyframes.items[number].features)
            if guess is None:
                continue
            found = register(
                prepared.pyramid, keyframes.pyramid(number), guess, self.settings.photometric_weight
            )
            T_world_camera = keyframes.T_world_keyframe[number] @ found.T_target_source
            if believable(found, guess) and self._reachable(
                keyframes.islands[number], T_world_camera
            ):
                return number, found
        return None

    def _reachable(self, island: int, T_world_camera: NDArray) -> bool:
        """Whether the camera may have come there since it was last seen in a sub-map: a place that
        repeats looks like this one, too.
        """
        if island not in self.seen:
            return True
        frame, T = self.seen[island]
        distance, _ = se3.distance(T, T_world_camera)
        return bool(distance < REACH + FASTEST * (self.frames - frame))

    def _fits_candidate(self, prepared: PreparedFrame) -> Registration | None:
        """The alignment of a lost frame to the lost frame before, from where on both are a map."""
        before, placements = self.candidate, self.odometry.placements
        if before is None or placements[-1].tracked.index != before.frame.index:
            return None
        if self.missed < LOST_FOR or not self.settings.loops:
            return None
        guess = np.eye(4)
        found = register(prepared.pyramid, before.pyramid, guess, self.settings.photometric_weight)
        return None if problem_of(found, guess) else found

    def _begin_island(self) -> None:
        """Begin a second map with the lost frame before, about where the camera was lost."""
        first, odometry = self.candidate, self.odometry
        assert first is not None
        lost = odometry.placements.pop()
        number = odometry.add_keyframe(first, self.T_world_camera, None, self.islands.begin())
        known = replace(
            lost.tracked,
            verdict=Verdict.TRACKED,
            T_world_camera=self.T_world_camera,
            keyframe=first.frame.index,
            message="",
        )
        odometry.placements.append(Placement(known, number, np.eye(4)))
        self.candidate = None
        logger.info("frame %d: lost; a second map begins here", first.frame.index)

    def _meet(self, number: int) -> None:
        """Look for what a keyframe of a second map shows of other maps, and let it join when that is
        sure; leave it where the camera proves to be in another one.
        """
        odometry = self.odometry
        sighting = self.islands.look(number, self._reachable)
        if sighting is None:
            return
        agreeing = self.islands.agreeing(sighting)
        if self.islands.contradicted(sighting):  # what it was begun on has moved
            odometry.reference = sighting.edge.a
            T = odometry.keyframes.T_world_keyframe[number]
            self.T_world_camera = se3.normalized(sighting.T_other_island @ T)
        elif len(agreeing) >= LEAST_SIGHTINGS:
            self.islands.join(agreeing)
            logger.info(
                "frame %d: the second map has met the first", odometry.keyframes.items[number].index
            )
            self.T_world_camera = odometry.keyframes.T_world_keyframe[number]

    def _accept(
        self, prepared: PreparedFrame, found: Registration, verdict: Verdict
    ) -> TrackedFrame:
        odometry = self.odometry
        T_world_camera = se3.normalized(
            odometry.keyframes.T_world_keyframe[odometry.reference] @ found.T_target_source
        )
        self.known_motion, self.before = not self.lost, prepared
        self.motion = np.eye(4) if self.lost else se3.inverse(self.T_world_camera) @ T_world_camera
        self.lost = False
        odometry.place(prepared, verdict, found.T_target_source, found)
        self.T_world_camera = T_world_camera
        if odometry.is_far(found) or self._is_stale(prepared):
            number = odometry.add_keyframe(prepared, T_world_camera, found)
            odometry.link_keyframe(number, by_appearance=True)
            self.T_world_camera = odometry.keyframes.T_world_keyframe[number]
            if odometry.island:
                self._meet(number)
        self.seen[odometry.island] = self.frames, self.T_world_camera
        return odometry.as_known()

    def _is_stale(self, prepared: PreparedFrame) -> bool:
        """Whether a second map needs a keyframe, so that it is looked for in others."""
        odometry = self.odometry
        last = odometry.keyframes.items[odometry.reference].index
        return bool(odometry.island) and prepared.frame.index - last >= APART_KEYFRAMES

    def _give_up(self, frame: Frame, problem: str) -> TrackedFrame:
        self.lost, self.motion, self.known_motion = True, np.eye(4), False
        return self.odometry.give_up(frame.index, frame.timestamp, Verdict.LOST, problem)
