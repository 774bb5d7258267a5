"""What image and text encoders are: anything with these members will do (Fig. 6 (c))."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from ..types import Frame


class ImageEncoder(Protocol):
    """f_im of Fig. 6 (c): features of a frame's image."""

    name: str

    def image_features(self, frame: Frame) -> NDArray[np.float32]:
        """(h, w, c) at any resolution, unit length; raises FrameError where the frame has none."""
        ...


class TextEncoder(Protocol):
    """f_text of Fig. 6 (c)."""

    name: str

    def text_features(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """(n, c), unit length; raises InputError for a text that it has no vector for."""
        ...


def feature_image(encoder: ImageEncoder, frame: Frame) -> NDArray[np.float32]:
    """An encoder's features (h, w, c) of a frame at unit length; FrameError where none is finite,
    InputError for another shape."""
    values = np.asarray(encoder.image_features(frame))
    if values.ndim != 3 or values.dtype.kind != "f" or not values.size:
        raise InputError(
            f"{encoder.name}: gives {values.shape} {values.dtype}, not features (h, w, c)"
        )
    values = unit_length(values)
    if not np.isfinite(values).any():
        raise FrameError(f"{encoder.name}: not one feature of {frame.label} is finite")
    return values


def unit_length(vectors: NDArray) -> NDArray[np.float32]:
    """Vectors (..., c) at unit length; a zero or not finite one becomes NaN."""
    vectors = np.asarray(vectors, np.float32)
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(lengths > 0, vectors / np.where(lengths > 0, lengths, 1), np.float32(np.nan))
