"""Features computed before, by any program: one file a frame, read in strips and made small on the
way.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FrameError, InputError, MissingDependency, check_choice
from ..files.frame_files import FrameFolder, files_by_stem
from ..networks.encoders import unit_length
from ..types import Frame

SUFFIXES = (".npy", ".npz", ".pt")
LONGEST_SIDE = 96  # pixels of a feature image; more only repeats what the networks made
# of image-text networks, to tell (h, w, c) from (c, h, w)
USUAL_CHANNELS = (512, 640, 768, 1024, 1152, 1280)
MAX_SIDE, MAX_CHANNELS = 16384, 8192


@dataclass(frozen=True)
class FolderFeatures:
    """Features of frames by the frame's file name, or by its number."""

    name: str
    files: FrameFolder
    layout: Literal["auto", "hwc", "chw"] = "auto"

    def image_features(self, frame: Frame) -> NDArray[np.float32]:
        """(h, w, c) unit length, no larger than LONGEST_SIDE; raises FrameError where there is no
        file or it is damaged.
        """
        path = self.files.file_of(frame.name, frame.index)
        if path is None:
            raise FrameError(f"{self.name}: has no features for {frame.label}")
        try:
            return unit_length(read_features(path, self.layout))
        except (FileError, InputError) as error:
            raise FrameError(str(error)) from error


def folder_features(
    folder: str | Path, *, layout: Literal["auto", "hwc", "chw"] = "auto"
) -> FolderFeatures:
    """The feature files in a folder; raises FileError where there are none."""
    folder = Path(folder)
    check_choice("layout", layout, ("auto", "hwc", "chw"))
    if not folder.is_dir():
        raise FileError(f"{folder}: no such folder")
    files = files_by_stem(folder, SUFFIXES)
    if not files:
        raise FileError(f"{folder}: no *{', *'.join(SUFFIXES)} here")
    return FolderFeatures(str(folder), FrameFolder(folder, files), layout)


def read_features(path: Path, layout: str = "auto") -> NDArray[np.float32]:
    """Mean features (h, w, c) of the blocks of a stored array (H, W, c) or (c, H, W); at no time is
    all of it in memory.

    Raises FileError where the file is missing, damaged or would run code, InputError where it holds
    something else.
    """
    with _planes(path) as (shape, planes):
        if len(shape) == 4 and shape[0] == 1:
            raise InputError(f"{path}: has a batch axis, shape {shape}; save the one image alone")
        if len(shape) != 3 or not all(0 < n <= MAX_SIDE for n in shape):
            raise InputError(f"{path}: features must be (H, W, c) or (c, H, W), got {shape}")
        if layout == "auto":
            layout = (
                "chw" if shape[0] in USUAL_CHANNELS and shape[2] not in USUAL_CHANNELS else "hwc"
            )
        height, width, channels = shape if layout == "hwc" else (*shape[1:], shape[0])
        if channels > MAX_CHANNELS:
            raise InputError(
                f"{path}: {channels} channels; is the layout another one than {layout}?"
            )
        block = -(-max(height, width) // LONGEST_SIDE)
        h, w = max(height // block, 1), max(width // block, 1)
        small = np.zeros((h, w, channels), np.float32)
        if layout == "chw":
            for c, plane in enumerate(planes):
                small[..., c] = _block_mean(_block_mean(plane, h).T, w).T
            return small
        rows = []
        for i, plane in enumerate(planes):  # strips of `block` rows
            rows.append(_block_mean(plane, w))
            first = min(i * h // height, h - 1)
            if i == height - 1 or min((i + 1) * h // height, h - 1) != first:
                small[first] = np.mean(rows, axis=0)
                rows = []
        return small


def _block_mean(values: NDArray, count: int) -> NDArray[np.float32]:
    """Means over `count` runs of rows of (n, ...)."""
    starts = np.arange(count) * len(values) // count
    sums = np.add.reduceat(values.astype(np.float32), starts, axis=0)
    lengths = np.diff([*starts, len(values)]).astype(np.float32)
    return sums / lengths.reshape(-1, *[1] * (values.ndim - 1))


@contextmanager
def _planes(path: Path) -> Iterator[tuple[tuple[int, ...], Iterator[NDArray]]]:
    """Shape of the one array in a file, and its slices along the first axis, read one after the
    other.
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


def _stream(path: Path, file: BinaryIO) -> tuple[tuple[int, ...], Iterator[NDArray]]:
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
            f"{path}: features must be floating-point numbers in C order, got {dtype}"
            f"{' in Fortran order' * fortran}; a pickle is never read"
        )
    return shape, _slices(path, file, shape, dtype)


def _slices(
    path: Path, file: BinaryIO, shape: tuple[int, ...], dtype: np.dtype
) -> Iterator[NDArray]:
    size = int(np.prod(shape[1:])) * dtype.itemsize
    for _ in range(shape[0]):
        data = file.read(size)
        if len(data) < size:
            raise FileError(f"{path}: the file ends early; it was cut off")
        yield np.frombuffer(data, dtype).reshape(shape[1:])


def _open_torch(path: Path):
    try:
        import torch
    except ImportError:
        raise MissingDependency(
            f"{path}: .pt files are read by torch: pip install 'taichi-unifusion[clip]', or save "
            ".npy"
        ) from None
    if not path.exists():
        raise FileNotFoundError
    try:
        array = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except Exception as error:  # noqa: BLE001 - torch has a class of its own for every kind
        line = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
        raise FileError(
            f"{path}: not a tensor that torch reads safely, without running code ({line})"
        ) from None
    if not isinstance(array, torch.Tensor) or not array.is_floating_point():
        raise InputError(
            f"{path}: holds {type(array).__name__}, expected one tensor of floating-point numbers"
        )
    return array.squeeze(0) if array.ndim == 4 and array.shape[0] == 1 else array
