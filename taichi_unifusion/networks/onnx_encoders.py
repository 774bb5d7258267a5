"""Image and text encoders in ONNX files, exported by the user; CLIP's tokenizer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from ..types import Frame
from .clip import NORMALIZATION, SHORT_SIDE
from .encoders import unit_length
from .image_input import FLOATS, find_image_input, normalized, resized, whole_patches
from .onnx_session import open_session, run_session
from .tokenizer import ClipTokenizer

TOKEN_TYPES = {"tensor(int64)": np.int64, "tensor(int32)": np.int32}
TEXT_LENGTH = 77  # of CLIP


class OnnxImageEncoder:
    """A network of one RGB image: features (1, h, w, c), (1, c, h, w), or one a patch,
    (1, [1 +] h w, c).
    """

    def __init__(
        self,
        file: str,
        mean: Sequence[float],
        std: Sequence[float],
        size: tuple[int, int] | None,
        patch: int,
        device: str,
    ) -> None:
        self.name, self.mean, self.std, self.patch = f"onnx:{file}", mean, std, patch
        self.session = open_session(file, device)
        self.input = find_image_input(self.session, file, size, FLOATS)

    def image_features(self, frame: Frame) -> NDArray[np.float32]:
        """(h, w, c), unit length; raises FrameError for a frame without colour or where nothing is
        finite.
        """
        at = frame.label
        if frame.color is None:
            raise FrameError(f"{at}: has no colour image for {self.name}")
        width, height = self.input.size or whole_patches(frame.color, SHORT_SIDE, self.patch)
        image = normalized(resized(frame.color, (width, height)), self.mean, self.std)
        raw = run_session(
            self.session,
            self.input.feed(image),
            failure=f"{self.name}: fails on an image of {width}x{height}",
        )
        features = unit_length(self._as_image(raw, height, width))
        if not np.isfinite(features).any():
            raise FrameError(f"{at}: {self.name} gives no finite feature")
        return features

    def _as_image(self, raw: NDArray, height: int, width: int) -> NDArray[np.float32]:
        if raw.ndim == 4 and raw.shape[0] == 1:
            # (h, w, c) or (c, h, w): whichever is of the image's shape
            _, first, middle, last = raw.shape
            channels_last = (
                abs(first * width - middle * height) * last
                < abs(middle * width - last * height) * first
            )
            return raw[0] if channels_last else raw[0].transpose(1, 2, 0)
        if raw.ndim == 3 and raw.shape[0] == 1:
            h, w = height // self.patch, width // self.patch
            if raw.shape[1] in (h * w, h * w + 1):
                return raw[0, -h * w :].reshape(h, w, -1)
            raise InputError(
                f"{self.name}: gives {raw.shape[1]} patches for {w}x{h} of {self.patch} pixels; give its patch "
                "size"
            )
        raise InputError(f"{self.name}: its output is {raw.shape}, not an image of features")


class OnnxTextEncoder:
    """A network of token numbers (n, 77), with or without a mask of them: embeddings (n, c)."""

    def __init__(self, file: str, tokenizer: ClipTokenizer, device: str) -> None:
        self.name, self.tokenizer = f"onnx:{file}", tokenizer
        self.session = open_session(file, device)
        self.inputs = self.session.get_inputs()
        if not 1 <= len(self.inputs) <= 2 or any(
            len(i.shape) != 2 or i.type not in TOKEN_TYPES for i in self.inputs
        ):
            raise InputError(
                f"{file}: takes {_described(self.inputs)}, not token numbers (n, 77) and at most their mask"
            )
        length = self.inputs[0].shape[1]
        self.length = length if isinstance(length, int) else TEXT_LENGTH
        self.batch = self.inputs[0].shape[0] if isinstance(self.inputs[0].shape[0], int) else None

    def text_features(self, texts: Sequence[str]) -> NDArray[np.float32]:
        """(n, c), unit length."""
        tokens = self.tokenizer(texts, self.length)
        step = self.batch or len(texts)
        found = []
        for first in range(0, len(texts), step):
            part = tokens[first : first + step]
            padded = np.concatenate([part, np.repeat(part[-1:], step - len(part), axis=0)])
            feeds = {
                i.name: (padded if k == 0 else padded != 0).astype(TOKEN_TYPES[i.type])
                for k, i in enumerate(self.inputs)
            }
            raw = run_session(
                self.session, feeds, failure=f"{self.name}: fails on {len(part)} texts"
            )
            found.append(raw[: len(part)])
        vectors = np.concatenate(found)
        if vectors.ndim != 2 or not np.isfinite(vectors).all():
            raise InputError(
                f"{self.name}: gives {vectors.shape} {'with numbers that are not finite' * (vectors.ndim == 2)}, "
                "not one embedding a text"
            )
        return unit_length(vectors)


def onnx_image_encoder(
    file: str,
    *,
    mean: Sequence[float] = NORMALIZATION["clip"][0],
    std: Sequence[float] = NORMALIZATION["clip"][1],
    size: tuple[int, int] | None = None,
    patch: int = 16,
    device: str = "auto",
) -> OnnxImageEncoder:
    """Image encoder in an ONNX file; `size` (width, height) where it leaves that open, `patch`
    where it gives patches.
    """
    if len(mean) != 3 or len(std) != 3 or min(std) <= 0 or patch < 1:
        raise InputError(
            f"onnx: needs three means, three positive stds and a positive patch, got {mean}, {std}, {patch}"
        )
    return OnnxImageEncoder(file, mean, std, size, patch, device)


def onnx_text_encoder(
    file: str, *, tokenizer: str | Path | None = None, device: str = "auto"
) -> OnnxTextEncoder:
    """Text encoder in an ONNX file; `tokenizer` is CLIP's list of merges."""
    if tokenizer is None:
        raise InputError(
            f"onnx:{file}: give CLIP's merges with --tokenizer (bpe_simple_vocab_16e6.txt.gz, or a model's "
            "merges.txt)"
        )
    return OnnxTextEncoder(file, ClipTokenizer(tokenizer), device)


def _described(inputs: Sequence[Any]) -> str:
    return ", ".join(f"{each.name} {each.shape} {each.type}" for each in inputs)
