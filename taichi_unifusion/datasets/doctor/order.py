"""Frames that stand in another one's place."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..pose_fit import EARLY_STEP, MIN_MOTION, PosePairs, View, compare
from .evidence import Change, Evidence
from .finding import Finding
from .sampling import Sample

SMALL_MOTION = 0.02, np.radians(1)  # [m], [rad]; with less a frame in another's place is no harm
# share of a frame out of place with its neighbours, and of these with each other
OUTLIER, ORDINARY = 0.55, 0.8


def swapped_frames(sample: Sample) -> tuple[list[int], list[Finding]]:
    """Places in the sample of frames that do not fit between their neighbours though these fit each
    other, and what is to be said of them.
    """
    chains = [sample.chains(step) for step in (EARLY_STEP, MIN_MOTION, SMALL_MOTION)]
    out = sorted({i for each in chains for i in _misplaced(sample, each)})
    if not out:
        return [], []
    exchanged = _exchanged(sample, out)
    if exchanged is not None:
        out = sorted({*out, *exchanged})
        a, b = (sample.frames[i].index for i in exchanged)
        sentence = (
            f"frames {a} and {b} stand in each other's place: their depth fits each other's poses"
        )
    else:
        numbers = ", ".join(str(sample.frames[i].index) for i in out[:8])
        said = f"{len(out)} frames do" if len(out) > 1 else "a frame does"
        sentence = f"{said} not fit between neighbours, which fit each other: {numbers}"
    advice = "put them in order, or leave them out; check names that were sorted as text"
    return out, [Finding("swapped", sentence, advice)]


def misfits(evidence: Evidence, change: Change, misplaced: Sequence[int]) -> bool:
    """Whether a frame that is out of place is so with a change, too, by which all others agree; what poses
    that are wrong say of one is chance.
    """
    frames = evidence.sample.frames
    for i in misplaced:
        around = [j for j in (i - 1, i + 1) if 0 <= j < len(frames) and j not in misplaced]
        beside = [frames[j] for j in around if frames[j].T_world_camera is not None]
        pairs = PosePairs([frames[i], *beside], [(0, k + 1) for k in range(len(beside))])
        fits = [] if change.offset else evidence.fits(change, pairs)
        if not fits or max(fit.share for fit in fits) < OUTLIER:
            return True
    return False


def _misplaced(sample: Sample, chains: list[list[int]]) -> list[int]:
    """Places in the sample of frames that fit neither neighbour in a chain, though these fit."""
    out: list[int] = []
    for chain in chains:
        if len(chain) < 4:
            continue
        pairs = PosePairs([sample.frames[i] for i in chain], [])
        shares = {
            (a, b): compare(pairs.views[a], pairs.views[b], _between(pairs, a, b)).share
            for a in range(len(chain))
            for b in (a + 1, a + 2)
            if b < len(chain)
        }
        for k in range(1, len(chain) - 1):
            beside = max(shares[k - 1, k], shares[k, k + 1])
            if beside < OUTLIER and shares[k - 1, k + 1] > ORDINARY:
                out.append(chain[k])
    return out


def _between(pairs: PosePairs, a: int, b: int) -> NDArray[np.float64]:
    return np.linalg.inv(pairs.T_world_camera[b]) @ pairs.T_world_camera[a]


def _exchanged(sample: Sample, out: Sequence[int]) -> tuple[int, int] | None:
    """Places in the sample of two frames, one of them known to be out of place, of which each has the
    other's pose.
    """
    posed = {i: View(f) for i, f in enumerate(sample.frames) if f.T_world_camera is not None}
    for a in out:
        for b in (i for i in posed if i != a):
            shares = [*_shares(posed, a, b, (a, b, *out)), *_shares(posed, b, a, (a, b, *out))]
            if shares and min(shares) > ORDINARY:
                return min(a, b), max(a, b)
    return None


def _shares(views: dict[int, View], i: int, place: int, out: Sequence[int]) -> list[float]:
    """How well frame i fits the neighbours of a place, with the pose that is given there."""
    T = views[place].frame.require_pose()
    beside = [j for j in (place - 1, place + 1) if j in views and j not in out]
    return [
        compare(views[i], views[j], np.linalg.inv(views[j].frame.require_pose()) @ T).share
        for j in beside
    ]
