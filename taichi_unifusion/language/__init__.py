"""Image-text features: what makes them from frames and from texts, and what is asked of a map of
them (Sec. V-C).

`make_image_encoder("clip:FOLDER")` and `make_text_encoder("embeddings:names.npz")` give one of
these. Your own is any object with `name`, and `image_features(frame) -> (h, w, c)` or
`text_features(texts) -> (n, c)`; vectors have unit length.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError, check_choice
from ..types import Frame

IMAGE_ENCODERS = {  # name -> module, its function, what stands after the colon
    "clip": (
        "..networks.clip",
        "clip_image_encoder",
        "MODEL: a folder, or a name on the Hugging Face hub",
    ),
    "onnx": ("..networks.onnx_encoders", "onnx_image_encoder", "FILE.onnx"),
    "folder": (".folder", "folder_features", "FOLDER of .npy, .npz or .pt files"),
}
TEXT_ENCODERS = {
    "clip": (
        "..networks.clip",
        "clip_text_encoder",
        "MODEL: a folder, or a name on the Hugging Face hub",
    ),
    "onnx": ("..networks.onnx_encoders", "onnx_text_encoder", "FILE.onnx"),
    "embeddings": (
        ".embeddings",
        "read_embeddings",
        "FILE.npz with names and vectors, or FILE.npy beside names",
    ),
}


class ImageEncoder(Protocol):
    """f_im of Fig. 6 (c): features of a frame's image."""

    name: str

    def image_features(self, frame: Frame) -> NDArray[np.float32]:
        """(h, w, c) at any resolution, unit length; raises FrameError where the frame has none."""


class TextEncoder(Protocol):
    """f_text of Fig. 6 (c)."""

    name: str

    def text_features(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """(n, c), unit length; raises InputError for a text that it has no vector for."""


def make_image_encoder(text: str, **options: Any) -> ImageEncoder:
    """The image encoder that `NAME:WHERE` names; raises InputError for an unknown name."""
    return _make(text, IMAGE_ENCODERS, "features", options)


def make_text_encoder(text: str, **options: Any) -> TextEncoder:
    """The text encoder that `NAME:WHERE` names; raises InputError for an unknown name."""
    return _make(text, TEXT_ENCODERS, "text", options)


def _make(
    text: str, encoders: dict[str, tuple[str, str, str]], what: str, options: dict[str, Any]
) -> Any:
    name, _, where = text.partition(":")
    check_choice(what, name, encoders)
    module, function, after = encoders[name]
    if not where:
        raise InputError(
            f"{what}: '{name}' needs more, as in {name}:{after.split(':')[0]} ({after})"
        )
    return getattr(import_module(module, __package__), function)(where, **options)


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
        raise FrameError(
            f"{encoder.name}: not one feature of frame {frame.name or frame.index} is finite"
        )
    return values


def unit_length(vectors: NDArray) -> NDArray[np.float32]:
    """Vectors (..., c) at unit length; a zero or not finite one becomes NaN."""
    vectors = np.asarray(vectors, np.float32)
    lengths = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.where(lengths > 0, vectors / np.where(lengths > 0, lengths, 1), np.float32(np.nan))
