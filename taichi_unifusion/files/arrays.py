"""Arrays that NumPy or torch wrote: read whole, or plane by plane where they are large. No pickle
is ever run.
"""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib.npyio import NpzFile
from numpy.typing import NDArray

from ..errors import FileError, InputError, MissingDependency
from .atomic import read_bytes

POINT_FEATURES = ("feat", "mask_full")  # names in OpenScene's files


def read_array(path: str | os.PathLike[str]) -> NDArray[Any]:
    """The array in a .npy file; raises FileError where it is missing, damaged or holds objects,
    InputError for an archive of several.
    """
    array = _load(path)
    if isinstance(array, np.ndarray):
        return array
    raise InputError(f"{path}: holds an archive of arrays, expected one array")


def read_archive(path: str | os.PathLike[str]) -> NpzFile:
    """The arrays in a .npz file by name, each read when asked for; errors as in `read_array`."""
    archive = _load(path)
    if isinstance(archive, NpzFile):
        return archive
    raise InputError(f"{path}: holds one array without a name, expected an archive of arrays")


def _load(path: str | os.PathLike[str]) -> NDArray[Any] | NpzFile:
    try:
        return np.load(io.BytesIO(read_bytes(path)), allow_pickle=False)
    except (ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileError(
            f"{path}: not an array that NumPy wrote, or a damaged file ({str(error)[:120]})"
        ) from None


@contextmanager
def open_planes(path: Path) -> Iterator[tuple[tuple[int, ...], Iterator[NDArray[Any]]]]:
    """Shape of the one array in a .npy, .npz or .pt file, and its slices along the first axis, read
    one after the other, so that never all of it is in memory.

    Raises FileError where the file is missing, damaged or would run code, InputError where it is
    not one array of floating-point numbers.
    """
    try:
        if path.suffix == ".pt":
            array = _open_torch(path)
            yield tuple(array.shape), (array[i].float().numpy() for i in range(array.shape[0]))
        elif path.suffix == ".npz":
            with zipfile.ZipFile(path) as archive:
                members = [name for name in archive.namelist() if name.endswith(".npy")]
                if len(members) != 1:
                    raise InputError(f"{path}: holds {len(members)} arrays, expected one")
                with archive.open(members[0]) as file:
                    yield _stream(path, file)
        else:
            with open(path, "rb") as file:
                yield _stream(path, file)
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except (zipfile.BadZipFile, OSError, EOFError) as error:
        if isinstance(error, FileError):
            raise
        raise FileError(f"{path}: a damaged file ({str(error)[:120]})") from None


def _stream(path: Path, file: IO[bytes]) -> tuple[tuple[int, ...], Iterator[NDArray[Any]]]:
    """Header and slices of an array in NumPy's format."""
    try:
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = read(file)
    except ValueError as error:
        raise FileError(f"{path}: not an array that NumPy wrote ({str(error)[:120]})") from None
    if dtype.kind != "f" or fortran:
        raise InputError(
            f"{path}: expected floating-point numbers in C order, got {dtype}"
            f"{' in Fortran order' * fortran}; a pickle is never read"
        )
    return shape, _slices(path, file, shape, dtype)


def _slices(
    path: Path, file: IO[bytes], shape: tuple[int, ...], dtype: np.dtype[Any]
) -> Iterator[NDArray[Any]]:
    size = int(np.prod(shape[1:])) * dtype.itemsize
    for _ in range(shape[0]):
        data = file.read(size)
        if len(data) < size:
            raise FileError(f"{path}: the file ends early; it was cut off")
        yield np.frombuffer(data, dtype).reshape(shape[1:])


def read_point_features(
    path: Path,
) -> tuple[NDArray[np.floating[Any]], NDArray[np.bool_] | None]:
    """Features (M, c) of points, and which (N,) of all points these M are, None: all.

    A .npy holds features of all points; a .npz or .pt, as OpenScene has it, `feat` (M, c) and
    `mask_full` (N,). Raises as `open_planes`.
    """
    mask = None
    if path.suffix == ".pt":
        stored = _load_torch(path)
        if isinstance(stored, dict):
            values = [stored[name] for name in POINT_FEATURES if hasattr(stored.get(name), "numpy")]
            if len(values) < len(POINT_FEATURES):
                raise InputError(f"{path}: expected tensors {' and '.join(POINT_FEATURES)} in it")
            features, mask = (value.numpy() for value in values)
        else:
            features = stored.numpy() if hasattr(stored, "numpy") else None
    elif path.suffix == ".npz":
        archive = read_archive(path)
        if not set(POINT_FEATURES) <= set(archive.files):
            raise InputError(f"{path}: must hold arrays {' and '.join(POINT_FEATURES)}")
        try:
            features, mask = (archive[name] for name in POINT_FEATURES)
        except (ValueError, zipfile.BadZipFile) as error:
            raise FileError(f"{path}: a damaged file, or Python objects ({error})") from None
    else:
        features = read_array(path)
    if features is not None and features.ndim == 3 and features.shape[2] == 1:
        features = features[..., 0]  # as OpenScene's first files have it
    if features is None or features.ndim != 2 or features.dtype.kind != "f":
        raise InputError(f"{path}: features of points must be (M, c) floating-point numbers")
    if mask is not None and (mask.ndim != 1 or mask.dtype != bool or mask.sum() != len(features)):
        raise InputError(
            f"{path}: its mask must say which points the {len(features)} features are of"
        )
    return features, mask


def _open_torch(path: Path) -> Any:
    """The one tensor in a file of torch."""
    array = _load_torch(path)
    if not hasattr(array, "is_floating_point") or not array.is_floating_point():
        raise InputError(
            f"{path}: holds {type(array).__name__}, expected one tensor of floating-point numbers"
        )
    return array.squeeze(0) if array.ndim == 4 and array.shape[0] == 1 else array


def _load_torch(path: Path) -> Any:
    """What a file of torch holds, mapped rather than read."""
    try:
        import torch  # pyright: ignore[reportMissingImports] - an extra, often not installed
    except ImportError:
        raise MissingDependency(
            f"{path}: .pt files are read by torch: pip install torch, or save .npy"
        ) from None
    if not path.exists():
        raise FileError(f"{path}: no such file")
    try:
        return torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # noqa: BLE001 - torch has a class of its own for every kind
        line = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
        raise FileError(
            f"{path}: not a tensor that torch reads safely, without running code ({line})"
        ) from None
