"""Is a recording plausible? Sentences about its poses and camera (when it is opened) and its depth
scale (from the first frame).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..files.trajectories import Pose
from ..preprocessing import FARTHEST
from ..types import PinholeCamera

MIN_IDENTITIES = 3  # one is normal, the first frame; this many mean that tracking failed
MAX_JUMP = 1.0  # [m] between consecutive frames
OFF_CENTRE = 0.15  # share of the image size; real principal points are nearer to the centre

PLAUSIBLE_MEDIAN = (0.05, 30.0)  # [m] median depth; outside, the scale is wrong
TYPICAL_MEDIAN = (0.3, 10.0)  # [m] median depth of indoor recordings
COMMON_MEDIAN = 2.0  # [m] of two scales that fit, the one that gives nearly this comes first
# units a metre: millimetres, TUM, Replica, 0.1 mm, metres
KNOWN_SCALES = (1000.0, 5000.0, 6553.5, 10000.0, 1.0)
# a far plane: at least this share of an image has exactly its largest value, and the next is nearer by so much
FAR_PLANE, FAR_PLANE_GAP = 0.01, 0.67
MIN_VALUES = 20  # different numbers, of which fewer are no measurements


def is_reading(depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Which pixels (H, W) hold a reading [m]: finite, positive, not beyond what maps take, and not
    the far plane that simulators write where nothing is hit.
    """
    with np.errstate(invalid="ignore"):
        held = np.isfinite(depth) & (depth > 0) & (depth <= FARTHEST)
    if not held.any():
        return held
    farthest = depth[held].max()
    below = held & (depth < farthest)
    if not below.any() or held.sum() - below.sum() < FAR_PLANE * depth.size:
        return held
    return below if depth[below].max() < FAR_PLANE_GAP * farthest else held


def pose_warnings(poses: Sequence[Pose]) -> list[str]:
    """Sentences on missing, unusable, repeated and jumping poses of consecutive frames."""
    if not poses:
        return []
    nothing = np.full((4, 4), np.nan)
    # (N, 4, 4)
    T = np.stack(
        [nothing if pose.T_world_camera is None else pose.T_world_camera for pose in poses]
    )
    finite = np.isfinite(T).all(axis=(1, 2))
    T[~finite] = np.nan
    warnings = []
    if not finite.all():
        first = poses[int(np.argmin(finite))]
        warnings.append(
            f"{np.sum(~finite)} of {len(poses)} frames have no usable pose and will be skipped (first: "
            f"{first.source}: {first.problem or 'NaN or infinite numbers'})"
        )
    identity = np.flatnonzero((np.eye(4) == T).all(axis=(1, 2)))
    if len(identity) >= MIN_IDENTITIES:
        warnings.append(
            f"{len(identity)} of {len(poses)} frames have exactly the identity as pose (first: "
            f"{poses[identity[0]].source}); if the camera moved, tracking was lost there"
        )
    # (N - 1,) [m], NaN beside a pose that is not finite
    step = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    jumps = np.flatnonzero(step > MAX_JUMP)
    if len(jumps):
        warnings.append(
            f"the camera jumps more than {MAX_JUMP:g} m between consecutive frames, {len(jumps)} times (first: "
            f"{step[jumps[0]]:.2f} m to {poses[jumps[0] + 1].source})"
        )
    return warnings


def camera_warnings(camera: PinholeCamera) -> list[str]:
    """A sentence if the principal point lies so far from the centre that the intrinsics may be
    another resolution's.
    """
    off = abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5)
    if max(off) <= OFF_CENTRE:
        return []
    return [
        f"the principal point ({camera.cx:g}, {camera.cy:g}) lies far from the centre of the "
        f"{camera.width}x{camera.height} depth images; are these the intrinsics of another resolution or camera?"
    ]


def guess_depth_scale(depth: NDArray[np.float32], current_scale: float) -> str | None:
    """What the depth scale may really be, as a sentence, if the median depth [m] under
    `current_scale` is implausible.
    """
    valid = depth[is_reading(depth)]
    if not len(valid):  # all beyond what maps take: still measurements if they differ
        valid = depth[np.isfinite(depth) & (depth > FARTHEST)]
        if len(np.unique(valid)) < MIN_VALUES:
            return None
    median = float(np.median(valid))
    if PLAUSIBLE_MEDIAN[0] <= median <= PLAUSIBLE_MEDIAN[1]:
        return None
    medians = {scale: median * current_scale / scale for scale in KNOWN_SCALES}
    fitting = [scale for scale, m in medians.items() if TYPICAL_MEDIAN[0] <= m <= TYPICAL_MEDIAN[1]]
    fitting.sort(key=lambda scale: abs(np.log(medians[scale] / COMMON_MEDIAN)))
    said = f"median depth is {median:.4g} m with depth_scale {current_scale:g}"
    if not fitting:
        return f"{said}, and no usual scale makes it plausible; look up how many units of the depth images make a metre"
    likely = " or ".join(f"{scale:g} (median {medians[scale]:.2f} m)" for scale in fitting)
    return f"{said}; is depth_scale {likely}?"
