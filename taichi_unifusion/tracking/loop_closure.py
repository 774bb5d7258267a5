"""Edges between keyframes that see the same: neighbours in time, and places that were seen before."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from .features import locate, most_similar
from .keyframes import Keyframes
from .pose_graph import Edge
from .registration import Registration, register

NEAR = 6  # how far back a keyframe counts as recent
NEIGHBORS = 2  # how many recent ones, besides the previous, get an edge
LOOPS = 2  # how many loop candidates are tried, by position and by appearance each
EXPECTED_OVERLAP = 0.3  # overlap, by the poses as they are, from which on a pair is aligned
# What an alignment of two keyframes must reach to become an edge; stricter than for a frame
LOOP_OVERLAP, LOOP_AGREEMENT = 0.25, 0.75
LOOP_UNCERTAINTY = 0.02  # [m] of the translation in its weakest direction
DRIFT = 0.5, 0.1  # [m], share of the way: a place that looks alike is another one beyond it
LOOP_CORRECTION = 0.3, np.radians(15)  # [m, rad] a result farther from its guess is wrong


def neighbor_edges(keyframes: Keyframes, number: int, photometric_weight: float) -> list[Edge]:
    """Edges of a keyframe to recent ones, besides the previous."""
    near = keyframes.same_island(number, range(max(0, number - NEAR), number - 1))
    recent = _by_overlap(keyframes, number, near)
    return [
        edge
        for other in recent[:NEIGHBORS]
        if (edge := _edge(keyframes, other, number, photometric_weight, None))
    ]


def find_loops(
    keyframes: Keyframes, number: int, photometric_weight: float, by_appearance: bool
) -> list[Edge]:
    """Edges of a keyframe to older ones: to those that it should see if its pose is right, or, if
    there is none, to those that look like it.
    """
    older = keyframes.same_island(number, range(max(0, number - NEAR)))
    edges = [
        edge
        for other in _by_overlap(keyframes, number, older)[:LOOPS]
        if (edge := _edge(keyframes, other, number, photometric_weight, None, loop=True))
    ]
    if by_appearance and not edges:
        features = keyframes.items[number].features
        stored = [keyframes.items[k].features for k in older]
        for other in (older[i] for i in most_similar(features, stored, LOOPS)):
            guess = locate(features, keyframes.items[other].features)
            if (
                guess is not None
                and _reachable(keyframes, other, number, guess)
                and (edge := _edge(keyframes, other, number, photometric_weight, guess, loop=True))
            ):
                edges.append(edge)
    return edges


def _reachable(keyframes: Keyframes, other: int, number: int, T_other_number: NDArray) -> bool:
    """Whether drift on the way from one keyframe to the other explains that they look alike; a
    corridor that repeats itself does so, too.
    """
    T_world_keyframe = np.array(keyframes.T_world_keyframe[other : number + 1])
    way = np.linalg.norm(np.diff(T_world_keyframe[:, :3, 3], axis=0), axis=1).sum()
    drift, _ = se3.distance(T_other_number, se3.inverse(T_world_keyframe[0]) @ T_world_keyframe[-1])
    return bool(drift < DRIFT[0] + DRIFT[1] * way)


def _by_overlap(keyframes: Keyframes, number: int, others: Sequence[int]) -> list[int]:
    """Those of `others` that overlap the keyframe by the poses as they are, most first."""
    found = []
    for other in others:
        T_other_number = (
            se3.inverse(keyframes.T_world_keyframe[other]) @ keyframes.T_world_keyframe[number]
        )
        overlap = keyframes.items[number].overlap(keyframes.items[other], T_other_number)
        if overlap > EXPECTED_OVERLAP:
            found.append((-overlap, other))
    return [other for _, other in sorted(found)]


def _edge(
    keyframes: Keyframes,
    other: int,
    number: int,
    photometric_weight: float,
    guess: NDArray | None,
    loop: bool = False,
) -> Edge | None:
    """Keyframe `number` aligned to `other`, or None where the result is not believable; `guess` is
    T_other_number, None: from the poses as they are.
    """
    if guess is None:
        guess = se3.inverse(keyframes.T_world_keyframe[other]) @ keyframes.T_world_keyframe[number]
    found = register(keyframes.pyramid(number), keyframes.pyramid(other), guess, photometric_weight)
    return (
        Edge.of(other, number, found, robust=True, loop=loop) if believable(found, guess) else None
    )


def believable(found: Registration, guess: NDArray) -> bool:
    """Whether an alignment of two keyframes is good enough for an edge."""
    distance, angle = se3.distance(guess, found.T_target_source)
    return (
        found.overlap > LOOP_OVERLAP
        and found.agreement > LOOP_AGREEMENT
        and found.determined
        and found.uncertainty[-1] < LOOP_UNCERTAINTY
        and distance < LOOP_CORRECTION[0]
        and angle < LOOP_CORRECTION[1]
    )
