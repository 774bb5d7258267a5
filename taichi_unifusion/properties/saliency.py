"""Saliency: how much each pixel draws the eye, in [0, 1] (Sec. V-B)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, check_choice
from ..networks.image_input import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    check_normalization,
    normalized,
)
from ..networks.image_network import ImageNetwork
from ..rendering.look import Look
from ..types import Frame
from .base import SurfaceProperty, color_of

LOOK = Look("viridis", (0.0, 1.0), "saliency")
PICTURE = 96  # pixels of the longer side: coarse, so that objects count, not their texture
BLUR = 2.5  # [pixels] of that picture
BRIGHTEST = 99.5  # percentile that becomes 1
RANGE_SLACK = 0.01  # how far outside [0, 1] rounding may take a network's output


def signature_saliency() -> SurfaceProperty:
    """Without weights: the image signature (Hou, Harel and Koch 2012) of lightness and colour.

    It finds what is small and unlike the rest of the picture; a salient-object network finds whole
    objects.
    """

    def function(frame: Frame) -> NDArray[np.float32]:
        color = color_of(frame)
        height, width = color.shape[:2]
        half = PICTURE / max(height, width) / 2
        # the cosine transform needs even sizes
        size = max(4, round(width * half)) * 2, max(4, round(height * half)) * 2
        small = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
        lab = cv2.cvtColor(small.astype(np.float32) / 255, cv2.COLOR_RGB2Lab)
        energy = np.sum([signature_energy(channel) for channel in cv2.split(lab)], axis=0)
        salient = np.asarray(cv2.GaussianBlur(energy, (0, 0), BLUR))
        salient -= salient.min()
        salient /= max(float(np.percentile(salient, BRIGHTEST)), 1e-12)
        return np.clip(cv2.resize(salient, (width, height), interpolation=cv2.INTER_CUBIC), 0, 1)

    return SurfaceProperty("saliency", 1, function, LOOK)


def signature_energy(channel: NDArray) -> NDArray:
    """Energy (H, W) of what is left of an image when only the signs of its cosine transform are
    kept.
    """
    return cv2.idct(np.sign(cv2.dct(channel))) ** 2


def network_saliency(
    file: Path,
    *,
    size: tuple[int, int] | None = None,
    mean: tuple[float, ...] = IMAGENET_MEAN,
    std: tuple[float, ...] = IMAGENET_STD,
    scale: float = 1.0,
    order: Literal["rgb", "bgr"] = "rgb",
    output: str = "",
    activation: Literal["none", "sigmoid", "minmax"] = "none",
    device: Literal["auto", "cpu", "cuda"] = "auto",
    sha256: str = "",
) -> SurfaceProperty:
    """A salient-object network in an ONNX file (U2-Net, InSPyReNet and their like): an image in,
    one channel out.

    The image is resized to `size` (the network's own where it is fixed), scaled to 0..`scale`, and
    normalised by `mean` and `std`. `activation` is applied to the output named `output`
    (default: the first): nothing, sigmoid, or stretching each frame to [0, 1].
    """
    check_choice("activation", activation, ("none", "sigmoid", "minmax"))
    check_normalization(scale, mean, std, order)
    network = ImageNetwork(file, size=size, output=output, channels=1, device=device, sha256=sha256)

    def function(frame: Frame) -> NDArray[np.float32]:
        color = color_of(frame)
        values = network(normalized(color, mean, std, scale, order), color.shape[:2])[..., 0]
        if activation == "sigmoid":
            return (1 / (1 + np.exp(-np.clip(values, -60, 60)))).astype(np.float32)
        low, high = float(values.min()), float(values.max())
        if activation == "minmax":
            return (values - low) / max(high - low, 1e-12)
        if low < -RANGE_SLACK or high > 1 + RANGE_SLACK:
            raise InputError(
                f"{file}: its output runs from {low:.3g} to {high:.3g}, which is no saliency of 0 to 1; say "
                "activation=sigmoid or activation=minmax, or choose another output"
            )
        return np.clip(values, 0, 1)

    return SurfaceProperty("saliency", 1, function, LOOK)
