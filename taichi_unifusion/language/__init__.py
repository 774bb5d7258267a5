"""Image-text features: what makes them from frames and from texts, and what is asked of a map of
them (Sec. V-C).

`make_image_encoder("clip:FOLDER")` and `make_text_encoder("embeddings:names.npz")` give one of
these. Your own is any object with `name`, and `image_features(frame) -> (h, w, c)` or
`text_features(texts) -> (n, c)`; vectors have unit length.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from ..errors import InputError, check_choice
from ..networks.encoders import ImageEncoder, TextEncoder, feature_image, unit_length

__all__ = [
    "IMAGE_ENCODERS",
    "TEXT_ENCODERS",
    "EncoderChoice",
    "ImageEncoder",
    "TextEncoder",
    "feature_image",
    "make_image_encoder",
    "make_text_encoder",
    "unit_length",
]

IMAGE_ENCODERS = {  # name -> module, its function, what stands after the colon
    "clip": (
        "..networks.clip",
        "clip_image_encoder",
        "MODEL: a folder, or a name on the Hugging Face hub",
    ),
    "onnx": ("..networks.onnx_encoders", "onnx_image_encoder", "FILE.onnx"),
    "folder": (".folder", "folder_features", "FOLDER of .npy, .npz or .pt files"),
    "points": (".points", "point_features", "FEATURES,POINTS.ply: .pt, .npz or .npy, and where"),
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


@dataclass(frozen=True)
class EncoderChoice:
    """An image encoder by name, as it goes to other processes, which make it there."""

    text: str  # NAME:WHERE
    options: Mapping[str, Any] = field(default_factory=dict)

    def make(self) -> ImageEncoder:
        """The encoder; raises as `make_image_encoder`."""
        return make_image_encoder(self.text, **self.options)


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
