"""Style: every frame as a painter would show it, RGB in [0, 1] (Sec. V-B, Fig. 14)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..networks.image_input import check_normalization, normalized
from ..networks.image_network import ImageNetwork
from ..rendering.look import Look
from ..types import Frame
from .base import SurfaceProperty, color_of

LOOK = Look()
VOXEL_SIZE = 0.02  # [m] contours and strokes are finer than other properties
CONTOUR_WIDTH = 2.0  # [pixels]
FAINTEST = 0.017  # smallest change of brightness a pixel that gives a contour
OVERSHOOT = 10.0  # an output this many times beyond the stated range means that the range is wrong


def painting_style(
    *, smoothness: float = 60.0, detail: float = 0.45, contours: float = 4.0
) -> SurfaceProperty:
    """Flat regions within dark contours, by OpenCV's edge-preserving filter; no weights.

    `smoothness` in pixels, `detail` in 0..1, `contours` 0 for none. Every pixel depends on its
    surroundings only, not on the frame's strongest edge, so that frames agree.
    """
    _check_filter(smoothness, detail)
    if not contours >= 0:
        raise InputError(f"style: contours must not be negative, got {contours}")

    def function(frame: Frame) -> NDArray[np.float32]:
        flat = cv2.edgePreservingFilter(
            color_of(frame), flags=cv2.RECURS_FILTER, sigma_s=smoothness, sigma_r=detail
        )
        flat = flat.astype(np.float32) / 255
        soft = cv2.GaussianBlur(flat, (0, 0), CONTOUR_WIDTH)
        # change a pixel along rows and columns
        down, right = (
            np.asarray(cv2.Sobel(soft, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8))
            for dx in (0, 1)
        )
        strength = np.sqrt((down**2 + right**2).max(axis=2, keepdims=True))
        return flat * (1 - np.clip(contours * (strength - FAINTEST), 0, 1))

    return SurfaceProperty("style", 3, function, LOOK, voxel_size=VOXEL_SIZE)


def opencv_style(*, smoothness: float = 60.0, detail: float = 0.45) -> SurfaceProperty:
    """OpenCV's stylisation; no weights. Its contours are as strong as the frame's strongest edge
    allows: frames differ more.
    """
    _check_filter(smoothness, detail)

    def function(frame: Frame) -> NDArray[np.float32]:
        bgr = _bgr_of(frame)
        # without noise, flat areas become black
        grain = np.random.default_rng(0).integers(0, 2, bgr.shape, dtype=np.uint8)
        painted = cv2.stylization(
            np.where(bgr < 128, bgr + grain, bgr - grain), sigma_s=smoothness, sigma_r=detail
        )
        return _as_rgb(painted)

    return SurfaceProperty("style", 3, function, LOOK, voxel_size=VOXEL_SIZE)


def sketch_style(
    *, color: bool = False, smoothness: float = 60.0, detail: float = 0.07, shade: float = 0.05
) -> SurfaceProperty:
    """OpenCV's pencil drawing, grey or in `color`; no weights. `shade` in 0..0.1 makes it darker."""
    _check_filter(smoothness, detail)
    if not 0 <= shade <= 0.1:
        raise InputError(f"style: shade must lie in 0..0.1, got {shade}")

    def function(frame: Frame) -> NDArray[np.float32]:
        grey, colored = cv2.pencilSketch(
            _bgr_of(frame), sigma_s=smoothness, sigma_r=detail, shade_factor=shade
        )
        return _as_rgb(colored if color else cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))

    return SurfaceProperty("style", 3, function, LOOK, voxel_size=VOXEL_SIZE)


def network_style(
    file: Path,
    *,
    size: tuple[int, int] | None = None,
    mean: tuple[float, ...] = (0.0, 0.0, 0.0),
    std: tuple[float, ...] = (1.0, 1.0, 1.0),
    scale: float = 255.0,
    order: Literal["rgb", "bgr"] = "rgb",
    output: str = "",
    output_scale: float = 255.0,
    device: Literal["auto", "cpu", "cuda"] = "auto",
    sha256: str = "",
) -> SurfaceProperty:
    """An image-to-image network in an ONNX file (fast neural style, MSG-Net and their like): an
    image in, an image out.

    The image is resized to `size` (the network's own where it is fixed), scaled to 0..`scale`, and
    normalised by `mean` and `std`; the output named `output` (the first) runs over
    0..`output_scale`. `order` holds for both.
    """
    if not output_scale > 0:
        raise InputError(f"style: output_scale must be positive, got {output_scale}")
    check_normalization(scale, mean, std, order)
    network = ImageNetwork(file, size=size, output=output, channels=3, device=device, sha256=sha256)

    def function(frame: Frame) -> NDArray[np.float32]:
        color = color_of(frame)
        values = network(normalized(color, mean, std, scale, order), color.shape[:2])
        largest = float(np.abs(values).max())
        if largest > OVERSHOOT * output_scale or OVERSHOOT * largest < output_scale / 10:
            raise InputError(
                f"{file}: its output reaches {largest:.3g}, which does not fit a range of 0 to {output_scale:g}; "
                f"say output_scale={'1' if largest < 10 else '255'}"
            )
        return np.clip(
            (values if order == "rgb" else values[..., ::-1]) / np.float32(output_scale), 0, 1
        )

    return SurfaceProperty("style", 3, function, LOOK, voxel_size=VOXEL_SIZE)


def _bgr_of(frame: Frame) -> NDArray[np.uint8]:
    return np.ascontiguousarray(color_of(frame)[..., ::-1])


def _as_rgb(bgr: NDArray) -> NDArray[np.float32]:
    return np.asarray(bgr[..., ::-1], np.float32) / np.float32(255)


def _check_filter(smoothness: float, detail: float) -> None:
    if not 0 < smoothness <= 200:
        raise InputError(
            f"style: smoothness must lie above 0 and at most at 200 pixels, got {smoothness}"
        )
    if not 0 < detail <= 1:
        raise InputError(f"style: detail must lie above 0 and at most at 1, got {detail}")
