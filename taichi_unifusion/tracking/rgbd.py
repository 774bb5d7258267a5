"""The built-in RGB-D tracker: poses from frames alone.

Every frame is aligned to the last keyframe, from where its motion so far would take it; keyframes
are aligned to all that see the same, loops included, and a pose graph spreads what does not fit. A
frame that fits nowhere gets no pose; the next ones are looked for by their features.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..preprocessing import PreprocessSettings
from ..types import Frame
from .base import PoseSource, TrackedFrame, Tracker, TrackingResult, TrackingSettings, Verdict
from .features import locate, most_similar
from .loop_closure import believable
from .odometry import MIN_AGREEMENT, SURE_AGREEMENT, KeyframeOdometry, Placement, View
from .registration import Registration, register

CANDIDATES = 3  # keyframes that a lost frame is compared with
# The world of a recording without poses: origin at the first camera, z up if that camera is level.
T_WORLD_FIRST = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])


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
        self.settings, self.preprocess = (
            settings or TrackingSettings(),
            preprocess or PreprocessSettings(),
        )
        self.odometry = KeyframeOdometry(self.settings, self.preprocess)
        self.T_world_first = np.array(T_world_first, np.float64)
        self.motion = np.eye(4)  # from the frame before last to the last one, in camera coordinates
        self.T_world_camera: NDArray | None = None  # of the last frame that was tracked
        self.lost = False

    def track(self, frame: Frame) -> TrackedFrame:
        odometry = self.odometry
        view = odometry.view(frame)
        if view.blank:
            return self._give_up(frame, view.blank)
        if not len(odometry.keyframes):
            return self._start(view)
        found, problem = self._align(view)
        if found is not None:
            return self._accept(view, found, Verdict.TRACKED)
        if (place := self._relocalise(view)) is not None:
            odometry.reference, found = place
            return self._accept(view, found, Verdict.RELOCALISED)
        if sum(placement.keyframe is not None for placement in odometry.placements) == 1:
            return self._restart(view)
        return self._give_up(frame, problem)

    def skip(self, index: int, error: Exception) -> TrackedFrame:
        tracked = super().skip(index, error)
        return self.odometry.give_up(index, None, tracked.verdict, tracked.message)

    def finish(self) -> TrackingResult:
        return self.odometry.result()

    def _start(self, view: View) -> TrackedFrame:
        self.odometry.add_keyframe(view, self.T_world_first, None)
        self.T_world_camera = self.T_world_first
        return self.odometry.place(view, Verdict.TRACKED, np.eye(4))

    def _restart(self, view: View) -> TrackedFrame:
        """Begin with this view: nothing ever fitted the first one."""
        before, self.odometry = self.odometry, KeyframeOdometry(self.settings, self.preprocess)
        for placement in before.placements:
            lost = placement.tracked
            if placement.keyframe is not None:
                lost = replace(
                    lost,
                    verdict=Verdict.LOST,
                    T_world_camera=None,
                    keyframe=None,
                    message="no other frame fits it",
                )
            self.odometry.placements.append(Placement(lost))
        self.lost, self.motion = False, np.eye(4)
        return self._start(view)

    def _align(self, view: View) -> tuple[Registration | None, str]:
        """Alignment to the reference keyframe from where the camera may be, the likeliest guess
        first.
        """
        problem = ""
        guesses = [
            lambda: self.T_world_camera @ self.motion,
            lambda: self.T_world_camera,
            lambda: self._by_features(view),
        ]
        # after a loss nobody knows how far the camera went
        for guess in guesses[:0:-1] if self.lost else guesses:
            if (T_world_camera := guess()) is None:
                continue
            found, wrong = self.odometry.align(
                view,
                T_world_camera,
                self.settings.window,
                SURE_AGREEMENT if self.lost else MIN_AGREEMENT,
            )
            if not wrong:
                return found, ""
            problem = problem or wrong
        return None, problem

    def _by_features(self, view: View) -> NDArray | None:
        reference = self.odometry.reference
        guess = locate(view.features(), self.odometry.keyframes.items[reference].features)
        return (
            None if guess is None else self.odometry.keyframes.T_world_keyframe[reference] @ guess
        )

    def _relocalise(self, view: View) -> tuple[int, Registration] | None:
        """The keyframe that a lost view belongs to, and its alignment to it."""
        keyframes = self.odometry.keyframes
        for number in most_similar(
            view.features(), [keyframe.features for keyframe in keyframes.items], CANDIDATES
        ):
            guess = locate(view.features(), keyframes.items[number].features)
            if guess is None:
                continue
            found = register(
                view.pyramid, keyframes.pyramid(number), guess, self.settings.photometric_weight
            )
            if believable(found, guess):
                return number, found
        return None

    def _accept(self, view: View, found: Registration, verdict: Verdict) -> TrackedFrame:
        odometry = self.odometry
        T_world_camera = se3.normalized(
            odometry.keyframes.T_world_keyframe[odometry.reference] @ found.T_target_source
        )
        self.motion = np.eye(4) if self.lost else se3.inverse(self.T_world_camera) @ T_world_camera
        self.lost = False
        tracked = odometry.place(view, verdict, found.T_target_source, found)
        if odometry.is_far(found):
            number = odometry.add_keyframe(view, T_world_camera, found)
            odometry.link_keyframe(number, by_appearance=True)
            T_world_camera = odometry.keyframes.T_world_keyframe[number]
        self.T_world_camera = T_world_camera
        return tracked

    def _give_up(self, frame: Frame, problem: str) -> TrackedFrame:
        self.lost, self.motion = True, np.eye(4)
        return self.odometry.give_up(frame.index, frame.timestamp, Verdict.LOST, problem)
