"""Depth: its unit, what stands for no reading, how much there is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...preprocessing import FARTHEST
from ..file_recording import Recording
from ..loading import index_in_recording, recording_of
from ..plausibility import (
    COMMON_MEDIAN,
    KNOWN_SCALES,
    PLAUSIBLE_MEDIAN,
    TYPICAL_MEDIAN,
    guess_depth_scale,
    is_reading,
)
from .finding import Finding
from .fix import Fix
from .sampling import Sample

FEW = 0.05  # share of pixels with readings; with less, hardly anything is mapped
SPARSE = 4  # one pixel of so many each way stands for all
FAR_SHARE = 0.005  # of the pixels: what is rarer is a stray reading


def depth_findings(sample: Sample) -> list[Finding]:
    """Findings on readings alone, whatever the poses."""
    found = [_unit(sample), *_far_plane(sample), _holes(sample)]
    return [finding for finding in found if finding is not None]


def scale_in_use(sample: Sample) -> float | None:
    """Units of the depth images that make a metre, where the recording has such."""
    recording = recording_of(sample.recording)
    if isinstance(recording, Recording) and sample.frames:
        return recording.scale_of(index_in_recording(sample.recording, 0))
    return getattr(recording, "depth_scale", None)


def pooled_readings(sample: Sample) -> NDArray[np.float32]:
    """Readings [m] from all frames, thinned out."""
    thinned = [frame.depth[::SPARSE, ::SPARSE] for frame in sample.frames]
    return np.concatenate([np.empty(0, np.float32)] + [d[is_reading(d)] for d in thinned])


def _unit(sample: Sample) -> Finding | None:
    scale = scale_in_use(sample)
    if scale is None:
        return None
    readings = pooled_readings(sample)
    if not len(readings) and sample.frames:
        readings = sample.frames[0].depth.ravel()  # all of it beyond what maps take
    sentence = guess_depth_scale(readings, scale)
    if sentence is None:
        return None
    median = float(np.median(readings))
    likely = likely_scales(median, scale)
    fix = Fix({"depth_scale": likely[0]}) if likely else Fix()
    return Finding(
        "depth-scale",
        sentence,
        f"--depth-scale {likely[0]:g}" if likely else "--depth-scale UNITS_A_METRE",
        fix,
    )


def likely_scales(median: float, scale: float) -> list[float]:
    """Usual scales that make a median depth [m], read with `scale`, one of a room; the likeliest
    first.
    """
    medians = {known: median * scale / known for known in KNOWN_SCALES}
    fitting = [k for k, m in medians.items() if TYPICAL_MEDIAN[0] <= m <= TYPICAL_MEDIAN[1]]
    return sorted(fitting, key=lambda known: abs(np.log(medians[known] / COMMON_MEDIAN)))


def plausible(median: float) -> bool:
    """Whether a median depth [m] may be a room's."""
    return PLAUSIBLE_MEDIAN[0] <= median <= PLAUSIBLE_MEDIAN[1]


def _far_plane(sample: Sample) -> list[Finding]:
    """Values that stand for "nothing there", but are numbers."""
    found: list[Finding] = []
    beyond, planes = [], []
    for frame in sample.frames:
        depth = frame.depth[::SPARSE, ::SPARSE]
        with np.errstate(invalid="ignore"):
            far = depth > FARTHEST
            positive = np.isfinite(depth) & (depth > 0) & ~far
        if far.mean() >= FAR_SHARE:
            beyond.append((float(far.mean()), float(np.min(depth[far]))))
        dropped = positive & ~is_reading(depth)
        if dropped.any():
            planes.append((float(dropped.mean()), float(depth[dropped].max())))
    count = len(sample.frames)
    if len(beyond) >= max(1, count // 4):
        share, value = np.mean([s for s, _ in beyond]), beyond[0][1]
        found.append(
            Finding(
                "far-plane",
                f"{share:.0%} of the pixels of {len(beyond)} frames hold {value:.6g} m, which stands for no reading; "
                "what is beyond 10 km is taken so",
                wrong=False,
            )
        )
    if len(planes) >= max(1, count // 4):
        share, value = np.mean([s for s, _ in planes]), float(np.median([v for _, v in planes]))
        limit = float(f"{0.98 * value:.3g}")
        found.append(
            Finding(
                "far-plane",
                f"{share:.0%} of the pixels of {len(planes)} frames hold exactly {value:.6g} m, far behind all others: "
                "it stands for no reading",
                f"--option depth_limit={limit:g}",
                Fix({"depth_limit": limit}),
            )
        )
    return found


def _holes(sample: Sample) -> Finding | None:
    if not sample.frames:
        return None
    share = float(np.mean([is_reading(f.depth[::SPARSE, ::SPARSE]).mean() for f in sample.frames]))
    if share >= FEW:
        return None
    return Finding(
        "no-depth",
        f"only {share:.1%} of the pixels have a depth reading",
        "look at the depth images: another unit, another file or a sensor without light?",
    )
