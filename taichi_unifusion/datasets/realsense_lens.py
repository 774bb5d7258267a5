"""Lenses as the RealSense SDK describes them, in OpenCV's numbers."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError

# from the ray to the image, as OpenCV has it, and from the image to the ray
STRAIGHT_MODELS = ("none", "brown conrady", "modified brown conrady", "plumb bob", "")
INVERSE_MODELS = ("inverse brown conrady",)
WIDEST = 0.7  # tangent of the angle off the axis up to which a lens is turned round


def sdk_distortion(model: str, coefficients: NDArray, where: str) -> tuple[float, ...]:
    """k1 k2 p1 p2 k3 k4 k5 k6 of a model of the SDK, by its name; DatasetError for one that cannot be
    undone.
    """
    D = np.asarray(coefficients, np.float64)
    D = D if len(D) == 5 else np.zeros(5)
    model = model.lower().replace("_", " ").rpartition(".")[2]
    if not np.isfinite(D).all():
        raise DatasetError(f"{where}: the distortion holds no numbers")
    if not D.any() or model in STRAIGHT_MODELS:
        return (*map(float, D), 0.0, 0.0, 0.0)
    if model in INVERSE_MODELS:
        return (*inverse_distortion(D), 0.0, 0.0, 0.0)
    raise DatasetError(f"{where}: the lens is '{model[:40]}', which cannot be undone here")


def inverse_distortion(D: NDArray) -> tuple[float, ...]:
    """k1 k2 p1 p2 k3 of the lens that these undo, by least squares over the image.

    The model "inverse Brown-Conrady" of the SDK leads from the image to the ray, OpenCV's from the ray to
    the image; both are linear in these numbers.
    """
    x, y = (each.ravel() for each in np.meshgrid(*[np.linspace(-WIDEST, WIDEST, 41)] * 2))
    straight = np.stack([x, y], axis=1) + np.einsum("nij,j->ni", _terms(x, y), D)
    target = np.stack([x, y], axis=1) - straight
    terms = _terms(*straight.T)
    return tuple(
        float(k) for k in np.linalg.lstsq(terms.reshape(-1, 5), target.ravel(), rcond=None)[0]
    )


def _terms(x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """(N, 2, 5): what k1 k2 p1 p2 k3 add to points (N,) with z = 1."""
    r2 = x * x + y * y
    return np.stack(
        [
            np.stack([x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x * r2**3], axis=-1),
            np.stack([y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, y * r2**3], axis=-1),
        ],
        axis=1,
    )
