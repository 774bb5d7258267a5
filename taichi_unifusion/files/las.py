"""Coloured points as LAS 1.2, or compressed as LAZ, by laspy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingDependency
from .atomic import atomic_write

UNIT = 1e-4  # [m] of the whole numbers that LAS holds: 215 km each way
WITH_COLOR = 2  # point format
WIDER = 257  # from 8 bits a channel to 16


def write_las(path: Path, points: NDArray, colors: NDArray[np.uint8] | None) -> None:
    """Write points (N, 3) [m], with colours (N, 3) sRGB if there are any, to `.las` or `.laz`.

    Raises FileError where that fails, MissingDependency without laspy.
    """
    try:
        import laspy
    except ImportError:
        raise MissingDependency(
            f"{path}: LAS is written by laspy: pip install 'taichi-unifusion[las]'"
        ) from None
    header = laspy.LasHeader(point_format=WITH_COLOR if colors is not None else 0, version="1.2")
    header.generating_software = "taichi_unifusion"
    header.scales = np.full(3, UNIT)
    header.offsets = np.floor(points.min(axis=0)) if len(points) else np.zeros(3)
    las = laspy.LasData(header)
    las.x, las.y, las.z = np.asarray(points, np.float64).T
    if colors is not None:
        las.red, las.green, las.blue = colors.T.astype(np.uint16) * WIDER
    with atomic_write(path) as temporary, open(temporary, "w+b") as file:
        las.write(file, do_compress=path.suffix.lower() == ".laz")
