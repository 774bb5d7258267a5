"""Internal tracking: poses that are given, refined by colored ICP against recent keyframes (Sec.
V-A.1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..preprocessing import PreprocessSettings
from ..types import Frame
from .base import PoseSource, TrackedFrame, Tracker, TrackingResult, TrackingSettings, Verdict
from .external import ExternalPoseTracker
from .given import GivenPoses
from .odometry import KeyframeOdometry, View
from .pose_graph import Edge, Prior
from .registration import Registration

WINDOW = 3  # keyframes, at least
PRIOR_SIGMA = np.array([0.02] * 3 + [np.radians(1.0)] * 3)  # [m, rad] of a given pose
# of the motion between two given poses that are near
GIVEN_SIGMA = np.array([0.01] * 3 + [np.radians(0.5)] * 3)


class InternalTracker(Tracker):
    """Refines the poses of another tracker; one that cannot be trusted stays as it was, relative to
    its keyframe.

    Keyframes are held near their given poses while they are aligned to each other, so that a
    globally consistent trajectory stays so.
    """

    reads_trajectory = True

    @classmethod
    def make(
        cls, settings: TrackingSettings, preprocess: PreprocessSettings, source: PoseSource
    ) -> InternalTracker:
        kind = GivenPoses if source.trajectory is None else ExternalPoseTracker
        return cls(kind.make(settings, preprocess, source), settings, preprocess)

    def __init__(
        self,
        prior: Tracker,
        settings: TrackingSettings | None = None,
        preprocess: PreprocessSettings | None = None,
    ) -> None:
        self.prior, self.settings = prior, settings or TrackingSettings()
        self.uses_given_poses, self.warnings = prior.uses_given_poses, prior.warnings
        self.odometry = KeyframeOdometry(self.settings, preprocess or PreprocessSettings())
        self.T_world_prior: list[NDArray[np.float64]] = []  # of every keyframe, as given

    def track(self, frame: Frame) -> TrackedFrame:
        odometry, given = self.odometry, self.prior.track(frame)
        if given.T_world_camera is None:
            return odometry.give_up(given.index, given.timestamp, given.verdict, given.message)
        view = odometry.view(frame)
        if not len(odometry.keyframes):
            return self._start(view, given, "")
        reference = odometry.reference
        T_reference_prior = se3.inverse(self.T_world_prior[reference]) @ given.T_world_camera
        guess = odometry.keyframes.T_world_keyframe[reference] @ T_reference_prior
        if view.blank:
            return odometry.place(view, Verdict.PRIOR_KEPT, T_reference_prior, None, view.blank)
        found, problem = odometry.align(view, guess, max(WINDOW, self.settings.window))
        problem = problem or self._too_far(found, T_reference_prior)
        if (
            problem
            and se3.distance(np.eye(4), T_reference_prior)[0] > 2 * self.settings.keyframe_distance
        ):
            # a gap: what comes next is aligned to this frame
            return self._start(view, given, problem)
        pose = T_reference_prior if problem else found.T_target_source
        tracked = odometry.place(
            view, Verdict.PRIOR_KEPT if problem else Verdict.REFINED, pose, found, problem
        )
        if not problem and odometry.is_far(found):
            self._add_keyframe(
                view, given, odometry.keyframes.T_world_keyframe[reference] @ pose, found
            )
        return tracked

    def skip(self, index: int, error: Exception) -> TrackedFrame:
        skipped = self.prior.skip(index, error)
        return self.odometry.give_up(index, None, skipped.verdict, skipped.message)

    def finish(self) -> TrackingResult:
        details = dict(self.prior.finish().details)
        return self.odometry.result(**details)

    def _too_far(self, found: Registration, T_reference_prior: NDArray) -> str:
        distance, angle = se3.distance(T_reference_prior, found.T_target_source)
        if distance > self.settings.prior_distance or np.degrees(angle) > self.settings.prior_angle:
            return f"alignment went {100 * distance:.1f} cm and {np.degrees(angle):.1f} degrees away from the given pose"
        return ""

    def _start(self, view: View, given: TrackedFrame, problem: str) -> TrackedFrame:
        """A keyframe that is where it was given, because of a problem or as the first; the next
        ones are aligned to it.
        """
        self._add_keyframe(view, given, given.T_world_camera, None)
        return self.odometry.place(
            view, Verdict.PRIOR_KEPT if problem else given.verdict, np.eye(4), None, problem
        )

    def _add_keyframe(
        self, view: View, given: TrackedFrame, T_world_camera: NDArray, found: Registration | None
    ) -> None:
        odometry, before = self.odometry, self.odometry.reference
        number = odometry.add_keyframe(view, se3.normalized(T_world_camera), found)
        self.T_world_prior.append(given.T_world_camera)
        odometry.priors.append(Prior(number, given.T_world_camera, np.diag(PRIOR_SIGMA**-2)))
        if number and found is None:
            motion = se3.inverse(self.T_world_prior[before]) @ given.T_world_camera
            odometry.edges.append(Edge(before, number, motion, np.diag(GIVEN_SIGMA**-2)))
        elif number:
            odometry.link_keyframe(number, by_appearance=False)
