"""Methods compared in the same readings: those where the surface of every one is hit.

A method that has no surface where it is difficult, at rims and in slits, is spared the errors there by means
over what each method itself hits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from quality_methods import Reconstruction
from quality_scenes import DEPTH_RANGE, Scene

from taichi_unifusion.evaluation.rendering import RenderedFrame, psnr, render_frame, ssim
from taichi_unifusion.rendering.raycaster import RayCaster
from taichi_unifusion.types import Frame

SHARED_COLUMNS = {  # title -> (where in a row's numbers, format)
    "Depth L1 cm": ("shared_l1_cm", ".2f"),
    "median cm": ("shared_median_cm", ".2f"),
    "PSNR dB": ("shared_psnr_db", ".2f"),
    "SSIM": ("shared_ssim", ".3f"),
    "of the readings %": ("shared_coverage", ".1%"),
    "of all within 2.5 cm %": ("depth_within", ".1%"),
}


def render_held_out(reconstruction: Reconstruction, scene: Scene) -> list[RenderedFrame]:
    """Depth and colour (float16, to be kept) from every held-out camera."""
    caster = RayCaster(reconstruction.mesh, "reconstruction")
    rendered = (render_frame(caster, frame, reconstruction.color) for frame in scene.held_out)
    return [RenderedFrame(each.depth, each.color.astype(np.float16)) for each in rendered]


def score_shared(
    rendered: Mapping[str, Sequence[RenderedFrame]], held_out: Sequence[Frame], nearest: float
) -> dict[str, dict[str, float]]:
    """Numbers of SHARED_COLUMNS by method, means over the frames; readings count from `nearest` [m]."""
    scores: dict[str, list[tuple[float, ...]]] = {name: [] for name in rendered}
    for i, frame in enumerate(held_out):
        read = (frame.depth >= nearest) & (frame.depth <= DEPTH_RANGE[1])
        hit = [np.isfinite(frames[i].depth) for frames in rendered.values()]
        both = read & np.logical_and.reduce(hit)
        if not both.any():
            continue
        taken = frame.color.astype(np.float32) / 255
        for name, frames in rendered.items():
            error = np.abs(frames[i].depth[both] - frame.depth[both]).astype(np.float64)
            color = frames[i].color.astype(np.float32)
            similar = ssim(color, taken, both)
            scores[name].append(
                (
                    100 * error.mean(),
                    100 * np.median(error),
                    psnr(color, taken, both),
                    np.nan if similar is None else similar,
                    both.sum() / read.sum(),
                )
            )
    keys = [key for key, _ in SHARED_COLUMNS.values()]
    return {
        name: dict(zip(keys, map(float, np.nanmean(rows, axis=0)), strict=False))
        for name, rows in scores.items()
        if rows
    }
