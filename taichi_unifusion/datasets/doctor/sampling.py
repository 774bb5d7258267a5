"""The frames of a recording that the doctor looks at."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ...errors import FrameError
from ...types import Frame
from ..dataset import Dataset
from ..loading import recording_of
from ..pose_fit import EARLY_STEP, MIN_MOTION, PosePairs, has_moved

MOST_FRAMES = 40
STEPS = (
    0,
    1,
    5,
    15,
)  # from the first frame of a group: neighbours, and frames that look from elsewhere
MOST_PAIRS = 10
MOST_POSES = 20_000  # that are looked at


@dataclass(frozen=True)
class Sample:
    """Up to MOST_FRAMES frames of a recording, and the poses of all."""

    recording: Dataset
    frames: tuple[Frame, ...]  # those that could be read, in order
    places: tuple[int, ...]  # of these in the recording
    groups: tuple[tuple[int, ...], ...]  # which of them are near each other
    problems: tuple[str, ...]  # why others could not be read
    asked: int
    times: NDArray[np.float64]  # (N,) [s] of all frames, NaN: not known
    poses: tuple[NDArray[np.float64] | None, ...]  # T_world_camera of all frames

    @property
    def timed(self) -> bool:
        """Whether times and poses of all frames are known, of four at least, and times ascend."""
        return len(self.times) == len(self.recording) and len(self.timed_poses[0]) >= 4

    @cached_property
    def timed_poses(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Ascending times (N,) [s] and poses (N, 4, 4) of the frames that have both; none where two
        have the same time.
        """
        known = [
            i
            for i, (time, T) in enumerate(zip(self.times, self.poses, strict=True))
            if np.isfinite(time) and T is not None
        ]
        order = sorted(known, key=lambda i: self.times[i])
        times = self.times[order]
        if (np.diff(times) <= 0).any():
            return np.empty(0), np.empty((0, 4, 4))
        return times, np.array([self.poses[i] for i in order]).reshape(-1, 4, 4)

    def neighbours(self) -> list[tuple[Frame, Frame]]:
        """Frames that follow each other at once."""
        at = zip(self.places, self.places[1:], strict=False)
        return [(self.frames[i], self.frames[i + 1]) for i, (a, b) in enumerate(at) if b == a + 1]

    def chains(self, step: tuple[float, float] = EARLY_STEP) -> list[list[int]]:
        """For every group the posed frames in it, each a step [m], [rad] from the one before."""
        found = []
        for group in self.groups:
            chain: list[int] = []
            for i in group:
                posed = self.frames[i].T_world_camera is not None
                if posed and (not chain or has_moved(self.frames[chain[-1]], self.frames[i], step)):
                    chain.append(i)
            found.append(chain)
        return found

    def pose_pairs(self, left_out: Sequence[int] = ()) -> tuple[PosePairs, list[int]] | None:
        """Pairs of frames that tell how poses fit, evenly from the sample, and which frames these
        are; None if there are none.
        """
        for step in (EARLY_STEP, MIN_MOTION):
            pairs = [
                (a, b)
                for chain in self.chains(step)
                for a, b in zip(chain, chain[1:], strict=False)
                if a not in left_out and b not in left_out
            ]
            if len(pairs) >= MOST_PAIRS // 3:
                break
        if not pairs:
            return None
        return self.chosen(pairs, MOST_PAIRS)

    def chosen(self, pairs: Sequence[tuple[int, int]], most: int) -> tuple[PosePairs, list[int]]:
        """At most so many of the pairs, evenly chosen, and their frames' places in the sample."""
        kept = np.linspace(0, len(pairs) - 1, min(most, len(pairs))).round().astype(int)
        pairs = [pairs[i] for i in kept]
        used = sorted({i for pair in pairs for i in pair})
        place = {i: k for k, i in enumerate(used)}
        found = [(place[a], place[b]) for a, b in pairs]
        return PosePairs([self.frames[i] for i in used], found), used


def take_sample(recording: Dataset) -> Sample:
    """Read the frames; what cannot be read is kept as a sentence."""
    wanted = _groups(len(recording))
    frames: list[Frame] = []
    problems: list[str] = []
    groups: list[tuple[int, ...]] = []
    asked = sorted({i for group in wanted for i in group})
    place: dict[int, int] = {}
    for i in asked:
        try:
            frame = recording[i]
        except FrameError as error:
            problems.append(str(error))
            continue
        place[i] = len(frames)
        frames.append(frame)
    for group in wanted:
        groups.append(tuple(place[i] for i in group if i in place))
    times, poses = _timed(recording, frames)
    return Sample(
        recording,
        tuple(frames),
        tuple(place),
        tuple(groups),
        tuple(problems),
        len(asked),
        times,
        poses,
    )


def _groups(count: int) -> list[list[int]]:
    """Places of frames in groups of near ones: one group of all where there are few."""
    if count <= MOST_FRAMES:
        return [list(range(count))]
    starts = np.linspace(0, count - 1 - STEPS[-1], MOST_FRAMES // len(STEPS)).round().astype(int)
    return [sorted({int(start) + step for step in STEPS}) for start in dict.fromkeys(starts)]


def _timed(
    recording: Dataset, frames: Sequence[Frame]
) -> tuple[NDArray[np.float64], tuple[NDArray[np.float64] | None, ...]]:
    """Time and pose of all frames where these are had without their images, else of the sample."""
    source = recording_of(recording)
    quick = isinstance(source, Dataset) and type(source).pose_at is not Dataset.pose_at
    if quick and len(recording) <= MOST_POSES:
        pairs = [recording.pose_at(i) for i in range(len(recording))]
    else:
        pairs = [(frame.timestamp, frame.T_world_camera) for frame in frames]
    times = np.array([np.nan if time is None else time for time, _ in pairs], np.float64)
    return times, tuple(T for _, T in pairs)
