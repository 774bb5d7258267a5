"""Images as networks take them: resized, normalised, in the type and order of axes of their input."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..errors import InputError, check_choice

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
FLOATS: Mapping[str, DTypeLike] = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
NUMBERS: Mapping[str, DTypeLike] = {**FLOATS, "tensor(uint8)": np.uint8}
MAX_SIDE = 8192  # pixels of a network's input


def check_normalization(
    scale: float, mean: Sequence[float], std: Sequence[float], order: str
) -> None:
    """Raise InputError where these are not what `normalized` takes."""
    check_choice("order", order, ("rgb", "bgr"))
    if len(mean) != 3 or len(std) != 3 or not scale > 0 or not min(std) > 0:
        raise InputError(
            f"network: needs scale above 0, three means and three positive stds, got {scale}, {mean}, {std}"
        )


def normalized(
    color: NDArray[np.uint8],
    mean: Sequence[float],
    std: Sequence[float],
    scale: float = 1.0,
    order: str = "rgb",
) -> NDArray[np.float32]:
    """Colours (H, W, 3) as 0..`scale`, less `mean`, by `std` (of the channels in the order given)."""
    image = color if order == "rgb" else color[..., ::-1]
    scaled = image.astype(np.float32) / np.float32(255 / scale)
    return (scaled - np.asarray(mean, np.float32)) / np.asarray(std, np.float32)


def resized(image: NDArray, size: tuple[int, int], enlarge: int = cv2.INTER_CUBIC) -> NDArray:
    """An image (H, W, c) of `size` (width, height): means over pixels where it becomes smaller,
    else interpolated as `enlarge` says.
    """
    smaller = size[0] < image.shape[1]
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else enlarge)


def whole_patches(image: NDArray, short_side: int, patch: int) -> tuple[int, int]:
    """(width, height) with about the aspect of an image (H, W, ...) and this shorter side, both
    multiples of `patch` pixels.
    """
    scale = short_side / min(image.shape[:2])
    height, width = (max(round(side * scale / patch), 1) * patch for side in image.shape[:2])
    return width, height


@dataclass(frozen=True)
class ImageInput:
    """The only input of a network: one RGB image."""

    name: str
    dtype: DTypeLike
    channels_first: bool  # (1, 3, H, W) or (1, H, W, 3)
    size: tuple[int, int] | None  # (width, height) [pixels]; None: any will do

    def feed(self, image: NDArray) -> dict[str, NDArray]:
        """An image (H, W, 3) as the network takes it."""
        if self.dtype is np.uint8:
            image = np.clip(np.rint(image), 0, 255)
        batch = (image.transpose(2, 0, 1) if self.channels_first else image)[None]
        return {self.name: np.ascontiguousarray(batch, self.dtype)}


def find_image_input(
    session: InferenceSession,
    file: str | Path,
    size: tuple[int, int] | None,
    types: Mapping[str, DTypeLike],
) -> ImageInput:
    """The input of a network that takes one RGB image, of one of `types` and of `size` (width,
    height) where the network leaves that open. Raises InputError where it takes something else.
    """
    inputs = session.get_inputs()
    if len(inputs) != 1:
        names = ", ".join(item.name for item in inputs)
        raise InputError(f"{file}: takes {len(inputs)} inputs ({names}), not one image")
    (wanted,) = inputs
    # open dimensions bear names
    shape = [side if isinstance(side, int) else None for side in wanted.shape]
    at = f"{file}: its input '{wanted.name}' is {wanted.shape} {wanted.type}"
    if (
        len(shape) != 4
        or shape[0] not in (1, None)
        or 3 not in (shape[1], shape[3])
        and shape[1] is not None
    ):
        raise InputError(f"{at}, not one RGB image (1, 3, H, W) or (1, H, W, 3)")
    if wanted.type not in types:
        raise InputError(f"{at}; types that an image can have are {', '.join(types)}")
    channels_first = shape[3] != 3 or shape[1] == 3
    height, width = shape[2:] if channels_first else shape[1:3]
    if size is not None and not all(8 <= side <= MAX_SIDE for side in size):
        raise InputError(f"size: must lie in 8..{MAX_SIDE} pixels, got {size[0]}x{size[1]}")
    if size is not None and (width not in (size[0], None) or height not in (size[1], None)):
        raise InputError(f"{at}, so its size is fixed, and size={size[0]}x{size[1]} does not fit")
    if width is not None and height is not None:
        size = width, height
    return ImageInput(wanted.name, types[wanted.type], channels_first, size)
