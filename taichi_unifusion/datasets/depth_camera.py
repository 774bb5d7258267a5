"""The camera of depth images: from intrinsics in text files, checked against the images."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from ..errors import DatasetError, InputError
from ..files.text_rows import parse_numbers, read_lines, split_row
from ..types import PinholeCamera


class Intrinsics(NamedTuple):
    """fx fy cx cy [pixels] of depth images, whatever size these have."""

    fx: float
    fy: float
    cx: float
    cy: float


def make_camera(
    source: str, size: tuple[int, int], fx: float, fy: float, cx: float, cy: float
) -> PinholeCamera:
    """The camera for depth images of `size` (width, height); an impossible one is a DatasetError
    naming its `source`.
    """
    try:
        return PinholeCamera(*size, float(fx), float(fy), float(cx), float(cy))
    except InputError as error:
        raise DatasetError(f"{source}: {error}") from error


def read_matrix_camera(path: Path, size: tuple[int, int]) -> PinholeCamera:
    """The camera whose matrix K fills the file as 3x3 or in the corner of a 4x4, row-major."""
    words = [word for _, line in read_lines(path) for word in split_row(line)]
    if len(words) not in (9, 16):
        raise DatasetError(
            f"{path}: expected a 3x3 or 4x4 intrinsic matrix, found {len(words)} numbers"
        )
    side = 3 if len(words) == 9 else 4
    K = np.array(parse_numbers(words, str(path))).reshape(side, side)
    return make_camera(str(path), size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])


def check_size(
    camera: PinholeCamera | Intrinsics, size: tuple[int, int], source: str
) -> PinholeCamera:
    """The camera, if it is for depth images of `size` (width, height), as bare intrinsics are; else
    DatasetError.
    """
    if isinstance(camera, Intrinsics):
        return make_camera("intrinsics", size, *camera)
    if camera.size != size:
        raise DatasetError(
            f"{source}: the intrinsics are for {camera.width}x{camera.height} images but the depth images are "
            f"{size[0]}x{size[1]}; give the depth camera's own: --intrinsics, or in Python camera=PinholeCamera(...)"
        )
    return camera
