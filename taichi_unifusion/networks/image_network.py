"""Image networks in ONNX files, run by onnxruntime: loaded once, checked when loaded and at every
frame.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FrameError, InputError
from ..files.atomic import read_bytes
from .image_input import NUMBERS, find_image_input, resized
from .onnx_session import open_session, run_session


class ImageNetwork:
    """A network that takes one image and gives one image of `channels` channels.

    `size` is the (width, height) of its input where the network leaves that open; without it an
    image keeps its own size. Raises FileError for a file that is missing or no model, InputError
    where the model is not of that kind, MissingDependency without onnxruntime.
    """

    def __init__(
        self,
        file: str | Path,
        *,
        channels: int,
        size: tuple[int, int] | None = None,
        output: str = "",
        device: str = "auto",
        sha256: str = "",
    ) -> None:
        self.file, self.channels = Path(file), channels
        if (
            sha256
            and (found := hashlib.sha256(read_bytes(self.file)).hexdigest()) != sha256.lower()
        ):
            raise FileError(
                f"{file}: has the SHA-256 {found}, not {sha256}; download the model again"
            )
        self.session = open_session(self.file, device)
        self.input = find_image_input(self.session, file, size, NUMBERS)
        names = [item.name for item in self.session.get_outputs()]
        if output and output not in names:
            raise InputError(f"{file}: has no output '{output}'; outputs: {', '.join(names)}")
        self.output = output or names[0]

    def __call__(self, image: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
        """The network's output for an image (H, W, 3), resized to `shape` (height, width) and
        `channels` channels.

        Raises FrameError where the output is not finite, InputError where the network does not give
        an image.
        """
        if self.input.size is not None and self.input.size != image.shape[1::-1]:
            image = resized(image, self.input.size, enlarge=cv2.INTER_LINEAR)
        failure = (
            f"{self.file}: fails on an image of {image.shape[1]}x{image.shape[0]}; if it needs another, say "
            "size=WIDTHxHEIGHT"
        )
        raw = run_session(self.session, self.input.feed(image), self.output, failure=failure)
        values = self._as_image(raw)
        if not np.isfinite(values).all():
            raise FrameError(
                f"{self.file} gives {np.mean(~np.isfinite(values)):.0%} NaN or infinite values"
            )
        if values.shape[:2] != shape:
            values = np.asarray(
                cv2.resize(values, shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32
            )
        return values.reshape(*shape, self.channels)

    def _as_image(self, raw: NDArray) -> NDArray[np.float32]:
        """The output as (h, w, channels), from (1, c, h, w), (1, h, w, c), or without the 1s."""
        values = raw[0] if raw.ndim == 4 and raw.shape[0] == 1 else raw
        if self.channels == 1 and raw.ndim in (2, 3) and (raw.ndim == 2 or raw.shape[0] == 1):
            values = raw.reshape(1, *raw.shape[-2:])
        if values.ndim == 3 and values.dtype.kind in "fu" and min(values.shape) > 0:
            if values.shape[0] == self.channels:
                return np.ascontiguousarray(values.transpose(1, 2, 0), np.float32)
            if values.shape[2] == self.channels:
                return np.ascontiguousarray(values, np.float32)
        raise InputError(
            f"{self.file}: its output '{self.output}' is {raw.shape} {raw.dtype}, not an image of {self.channels} "
            f"channel{'s' * (self.channels > 1)}; outputs: "
            f"{', '.join(item.name for item in self.session.get_outputs())}"
        )
