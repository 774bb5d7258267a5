"""Arrays in HDF5 files, through h5py."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, MissingDependency
from .image_headers import MAX_PIXELS

NAME = "dataset"  # of the one array in a file, as Hypersim has it


def check_hdf5() -> None:
    """Raise MissingDependency without h5py."""
    try:
        import h5py  # noqa: F401
    except ImportError:
        raise MissingDependency(
            "HDF5 files are read with h5py; run: pip install 'taichi-unifusion[phone]'"
        ) from None


def read_hdf5(path: Path, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
    """The array in the file, of that shape; None: any size. FrameError where there is none."""
    import h5py

    if not os.path.exists(path):
        raise FrameError(f"{path}: no such file")
    try:
        with h5py.File(path, "r") as file:
            found = file[NAME]
            if not isinstance(found, h5py.Dataset) or not (found.size or 0) <= MAX_PIXELS:
                raise FrameError(f"{path}: '{NAME}' is no array of at most {MAX_PIXELS} numbers")
            array = np.asarray(found[()], np.float64)
    except FrameError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged file gives errors of any type
        raise FrameError(f"{path}: not a readable HDF5 file ({str(error)[:80]})") from None
    wanted = len(shape) == array.ndim and all(
        side is None or side == own for side, own in zip(shape, array.shape, strict=True)
    )
    if not wanted or not array.size:
        raise FrameError(f"{path}: holds {array.shape}, expected {shape}")
    return array
