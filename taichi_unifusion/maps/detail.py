"""The voxel size that fits what frames see: a table at arm's length takes other voxels than a room."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from ..types import Frame
from .settings import MapSettings

Detail = Literal["auto", "fine", "coarse"]

ROOM = 0.05  # [m] surface voxels of a room, which other sizes are relative to
STEPS = (
    0.005,
    0.0075,
    0.01,
    0.015,
    0.02,
    0.03,
    0.04,
    ROOM,
)  # [m] to choose from: few kernels to compile
# Voxels grow with depth a little faster than pixels do, since noise does: measured from 0.4 to 3 m.
AT_ONE_METRE, EXPONENT = 0.034, 1.3
PIXELS = 8  # that a voxel spans at least: fewer hold too few samples
# A hall: farther than the default `depth_max` lets a room be seen. Its voxels follow pixels and depth: at 8.4 m with
# 320 x 240 pixels, 5 cm leave 61 % of the surface out and 10 cm 4 %, with 640 x 480 and ten frames 36 and 9 %.
HALL, PIXELS_OF_HALL, DEPTH_OF_HALL = 5.0, 3.4, 0.01
STEPS_OF_HALL = (ROOM, 0.075, 0.1, 0.15, 0.2)
TIMES = {"auto": 1.0, "fine": 0.5, "coarse": 2.0}


@dataclass(frozen=True)
class Sight:
    """What frames see, in the middle of all their readings."""

    depth: float  # [m]
    footprint: float  # [m] of a pixel at that depth


def sight_of(frames: Iterable[Frame], depth_min: float, depth_max: float) -> Sight | None:
    """The medians over frames of the depth of their readings in range, and of a pixel's footprint
    z / f there; None where there is no reading.
    """
    depths, footprints = [], []
    for frame in frames:
        z = frame.depth[(frame.depth >= depth_min) & (frame.depth <= depth_max)]  # NaN is neither
        if len(z):
            depths.append(float(np.median(z)))
            footprints.append(depths[-1] / max(frame.camera.fx, frame.camera.fy))
    return Sight(float(np.median(depths)), float(np.median(footprints))) if depths else None


def choose_voxel_size(sight: Sight | None, detail: Detail = "auto") -> float:
    """Edge of the surface's voxels [m]: for auto that of a room, less where everything is nearer, more in a
    hall whose pixels are coarse; half and twice that for fine and coarse. None is a room.
    """
    size = ROOM
    if sight is not None:
        fits = max(AT_ONE_METRE * sight.depth**EXPONENT, PIXELS * sight.footprint)
        size = min(STEPS, key=lambda step: abs(np.log(step / fits)))
        if sight.depth > HALL:
            least = max(PIXELS_OF_HALL * sight.footprint, DEPTH_OF_HALL * sight.depth)
            size = next((step for step in STEPS_OF_HALL if step >= least), STEPS_OF_HALL[-1])
    return TIMES[detail] * size


def sizes_sentence(surface: MapSettings, color: MapSettings, sight: Sight) -> str:
    """Which voxel sizes were chosen, why, and how to choose others."""
    return (
        f"voxels of {100 * surface.voxel_size:g} cm, {100 * color.voxel_size:g} cm for colour: the first frames look "
        f"{sight.depth:.2g} m far; detail (fine, coarse) or voxel_size choose others"
    )
