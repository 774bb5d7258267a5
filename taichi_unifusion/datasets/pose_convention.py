"""Do the poses fit the depth, as camera to world in metres? Two overlapping frames can tell.

If they do not, but do under another reading of the same numbers (another direction, order of the
quaternion, axes or unit), the recording probably uses that one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..types import Frame
from .pose_fit import Fit, PosePairs, has_moved
from .pose_readings import AS_READ, FLIP_YZ, NAMES, SINGLE, describe, read_as

# Chosen by the worst of the synthetic room, the kitchen, TUM's desk and nine stretches of a house: right poses
# reach a share of 0.90 and a closeness of 0.66 at least
GOOD_SHARE, GOOD_CLOSENESS = 0.9, 0.6  # with less, every known reading is tried
PROPOSED_SHARE = 0.85  # nearly as well as right poses
CLEARLY = 0.1  # closeness by which another reading must be ahead
CLEARLY_SHARE = 0.04  # and share
POOR_SHARE = 0.65  # with less, and no reading that explains it, the poses do not fit
MIN_COMPARED = 0.2  # of the points, for a reading to be proposed
MIN_OVERLAP = 0.03  # of the points; with less the frames may not overlap at all
SIMPLER = 0.03  # closeness that a simpler reading may be behind
FINALISTS, REFINED = 4, 3  # readings whose scale is searched, and refined
SCALES = np.geomspace(1e-4, 1e3, 29)  # of translations
NEAR_SCALES = (0.1, 0.2, 0.35, 0.5, 0.7, 1.4, 2.0, 3.0, 5.0, 10.0)
SAME_SCALE = 1.2  # factor within which translations count as metres
UNITS = {0.01: "centimetres", 0.001: "millimetres", 0.0254: "inches", 0.3048: "feet"}
UNIT_TOLERANCE = 0.08  # relative

CAUSES = (
    "usual causes are poses of other frames or another clock, another camera's poses, or intrinsics or a "
    "depth scale that are wrong"
)


@dataclass(frozen=True)
class PoseVerdict:
    """What pairs of frames say of the poses."""

    kind: Literal["fits", "other reading", "does not fit", "undecided"]
    given: Fit
    best: Fit
    reading: str = AS_READ  # that fits best
    scale: float = 1.0  # of the translations, with it

    @property
    def sentence(self) -> str | None:
        """What is wrong, or None."""
        if self.kind == "other reading":
            return (
                f"depth agrees with the poses on {self.given.share:.0%} of the points, but on "
                f"{self.best.share:.0%} if they are {self.words} ({self.options})"
            )
        if self.kind == "does not fit":
            return (
                f"the poses do not fit the depth: it agrees on {self.given.share:.0%} of the points that two frames "
                f"see, where right poses reach 90%, and no other reading of them fits; {CAUSES}"
            )
        return None

    @property
    def words(self) -> str:
        """The reading and the unit, as the end of "they are ..."."""
        parts = [describe(self.reading)] if self.reading != AS_READ else []
        if self.scale != 1:
            near = unit_of_scale(self.scale)
            parts.append(
                f"translations in {near}"
                if near
                else f"translations in a unit of {self.scale:.3g} m (a scale that structure from motion leaves open)"
            )
        return ", and ".join(parts)

    @property
    def options(self) -> str:
        """The options that take the poses so, for a message."""
        parts = [f"--pose-reading {self.reading}"] if self.reading != AS_READ else []
        parts += [f"--pose-scale {self.scale:.4g}"] if self.scale != 1 else []
        return " ".join(parts)


def unit_of_scale(scale: float) -> str | None:
    """The unit that has so many metres, if it is a usual one."""
    for metres, name in UNITS.items():
        if abs(scale / metres - 1) <= UNIT_TOLERANCE:
            return name
    return None


def guess_pose_convention(a: Frame, b: Frame) -> tuple[bool, str | None]:
    """Whether this pair of frames decides it, and a sentence if the poses do not fit."""
    verdict = judge_poses(PosePairs([a, b], [(0, 1)]))
    return verdict.kind != "undecided", verdict.sentence


def judge_poses(pairs: PosePairs, thorough: bool = False) -> PoseVerdict:
    """What pairs of frames say of their poses; `thorough` tries every reading also where the poses
    fit well enough.
    """
    given = pairs.fit()
    good = given.share >= GOOD_SHARE and given.closeness >= GOOD_CLOSENESS
    candidates = search(pairs, given, SINGLE if good and not thorough else NAMES, near=good)
    reading, scale, best = choose(candidates)
    gain = best.closeness - given.closeness, best.share - given.share
    if (
        best.share >= PROPOSED_SHARE
        and best.compared >= MIN_COMPARED
        and gain[0] >= CLEARLY
        and gain[1] >= CLEARLY_SHARE
    ):
        return PoseVerdict("other reading", given, best, reading, rounded_scale(scale))
    if given.compared < MIN_OVERLAP:
        return PoseVerdict("undecided", given, best)
    if given.share < POOR_SHARE:
        return PoseVerdict("does not fit", given, best)
    return PoseVerdict("fits", given, best)


Candidate = tuple[str, float, Fit]  # reading, scale of translations, how well it fits


def search(pairs: PosePairs, given: Fit, names: tuple[str, ...], near: bool) -> list[Candidate]:
    """How well readings fit, the best of them at their best scale; `near` tries few scales, and of
    the poses as they are.
    """
    posed = {name: read_as(name, pairs.T_world_camera) for name in names}
    few, rough = pairs.thinned(), []
    rough += [(name, 1.0, few.fit(T)) for name, T in posed.items()]
    # translations may be far too long: what turns alone explain tells more then
    still = [(name, 0.0, few.fit(T, 0.0)) for name, T in posed.items()] if not near else []
    tried = {AS_READ: NEAR_SCALES if near else SCALES}
    tried |= (
        {name: SCALES for name, _, _ in [*_first(rough, 2), *_first(still, FINALISTS)]}
        if not near
        else {}
    )
    for name, scales in tried.items():
        rough += [(name, scale, few.fit(posed[name], scale)) for scale in scales]
    best_of = {name: _first([item for item in rough if item[0] == name], 1)[0] for name in posed}
    found: list[Candidate] = [(AS_READ, 1.0, given)]
    for name, scale, _ in _first(list(best_of.values()), REFINED):
        found.append((name, 1.0, pairs.fit(posed[name])))
        found.append((name, *refined_scale(pairs, posed[name], scale)))
    return found


def _first(candidates: list[Candidate], count: int) -> list[Candidate]:
    return sorted(candidates, key=lambda item: -item[2].closeness)[:count]


def choose(candidates: list[Candidate]) -> Candidate:
    """The candidate that fits best, or a simpler one that fits nearly as well."""
    top = max(fit.closeness for _, _, fit in candidates)
    close = [item for item in candidates if item[2].closeness >= top - SIMPLER]
    return min(close, key=_complexity)


def _complexity(candidate: Candidate) -> tuple[float, float]:
    reading, scale, fit = candidate
    words = 0 if reading == AS_READ else 1 + reading.count("+")
    return words + (not same_scale(scale)), -fit.closeness


def same_scale(scale: float) -> bool:
    """Whether translations count as metres."""
    return 1 / SAME_SCALE <= scale <= SAME_SCALE


def rounded_scale(scale: float) -> float:
    """1 where translations count as metres, else the usual unit's or the scale itself."""
    if same_scale(scale):
        return 1.0
    near = [metres for metres in UNITS if abs(scale / metres - 1) <= UNIT_TOLERANCE]
    return near[0] if near else scale


def refined_scale(
    pairs: PosePairs, T_world_camera: NDArray[np.float64], scale: float
) -> tuple[float, Fit]:
    """The scale near `scale` at which pairs fit best, to a percent, and how well they do."""
    best, fit, step = scale, pairs.fit(T_world_camera, scale), 1.2
    while step > 1.004:
        for other in (best / step, best * step):
            found = pairs.fit(T_world_camera, other)
            if found.closeness > fit.closeness:
                best, fit = other, found
        step = np.sqrt(step)
    return float(best), fit


__all__ = [
    "FLIP_YZ",
    "PoseVerdict",
    "guess_pose_convention",
    "has_moved",
    "judge_poses",
]
