"""Frames aligned to keyframes and keyframes to each other: what the built-in trackers share."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..preprocessing import PreprocessSettings
from ..types import Frame
from .base import CurrentPoses, TrackedFrame, TrackingResult, TrackingSettings, Verdict
from .depth_bias import LEAST_PAIRS, DepthBias
from .features import Features, extract_features
from .keyframes import Keyframe, Keyframes
from .loop_closure import believable, find_loops, neighbor_edges
from .pose_graph import ANCHOR, Edge, Prior, optimize
from .pyramid import ReducedFrame, SurfelPyramid, build_pyramid, reduce_frame
from .registration import Registration, Target, register
from .static_part import MOST_MOVING, SOME_MOVING, register_static, without_left_out

logger = logging.getLogger(__name__)

MIN_SURFELS = 0.03  # smallest share of the image with usable depth that can be aligned
# An alignment of a frame to its keyframe is trusted from these shares on: of the frame that meets
# the keyframe, and of that part that lies on the keyframe's surface (right ones have 0.84 to 0.98).
FRAME_OVERLAP, FRAME_AGREEMENT = 0.25, 0.65
SURE_AGREEMENT = 0.8  # the same after a loss, when the camera may be far from where it was
# of a frame that nothing contradicts: noise, glass and edges are not held against it
FEW_MOVING, LEAST_AGREEMENT = 0.03, 0.5
# [m, rad] farther from where the camera was expected, little may contradict
JUMP = 0.1, np.radians(7)
FRAME_CORRECTION = 0.3, np.radians(20)  # [m, rad] a result farther from its guess is wrong
ROUNDS = 2  # of correcting depth and aligning keyframes anew
BIASED = (
    "tracking: depth is off by up to %.1f%% of itself, by its place in the image, and is corrected"
)
SEEMS_BIASED = (
    "tracking: depth seems to be off by up to %.1f%% of itself, by its place in the image; "
    "--tracking.depth-bias correct puts it right, in the map too"
)
NOT_MET = "in a second map, begun where the camera was lost, which has not met the first yet"
NEVER_MET = "in a second map, begun where the camera was lost, which never surely met the first"


@dataclass(frozen=True, eq=False)
class PreparedFrame:
    """A frame with what it is aligned by."""

    frame: Frame
    reduced: ReducedFrame
    pyramid: SurfelPyramid
    depth_range: tuple[float, float]  # [m]

    @cached_property
    def features(self) -> Features:
        """Found when asked for: most frames never need them."""
        return extract_features(self.frame, *self.depth_range)

    @property
    def blank(self) -> str:
        """Why this frame cannot be aligned; empty if it can."""
        share = float((self.reduced.inverse > 0).mean())
        return f"only {share:.1%} of the image has usable depth" if share < MIN_SURFELS else ""


@dataclass(frozen=True, eq=False)
class Placement:
    """A frame relative to its keyframe; the pose in the world follows from the keyframe's, which
    may still move.
    """

    tracked: TrackedFrame
    keyframe: int | None = None  # number among the keyframes; None: the frame has no pose
    T_keyframe_camera: NDArray[np.float64] | None = None  # (4, 4)
    registration: Registration | None = None  # that it was aligned by


class KeyframeOdometry:
    """Keyframes, the edges between them, and where every frame lies relative to one of them."""

    def __init__(
        self, settings: TrackingSettings, preprocess: PreprocessSettings, version: int = 0
    ) -> None:
        self.settings = settings
        self.depth_range = preprocess.depth_min, settings.depth_max
        self.keyframes = Keyframes()
        self.edges: list[Edge] = []
        self.priors: list[Prior] = []
        self.placements: list[Placement] = []
        self.reference = 0  # number of the keyframe that frames are aligned to
        self.optimizations = 0
        self.bias = DepthBias()
        self.version = version  # grows when the poses of earlier frames change

    def prepare(self, frame: Frame) -> PreparedFrame:
        """Build the frame's pyramid, of depth that is corrected where it is known to be wrong."""
        frame = self.bias.corrected(frame)
        reduced = reduce_frame(frame, *self.depth_range)
        return PreparedFrame(frame, reduced, build_pyramid(reduced), self.depth_range)

    def align(
        self,
        prepared: PreparedFrame,
        T_world_camera: NDArray,
        window: int = 1,
        agreement: float = FRAME_AGREEMENT,
        expected: NDArray | None = None,
    ) -> tuple[Registration, str]:
        """The frame relative to the reference keyframe, from the guess `T_world_camera`, and why
        the result cannot be trusted; empty if it can. `expected` is where a motion that was observed
        takes the camera.
        """
        poses, newest = self.keyframes.T_world_keyframe, self.reference
        T_newest_world = se3.inverse(poses[newest])
        recent = self.keyframes.same_island(newest, range(max(0, newest - window + 1), newest + 1))
        targets = [
            Target(self.keyframes.pyramid(k), se3.inverse(poses[k]) @ poses[newest]) for k in recent
        ]
        guess = T_newest_world @ T_world_camera
        found, compared = register_static(
            prepared.pyramid,
            targets,
            guess,
            self.settings.photometric_weight,
            expected=expected is not None,
        )
        if expected is not None and compared.contradicted < FEW_MOVING:
            agreement = min(agreement, LEAST_AGREEMENT)
        problem = problem_of(found, guess, agreement)
        from_there = guess if expected is None else T_newest_world @ expected
        distance, angle = se3.distance(from_there, found.T_target_source)
        # without a motion that was observed, a wrong place near the guess looks like things that move
        sure = expected is not None and distance < JUMP[0] and angle < JUMP[1]
        if not problem and compared.contradicted > (MOST_MOVING if sure else SOME_MOVING):
            problem = f"{compared.contradicted:.0%} of what it sees has moved"
        return found, problem

    def add_keyframe(
        self,
        prepared: PreparedFrame,
        T_world_camera: NDArray,
        registration: Registration | None,
        island: int | None = None,
    ) -> int:
        """Make the frame a keyframe and the new reference; `registration` is its alignment to the
        reference before it, whose sub-map it belongs to unless another `island` is given. Returns its
        number.
        """
        reduced = without_left_out(prepared.reduced, prepared.pyramid)
        keyframe = Keyframe(prepared.frame.index, reduced, prepared.features)
        before = self.reference
        if island is None:
            island = self.island
        number = self.keyframes.add(keyframe, prepared.pyramid, T_world_camera, island)
        if registration is not None:
            self.edges.append(Edge.of(before, number, registration))
            # from now on the frame is its own keyframe: identity pose
            if self.placements[-1].tracked.index == keyframe.index:
                self.placements[-1] = replace(
                    self.placements[-1], keyframe=number, T_keyframe_camera=np.eye(4)
                )
        self.reference = number
        return number

    @property
    def island(self) -> int:
        """The sub-map that frames are aligned to; 0: the first."""
        return self.keyframes.islands[self.reference] if len(self.keyframes) else 0

    def join(self, island: int, other: int, T_other_island: NDArray, edges: Sequence[Edge]) -> None:
        """Let a sub-map become a part of another one, in whose world it lies as the transform says,
        held there by edges.
        """
        poses, islands = self.keyframes.T_world_keyframe, self.keyframes.islands
        for number, each in enumerate(islands):
            if each == island:
                poses[number] = se3.normalized(T_other_island @ poses[number])
                islands[number] = other
        self.edges += edges
        self.version += 1  # also where nothing is left to optimise
        self.optimize()

    def link_keyframe(self, number: int, by_appearance: bool) -> None:
        """Add edges from a new keyframe to recent ones, and to older ones that close a loop."""
        weight = self.settings.photometric_weight
        self.edges += neighbor_edges(self.keyframes, number, weight)
        if self.settings.depth_bias != "off":
            self._look_for_bias(number)
        if not self.settings.loops:
            return
        loops = find_loops(self.keyframes, number, weight, by_appearance)
        self.edges += loops
        if any(edge.contradicts(self.keyframes.T_world_keyframe) for edge in loops):
            # at once: loops of the next keyframes are looked for from the corrected poses
            self.optimize()

    def _look_for_bias(self, number: int) -> None:
        """Take in what the edges of a new keyframe say of depth that is wrong by its place in the image. Once
        that is sure, say so, or correct it: of all keyframes, which are aligned anew, and of frames to come.
        """
        corrects = self.settings.depth_bias == "correct"
        if not corrects and self.bias.pairs >= LEAST_PAIRS:
            return
        for edge in self.edges:
            if edge.b == number and self.bias.looking:
                self._add_pair(edge)
        if (more := self.bias.surely()) is None:
            return
        if not corrects:
            logger.warning(SEEMS_BIASED, 100 * self.bias.largest(more))
            return
        for _ in range(ROUNDS):
            self.bias.correct(more)
            self.keyframes.correct(more)
            self.edges = [self._again(edge) for edge in self.edges]
            for edge in self.edges:
                self._add_pair(edge)
            more = self.bias.likeliest
        self.bias.correct(np.zeros_like(more))
        logger.warning(BIASED, 100 * self.bias.largest(self.bias.known))
        self.optimize()

    def _add_pair(self, edge: Edge) -> None:
        source, target = self.keyframes.pyramid(edge.b), self.keyframes.pyramid(edge.a)
        self.bias.add(source, target, edge.T_a_b)

    def _again(self, edge: Edge) -> Edge:
        """An edge after depth was corrected; as it was, where its alignment is not sure any more."""
        source, target = self.keyframes.pyramid(edge.b), self.keyframes.pyramid(edge.a)
        found = register(source, target, edge.T_a_b, self.settings.photometric_weight)
        if edge.robust and not believable(found, edge.T_a_b):
            return edge
        return Edge.of(edge.a, edge.b, found, robust=edge.robust, loop=edge.loop)

    def optimize(self) -> None:
        """Move the keyframes to the poses that fit all edges and priors best."""
        if self.edges:
            graph = optimize(
                self.keyframes.T_world_keyframe, self.edges, [*self.priors, *self._anchors()]
            )
            self.keyframes.T_world_keyframe = list(graph.T_world_node)
            self.optimizations += 1
            self.version += 1

    def _anchors(self) -> list[Prior]:
        """What holds each of several sub-maps, which no edge does."""
        islands, poses = self.keyframes.islands, self.keyframes.T_world_keyframe
        first = {island: islands.index(island) for island in islands}
        if len(first) < 2:
            return []
        return [Prior(number, poses[number], ANCHOR * np.eye(6)) for number in first.values()]

    def is_far(self, registration: Registration) -> bool:
        """Whether a frame is so far from its keyframe that it becomes one itself."""
        distance, angle = se3.distance(np.eye(4), registration.T_target_source)
        s = self.settings
        return (
            distance > s.keyframe_distance
            or angle > np.radians(s.keyframe_angle)
            or registration.fitness < s.keyframe_fitness
        )

    def place(
        self,
        prepared: PreparedFrame,
        verdict: Verdict,
        T_keyframe_camera: NDArray,
        registration: Registration | None = None,
        message: str = "",
    ) -> TrackedFrame:
        """Note where a frame lies relative to the reference keyframe."""
        keyframe = self.reference
        T_keyframe_camera = se3.normalized(T_keyframe_camera)
        T = self.keyframes.T_world_keyframe[keyframe] @ T_keyframe_camera
        tracked = TrackedFrame(
            prepared.frame.index,
            verdict,
            T,
            prepared.frame.timestamp,
            None if registration is None else registration.fitness,
            None if registration is None else registration.rmse,
            keyframe=self.keyframes.items[keyframe].index,
            message=message,
        )
        self.placements.append(Placement(tracked, keyframe, T_keyframe_camera, registration))
        return self.as_known(NOT_MET)

    def as_known(self, apart: str = NOT_MET) -> TrackedFrame:
        """The last frame where its keyframe says that it lies; why it has no pose where that is
        `apart` from the first map.
        """
        return self._final(self.placements[-1], apart)

    def give_up(
        self, index: int, timestamp: float | None, verdict: Verdict, message: str
    ) -> TrackedFrame:
        """Note a frame that has no pose."""
        tracked = TrackedFrame(index, verdict, None, timestamp, message=message)
        self.placements.append(Placement(tracked))
        return tracked

    def current_poses(self) -> CurrentPoses:
        """Keyframes as they are now, and every frame's place relative to its own."""
        placements = self.placements
        poses = [placement.T_keyframe_camera for placement in placements]
        return CurrentPoses(
            self.version,
            np.array([keyframe.index for keyframe in self.keyframes.items], np.int64),
            np.array(self.keyframes.T_world_keyframe, np.float64).reshape(-1, 4, 4),
            np.array(self.keyframes.islands, np.int64) == 0,
            np.array([placement.tracked.index for placement in placements], np.int64),
            np.array([-1 if p.keyframe is None else p.keyframe for p in placements], np.int64),
            np.array([np.eye(4) if T is None else T for T in poses]).reshape(-1, 4, 4),
        )

    def result(self, details: Mapping[str, Any] | None = None) -> TrackingResult:
        """All frames with poses that follow from the optimised keyframes."""
        self.optimize()
        frames = []
        for placement in self.placements:
            frames.append(self._final(placement, NEVER_MET))
        indices = [keyframe.index for keyframe in self.keyframes.items]
        loops = tuple((indices[edge.a], indices[edge.b]) for edge in self.edges if edge.loop)
        apart = len({*self.keyframes.islands} - {0})
        counts = {
            "keyframes": len(indices),
            "edges": len(self.edges),
            "loops": len(loops),
            "optimizations": self.optimizations,
            **({"islands": apart} if apart else {}),
            **({"depth_bias": self.bias.known.tolist()} if self.bias.known.any() else {}),
        }
        return TrackingResult(tuple(frames), tuple(indices), loops, {**counts, **(details or {})})

    def _final(self, placement: Placement, apart: str) -> TrackedFrame:
        """A frame where its keyframe says that it lies, or why it lies `apart`."""
        tracked, number = placement.tracked, placement.keyframe
        if number is None or placement.T_keyframe_camera is None:
            return replace(tracked, T_world_camera=None)
        pose = self.keyframes.T_world_keyframe[number] @ placement.T_keyframe_camera
        T: NDArray[np.float64] = se3.normalized(pose)
        if self.keyframes.islands[number]:
            return replace(
                tracked,
                verdict=Verdict.APART,
                T_world_camera=None,
                T_apart_camera=T,
                keyframe=None,
                message=apart,
            )
        return replace(tracked, T_world_camera=T, T_apart_camera=None)


def problem_of(found: Registration, guess: NDArray, agreement: float = FRAME_AGREEMENT) -> str:
    """Why an alignment cannot be trusted; empty if it can."""
    distance, angle = se3.distance(guess, found.T_target_source)
    if found.overlap < FRAME_OVERLAP:
        return f"only {found.overlap:.0%} of the frame overlaps its keyframe"
    if found.agreement < agreement:
        return f"only {found.agreement:.0%} of the overlap lies on the surface that was seen before"
    if not found.determined:
        return "what the frame sees does not tell where the camera is (a blank wall?)"
    if distance > FRAME_CORRECTION[0] or angle > FRAME_CORRECTION[1]:
        return (
            f"alignment went astray ({distance:.2f} m, {np.degrees(angle):.0f} degrees from where "
            "the camera was expected)"
        )
    return ""
