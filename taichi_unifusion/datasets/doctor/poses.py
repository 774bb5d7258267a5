"""Do poses, depth and intrinsics fit together, and if not, which change of one makes them?

Every cause is tried as a change on the same pairs of frames; the one under which they agree best is
named, if it is clearly better than none and reaches what right poses reach. Where two do nearly
equally well, both are said.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..plausibility import KNOWN_SCALES
from ..pose_convention import CAUSES as USUAL_CAUSES
from ..pose_convention import (
    MIN_OVERLAP,
    POOR_SHARE,
    PoseVerdict,
    judge_poses,
    rounded_scale,
    same_scale,
    unit_of_scale,
)
from ..pose_readings import AS_READ
from .depth import COMMON_MEDIAN, plausible, pooled_readings, scale_in_use
from .evidence import RIVAL, Change, Evidence
from .finding import Finding
from .fix import Fix
from .intrinsics import off_centre, other_focal
from .order import misfits, swapped_frames
from .sampling import Sample

OFFSETS = np.arange(-1.04, 1.05, 0.08)  # [s] that clocks may be apart
LEAST_OFFSET = 0.03  # [s]
SCALES = np.geomspace(0.1, 10, 17)  # of translations
KNOWN_RATIO = 0.1  # relative: how near a factor of depth must be to a usual unit's

Named = tuple[Change, Finding]


def pose_findings(sample: Sample) -> list[Finding]:
    """Findings on poses, intrinsics and clocks."""
    centre = off_centre(sample)
    misplaced, said = swapped_frames(sample)
    chosen = sample.pose_pairs(misplaced)
    if chosen is None:
        return [*([centre] if centre else []), *said]
    pairs, _ = chosen
    evidence = Evidence(sample, pairs, misplaced)
    verdict = judge_poses(pairs, thorough=True)
    named = _named(evidence, verdict, centre)
    if named:
        change = min((change for change, _ in named), key=evidence.remaining)
        return [
            _with_rivals(evidence, named),
            *(said if misfits(evidence, change, misplaced) else []),
        ]
    if centre is not None:
        return [centre, *said]
    if not said and verdict.given.share < POOR_SHARE and verdict.given.compared >= MIN_OVERLAP:
        return [_unexplained(verdict)]
    return said


def _unexplained(verdict: PoseVerdict) -> Finding:
    return Finding(
        "poses",
        f"the poses do not fit the depth: it agrees on {verdict.given.share:.0%} of the points that two frames see, "
        "where right poses reach 90%; no other reading, unit, clock or focal length mends it",
        f"{USUAL_CAUSES}; --tracking rgbd finds poses from the frames alone",
    )


def _named(evidence: Evidence, verdict: PoseVerdict, centre: Finding | None) -> list[Named]:
    """The changes under which the pairs agree clearly better."""
    found: list[Named] = []
    if verdict.kind == "other reading":
        found.append(_of_verdict(evidence, verdict))
    if verdict.reading == AS_READ:
        found += other_unit(evidence)
    tried = [*clock_offset(evidence), *other_focal(evidence, centre)]
    return found + [each for each in tried if evidence.speaks_for(each[0])]


def _with_rivals(evidence: Evidence, named: list[Named]) -> Finding:
    """The finding whose change leaves the least difference, and in words those of other causes that leave
    as little.
    """
    clocks = [change for change, _ in named if change.offset]
    like = clocks[0] if clocks else None  # all on the same pairs
    ranked = sorted(named, key=lambda each: evidence.remaining(each[0], like))
    least, first = evidence.remaining(ranked[0][0], like), ranked[0][1]
    rivals = [
        finding
        for other, finding in ranked[1:]
        if finding.cause != first.cause and evidence.remaining(other, like) < least + RIVAL
    ]
    if not rivals:
        return first
    words = "; or ".join([first.sentence, *(rival.sentence for rival in rivals)])
    advice = "; or ".join([first.advice, *(rival.advice for rival in rivals)])
    causes = (*first.rivals, *(rival.cause for rival in rivals))
    return replace(first, sentence=words, advice=f"one of: {advice}", rivals=causes)


# Readings and units


def _of_verdict(evidence: Evidence, verdict: PoseVerdict) -> Named:
    """Another reading of the poses, or a unit that is far from theirs."""
    scale = verdict.scale
    if verdict.reading == AS_READ:
        return _unit(evidence, scale)
    recording: dict[str, object] = {"pose_reading": verdict.reading}
    if scale != 1:
        recording["pose_scale"] = float(f"{scale:.4g}")
    change = Change(verdict.reading, scale)
    sentence = f"{evidence.agreement(change)} if they are {verdict.words}"
    return change, Finding("pose-reading", sentence, verdict.options, Fix(recording))


def other_unit(evidence: Evidence) -> list[Named]:
    """Another factor between translations and depth, where pairs speak for it."""
    scale = evidence.best(lambda factor: Change(scale=factor), SCALES, log=True)
    if same_scale(scale):
        return []
    # what a sensor may be off by grows with depth, if that is too large
    if evidence.speaks_for(Change(scale=scale)):
        return [_unit(evidence, rounded_scale(scale))]
    if evidence.speaks_for(Change(scale=scale, of_depth=True)):
        return [_unit(evidence, scale, of_poses=False)]
    return []


def _unit(evidence: Evidence, pose_scale: float, of_poses: bool = True) -> Named:
    """Depth and translations differ by a factor: which of them is wrong, as far as can be told."""
    sample, change = evidence.sample, Change(scale=pose_scale)
    scale, median = scale_in_use(sample), float(np.median(pooled_readings(sample)))
    other = None if scale is None else usual_depth_scale(scale * pose_scale)
    agree, options = evidence.agreement(change), f"--pose-scale {pose_scale:.4g}"
    near = unit_of_scale(pose_scale)
    if other is None or scale is None:
        unit = f"in {near}" if near else f"multiplied by {pose_scale:.4g}"
        fix = Fix({"pose_scale": float(f"{pose_scale:.4g}")})
        sentence = f"{agree} if translations are {unit} (the median depth is {median:.3g} m)"
        return change, Finding("pose-scale", sentence, options, fix)
    of_depth = (
        f"depth_scale is {other:g} instead of {scale:g} (the median depth {median * scale / other:.3g} m instead of "
        f"{median:.3g})"
    )
    of_pose = f"translations are multiplied by {pose_scale:.4g}"
    # a usual unit in place of an unusual one, or a room of likelier size
    unusual = usual_depth_scale(scale) is None
    if unusual or not of_poses or likelier_depth(median, pose_scale):
        rivals = () if unusual or not of_poses else ("pose-scale",)
        sentence = f"{agree} if {of_depth}, or {of_pose}"
        advice = f"--depth-scale {other:g}; or, if the depth is right, {options}"
        fix = Fix({"depth_scale": other})
        return change, Finding("depth-scale", sentence, advice, fix, rivals=rivals)
    return change, Finding(
        "pose-scale",
        f"{agree} if {of_pose}, or {of_depth}",
        f"{options}; or, if the poses are right, --depth-scale {other:g}",
        Fix({"pose_scale": float(f"{pose_scale:.4g}")}),
        rivals=("depth-scale",),
    )


def usual_depth_scale(scale: float) -> float | None:
    """The usual number of units a metre that is nearly this."""
    near = [known for known in KNOWN_SCALES if abs(scale / known - 1) <= KNOWN_RATIO]
    return near[0] if near else None


def likelier_depth(median: float, pose_scale: float) -> bool:
    """Whether a median depth [m] divided by the factor is rather a room's."""
    mended = median / pose_scale
    return plausible(mended) and abs(np.log(mended / COMMON_MEDIAN)) < abs(
        np.log(median / COMMON_MEDIAN)
    )


# Clocks


def clock_offset(evidence: Evidence) -> list[Named]:
    """The poses of another moment, the same for all frames, that fit best."""
    if evidence.at is None:
        return []
    best = evidence.best(lambda seconds: Change(offset=seconds), OFFSETS, log=False)
    if abs(best) < LEAST_OFFSET:
        return []
    offset = round(best, 3)
    change = Change(offset=offset)
    sentence = (
        f"{evidence.agreement(change)} with the poses of {abs(offset):.3f} s {'later' if offset > 0 else 'earlier'}: "
        "the clocks of images and poses are apart"
    )
    fix = Fix({"clock_offset": offset})
    return [(change, Finding("clock-offset", sentence, f"--clock-offset {offset:g}", fix))]
