"""Frames aligned to keyframes, keyframes aligned to each other: the part that the built-in trackers
share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..preprocessing import PreprocessSettings
from ..types import Frame
from .base import TrackedFrame, TrackingResult, TrackingSettings, Verdict
from .features import Features, extract_features
from .keyframes import Keyframe, Keyframes
from .loop_closure import find_loops, neighbor_edges
from .pose_graph import Edge, Prior, optimize
from .pyramid import ReducedFrame, SurfelPyramid, build_pyramid, reduce_frame
from .registration import Registration, Target, register

MIN_SURFELS = 0.03  # share of the image
MIN_OVERLAP = 0.25
MIN_AGREEMENT = 0.65  # of what is in view; right alignments leave 0.84 to 0.98
SURE_AGREEMENT = 0.8  # where nobody knows how far the camera went
MAX_CORRECTION = 0.3, np.radians(20)  # [m, rad] farther from the guess alignment only goes astray


@dataclass(frozen=True, eq=False)
class View:
    """A frame as the trackers need it."""

    frame: Frame
    reduced: ReducedFrame
    pyramid: SurfelPyramid
    features: Callable[[], Features]  # found when asked for: most frames never need them

    @property
    def blank(self) -> str:
        """Why nothing can be aligned to this frame, or nothing."""
        share = float((self.reduced.inverse > 0).mean())
        return f"only {share:.1%} of the image has usable depth" if share < MIN_SURFELS else ""


@dataclass(frozen=True, eq=False)
class Placement:
    """A frame relative to its keyframe; the pose in the world follows from the keyframe's, which
    may still move.
    """

    tracked: TrackedFrame
    keyframe: int | None = None  # number among the keyframes
    T_keyframe_camera: NDArray[np.float64] | None = None


class KeyframeOdometry:
    """Keyframes, the edges between them, and where every frame lies relative to one of them."""

    def __init__(self, settings: TrackingSettings, preprocess: PreprocessSettings) -> None:
        self.settings = settings
        self.depth_range = preprocess.depth_min, settings.depth_max
        self.keyframes = Keyframes()
        self.edges: list[Edge] = []
        self.priors: list[Prior] = []
        self.placements: list[Placement] = []
        self.reference = 0  # number of the keyframe that frames are aligned to
        self.optimizations = 0

    def view(self, frame: Frame) -> View:
        """The frame's pyramid, and its features when they are asked for."""
        reduced = reduce_frame(frame, *self.depth_range)
        found: list[Features] = []

        def features() -> Features:
            if not found:
                found.append(extract_features(frame, *self.depth_range))
            return found[0]

        return View(frame, reduced, build_pyramid(reduced), features)

    def align(
        self, view: View, T_world_camera: NDArray, window: int = 1, agreement: float = MIN_AGREEMENT
    ) -> tuple[Registration, str]:
        """The view relative to the reference keyframe, from a guess, and why that is not to be
        trusted, if so.
        """
        poses, newest = self.keyframes.T_world_keyframe, self.reference
        targets = [
            Target(self.keyframes.pyramid(k), se3.inverse(poses[k]) @ poses[newest])
            for k in range(max(0, newest - window + 1), newest + 1)
        ]
        guess = se3.inverse(poses[newest]) @ T_world_camera
        found = register(view.pyramid, targets, guess, self.settings.photometric_weight)
        return found, problem_of(found, guess, agreement)

    def add_keyframe(
        self, view: View, T_world_camera: NDArray, registration: Registration | None
    ) -> int:
        """Make the view a keyframe; `registration` is its alignment to the reference keyframe,
        whose place it takes.
        """
        keyframe = Keyframe(view.frame.index, view.reduced, view.features())
        before, number = self.reference, self.keyframes.add(keyframe, view.pyramid, T_world_camera)
        if registration is not None:
            self.edges.append(Edge.of(before, number, registration))
            if self.placements[-1].tracked.index == keyframe.index:  # it moves with itself now
                self.placements[-1] = replace(
                    self.placements[-1], keyframe=number, T_keyframe_camera=np.eye(4)
                )
        self.reference = number
        return number

    def link_keyframe(self, number: int, by_appearance: bool) -> None:
        """Align a new keyframe to others that see the same, near ones and such as close a loop."""
        weight = self.settings.photometric_weight
        self.edges += neighbor_edges(self.keyframes, number, weight)
        if not self.settings.loops:
            return
        loops = find_loops(self.keyframes, number, weight, by_appearance)
        self.edges += loops
        if any(edge.contradicts(self.keyframes.T_world_keyframe) for edge in loops):
            # at once: the next loops are looked for where the camera is now thought to be
            self.optimize()

    def optimize(self) -> None:
        """Move the keyframes to where all edges and priors agree best."""
        if self.edges:
            graph = optimize(self.keyframes.T_world_keyframe, self.edges, self.priors)
            self.keyframes.T_world_keyframe = list(graph.T_world_node)
            self.optimizations += 1

    def is_far(self, registration: Registration) -> bool:
        """Whether a frame shares so little with its keyframe that it becomes one."""
        distance, angle = se3.distance(np.eye(4), registration.T_target_source)
        s = self.settings
        return (
            distance > s.keyframe_distance
            or angle > np.radians(s.keyframe_angle)
            or registration.fitness < s.keyframe_fitness
        )

    def place(
        self,
        view: View,
        verdict: Verdict,
        T_keyframe_camera: NDArray,
        registration: Registration | None = None,
        message: str = "",
    ) -> TrackedFrame:
        """Note where a frame lies relative to the reference keyframe."""
        keyframe = self.reference
        T_keyframe_camera = se3.normalized(T_keyframe_camera)
        fit = (
            {}
            if registration is None
            else {"fitness": registration.fitness, "rmse": registration.rmse}
        )
        tracked = TrackedFrame(
            view.frame.index,
            verdict,
            self.keyframes.T_world_keyframe[keyframe] @ T_keyframe_camera,
            view.frame.timestamp,
            keyframe=self.keyframes.items[keyframe].index,
            message=message,
            **fit,
        )
        self.placements.append(Placement(tracked, keyframe, T_keyframe_camera))
        return tracked

    def give_up(
        self, index: int, timestamp: float | None, verdict: Verdict, message: str
    ) -> TrackedFrame:
        """Note a frame that has no pose."""
        tracked = TrackedFrame(index, verdict, None, timestamp, message=message)
        self.placements.append(Placement(tracked))
        return tracked

    def result(self, **details) -> TrackingResult:
        """All frames with poses that follow from the optimised keyframes."""
        self.optimize()
        frames = []
        for placement in self.placements:
            pose = None
            if placement.keyframe is not None:
                pose = se3.normalized(
                    self.keyframes.T_world_keyframe[placement.keyframe]
                    @ placement.T_keyframe_camera
                )
            frames.append(replace(placement.tracked, T_world_camera=pose))
        indices = [keyframe.index for keyframe in self.keyframes.items]
        loops = tuple((indices[edge.a], indices[edge.b]) for edge in self.edges if edge.loop)
        details = {
            "keyframes": len(indices),
            "edges": len(self.edges),
            "loops": len(loops),
            "optimizations": self.optimizations,
            **details,
        }
        return TrackingResult(tuple(frames), tuple(indices), loops, details)


def problem_of(found: Registration, guess: NDArray, agreement: float = MIN_AGREEMENT) -> str:
    """Why an alignment is not to be trusted, or nothing."""
    distance, angle = se3.distance(guess, found.T_target_source)
    if found.overlap < MIN_OVERLAP:
        return f"only {found.overlap:.0%} of the frame overlaps its keyframe"
    if found.agreement < agreement:
        return f"only {found.agreement:.0%} of the overlap lies on the surface that was seen before"
    if not found.determined:
        return "what the frame sees does not tell where the camera is (a blank wall?)"
    if distance > MAX_CORRECTION[0] or angle > MAX_CORRECTION[1]:
        return f"alignment went astray ({distance:.2f} m, {np.degrees(angle):.0f} degrees from where the camera was expected)"
    return ""
