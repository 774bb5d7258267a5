"""Image networks in ONNX files, run by onnxruntime: loaded once, checked when loaded and at every
frame.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FrameError, InputError, check_choice
from ..files.atomic import read_bytes
from .onnx_session import open_session, run_session

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
INPUT_TYPES = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(uint8)": np.uint8,
}
MAX_SIDE = 8192  # pixels of a network's input


def check_preparation(
    scale: float, mean: Sequence[float], std: Sequence[float], order: str
) -> None:
    """Raise InputError where these are not what `prepare` takes."""
    check_choice("order", order, ("rgb", "bgr"))
    if len(mean) != 3 or len(std) != 3 or not scale > 0 or not min(std) > 0:
        raise InputError(
            f"network: needs scale above 0, three means and three positive stds, got {scale}, {mean}, {std}"
        )


def prepare(
    color: NDArray[np.uint8], scale: float, mean: Sequence[float], std: Sequence[float], order: str
) -> NDArray[np.float32]:
    """Colours (H, W, 3) as 0..`scale`, less `mean`, by `std` (of the channels in the order given)."""
    image = color if order == "rgb" else color[..., ::-1]
    return (image * np.float32(scale / 255) - np.float32(mean)) / np.float32(std)


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
        self.input, self.channels_first, self.size = self._check_input(size)
        names = [item.name for item in self.session.get_outputs()]
        if output and output not in names:
            raise InputError(f"{file}: has no output '{output}'; outputs: {', '.join(names)}")
        self.output = output or names[0]

    def _check_input(
        self, size: tuple[int, int] | None
    ) -> tuple[Any, bool, tuple[int, int] | None]:
        """The input, whether its channels come before rows and columns, and its (width, height),
        None if any will do.
        """
        inputs = self.session.get_inputs()
        if len(inputs) != 1:
            names = ", ".join(item.name for item in inputs)
            raise InputError(f"{self.file}: takes {len(inputs)} inputs ({names}), not one image")
        (wanted,) = inputs
        # open dimensions bear names
        shape = [dim if isinstance(dim, int) else None for dim in wanted.shape]
        at = f"{self.file}: its input '{wanted.name}' is {wanted.shape} {wanted.type}"
        if (
            len(shape) != 4
            or shape[0] not in (1, None)
            or 3 not in (shape[1], shape[3])
            and shape[1] is not None
        ):
            raise InputError(f"{at}, not one RGB image (1, 3, H, W) or (1, H, W, 3)")
        if wanted.type not in INPUT_TYPES:
            raise InputError(f"{at}; types that an image can have are {', '.join(INPUT_TYPES)}")
        channels_first = shape[3] != 3 or shape[1] == 3
        height, width = shape[2:] if channels_first else shape[1:3]
        if size is not None and not all(8 <= side <= MAX_SIDE for side in size):
            raise InputError(f"size: must lie in 8..{MAX_SIDE} pixels, got {size[0]}x{size[1]}")
        if size is not None and (width not in (size[0], None) or height not in (size[1], None)):
            raise InputError(
                f"{at}, so its size is fixed, and size={size[0]}x{size[1]} does not fit"
            )
        if width is not None and height is not None:
            size = width, height
        return wanted, channels_first, size

    def __call__(self, image: NDArray[np.float32], shape: tuple[int, int]) -> NDArray[np.float32]:
        """The network's output for an image (H, W, 3), resized to `shape` (height, width) and
        `channels` channels.

        Raises FrameError where the output is not finite, InputError where the network does not give
        an image.
        """
        if self.size is not None and self.size != image.shape[1::-1]:
            smaller = self.size[0] < image.shape[1]
            image = cv2.resize(
                image, self.size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR
            )
        dtype = INPUT_TYPES[self.input.type]
        if dtype is np.uint8:
            image = np.clip(np.rint(image), 0, 255)
        tensor = np.ascontiguousarray(
            (image.transpose(2, 0, 1) if self.channels_first else image)[None], dtype
        )
        failure = (
            f"{self.file}: fails on an image of {image.shape[1]}x{image.shape[0]}; if it needs another, say "
            "size=WIDTHxHEIGHT"
        )
        values = self._as_image(
            np.asarray(
                run_session(self.session, {self.input.name: tensor}, self.output, failure=failure)
            )
        )
        if not np.isfinite(values).all():
            raise FrameError(
                f"{self.file} gives {np.mean(~np.isfinite(values)):.0%} NaN or infinite values"
            )
        if values.shape[:2] != shape:
            values = cv2.resize(values, shape[::-1], interpolation=cv2.INTER_LINEAR)
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
