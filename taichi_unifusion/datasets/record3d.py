"""Record3D (iPhone and iPad): an `.r3d` file, or the folder of its "EXR + RGB" export.

`NAME.r3d` is a ZIP of `metadata` (JSON), `rgbd/N.jpg`, `rgbd/N.depth` (LZFSE of float32 metres) and,
from newer versions, `rgbd/N.conf` (LZFSE of bytes 0, 1, 2: how sure the phone is). The export is
`EXR_RGBD/` with `metadata.json`, `rgb/N.jpg` and `depth/N.exr`. Intrinsics: `K` of the metadata, by
columns, for images of `w` x `h`; `perFrameIntrinsicCoeffs` (fx fy cx cy) where there are any. Depth
is `dw` x `dh`, smaller, of the same view. Poses: `poses`, rows qx qy qz qw tx ty tz, camera to world
in metres with ARKit's axes (y up, z backward), turned to ours. `frameTimestamps` are seconds.
Portrait stays portrait. Frames are the numbers that have a depth image.
"""

from __future__ import annotations

import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError
from ..files.exr import check_exr, read_exr_depth
from ..files.frame_files import list_names, numbered_files
from ..files.image_headers import MAX_PIXELS
from ..files.images import decode_color, read_color
from ..files.lzfse import decompress
from ..files.strict_json import list_of, number, numbers, parse_object, read_object
from ..files.trajectories import Pose, poses_from_quaternions
from ..geometry.se3 import FLIP_YZ
from .depth_camera import make_camera
from .depth_registration import LensCamera
from .shared_view import ARKIT_UP, Confidence, SharedView, Shot

METADATA, EXPORT = "metadata", "EXR_RGBD"
# NotImplementedError, of RuntimeError: a compression that Python lacks
_UNREADABLE = (
    OSError,
    RuntimeError,
    ValueError,
    EOFError,
    struct.error,
    zipfile.BadZipFile,
    zlib.error,
)
MOST_BYTES = 1 << 28  # of a file in the archive
# [pixels] of depth by the bytes that it takes, where old metadata do not say
OLD_SIZES = {4 * 192 * 256: (192, 256), 4 * 480 * 640: (480, 640), 4 * 720 * 960: (720, 960)}


def open_record3d(
    path: Path,
    *,
    min_confidence: int = 1,
    weigh_confidence: bool = False,
    color_detail: int = 1,
) -> SharedView:
    """The frames of an `.r3d` file or of an export's folder."""
    confidence = Confidence(min_confidence, weigh_confidence)
    name, metadata, shots = _open_archive(path) if path.is_file() else _open_export(path)
    return SharedView(
        f"record3d {name}",
        shots,
        confidence=confidence,
        detail=color_detail,
        no_poses=metadata.no_poses,
        up=ARKIT_UP,
    )


@dataclass(frozen=True)
class Metadata:
    """What a recording says of all frames."""

    source: str
    values: Mapping[str, Any]
    lens: LensCamera
    depth_size: tuple[int, int] | None  # (width, height)
    poses: tuple[Pose, ...]
    stamps: tuple[float, ...]
    lenses: tuple[LensCamera, ...]  # of frames, if each has its own

    def lens_of(self, number: int) -> LensCamera:
        """The camera of a frame's colour image."""
        return self.lenses[number] if number < len(self.lenses) else self.lens

    def pose_of(self, number: int) -> Pose | None:
        """The pose of a frame; None where no frame has one."""
        if not self.poses:
            return None
        if number < len(self.poses):
            return self.poses[number]
        return Pose(
            f"{self.source}: frame {number}", problem=f"it has {len(self.poses)} poses only"
        )

    def stamp_of(self, number: int) -> float | None:
        """When a frame was taken [s]."""
        if number < len(self.stamps):
            return self.stamps[number]
        fps = self.values.get("fps")
        return number / fps if isinstance(fps, int | float) and 0 < fps < 1e6 else None

    @property
    def no_poses(self) -> str:
        """Why no frame has a pose; empty if some have."""
        return "" if self.poses else f"{self.source}: no 'poses' in it"


def _metadata(values: Mapping[str, Any], source: str) -> Metadata:
    width, height = (int(number(values, key, source)) for key in ("w", "h"))
    K = numbers(values.get("K"), (9,), f"{source}: K")
    lens = _lens(source, (width, height), K[[0, 4, 6, 7]])
    size = None
    if "dw" in values or "dh" in values:
        size = int(number(values, "dw", source)), int(number(values, "dh", source))
        if not (min(size) > 0 and size[0] * size[1] <= MAX_PIXELS):
            raise DatasetError(f"{source}: depth images of {size[0]}x{size[1]} make no sense")
    rows = list_of(values, "poses", source) if values.get("poses") else []
    stamps = list_of(values, "frameTimestamps", source) if values.get("frameTimestamps") else []
    own = values.get("perFrameIntrinsicCoeffs")
    return Metadata(
        source,
        values,
        lens,
        size,
        _poses(rows, source),
        tuple(numbers(stamps, (len(stamps),), f"{source}: frameTimestamps")),
        tuple(
            _lens(
                f"{source}: frame {i}", (width, height), numbers(each, (4,), f"{source}: frame {i}")
            )
            for i, each in enumerate(own if isinstance(own, list) else [])
        ),
    )


def _lens(source: str, size: tuple[int, int], intrinsics: NDArray[np.float64]) -> LensCamera:
    return LensCamera(make_camera(source, size, *intrinsics), ())


def _poses(rows: list[Any], source: str) -> tuple[Pose, ...]:
    """Poses of rows qx qy qz qw tx ty tz."""
    sources = [f"{source}: pose {i}" for i in range(len(rows))]
    read = [numbers(row, (7,), where) for row, where in zip(rows, sources, strict=True)]
    if not read:
        return ()
    every = np.stack(read)[:, [4, 5, 6, 0, 1, 2, 3]]
    return tuple(pose.turned(FLIP_YZ) for pose in poses_from_quaternions(every, sources))


def _open_archive(path: Path) -> tuple[Path, Metadata, list[Shot]]:
    try:
        with zipfile.ZipFile(path) as archive:
            names = set(archive.namelist())
    except _UNREADABLE as error:
        raise DatasetError(
            f"{path}: not an .r3d file, which is a ZIP ({str(error)[:80]})"
        ) from None
    if METADATA not in names:
        raise DatasetError(f"{path}: no '{METADATA}' in it, so it is no .r3d file of Record3D")
    metadata = _metadata(
        parse_object(_member(path, METADATA, DatasetError), f"{path}: {METADATA}"),
        f"{path}: {METADATA}",
    )
    found = sorted(
        int(match[1]) for name in names if (match := re.fullmatch(r"rgbd/(\d{1,9})\.depth", name))
    )
    if not found:
        raise DatasetError(f"{path}: no rgbd/N.depth in it")
    shots = [
        Shot(
            f"{path}: rgbd/{i}.jpg",
            partial(metadata.lens_of, i),
            partial(_archived_depth, path, i, metadata),
            partial(_archived_color, path, i),
            partial(_archived_confidence, path, i, metadata) if f"rgbd/{i}.conf" in names else None,
            metadata.pose_of(i),
            metadata.stamp_of(i),
        )
        for i in found
    ]
    return path, metadata, shots


def _member(path: Path, name: str, kind: type[DatasetError] = FrameError) -> bytes:
    """A file of the archive, or an error of that kind."""
    try:
        with zipfile.ZipFile(path) as archive:
            info = archive.getinfo(name)
            if info.file_size > MOST_BYTES:
                raise kind(f"{path}: {name} would take {info.file_size} bytes, refused")
            return archive.read(info)
    except KeyError:
        raise kind(f"{path}: no {name} in it") from None
    except _UNREADABLE as error:
        raise kind(f"{path}: {name} cannot be read ({str(error)[:80]})") from None


def _archived_color(path: Path, i: int) -> NDArray[np.uint8]:
    return decode_color(_member(path, f"rgbd/{i}.jpg"), f"{path}: rgbd/{i}.jpg")


def _archived_depth(path: Path, i: int, metadata: Metadata) -> NDArray[np.float32]:
    where = f"{path}: rgbd/{i}.depth"
    data = _member(path, f"rgbd/{i}.depth")
    if metadata.depth_size is not None:
        size = metadata.depth_size
        raw = decompress(data, 4 * size[0] * size[1], where)
    else:
        raw, size = _of_known_size(data, where)
    depth = np.frombuffer(raw, "<f4").reshape(size[1], size[0])
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))


def _of_known_size(data: bytes, where: str) -> tuple[bytes, tuple[int, int]]:
    """Depth of an old recording, which does not say its size."""
    problem = None
    for count, size in OLD_SIZES.items():
        try:
            return decompress(data, count, where), size
        except FrameError as error:
            problem = problem or error
    raise FrameError(f"{where}: of no size that is known; metadata lack dw and dh ({problem})")


def _archived_confidence(path: Path, i: int, metadata: Metadata) -> NDArray[np.uint8]:
    width, height = metadata.depth_size or OLD_SIZES[4 * 192 * 256]
    data = _member(path, f"rgbd/{i}.conf")
    raw = decompress(data, width * height, f"{path}: rgbd/{i}.conf")
    return np.frombuffer(raw, np.uint8).reshape(height, width)


def _open_export(path: Path) -> tuple[Path, Metadata, list[Shot]]:
    folder = path / EXPORT if (path / EXPORT).is_dir() else path
    if "metadata.json" not in list_names(folder):
        raise DatasetError(
            f"{folder}: no metadata.json here; Record3D gives NAME.r3d, or EXR_RGBD/ with "
            "metadata.json, rgb/ and depth/"
        )
    check_exr()
    file = folder / "metadata.json"
    metadata = _metadata(read_object(file), str(file))
    found = numbered_files(folder / "depth", r"(\d{1,9})\.exr")
    if not found:
        raise DatasetError(f"{folder / 'depth'}: no N.exr here")
    shots = [
        Shot(
            str(folder / "rgb" / f"{i}.jpg"),
            partial(metadata.lens_of, i),
            partial(read_exr_depth, found[i]),
            partial(read_color, folder / "rgb" / f"{i}.jpg"),
            None,
            metadata.pose_of(i),
            metadata.stamp_of(i),
        )
        for i in sorted(found)
    ]
    return folder, metadata, shots
