"""What pairs of frames say for a change: how much nearer their depths come to each other with it.

The median difference of two depths at the same place is about 0.5 % for a usual sensor, whatever the
way between the frames; under a wrong pose, clock or focal length it grows with that way. So pairs
that lie far apart tell most, and a change is judged by the logarithm of the ratio of both
differences, pair by pair.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...geometry import se3
from ...types import PinholeCamera
from ..mended import pose_at_time
from ..pose_convention import CLEARLY, CLEARLY_SHARE, MIN_COMPARED, PROPOSED_SHARE
from ..pose_fit import MIN_MOTION, Fit, PosePairs, mean_fit
from ..pose_readings import AS_READ, read_as
from .sampling import Sample

REACHES = (2, 4, 8)  # steps of MIN_MOTION between the frames of a pair
SHORT = 6  # frames of a chain; of fewer, neighbours are pairs too
MOST_WIDE = 24  # pairs
TELLING = 0.005, np.radians(0.25)  # [m], [rad] by which ways must differ, for a pair to tell
MOST_GAIN = 1.5  # of one pair, so that none outweighs the others
LEAST_GAIN = 0.25  # mean; right poses are never bettered by half of it (benchmarks/doctor.py)
FEW, GAIN_OF_FEW = 5, 0.4  # pairs; what fewer must gain, each of them
MOSTLY = 0.7  # of the pairs must gain
SURE = 3.0  # standard errors by which the mean gain is above none
RIVAL = 0.1  # gain by which two changes tell apart: what a sensor's noise is worth


@dataclass(frozen=True)
class Change:
    """One thing that may be other than the recording says; the defaults change nothing."""

    reading: str = AS_READ
    scale: float = 1.0  # of the translations
    offset: float = 0.0  # [s] of the clock of the poses
    camera: PinholeCamera | None = None
    of_depth: bool = False  # it is depth that is `scale` times too long


class Evidence:
    """Pairs of frames near each other and far apart, under one change after another."""

    def __init__(self, sample: Sample, near: PosePairs, left_out: list[int]) -> None:
        self.sample, self.near = sample, near
        self.wide = sample.chosen(_wide_pairs(sample, left_out), MOST_WIDE)[0]
        self.moments, self.at = self.wide, None
        if sample.timed:
            # under another clock the camera may move where it seems to rest
            self.moments, used = sample.chosen(_pairs_in_time(sample, left_out), MOST_WIDE)
            self.at = sample.times[[sample.places[i] for i in used]]
        self.scored: dict[tuple[Change, bool], NDArray[np.float64]] = {}
        self.poses_at: dict[float, NDArray[np.float64]] = {}

    def fits(self, change: Change, pairs: PosePairs) -> list[Fit]:
        """How well pairs fit under a change; those of `moments`, if it is a clock's."""
        T = read_as(change.reading, pairs.T_world_camera)
        if change.offset:
            T = self.moved(change.offset)
        unit = change.scale if change.of_depth else 1.0
        return pairs.fits(T, change.scale, change.camera, unit)

    def errors(self, change: Change, in_time: bool = False) -> NDArray[np.float64]:
        """The logarithm of the difference in every wide pair, or in those of `moments`; 0 where nothing
        could be compared, NaN where a change of the clock leaves a pose unknown or changes nothing.
        """
        key = change, in_time
        if key not in self.scored:
            pairs = self.moments if in_time else self.wide
            errors = np.log([fit.error for fit in self.fits(change, pairs)]).reshape(-1)
            if change.offset:
                errors[~self._changed(change.offset)] = np.nan
            self.scored[key] = errors
        return self.scored[key]

    def gains(self, change: Change) -> NDArray[np.float64]:
        """By how much every pair that tells gains by a change."""
        in_time = bool(change.offset)
        before, after = self.errors(Change(), in_time), self.errors(change, in_time)
        told = np.isfinite(after) & ((before != 0) | (after != 0))
        return np.clip((before - after)[told], -MOST_GAIN, MOST_GAIN)

    def gain(self, change: Change) -> float:
        """The mean of `gains`; -MOST_GAIN where no pair tells, or one alone of a clock."""
        gains = self.gains(change)
        return float(gains.mean()) if len(gains) > bool(change.offset) else -MOST_GAIN

    def remaining(self, change: Change, like: Change | None = None) -> float:
        """The mean logarithm of the difference that is left with a change, in the pairs that tell."""
        in_time = bool((like or change).offset)
        errors = self.errors(change, in_time)
        told = np.isfinite(errors) & np.isfinite(self.errors(like or change, in_time))
        return float(errors[told].mean()) if told.any() else 0.0

    def own(self, change: Change) -> tuple[Fit, Fit]:
        """How well near pairs fit, with and without a change; those that tell if it is a clock's."""
        if not change.offset:
            return mean_fit(self.fits(change, self.near)), self.near.fit()
        told = np.isfinite(self.errors(change, in_time=True))
        pairs = self.moments.between(
            [pair for pair, tells in zip(self.moments.pairs, told, strict=True) if tells]
        )
        return mean_fit(self.fits(change, pairs)), pairs.fit()

    def speaks_for(self, change: Change) -> bool:
        """Whether depths agree clearly better with a change, and well by themselves."""
        gains = self.gains(change)
        if self.gain(change) <= 0:
            return False
        fit, given = self.own(change)
        if fit.share < PROPOSED_SHARE or fit.compared < MIN_COMPARED:
            return False
        clearly = fit.closeness >= given.closeness + CLEARLY
        if clearly and fit.share >= given.share + CLEARLY_SHARE:
            return True
        if len(gains) < FEW:
            return len(gains) > 1 and gains.mean() >= GAIN_OF_FEW and bool((gains > 0).all())
        sure = SURE * gains.std() / np.sqrt(len(gains))
        return gains.mean() >= max(LEAST_GAIN, sure) and (gains > 0).mean() >= MOSTLY

    def agreement(self, change: Change) -> str:
        """How well depth agrees with a change and without, as the start of a sentence."""
        fit, given = self.own(change)
        after, before = (
            np.exp(self.errors(each, bool(change.offset))) for each in (change, Change())
        )
        told = np.isfinite(after)
        differs = (float(np.median(e[told])) if told.any() else 1.0 for e in (before, after))
        return (
            f"depth agrees with the poses on {fit.share:.0%} of the points instead of {given.share:.0%}, and differs "
            "by {1:.2%} instead of {0:.2%} between frames far apart,".format(*differs)
        )

    def moved(self, offset: float) -> NDArray[np.float64]:
        """The poses of that much later, NaN where none is known."""
        assert self.at is not None
        if offset not in self.poses_at:
            times, poses = self.sample.timed_poses
            nothing = np.full((4, 4), np.nan)
            found = [pose_at_time(times, poses, float(time) + offset) for time in self.at]
            usable = [nothing if T is None else T for T in found]
            self.poses_at[offset] = np.array(usable).reshape(-1, 4, 4)
        return self.poses_at[offset]

    def _changed(self, offset: float) -> NDArray[np.bool_]:
        """In which pairs of `moments` the way between the frames is another at that offset."""
        T, given = self.moved(offset), self.moments.T_world_camera
        a, b = np.array(self.moments.pairs, int).reshape(-1, 2).T
        change = (se3.inverse(T[b]) @ T[a]) @ se3.inverse(se3.inverse(given[b]) @ given[a])
        way = np.linalg.norm(change[:, :3, 3], axis=1)
        turn = np.linalg.norm(change[:, :3, :3] - np.eye(3), axis=(1, 2)) / np.sqrt(2)
        return (way > TELLING[0]) | (turn > TELLING[1])  # not of NaN

    def best(
        self, make: Callable[[float], Change], values: NDArray[np.float64], log: bool
    ) -> float:
        """The value at which pairs gain most, of some and then between them; a factor where `log`."""
        thinned = copy(self)  # for a first look, but of other moments few poses may be known
        if log and len(self.wide.pairs) >= 2 * FEW:
            thinned.wide, thinned.scored = self.wide.thinned(), {}
        best = max(values, key=lambda value: thinned.gain(make(float(value))))
        step = values[1] / values[0] if log else values[1] - values[0]
        for _ in range(6):
            step = np.sqrt(step) if log else step / 2
            near = (best / step, best * step) if log else (best - step, best + step)
            best = max((best, *near), key=lambda value: self.gain(make(float(value))))
        return float(best)


Pairs = list[tuple[int, int]]  # of places in a sample


def _wide_pairs(sample: Sample, left_out: list[int]) -> Pairs:
    """Frames that lie some steps apart."""
    return _apart(sample.chains(MIN_MOTION), left_out)


def _pairs_in_time(sample: Sample, left_out: list[int]) -> Pairs:
    """Frames that lie some frames of the sample apart, however they moved."""
    posed = {i for i, frame in enumerate(sample.frames) if frame.T_world_camera is not None}
    return _apart([[i for i in group if i in posed] for group in sample.groups], left_out)


def _apart(groups: Sequence[Sequence[int]], left_out: list[int]) -> Pairs:
    """Pairs, in order, of frames that lie some places apart in a group."""
    pairs = set()
    for group in groups:
        kept = [i for i in group if i not in left_out]
        reaches = REACHES if len(kept) > SHORT else (1, *REACHES)
        for reach in reaches:
            pairs |= set(zip(kept, kept[reach:], strict=False))
    return sorted(pairs)
