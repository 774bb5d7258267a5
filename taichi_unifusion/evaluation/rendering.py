"""Rendering metrics: depth and colour of a mesh, seen from given poses, against images taken there
(Sec. VI-A, Table III).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.texture import Texture
from ..rendering.raycaster import RayCaster
from ..types import Frame, Mesh

WITHIN = 0.025  # [m] an error below this counts as correct
# [px] of the Gaussian window; this and the constants below as in Wang et al. 2004
SSIM_SIGMA = 1.5
SSIM_RADIUS = 5  # [px]
SSIM_CONSTANTS = (0.01**2, 0.03**2)  # for values in [0, 1]

# points (N, 3) world [m] -> RGB (N, 3) in [0, 1]; `PropertyMap.query` is one
ColorAt = Callable[[NDArray], NDArray]


@dataclass(frozen=True)
class RenderedFrame:
    """What a camera would see of a reconstruction."""

    depth: NDArray[np.float32]  # (H, W) [m], inf where nothing is hit
    color: NDArray[np.float32] | None  # (H, W, 3) RGB in [0, 1], 0 where nothing is hit


@dataclass(frozen=True)
class FrameScore:
    """One rendered image against one taken image; None where there was nothing to compare."""

    index: int  # of the frame in its recording
    readings: int  # depth readings in range
    coverage: float | None  # share of the readings, 0..1, where the ray hits the mesh
    depth_l1_cm: float | None  # mean |rendered - read| where there are both
    depth_median_cm: float | None  # median of the same
    depth_within: float | None  # share of all readings, 0..1, with a hit less than 2.5 cm off
    psnr_db: float | None  # of colour where there are a reading, a hit and a colour of the reading
    ssim: float | None  # mean over the same pixels


@dataclass(frozen=True)
class RenderingResult:
    """Means over the frames, each over those that have the number."""

    depth_l1_cm: float | None
    depth_median_cm: float | None
    depth_within: float | None
    coverage: float | None
    psnr_db: float | None
    ssim: float | None
    frames: tuple[FrameScore, ...]


MEANS = ("depth_l1_cm", "depth_median_cm", "depth_within", "coverage", "psnr_db", "ssim")


def evaluate_rendering(
    mesh: Mesh,
    frames: Iterable[Frame],
    *,
    color: ColorAt | None = None,
    texture: Texture | None = None,
    depth_min: float = 0.1,
    depth_max: float = 5.0,
) -> RenderingResult:
    """Compare images with the mesh rendered at their poses.

    Depth is that of the rays through the pixel centres, from either side of the surface. Colour is
    `color` at the points hit (the query of a colour LIM, as published), else the mesh's `texture`,
    else its vertex colours, else none. Compared are pixels whose reading lies in depth_min..depth_max [m] and whose
    ray hits; what is not hit lowers `coverage` and `depth_within` only.

    Raises InputError for a mesh that is empty or not finite, where there is no frame, no frame with a
    reading in range, or no ray of any frame that hits; PoseError for a frame without a pose.
    """
    if not 0 <= depth_min < depth_max:
        raise InputError(
            f"rendering: need 0 <= depth_min < depth_max, got {depth_min} and {depth_max}"
        )
    caster = RayCaster(mesh, "reconstruction")
    scores = tuple(
        _score(render_frame(caster, frame, color, texture), frame, depth_min, depth_max)
        for frame in frames
    )
    if not scores:
        raise InputError("rendering: there are no frames to compare with")
    if not any(score.readings for score in scores):
        raise InputError(
            f"rendering: none of {len(scores)} frames has a depth reading in {depth_min:g}..{depth_max:g} m; "
            "is the depth scale wrong?"
        )
    if not any(score.coverage for score in scores):
        raise InputError(
            f"rendering: no ray of {len(scores)} frames meets the mesh; is it in the world of the frames' "
            "poses, in metres?"
        )
    means = {name: _mean([getattr(score, name) for score in scores]) for name in MEANS}
    return RenderingResult(**means, frames=scores)


def render_frame(
    caster: RayCaster,
    frame: Frame,
    color: ColorAt | None = None,
    texture: Texture | None = None,
) -> RenderedFrame:
    """What the camera of `frame` would see of the caster's mesh; colour as in `evaluate_rendering`."""
    hits = caster.cast(frame.camera, frame.require_pose())
    if color is None and texture is None and "color" not in caster.mesh.attributes:
        return RenderedFrame(hits.depth, None)
    image = np.zeros((*hits.depth.shape, 3), np.float32)
    if hits.hit.any():
        if color:
            values = color(hits.points(hits.hit))
        elif texture:
            values = texture.at(caster.interpolate(hits, hits.hit, texture.coordinates))
        else:
            values = caster.interpolate(hits, hits.hit, caster.mesh.attributes["color"])
        if values.shape[1:] != (3,):
            raise InputError(f"rendering: colours must be (N, 3) RGB in [0, 1], got {values.shape}")
        image[hits.hit] = np.clip(values, 0, 1)
    return RenderedFrame(hits.depth, image)


def _score(rendered: RenderedFrame, frame: Frame, depth_min: float, depth_max: float) -> FrameScore:
    with np.errstate(invalid="ignore"):
        read = (frame.depth >= depth_min) & (frame.depth <= depth_max) & (frame.depth > 0)
    both = read & np.isfinite(rendered.depth)
    readings, compared = int(read.sum()), int(both.sum())
    if not readings:
        return FrameScore(frame.index, 0, None, None, None, None, None, None)
    error = np.abs(rendered.depth[both].astype(np.float64) - frame.depth[both])
    l1, median = (
        (100 * float(error.mean()), 100 * float(np.median(error))) if compared else (None, None)
    )
    psnr_db = structure = None
    if rendered.color is not None and frame.color is not None:
        taken, known = _taken_color(frame, frame.color)
        known &= both
        if known.any():
            psnr_db = psnr(rendered.color, taken, known)
            structure = ssim(rendered.color, taken, known)
    return FrameScore(
        frame.index,
        readings,
        compared / readings,
        l1,
        median,
        float((error < WITHIN).sum()) / readings,
        psnr_db,
        structure,
    )


def _taken_color(
    frame: Frame, picture: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """A frame's colour (H, W, 3) RGB in [0, 1], and where (H, W) it is that of the reading: the
    colour camera may not see it.
    """
    image = frame.images.get("color")
    if image is None:
        return picture.astype(np.float32) / np.float32(255), np.ones(frame.depth.shape, np.bool_)
    known = np.isfinite(image.sum(axis=2))
    return np.where(known[..., None], image, np.float32(0)), np.asarray(known)


def psnr(image: NDArray, reference: NDArray, mask: NDArray[np.bool_]) -> float:
    """Peak signal-to-noise ratio [dB] over the pixels (H, W) of `mask`, of images (H, W, c) in [0,
    1]; inf for equal ones.
    """
    squared = float(np.mean((image[mask].astype(np.float64) - reference[mask]) ** 2))
    return -10 * float(np.log10(squared)) if squared > 0 else float("inf")


def ssim(image: NDArray, reference: NDArray, mask: NDArray[np.bool_]) -> float | None:
    """Mean structural similarity (Wang et al. 2004) over the pixels (H, W) of `mask`, of images (H,
    W, c) in [0, 1].

    Each pixel's Gaussian window takes in the pixels of `mask` only, with weights that sum to 1 over
    those, so that the content of holes does not count. Pixels within 5 of the image's border are left
    out, as scikit-image does; None where none is left.
    """
    import cv2

    kept = mask.copy()
    kept[:SSIM_RADIUS] = kept[-SSIM_RADIUS:] = kept[:, :SSIM_RADIUS] = kept[:, -SSIM_RADIUS:] = (
        False
    )
    if not kept.any():
        return None

    def blur(values: NDArray) -> NDArray:
        size = 2 * SSIM_RADIUS + 1
        return cv2.GaussianBlur(values, (size, size), SSIM_SIGMA, borderType=cv2.BORDER_CONSTANT)[
            kept
        ]

    inside = mask.astype(np.float64)
    weight = blur(inside)
    totals = []
    for channel in range(image.shape[2]):
        x, y = image[..., channel] * inside, reference[..., channel] * inside
        mean_x, mean_y = blur(x) / weight, blur(y) / weight
        var_x, var_y = blur(x * x) / weight - mean_x**2, blur(y * y) / weight - mean_y**2
        covariance = blur(x * y) / weight - mean_x * mean_y
        c1, c2 = SSIM_CONSTANTS
        totals.append(
            np.mean(
                (2 * mean_x * mean_y + c1)
                * (2 * covariance + c2)
                / ((mean_x**2 + mean_y**2 + c1) * (var_x + var_y + c2))
            )
        )
    return float(np.mean(totals))


def _mean(values: list[float | None]) -> float | None:
    present = [value for value in values if value is not None]
    return float(np.mean(present)) if present else None
