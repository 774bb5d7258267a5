"""What commands that ask a map of features make of their text options."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..errors import InputError
from .options import EncoderOptions

if TYPE_CHECKING:
    from ..language.embeddings import TextEmbeddings
    from ..maps.stored import MapDescription
    from ..networks.encoders import TextEncoder


def templates_of(options: EncoderOptions) -> tuple[str, ...]:
    """The templates asked for, or the usual ones."""
    from ..language.prompts import TEMPLATES

    return options.template or TEMPLATES


def check_fits(encoder: TextEmbeddings, features: MapDescription, directory: Path) -> None:
    """Raise InputError where the vectors of a file cannot be of the network that made the features."""
    channels = encoder.vectors.shape[1]
    if channels != features.channels:
        raise InputError(
            f"{encoder.name}: holds vectors of {channels} channels, the features of {directory} have "
            f"{features.channels} channels ({_made_by(features.source)}); give the texts of the network that "
            "made these"
        )


def _made_by(source: str) -> str:
    return f"from {source}" if source else "from an unknown network"


def make_encoder(options: EncoderOptions, source: str, directory: Path) -> TextEncoder:
    """The text encoder asked for, or the one that belongs to features of `source`; InputError where
    there is none.
    """
    from ..language import make_text_encoder

    text = options.text or (source if source.startswith("clip:") else None)
    if text is None:
        raise InputError(
            f"{directory}: its features come {_made_by(source)}; give the text encoder that "
            "belongs to them, with --text clip:MODEL, onnx:FILE.onnx or embeddings:FILE"
        )
    choices = {
        "clip": {"download": options.download, "device": options.device},
        "onnx": {"tokenizer": options.tokenizer, "device": options.device},
        "embeddings": {"names": options.names},
    }.get(text.partition(":")[0], {})
    return make_text_encoder(text, **choices)
