"""Checks of arrays that a caller gives: each raises an error that names them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from ..errors import InputError, NotRigid, PoseError, UniFusionError, shortened

# |R^T R - I| and |det R - 1|: text files of 6 digits pass, a scale of 0.1 % does not
RIGID_TOLERANCE = 1e-3
FLATTEST = 1e-6  # least stretch of a matrix over its largest, below which it is flat


def as_numbers(
    what: str,
    values: ArrayLike | object,
    dtype: DTypeLike = np.float32,
    error: type[UniFusionError] = InputError,
) -> NDArray:
    """What is or can become an array of numbers, contiguous; else raises the error, which calls it
    `what`.
    """
    try:
        return np.ascontiguousarray(values, dtype)
    except (TypeError, ValueError, OverflowError):
        raise error(f"{what}: expected an array of numbers, got {shortened(values)}") from None


def check_array(what: str, value: object, error: type[UniFusionError] = InputError) -> None:
    """Raise the error unless a value is a NumPy array."""
    if not isinstance(value, np.ndarray):
        raise error(f"{what} must be a NumPy array, got {type(value).__name__}")


def check_rigid(T: ArrayLike, name: str = "T_world_camera") -> NDArray[np.float64]:
    """Return T as a (4, 4) float64 rigid transform, or raise PoseError with the numbers that are
    off.
    """
    T = as_numbers(name, T, np.float64, PoseError)
    if T.shape != (4, 4):
        raise PoseError(f"{name}: expected a 4x4 matrix, got shape {T.shape}")
    if not np.isfinite(T).all():
        raise PoseError(f"{name}: holds NaN or infinite numbers")
    if not np.allclose(T[3], (0, 0, 0, 1), atol=1e-6):
        raise PoseError(
            f"{name}: last row is {T[3].tolist()}, not 0 0 0 1; is the matrix transposed?"
        )
    R = T[:3, :3]
    det, skew = float(np.linalg.det(R)), float(np.abs(R.T @ R - np.eye(3)).max())
    if abs(det - 1) > RIGID_TOLERANCE or skew > RIGID_TOLERANCE:
        raise NotRigid(
            name,
            f"not a rotation (det R = {det:.4f}, max |R^T R - I| = {skew:.4f}; "
            f"both must be within {RIGID_TOLERANCE} of 1 and 0)",
            T,
        )
    return T


def nearest_rigid(T: NDArray[np.float64], name: str = "T_world_camera") -> NDArray[np.float64]:
    """T (4, 4) with the rotation nearest to its own (least sum of squared differences).

    Raises PoseError where it mirrors or flattens space: no rotation is nearest then.
    """
    U, stretch, Vt = np.linalg.svd(T[:3, :3])
    if np.linalg.det(T[:3, :3]) <= 0 or stretch[-1] < FLATTEST * stretch[0]:
        raise PoseError(
            f"{name}: det R = {np.linalg.det(T[:3, :3]):.4f}; a mirrored or flat matrix has no nearest rotation"
        )
    rigid = np.array(T, np.float64)
    rigid[:3, :3] = U @ Vt
    return rigid
