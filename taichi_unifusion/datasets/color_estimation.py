"""Where the colour camera stands beside the depth camera, from the recording alone.

A point of a surface has one colour. Points that several posed frames see are looked up in their
colour images, and what varies is minimised over rotation, translation, focal length and clock offset
of the colour camera: Gauss-Newton with robust weights and analytic derivatives, from coarse images
to finer ones. Half of the frames are left out; they decide whether the answer is any good.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .color_camera import ColorCamera
from .color_rig import NEAREST, PARAMETERS, Rig, look_up, project, residuals_of, shrunk
from .color_sightings import Sightings, find_sightings
from .dataset import Dataset
from .loading import index_in_recording

# what is likely of a rig, one standard deviation each; it decides what the frames leave open
LIKELY = np.array([*[np.radians(3.0)] * 3, *[0.03] * 3, 0.1, 0.02])
# so many points tell as much as one independent one: neighbours share texture and errors of poses
REDUNDANCY = 100.0
CAUCHY = 8.0  # [grey levels] residuals well beyond it hardly count
SHRINKS = (16, 8, 4, 2)  # of images 640 pixels wide, coarse to fine
MOST_STEPS = 30  # of Gauss-Newton at one scale
LONGEST_DOUBLING = 4  # times that a step of Gauss-Newton is doubled
SHORTEST_STEP = 0.05  # [shrunk pixels] what is moved by less has converged
LEAST_GROUPS = 4  # of frames, half of them left out
# [pixels] of images 640 wide: what is off by less counts as registered; noise of depth looks like half of it
LEAST_SHIFT = 2.0
LEAST_GAIN = 0.3  # [dB] on frames left out
LEAST_SHARE = 0.75  # of the frames left out must gain
# a rig beyond it is no answer
FARTHEST = np.array([*[np.radians(12.0)] * 3, *[0.2] * 3, np.log(1.35), 0.1])
LEAST_NOISE = 0.1  # [grey levels^2] of 8-bit images


@dataclass(frozen=True)
class ColorEstimate:
    """What a recording says of its colour camera, and whether to believe it."""

    camera: ColorCamera | None  # None: colour stays as it was recorded
    verdict: str  # a sentence: why
    gain_db: float | None = None  # mean over the frames left out; None: there was nothing to try
    frames: int = 0  # how many were left out


def estimate_color_camera(recording: Dataset) -> ColorEstimate:
    """The colour camera of a recording of posed frames whose colour may not be registered to depth.

    `recording` gives colour as it was taken, in the size of depth. The estimate's camera is None
    where colour fits, where frames tell too little, and where frames left out do not gain clearly. Groups
    of neighbours must see the same: give all frames of a range, and thin them out for the map afterwards.
    """
    if recording.registered:
        return ColorEstimate(None, "registered by the recording itself")
    groups = list(find_sightings(recording))
    if len(groups) < LEAST_GROUPS:
        return ColorEstimate(None, f"left as recorded: {_too_little(recording)}")
    used, left_out = groups[::2], groups[1::2]
    start = Rig(groups[0].camera, np.eye(3), np.zeros(3))
    found = _solve(used, start)
    if (np.abs(found.values) > FARTHEST).any():
        return ColorEstimate(None, "left as recorded: no colour camera makes its frames agree")
    before, after = _errors(left_out, start, found)
    gains = 10 * np.log10(before / after)
    gain = float(gains.mean()) if len(gains) else 0.0
    if _shift(left_out, start, found) < max(1.0, LEAST_SHIFT * start.start.width / 640):
        return ColorEstimate(None, "registered", gain, len(gains))
    if gain < LEAST_GAIN or (gains > 0).mean() < LEAST_SHARE:
        verdict = (
            f"left as recorded: an estimate changes {len(gains)} frames left out by {gain:+.1f} dB"
        )
        return ColorEstimate(None, verdict, gain, len(gains))
    return ColorEstimate(found.camera(), _described(found, gain, len(gains)), gain, len(gains))


def _too_little(recording: Dataset) -> str:
    """Why there are too few groups of frames that see the same."""
    given = len(recording)
    step = index_in_recording(recording, 1) - index_in_recording(recording, 0) if given > 1 else 1
    if step > 1:
        return (
            f"{given} frames, {step} apart in their recording, see too little of the same to tell; give the "
            "frames between them too, and thin them out afterwards"
        )
    return "the camera moves too little, or too few frames have poses and colour, to tell"


def _described(rig: Rig, gain: float, frames: int) -> str:
    turned = np.degrees(np.linalg.norm(rig.values[:3]))
    return (
        f"estimated: turned by {turned:.1f} degrees, {100 * np.linalg.norm(rig.t):.1f} cm beside the depth camera, "
        f"focal length {rig.focal[0]:.0f} (depth {rig.start.fx:.0f}), {1e3 * rig.offset:+.0f} ms; "
        f"{gain:+.1f} dB on {frames} frames left out"
    )


def _solve(groups: Sequence[Sightings], rig: Rig) -> Rig:
    """The rig whose images agree best, from that of the start."""
    wide = rig.start.width / 640
    shrinks = sorted({max(1, round(wide * shrink)) for shrink in SHRINKS}, reverse=True)
    for shrink in shrinks:
        images = [[shrunk(color, shrink) for color in group.colors] for group in groups]
        # [parameters] of a change that shifts images by about a pixel
        pixel = np.array([*[1.0] * 3, *[1.0] * 3, 2.0, 10.0]) * shrink / rig.start.fx
        for _ in range(MOST_STEPS):
            step = _newton_step(groups, images, shrink, rig)
            length = _line_search(groups, images, shrink, rig, step)
            rig = rig.moved(length * step)
            if (np.abs(length * step) / pixel).max() < SHORTEST_STEP:
                break
    return rig


def _newton_step(
    groups: Sequence[Sightings], images: Sequence[Sequence[NDArray]], shrink: int, rig: Rig
) -> NDArray[np.float64]:
    """The step of Gauss-Newton with robust weights, (PARAMETERS,)."""
    A, b = np.zeros((PARAMETERS, PARAMETERS)), np.zeros(PARAMETERS)
    cost, count = 0.0, 0
    for group, own in zip(groups, images, strict=True):
        residuals, used, J = residuals_of(group, own, shrink, rig, derivatives=True)
        weights = used / (1 + (residuals / CAUCHY) ** 2)
        J = J.reshape(-1, PARAMETERS)
        weighted = J * weights.reshape(-1, 1)
        A += weighted.T @ J
        b += weighted.T @ residuals.reshape(-1)
        cost, count = cost + _cost(residuals, used), count + int(used.sum())
    noise = REDUNDANCY * max(cost / max(count, 1), LEAST_NOISE)  # of independent points
    prior = np.diag(LIKELY**-2.0)
    step = np.linalg.solve(A / noise + prior, b / noise + prior @ rig.values)
    return -np.asarray(step, np.float64)


def _line_search(
    groups: Sequence[Sightings],
    images: Sequence[Sequence[NDArray]],
    shrink: int,
    rig: Rig,
    step: NDArray,
) -> float:
    """How many steps to go, doubling while it helps; 0 where none does.

    Noise in the images makes Gauss-Newton believe in steeper slopes than there are.
    """

    def mean_cost(rig: Rig) -> tuple[float, int]:
        cost, count = 0.0, 0
        for group, own in zip(groups, images, strict=True):
            residuals, used, _ = residuals_of(group, own, shrink, rig)
            cost, count = cost + _cost(residuals, used), count + int(used.sum())
        unlikely = REDUNDANCY * float(((rig.values / LIKELY) ** 2).sum())
        return cost / max(count, 1) * (1 + unlikely / max(count, 1)), count

    best, most = mean_cost(rig)
    length = 0.0
    for trial in 2.0 ** np.arange(LONGEST_DOUBLING + 1):
        cost, count = mean_cost(rig.moved(trial * step))
        # points that leave the images cost nothing: not a way to get better
        if not (cost < best and count > most / 2):
            break
        best, length = cost, float(trial)
    return length


def _cost(residuals: NDArray, used: NDArray) -> float:
    return float((CAUCHY**2 * np.log1p((residuals / CAUCHY) ** 2) * used).sum())


def _errors(
    groups: Sequence[Sightings], before: Rig, after: Rig
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean squared error of what a frame shows against the mean of its neighbours, one a frame, for
    either rig, over the points that both show.

    Images are blurred a little, so that interpolation between pixels, which evens out noise, makes
    no difference.
    """
    errors: list[list[float]] = []
    for group in groups:
        images = [cv2.GaussianBlur(each, (0, 0), 1.0).astype(np.float32) for each in group.colors]
        shown, both = [], group.seen.copy()
        for rig in (before, after):
            values = []
            for k, image in enumerate(images):
                at = project(rig, group.points[k], group.velocity[k])
                found, inside = look_up(image, at.u, at.v)
                values.append(found)
                both[k] &= inside & (at.point[:, 2] > NEAREST)
            shown.append(np.stack(values))
        others = both.sum(axis=0) - 1
        for k in range(len(images)):
            used = both[k] & (others >= 1)
            if used.any():
                rest = [
                    ((values * both[..., None]).sum(axis=0) - values[k])[used] / others[used, None]
                    for values in shown
                ]
                errors.append(
                    [
                        float(np.mean((values[k][used] - mean) ** 2)) + 1e-3  # [grey levels^2]
                        for values, mean in zip(shown, rest, strict=True)
                    ]
                )
    pairs = np.array(errors).reshape(-1, 2)
    return pairs[:, 0], pairs[:, 1]


def _shift(groups: Sequence[Sightings], before: Rig, after: Rig) -> float:
    """Root mean square of how far points move in the images from one rig to another [pixels]."""
    squares = []
    for group in groups:
        for points, seen, velocity in zip(group.points, group.seen, group.velocity, strict=True):
            a, b = (project(rig, points[seen], velocity) for rig in (before, after))
            squares.append((a.u - b.u) ** 2 + (a.v - b.v) ** 2)
    return float(np.sqrt(np.mean(np.concatenate(squares))))
