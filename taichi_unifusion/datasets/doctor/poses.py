"""Do poses, depth and intrinsics fit together, and if not, which change of one makes them?

Every cause is tried as a hypothesis on the same pairs of frames; the one under which they agree
best is named, if it is clearly better than none and reaches what right poses reach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...types import PinholeCamera
from ..mended import pose_at_time
from ..plausibility import KNOWN_SCALES, OFF_CENTRE
from ..pose_convention import (
    CAUSES as USUAL_CAUSES,
)
from ..pose_convention import (
    CLEARLY,
    CLEARLY_SHARE,
    MIN_OVERLAP,
    POOR_SHARE,
    PROPOSED_SHARE,
    PoseVerdict,
    judge_poses,
    unit_of_scale,
)
from ..pose_fit import (
    EARLY_STEP,
    MIN_MOTION,
    NOTHING,
    Fit,
    PosePairs,
    compare,
    mean_fit,
)
from ..pose_readings import AS_READ
from .depth import COMMON_MEDIAN, plausible, pooled_readings, scale_in_use
from .finding import Finding
from .fix import Fix
from .sampling import Sample

OFFSETS = np.arange(-1.0, 1.001, 0.04)  # [s] that clocks may be apart
LEAST_OFFSET = 0.03  # [s]
FOCALS = np.geomspace(0.4, 2.5, 19)  # factors of another resolution's intrinsics
SMALL_MOTION = 0.02, np.radians(1)  # [m], [rad]; with less a frame in another's place is no harm
LEAST_FOCAL = 1.12  # factor
SAME_FACTOR = 0.1  # relative, of the two axes' factors and the focal length's
KNOWN_RATIO = 0.1  # relative: how near a factor of depth must be to a usual unit's
OUTLIER, ORDINARY = (
    0.55,
    0.8,
)  # share of a frame out of place with its neighbours, and of these with each other


@dataclass(frozen=True)
class Hypothesis:
    """What one change makes of the fit."""

    fit: Fit
    finding: Finding


def pose_findings(sample: Sample) -> list[Finding]:
    """Findings on poses, intrinsics and clocks."""
    centre = off_centre(sample)
    misplaced, said = swapped_frames(sample)
    chosen = sample.pose_pairs(misplaced)
    if chosen is None:
        return [*([centre] if centre else []), *said]
    pairs, used = chosen
    verdict = judge_poses(pairs, thorough=True)
    hypotheses = _hypotheses(sample, pairs, used, verdict, centre)
    best = max(hypotheses, key=lambda each: each.fit.closeness, default=None)
    if best is not None:
        return [best.finding, *said]
    if centre is not None:
        return [centre, *said]
    if verdict.given.share < POOR_SHARE and verdict.given.compared >= MIN_OVERLAP:
        return [
            Finding(
                "poses",
                f"the poses do not fit the depth: it agrees on {verdict.given.share:.0%} of the points that two "
                "frames see, where right poses reach 90%; no other reading, unit, clock or focal length mends it",
                f"{USUAL_CAUSES}; --tracking rgbd finds poses from the frames alone",
            ),
            *said,
        ]
    return said


def _hypotheses(
    sample: Sample,
    pairs: PosePairs,
    used: Sequence[int],
    verdict: PoseVerdict,
    centre: Finding | None,
) -> list[Hypothesis]:
    """The changes under which the pairs agree clearly better."""
    found = []
    if verdict.kind == "other reading":
        found.append(Hypothesis(verdict.best, _of_reading(sample, verdict)))
    found += clock_offset(sample, pairs, used, verdict.given)
    found += other_focal(pairs, verdict.given, centre)
    return [each for each in found if better(each.fit, verdict.given)]


def better(fit: Fit, given: Fit) -> bool:
    """Whether a change is clearly better than none, and good by itself."""
    return (
        fit.share >= PROPOSED_SHARE
        and fit.closeness >= given.closeness + CLEARLY
        and fit.share >= given.share + CLEARLY_SHARE
    )


# Readings and units


def _of_reading(sample: Sample, verdict: PoseVerdict) -> Finding:
    agree = f"depth agrees with the poses on {verdict.given.share:.0%} of the points, on {verdict.best.share:.0%} if"
    recording: dict[str, object] = {}
    if verdict.reading != AS_READ:
        recording["pose_reading"] = verdict.reading
    if verdict.scale != 1:
        recording["pose_scale"] = float(f"{verdict.scale:.4g}")
    if verdict.reading != AS_READ:
        sentence = f"{agree} they are {verdict.words}"
        return Finding("pose-reading", sentence, verdict.options, Fix(recording))
    scale, median = scale_in_use(sample), float(np.median(pooled_readings(sample)))
    other = None if scale is None else usual_depth_scale(scale * verdict.scale)
    unit = f"translations times {verdict.scale:.4g}"
    if other is not None and scale is not None and of_depth(median, verdict.scale):
        return Finding(
            "depth-scale",
            f"{agree} depth_scale is {other:g} instead of {scale:g} (the median depth {median * scale / other:.3g} m "
            f"instead of {median:.3g}), or {unit}",
            f"--depth-scale {other:g}; or, if the depth is right, {verdict.options}",
            Fix({"depth_scale": other}),
        )
    near = unit_of_scale(verdict.scale)
    also = f", or depth_scale is {other:g}" if other is not None else ""
    return Finding(
        "pose-scale",
        f"{agree} translations are {f'in {near}' if near else f'multiplied by {verdict.scale:.4g}'}{also} (the median "
        f"depth is {median:.3g} m)",
        verdict.options,
        Fix(recording),
    )


def usual_depth_scale(scale: float) -> float | None:
    """The usual number of units a metre that is nearly this."""
    near = [known for known in KNOWN_SCALES if abs(scale / known - 1) <= KNOWN_RATIO]
    return near[0] if near else None


def of_depth(median: float, pose_scale: float) -> bool:
    """Whether depth is the likelier one to be wrong: divided by the factor it is rather a room's."""
    mended = median / pose_scale
    return plausible(mended) and abs(np.log(mended / COMMON_MEDIAN)) < abs(
        np.log(median / COMMON_MEDIAN)
    )


# Clocks


def clock_offset(
    sample: Sample, pairs: PosePairs, used: Sequence[int], given: Fit
) -> list[Hypothesis]:
    """Whether poses of another moment fit better, the same for all frames."""
    known = [
        i
        for i, (time, T) in enumerate(zip(sample.times, sample.poses, strict=True))
        if np.isfinite(time) and T is not None
    ]
    if len(known) < 4 or len(sample.times) != len(sample.recording):
        return []
    order = sorted(known, key=lambda i: sample.times[i])
    times = sample.times[order]
    poses = np.array([sample.poses[i] for i in order])
    if (np.diff(times) <= 0).any():
        return []
    at = [float(sample.times[sample.places[i]]) for i in used]

    own = pairs.fits()

    def fit(offset: float) -> tuple[Fit, Fit]:
        """With the poses of that much later, and with the given ones on the same pairs."""
        T = [pose_at_time(times, poses, time + offset) for time in at]
        usable = [
            k for k, (a, b) in enumerate(pairs.pairs) if T[a] is not None and T[b] is not None
        ]
        if len(usable) < max(2, len(own) // 2):
            return NOTHING, NOTHING
        there = [_fit_of(pairs, *pairs.pairs[k], T) for k in usable]
        return mean_fit(there), mean_fit([own[k] for k in usable])

    scored = [(offset, *fit(offset)) for offset in OFFSETS]
    best, found, before = max(scored, key=lambda item: item[1].closeness - item[2].closeness)
    step = 0.02
    while step > 0.002:
        for other in (best - step, best + step):
            new, same = fit(other)
            if new.closeness - same.closeness > found.closeness - before.closeness:
                best, found, before = other, new, same
        step /= 2
    if abs(best) < LEAST_OFFSET or not better(found, before):
        return []
    sentence = (
        f"depth agrees with the poses on {given.share:.0%} of the points, on {found.share:.0%} with the poses of "
        f"{abs(best):.3f} s {'later' if best > 0 else 'earlier'}: the clocks of images and poses are apart"
    )
    offset = round(float(best), 3)
    finding = Finding(
        "clock-offset", sentence, f"--clock-offset {offset:g}", Fix({"clock_offset": offset})
    )
    return [Hypothesis(found, finding)]


def _fit_of(pairs: PosePairs, a: int, b: int, T: Sequence[NDArray | None]) -> Fit:
    T_a, T_b = T[a], T[b]
    if T_a is None or T_b is None:
        return NOTHING
    return compare(pairs.views[a], pairs.views[b], np.linalg.inv(T_b) @ T_a)


# Intrinsics


def off_centre(sample: Sample) -> Finding | None:
    """Intrinsics of another resolution, by where the principal point lies."""
    if not sample.frames:
        return None
    camera = sample.frames[0].camera
    shares = np.array([(camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height])
    if np.abs(shares - 0.5).max() <= OFF_CENTRE:
        return None
    factors = 0.5 / shares
    told = (
        f"the principal point ({camera.cx:g}, {camera.cy:g}) is not near the middle of the "
        f"{camera.width}x{camera.height} images"
    )
    if abs(factors[0] / factors[1] - 1) > SAME_FACTOR:
        return Finding(
            "intrinsics",
            f"{told}: these are another camera's intrinsics, or of images that were cut",
            "--intrinsics FX,FY,CX,CY of the depth images",
        )
    factor = round_factor(float(factors.mean()))
    mended = times(camera, factor)
    size = f"{round(camera.width / factor)}x{round(camera.height / factor)}"
    return Finding(
        "intrinsics",
        f"{told}: these are intrinsics of {size} images",
        f"--intrinsics {listed(mended)}",
        Fix({"intrinsics": [float(f"{number:.6g}") for number in mended.intrinsics]}),
    )


def round_factor(factor: float) -> float:
    """A ratio of two usual resolutions near the factor, or the factor."""
    usual = [a / b for b in (1, 2, 3, 4, 5, 9) for a in (1, 2, 3, 4, 5, 8, 9)]
    near = min(usual, key=lambda ratio: abs(np.log(ratio / factor)))
    return near if abs(near / factor - 1) < 0.06 else factor


def times(camera: PinholeCamera, factor: float) -> PinholeCamera:
    """The camera with the intrinsics of images so much larger."""
    return PinholeCamera(
        camera.width,
        camera.height,
        camera.fx * factor,
        camera.fy * factor,
        min(max((camera.cx + 0.5) * factor - 0.5, 0), camera.width),
        min(max((camera.cy + 0.5) * factor - 0.5, 0), camera.height),
    )


def with_focal(camera: PinholeCamera, factor: float) -> PinholeCamera:
    """The camera with another focal length."""
    fx, fy = camera.fx * factor, camera.fy * factor
    return PinholeCamera(camera.width, camera.height, fx, fy, camera.cx, camera.cy)


def listed(camera: PinholeCamera) -> str:
    """The intrinsics as the option takes them."""
    return ",".join(f"{number:.6g}" for number in camera.intrinsics)


def other_focal(pairs: PosePairs, given: Fit, centre: Finding | None) -> list[Hypothesis]:
    """Whether the frames agree better with another focal length, or with the intrinsics that the
    principal point tells of.
    """
    camera = pairs.views[0].camera
    if any(view.camera != camera for view in pairs.views):
        return []
    if centre is not None:
        numbers = centre.fix.recording.get("intrinsics")
        if numbers is None:
            return []
        mended = PinholeCamera(camera.width, camera.height, *numbers)
        return [Hypothesis(pairs.fit(camera=mended), centre)]
    scored = [(factor, pairs.fit(camera=with_focal(camera, factor))) for factor in FOCALS]
    best, found = max(scored, key=lambda item: item[1].closeness)
    step = 1.05
    while step > 1.004:
        for other in (best / step, best * step):
            fit = pairs.fit(camera=with_focal(camera, other))
            if fit.closeness > found.closeness:
                best, found = other, fit
        step = float(np.sqrt(step))
    if max(best, 1 / best) < LEAST_FOCAL:
        return []
    mended = with_focal(camera, float(best))
    sentence = (
        f"depth agrees with the poses on {given.share:.0%} of the points, on {found.share:.0%} with a focal length of "
        f"{mended.fx:.4g} pixels instead of {camera.fx:.4g}: the intrinsics are of another camera or resolution"
    )
    fix = Fix({"intrinsics": [float(f"{number:.6g}") for number in mended.intrinsics]})
    return [
        Hypothesis(found, Finding("intrinsics", sentence, f"--intrinsics {listed(mended)}", fix))
    ]


# Order


def swapped_frames(sample: Sample) -> tuple[list[int], list[Finding]]:
    """Places in the sample of frames that do not fit between their neighbours though these fit each
    other, and what is to be said of them.
    """
    chains = [sample.chains(step) for step in (EARLY_STEP, MIN_MOTION, SMALL_MOTION)]
    out = sorted({i for each in chains for i in _misplaced(sample, each)})
    if not out:
        return [], []
    numbers = [sample.frames[i].index for i in out]
    exchanged = _exchanged(sample, out)
    if exchanged is not None:
        a, b = exchanged
        sentence = (
            f"frames {a} and {b} stand in each other's place: their depth fits each other's poses"
        )
    else:
        sentence = (
            f"{len(out)} frames do not fit between their neighbours, which fit each other: "
            f"{', '.join(map(str, numbers[:8]))}"
        )
    advice = "put them in order, or leave them out; check names that were sorted as text"
    return out, [Finding("swapped", sentence, advice)]


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
    """Numbers of two frames out of place, of which each has the other's pose."""
    frames = sample.frames
    for x, a in enumerate(out):
        for b in out[x + 1 :]:
            swapped = {a: frames[b].require_pose(), b: frames[a].require_pose()}
            shares = []
            for i in (a, b):
                beside = [j for j in (i - 1, i + 1) if 0 <= j < len(frames) and j not in out]
                pair = PosePairs([frames[i], *(frames[j] for j in beside)], [])
                shares += [
                    compare(
                        pair.views[0],
                        pair.views[1 + k],
                        np.linalg.inv(frames[j].require_pose()) @ swapped[i],
                    ).share
                    for k, j in enumerate(beside)
                ]
            if shares and min(shares) > ORDINARY:
                return frames[a].index, frames[b].index
    return None
