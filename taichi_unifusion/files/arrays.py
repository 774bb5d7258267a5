"""Arrays that NumPy or torch wrote: read whole, or plane by plane where they are large. No pickle
is ever run, and nothing is allocated that the file does not hold.
"""

from __future__ import annotations

import lzma
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, MissingDependency, UniFusionError, shortened
from .atomic import check_name, file_error

POINT_FEATURES = ("feat", "mask_full")  # names in OpenScene's files
MAX_BYTES = 4 << 30  # of an array that is read whole
# What is packed more than a hundredfold is no measurement; little of it does no harm.
MAX_RATIO, HARMLESS_BYTES = 100, 16 << 20
MAX_DIMENSIONS = 8
MAX_MEMBERS = 10_000  # arrays in an archive
_DAMAGE = (  # what Python's readers of archives raise for one that is damaged, or of a kind they lack
    zipfile.BadZipFile,
    zlib.error,
    lzma.LZMAError,
    EOFError,
    OSError,
    NotImplementedError,
    RuntimeError,
    struct.error,
    UnicodeDecodeError,  # names of members
)


@dataclass(frozen=True)
class _Header:
    """What a file in NumPy's format says of its array."""

    shape: tuple[int, ...]
    fortran: bool
    dtype: np.dtype[Any]

    @property
    def bytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize


def read_array(path: str | os.PathLike[str]) -> NDArray[Any]:
    """The array in a .npy file; raises FileError where it is missing, damaged, holds objects or
    promises more than it holds, InputError for an archive of several.
    """
    with _open(Path(path)) as file:
        if file.read(2) == b"PK":
            raise InputError(f"{path}: holds an archive of arrays, expected one array")
        file.seek(0)
        return _read_whole(path, file, os.fstat(file.fileno()).st_size)


def read_archive(path: str | os.PathLike[str], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """The arrays of these names in a .npz file; others are not read.

    Raises FileError as `read_array`, also for what is packed so tightly that it would fill the memory,
    InputError where the file is one array without a name or lacks one of the names.
    """
    with _open(Path(path)) as file:
        if file.read(6) == np.lib.format.MAGIC_PREFIX:
            raise InputError(
                f"{path}: holds one array without a name, expected an archive of arrays"
            )
        members = _members(path, file)
        if not set(names) <= set(members):
            raise InputError(
                f"{path}: must hold arrays {' and '.join(names)}, it holds "
                f"{', '.join(list(members)[:8]) or 'none'}"
            )
        with zipfile.ZipFile(file) as archive:
            arrays = {}
            for name in names:
                with archive.open(members[name]) as member:
                    arrays[name] = _read_whole(path, member, members[name].file_size)
            return arrays


@contextmanager
def open_planes(path: Path) -> Iterator[tuple[tuple[int, ...], Iterator[NDArray[Any]]]]:
    """Shape of the one array in a .npy, .npz or .pt file, and its slices along the first axis, read
    one after the other, so that never all of it is in memory.

    Raises FileError where the file is missing, damaged, packed too tightly or would run code,
    InputError where it is not one array of floating-point numbers.
    """
    if path.suffix == ".pt":
        array = _open_torch(path)
        yield tuple(array.shape), (array[i].float().numpy() for i in range(array.shape[0]))
        return
    with _open(path) as file:
        if path.suffix == ".npz":
            members = _members(path, file)
            if len(members) != 1:
                raise InputError(f"{path}: holds {len(members)} arrays, expected one")
            (info,) = members.values()
            with zipfile.ZipFile(file) as archive, archive.open(info) as member:
                yield _stream(path, member, info.file_size)
        else:
            yield _stream(path, file, os.fstat(file.fileno()).st_size)


@contextmanager
def _open(path: Path) -> Iterator[IO[bytes]]:
    """The open file; what a damaged one makes its readers raise becomes a FileError."""
    check_name(path)
    if path.exists() and not path.is_file():
        raise FileError(f"{path}: is not a regular file")
    try:
        with open(path, "rb") as file:
            yield file
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except UniFusionError:
        raise
    except OSError as error:
        if error.errno is not None:
            raise file_error("read", path, error) from error
        raise FileError(
            f"{path}: not an array that NumPy wrote, or a damaged file ({str(error)[:120]})"
        ) from None
    except _DAMAGE as error:
        raise FileError(
            f"{path}: not an array that NumPy wrote, or a damaged file ({str(error)[:120]})"
        ) from None


def _members(path: str | os.PathLike[str], file: IO[bytes]) -> dict[str, zipfile.ZipInfo]:
    """The arrays in an archive by name, as its directory has them; none is unpacked."""
    with zipfile.ZipFile(file) as archive:
        infos = archive.infolist()
    if len(infos) > MAX_MEMBERS:
        raise FileError(f"{path}: holds {len(infos)} files, more than any archive of arrays")
    members: dict[str, zipfile.ZipInfo] = {}
    for info in infos:
        if info.file_size > max(HARMLESS_BYTES, MAX_RATIO * info.compress_size):
            raise FileError(
                f"{path}: '{info.filename[:80]}' would unpack to {info.file_size / 1e6:.0f} MB, more than "
                f"{MAX_RATIO} times its size in the file; it was not read"
            )
        if not info.filename.endswith(".npy"):
            continue
        if members.setdefault(info.filename[:-4], info) is not info:
            raise FileError(f"{path}: holds two arrays of the name '{info.filename[:80]}'")
    return members


def _read_header(path: str | os.PathLike[str], file: IO[bytes], size: int) -> _Header:
    """The header of an array, of a file or member of `size` bytes that really holds it."""
    try:
        version = np.lib.format.read_magic(file)
        read = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        header = _Header(*read(file))
    except _DAMAGE:
        raise
    except Exception as error:  # noqa: BLE001 - NumPy parses the header as Python: any error escapes
        raise FileError(f"{path}: not an array that NumPy wrote ({str(error)[:120]})") from None
    if header.dtype.hasobject:
        raise FileError(
            f"{path}: holds Python objects, a pickle, which can run code when it is read; it was not "
            "read: save numbers or text"
        )
    shape = header.shape
    if len(shape) > MAX_DIMENSIONS or min(shape, default=0) < 0 or header.bytes > size:
        raise FileError(
            f"{path}: the header says {header.shape} {header.dtype}, more than the {size} bytes there are; "
            "it was cut off or damaged"
        )
    return header


def _read_whole(path: str | os.PathLike[str], file: IO[bytes], size: int) -> NDArray[Any]:
    """The array in a file or member of `size` bytes."""
    header = _read_header(path, file, size)
    if header.bytes > MAX_BYTES:
        raise FileError(
            f"{path}: holds {header.bytes / 1e9:.1f} GB, more than the {MAX_BYTES / 1e9:.1f} GB that "
            "are read at once; save fewer rows or half precision"
        )
    if not header.bytes:
        return np.empty(header.shape, header.dtype)
    array = np.empty(header.shape, header.dtype, order="F" if header.fortran else "C")
    buffer = array.reshape(-1, order="A").view(np.uint8).data
    at = 0
    while at < len(buffer) and (data := file.read(min(len(buffer) - at, 1 << 24))):
        buffer[at : at + len(data)] = data
        at += len(data)
    if at < len(buffer):
        raise FileError(f"{path}: the file ends early; it was cut off")
    return array


def _stream(
    path: Path, file: IO[bytes], size: int
) -> tuple[tuple[int, ...], Iterator[NDArray[Any]]]:
    """Header and slices of an array in NumPy's format."""
    header = _read_header(path, file, size)
    if header.dtype.kind != "f" or header.fortran:
        raise InputError(
            f"{path}: expected floating-point numbers in C order, got {header.dtype}"
            f"{' in Fortran order' * header.fortran}; a pickle is never read"
        )
    return header.shape, _slices(path, file, header.shape, header.dtype)


def _slices(
    path: Path, file: IO[bytes], shape: tuple[int, ...], dtype: np.dtype[Any]
) -> Iterator[NDArray[Any]]:
    size = math.prod(shape[1:]) * dtype.itemsize
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
            tensors = {key: _in_numpy(each) for key, each in stored.items() if _is_tensor(each)}
            if not set(POINT_FEATURES) <= set(tensors):
                raise InputError(
                    f"{path}: expected tensors {' and '.join(POINT_FEATURES)} in it, found "
                    f"{shortened(', '.join(map(str, tensors)) or 'none')}"
                )
            features, mask = (tensors[name] for name in POINT_FEATURES)
        else:
            features = _in_numpy(stored) if _is_tensor(stored) else None
    elif path.suffix == ".npz":
        features, mask = read_archive(path, POINT_FEATURES).values()
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
    except Exception:  # noqa: BLE001 - torch has a class of its own for every kind
        why = "it holds more than plain tensors, whose reading could run code, or is damaged"
        if not zipfile.is_zipfile(path):
            why = "it is damaged, or from before torch 1.6"
        raise FileError(
            f"{path}: torch does not read it as tensors: {why}; save the tensors alone, with torch.save"
        ) from None


def _is_tensor(value: Any) -> bool:
    return hasattr(value, "numpy")


def _in_numpy(tensor: Any) -> NDArray[Any]:
    """A tensor of torch as an array; what NumPy has no type for in single precision."""
    return (tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor).numpy()
