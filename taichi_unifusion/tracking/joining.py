"""Two recordings of one place, each in a world of its own: where the second lies in the world of the
first.

Keyframes of the second are recognised among those of the first by their features, and aligned to them
as loops are. One place of the whole trajectory must explain most of what was recognised; then
keyframes that should see the same are aligned, too, and a pose graph fits the second to the first,
which stays where it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..datasets import Dataset
from ..datasets.loading import index_in_recording
from ..errors import FrameError, NoOverlap
from ..geometry import se3
from .features import extract_features, locate, most_similar
from .keyframes import Keyframe, Keyframes
from .loop_closure import believable
from .pose_graph import ANCHOR, FLOOR, Edge, Prior, optimize
from .pyramid import reduce_frame
from .registration import register

APART = 0.15, 8.0  # [m, degrees] from one keyframe to the next
MOST_ASKED = 80  # keyframes of the second recording that are looked for by features
CANDIDATES = 3  # keyframes of the first that each of them is compared with
SURE_AGREEMENT = 0.8  # of an alignment that says where the second recording lies
SAME_PLACE = 0.25, np.radians(8)  # [m, rad] that alignments of one trajectory may differ by
LEAST_MATCHES = 2  # alignments that must say the same ...
MAJORITY = 0.6  # ... and their share of all that were found
EXPECTED_OVERLAP = 0.3  # from which on keyframes are aligned that were not recognised
STIFF = 1e6  # information of poses that are not to bend, against that of an alignment


@dataclass(frozen=True, eq=False)
class Joined:
    """Where the second recording lies in the world of the first."""

    T_known_new: NDArray[np.float64]  # (4, 4) of its world, before it was bent
    T_known_keyframe: NDArray[np.float64]  # (N, 4, 4) of its keyframes
    matched: int  # keyframes that were recognised and fit there
    aligned: int  # pairs of keyframes that the pose graph holds together
    agreement: float  # of these, median share of what both see that lies on one surface
    bent: float  # [m] by which a keyframe moved at most when the graph was fitted


def keyframes_of(
    frames: Dataset, depth_range: tuple[float, float], stop: Callable[[], bool] = lambda: False
) -> Keyframes:
    """Frames of a posed recording that are some way apart, as keyframes; Taichi must run."""
    found, last = Keyframes(), None
    for i in range(len(frames)):
        if stop():
            break
        T = frames.pose_at(i)[1]
        if T is None or not np.isfinite(T).all():
            continue
        if last is not None:
            moved, turned = se3.distance(last, T)
            if moved < APART[0] and np.degrees(turned) < APART[1]:
                continue
        try:
            frame = frames[i]
        except FrameError:
            continue
        reduced = reduce_frame(frame, *depth_range)
        features = extract_features(frame, *depth_range)
        found.append(Keyframe(index_in_recording(frames, i), reduced, features), T)
        last = T
    return found


def join(
    known: Keyframes, new: Keyframes, photometric_weight: float = 0.1, *, rigid: bool = False
) -> Joined:
    """The place of `new` among `known`, whose poses stay; `rigid`: poses of `new` keep their places
    relative to each other. Raises NoOverlap where that is not sure.
    """
    matches = _recognised(known, new, photometric_weight)
    T_known_new, kept = _agreed(known, new, matches)
    edges = [match.edge for match in kept]
    poses = [T_known_new @ T for T in new.T_world_keyframe]
    edges += _expected(known, new, poses, {match.edge.b for match in kept}, photometric_weight)
    fitted = _fitted(known, poses, edges, rigid)
    bent = max(se3.distance(a, b)[0] for a, b in zip(poses, fitted, strict=True))
    return Joined(
        T_known_new,
        fitted,
        len({match.edge.b for match in kept}),
        len(edges),
        float(np.median([match.agreement for match in kept])),
        bent,
    )


@dataclass(frozen=True, eq=False)
class _Match:
    """A keyframe `edge.b` of the second recording aligned to `edge.a` of the first."""

    edge: Edge
    T_known_new: NDArray[np.float64]  # (4, 4) of worlds
    agreement: float


def _recognised(known: Keyframes, new: Keyframes, weight: float) -> list[_Match]:
    """Alignments of keyframes of `new` to those of `known` that look like them."""
    matches, stored = [], [keyframe.features for keyframe in known.items]
    step = max(1, -(-len(new) // MOST_ASKED))
    for number in range(0, len(new), step):
        features = new.items[number].features
        for other in most_similar(features, stored, CANDIDATES):
            guess = locate(features, known.items[other].features)
            if guess is None:
                continue
            found = register(new.pyramid(number), known.pyramid(other), guess, weight)
            if not believable(found, guess) or found.agreement < SURE_AGREEMENT:
                continue
            T = known.T_world_keyframe[other] @ found.T_target_source
            matches.append(
                _Match(
                    Edge.of(other, number, found, robust=True, loop=True),
                    se3.normalized(T @ se3.inverse(new.T_world_keyframe[number])),
                    found.agreement,
                )
            )
    return matches


def _agreed(
    known: Keyframes, new: Keyframes, matches: list[_Match]
) -> tuple[NDArray[np.float64], list[_Match]]:
    """The place that most matches say, and those that do; raises NoOverlap where it is not sure."""

    def same(a: _Match, b: _Match) -> bool:
        T = new.T_world_keyframe[b.edge.b]  # compared where the camera of one of them was
        distance, angle = se3.distance(a.T_known_new @ T, b.T_known_new @ T)
        return distance < SAME_PLACE[0] and angle < SAME_PLACE[1]

    best: list[_Match] = []
    for each in matches:
        agreeing = [other for other in matches if same(each, other)]
        if len(agreeing) > len(best):
            best = agreeing
    share = len(best) / max(len(matches), 1)
    if len(best) >= LEAST_MATCHES and share >= MAJORITY:
        scored = sorted(best, key=lambda m: sum(_off(m, o, new) for o in best))
        return scored[0].T_known_new, best
    if not any(len(keyframe.features) for keyframe in new.items):
        why = "its frames have no colour to recognise a place by"
    elif not matches:
        why = "no frame fits any that the map was made from"
    elif len(best) < LEAST_MATCHES:
        why = "only a single frame fits one that the map was made from"
    else:
        why = "its frames fit several places of the map, which look alike"
    raise NoOverlap(
        f"the camera does not find its place in the map: {why} ({len(new)} views of the recording, {len(known)} "
        "of the map); begin or end the recording where the map has been"
    )


def _off(a: _Match, b: _Match, new: Keyframes) -> float:
    T = new.T_world_keyframe[b.edge.b]
    return se3.distance(a.T_known_new @ T, b.T_known_new @ T)[0]


def _expected(
    known: Keyframes, new: Keyframes, poses: list[NDArray], done: set[int], weight: float
) -> list[Edge]:
    """Alignments of keyframes that were not recognised, to the one that they overlap most."""
    edges = []
    for number, T in enumerate(poses):
        if number in done:
            continue
        keyframe = new.items[number]
        guesses = [se3.inverse(T_other) @ T for T_other in known.T_world_keyframe]
        overlaps = [
            keyframe.overlap(other, guess)
            for other, guess in zip(known.items, guesses, strict=True)
        ]
        best = int(np.argmax(overlaps))
        if overlaps[best] <= EXPECTED_OVERLAP:
            continue
        found = register(new.pyramid(number), known.pyramid(best), guesses[best], weight)
        if believable(found, guesses[best]):
            edges.append(Edge.of(best, number, found, robust=True, loop=True))
    return edges


def _fitted(
    known: Keyframes, poses: list[NDArray], edges: list[Edge], rigid: bool
) -> NDArray[np.float64]:
    """Poses (N, 4, 4) of the second recording that fit all edges and its own course best."""
    used = sorted({edge.a for edge in edges})
    row = {number: i for i, number in enumerate(used)}
    n = len(used)
    across = [
        Edge(row[edge.a], n + edge.b, edge.T_a_b, edge.information, edge.robust, edge.loop)
        for edge in edges
    ]
    information = np.diag(FLOOR**-2.0) * (STIFF if rigid else 1.0)
    along = [
        Edge(n + i, n + i + 1, se3.inverse(poses[i]) @ poses[i + 1], information)
        for i in range(len(poses) - 1)
    ]
    fixed = [Prior(i, known.T_world_keyframe[a], ANCHOR * np.eye(6)) for a, i in row.items()]
    start = [known.T_world_keyframe[a] for a in used] + poses
    return optimize(start, across + along, fixed).T_world_node[n:]
