"""Internal tracking: given poses, refined by colored ICP against recent keyframes (Sec. V-A.1)."""

from __future__ import annotations

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
from .external import ExternalPoseTracker
from .given import GivenPoses
from .odometry import KeyframeOdometry, PreparedFrame
from .pose_graph import Edge, Prior
from .registration import Registration

WINDOW = 3  # keyframes that a frame is aligned to, at least
# Standard deviations [m, rad] of a given pose, and of the motion between two neighbouring ones
PRIOR_SIGMA = np.array([0.02] * 3 + [np.radians(1.0)] * 3)
GIVEN_SIGMA = np.array([0.01] * 3 + [np.radians(0.5)] * 3)


class InternalTracker(Tracker):
    """Refines the poses of another tracker; where a refinement cannot be trusted, the frame keeps
    its given pose relative to its keyframe.

    The pose graph has a prior at each keyframe's given pose, so that a globally consistent
    trajectory stays so.
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
        # poses are not to leave the given ones for it
        alone = replace(self.settings, depth_bias="off")
        self.odometry = KeyframeOdometry(alone, preprocess or PreprocessSettings())
        self.T_world_prior: list[NDArray[np.float64]] = []  # of every keyframe, as given

    def track(self, frame: Frame) -> TrackedFrame:
        odometry, given = self.odometry, self.prior.track(frame)
        T_world_prior = given.T_world_camera
        if T_world_prior is None:
            return odometry.give_up(given.index, given.timestamp, given.verdict, given.message)
        prepared = odometry.prepare(frame)
        if not len(odometry.keyframes):
            return self._start(prepared, T_world_prior, given.verdict, "")
        reference = odometry.reference
        T_reference_prior = se3.inverse(self.T_world_prior[reference]) @ T_world_prior
        guess = odometry.keyframes.T_world_keyframe[reference] @ T_reference_prior
        if prepared.blank:
            return odometry.place(
                prepared, Verdict.PRIOR_KEPT, T_reference_prior, None, prepared.blank
            )
        found, problem = odometry.align(prepared, guess, max(WINDOW, self.settings.window))
        problem = problem or self._too_far(found, T_reference_prior)
        if (
            problem
            and se3.distance(np.eye(4), T_reference_prior)[0] > 2 * self.settings.keyframe_distance
        ):
            # too far from the keyframe: the next frames are aligned to this one
            return self._start(prepared, T_world_prior, Verdict.PRIOR_KEPT, problem)
        pose = T_reference_prior if problem else found.T_target_source
        tracked = odometry.place(
            prepared, Verdict.PRIOR_KEPT if problem else Verdict.REFINED, pose, found, problem
        )
        if not problem and odometry.is_far(found):
            T_world_camera = odometry.keyframes.T_world_keyframe[reference] @ pose
            self._add_keyframe(prepared, T_world_prior, T_world_camera, found)
        return tracked

    def skip(self, index: int, error: Exception) -> TrackedFrame:
        skipped = self.prior.skip(index, error)
        return self.odometry.give_up(index, None, skipped.verdict, skipped.message)

    @property
    def version(self) -> int:
        return self.odometry.version

    def current_poses(self) -> CurrentPoses:
        return self.odometry.current_poses()

    def finish(self) -> TrackingResult:
        return self.odometry.result(self.prior.finish().details)

    def _too_far(self, found: Registration, T_reference_prior: NDArray) -> str:
        distance, angle = se3.distance(T_reference_prior, found.T_target_source)
        if distance > self.settings.prior_distance or np.degrees(angle) > self.settings.prior_angle:
            return (
                f"alignment went {100 * distance:.1f} cm and {np.degrees(angle):.1f} degrees away "
                "from the given pose"
            )
        return ""

    def _start(
        self, prepared: PreparedFrame, T_world_prior: NDArray, verdict: Verdict, problem: str
    ) -> TrackedFrame:
        """Make the frame a keyframe at its given pose: it is the first, or alignment to the one
        before failed (`problem`).
        """
        self._add_keyframe(prepared, T_world_prior, T_world_prior, None)
        return self.odometry.place(prepared, verdict, np.eye(4), None, problem)

    def _add_keyframe(
        self,
        prepared: PreparedFrame,
        T_world_prior: NDArray,
        T_world_camera: NDArray,
        found: Registration | None,
    ) -> None:
        odometry, before = self.odometry, self.odometry.reference
        number = odometry.add_keyframe(prepared, se3.normalized(T_world_camera), found)
        self.T_world_prior.append(T_world_prior)
        odometry.priors.append(Prior(number, T_world_prior, np.diag(PRIOR_SIGMA**-2)))
        if number and found is None:
            motion = se3.inverse(self.T_world_prior[before]) @ T_world_prior
            odometry.edges.append(Edge(before, number, motion, np.diag(GIVEN_SIGMA**-2)))
        elif number:
            odometry.link_keyframe(number, by_appearance=False)
