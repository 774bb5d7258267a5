"""What there is: sizes, rates, ranges, the way of the camera."""

from __future__ import annotations

from collections import Counter

import numpy as np

from ...types import PinholeCamera
from ..plausibility import is_reading
from .depth import SPARSE
from .sampling import Sample

GAP = 3.0  # times the usual step between frames


def facts_of(sample: Sample) -> dict[str, str]:
    """Name -> what is to be said, in the order of a report."""
    frames = sample.frames
    facts = {"frames": f"{len(sample.recording)}, {sample.asked} of them looked at"}
    if not frames:
        return facts
    facts["depth"] = _depth(sample)
    colors = Counter(f.color.shape[1::-1] if f.color is not None else None for f in frames)
    usual = colors.most_common(1)[0][0]
    facts["colour"] = "none" if usual is None else f"{usual[0]}x{usual[1]}, as the frames have it"
    facts["camera"] = _camera(frames[0].camera)
    facts["time"] = _times(sample)
    facts["poses"] = _poses(sample)
    return facts


def _depth(sample: Sample) -> str:
    sizes = Counter(frame.depth.shape[::-1] for frame in sample.frames)
    thinned = [frame.depth[::SPARSE, ::SPARSE] for frame in sample.frames]
    held = [depth[is_reading(depth)] for depth in thinned]
    share = sum(map(len, held)) / sum(depth.size for depth in thinned)
    said = " and ".join(f"{width}x{height}" for width, height in sizes)
    if not any(map(len, held)):
        return f"{said}, no readings"
    low, middle, high = np.percentile(np.concatenate(held), [1, 50, 99])
    return f"{said}, {share:.0%} of the pixels have readings, {low:.3g} to {high:.3g} m, median {middle:.3g} m"


def _camera(camera: PinholeCamera) -> str:
    degrees = 2 * np.degrees(np.arctan(camera.width / 2 / camera.fx))
    return f"fx {camera.fx:.5g} fy {camera.fy:.5g} cx {camera.cx:.5g} cy {camera.cy:.5g}, {degrees:.0f} degrees wide"


def _times(sample: Sample) -> str:
    known = sample.times[np.isfinite(sample.times)]
    if len(known) < 2 or np.ptp(known) == 0:
        return "not known"
    steps = np.diff(known)
    usual = float(np.median(np.abs(steps)))
    gaps = steps[steps > GAP * usual]
    said = (
        f"{np.ptp(known):.4g} s, {1 / usual:.3g} frames a second"
        if usual
        else f"{np.ptp(known):.4g} s"
    )
    if len(gaps):
        said += f", {len(gaps)} gaps (the longest {gaps.max():.3g} s)"
    return said


def _poses(sample: Sample) -> str:
    known = [T for T in sample.poses if T is not None]
    if not known:
        return "none"
    places = np.array([T[:3, 3] for T in known])
    way = np.linalg.norm(np.diff(places, axis=0), axis=1)
    size = " x ".join(f"{extent:.3g}" for extent in np.ptp(places, axis=0))
    missing = len(sample.poses) - len(known)
    return (
        f"of {'all' if not missing else f'{len(known)} of {len(sample.poses)}'} frames, "
        f"within {size} m, a way of {way.sum():.3g} m"
    )
