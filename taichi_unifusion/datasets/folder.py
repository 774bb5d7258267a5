"""Your own recording: a folder with `camera.yaml`, `depth/`, and, if there are any, `color/` and
poses.

Depth: `depth/NAME.png`, 16 bits, `depth_scale` units a metre (default 1000), 0 and 65535 no
reading; or `depth/NAME.npy`, (H, W) or (H, W, 1), integers of the same units, or floats, which are
metres unless a depth_scale is given. Colour: `color/NAME.png` or `.jpg`, registered to
depth, where another size of the same shape is resampled, or, beside a `color_camera.yaml`, as that
camera took it. Frames are the names, in the order of the numbers in them. Infrared, if any:
`infrared/NAME.png`, one channel of 8 or 16 bits, registered to depth, for the frames that have one.
Poses: camera-to-world in metres, camera x right, y down, z forward, as `poses/NAME.txt` (4x4 each),
or `poses.txt` with rows `NAME tx ty tz qx qy qz qw` (where images are named by time it may be a
time stamp, matched within max_difference; `pose_rows.py` has the rules), or `poses.txt` with one row
of 16 or 12 numbers for every frame, in their order; or, named as `poses` in camera.yaml, a file of
COLMAP, EuRoC, Redwood, Open3D or a transforms.json.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from ..errors import DatasetError
from ..files.frame_files import files_by_stem, in_order, list_names
from ..files.pose_files import colmap_file, read_pose_list
from ..files.trajectories import Pose, read_pose_file
from ..geometry.time_stamps import check_max_difference, unit_of
from ..types import PinholeCamera
from .camera_yaml import CameraFile, read_camera_yaml
from .color_camera import read_color_camera
from .depth_camera import Intrinsics, check_size
from .file_recording import FrameFiles, Recording, depth_size
from .pose_rows import rows_of_frames, say_unit, times_of

DEPTH_SUFFIXES, COLOR_SUFFIXES, INFRARED_SUFFIXES = (
    (".png", ".npy"),
    (".png", ".jpg", ".jpeg"),
    (".png",),
)
MAX_DIFFERENCE = 0.02  # [s]
DEPTH_SCALE = 1000.0  # units a metre of integers, where nothing says otherwise
CAMERA_FILE, COLOR_CAMERA_FILE = "camera.yaml", "color_camera.yaml"


def open_folder(
    path: Path,
    *,
    depth_scale: float | None = None,
    camera: PinholeCamera | Intrinsics | None = None,
    drop_alpha: bool = False,
    max_difference: float = MAX_DIFFERENCE,
) -> Recording:
    """The recording in folder `path`; a frame is a name that has a depth or a colour image."""
    check_max_difference(max_difference)
    settings = _settings(path, camera)
    depth, color = _images(path / "depth", DEPTH_SUFFIXES), _images(path / "color", COLOR_SUFFIXES)
    infrared = _images(path / "infrared", INFRARED_SUFFIXES)
    if not depth:
        raise DatasetError(f"{path / 'depth'}: no *.png (16 bits) or *.npy here")
    stems = in_order({*depth, *color})
    warnings: list[str] = []
    poses = _read_poses(path, settings, stems, max_difference, warnings)
    times = times_of(stems)
    if times:
        say_unit(path / "depth", unit_of(stems), warnings)
    frames = [
        FrameFiles(
            _file_of(stem, depth),
            _file_of(stem, color) if color else None,
            pose,
            times[i] / 10**9 if times else None,
            infrared.get(stem),
        )
        for i, (stem, pose) in enumerate(zip(stems, poses, strict=True))
    ]
    source = str(path / CAMERA_FILE) if camera is None else "camera"
    own = path / COLOR_CAMERA_FILE
    camera = check_size(camera or settings.camera(source), depth_size(frames), source)
    given = settings.depth_scale if depth_scale is None else depth_scale
    return Recording(
        f"folder {path}",
        frames,
        camera,
        DEPTH_SCALE if given is None else given,
        float_scale=1.0 if given is None else given,
        invalid=settings.depth_invalid,
        fit_color=True,
        drop_alpha=drop_alpha,
        warnings=warnings,
        no_poses="" if any(poses) else f"{path}: no poses.txt and no poses/ here",
        color_camera=read_color_camera(own) if own.exists() else None,
    )


def _settings(path: Path, camera: PinholeCamera | Intrinsics | None) -> CameraFile:
    """camera.yaml; a caller's camera may stand in for it, but a file that is there must be right."""
    file = path / CAMERA_FILE
    if camera is not None and not file.exists():
        size = camera.size if isinstance(camera, PinholeCamera) else (1, 1)
        return CameraFile(*size, camera.fx, camera.fy, camera.cx, camera.cy)
    list_names(path)  # says so if this is no folder
    return read_camera_yaml(file)


def _images(folder: Path, suffixes: Sequence[str]) -> dict[str, Path]:
    """Stem -> file of the images in `folder`; none if there is no such folder."""
    return files_by_stem(folder, suffixes) if folder.exists() else {}


def _file_of(stem: str, files: dict[str, Path]) -> Path:
    """The image of that name, or where it should be."""
    like = next(iter(files.values()))
    return files.get(stem) or like.with_name(stem + like.suffix)


def _pose_source(path: Path, settings: CameraFile) -> Path | None:
    if settings.poses is not None:
        return path / settings.poses
    found = [path / name for name in ("poses.txt", "poses") if (path / name).exists()]
    if len(found) > 1:
        raise DatasetError(
            f"{path}: both poses.txt and poses/ are here; name the right one as 'poses:' in {CAMERA_FILE}"
        )
    return found[0] if found else None


def _read_poses(
    path: Path,
    settings: CameraFile,
    stems: Sequence[str],
    max_difference: float,
    warnings: list[str],
) -> list[Pose | None]:
    """The pose of every frame, in the order of `stems`; all None where no poses are given."""
    source = _pose_source(path, settings)
    if source is None:
        return [None] * len(stems)
    if os.path.isdir(source):  # unlike Path.is_dir it answers for any name
        model = colmap_file(source)
        if model is None:
            return [read_pose_file(source / f"{stem}.txt") for stem in stems]
        source = model
    body_camera = None if settings.body_camera is None else path / settings.body_camera
    listed = read_pose_list(source, body_camera)
    rows = listed.rows
    warnings += listed.warnings
    if listed.key != "place":
        named = rows_of_frames(rows, source, stems, max_difference)
        warnings += named.warnings
        return [*named.poses]
    if len(rows) != len(stems):
        raise DatasetError(
            f"{source}: {len(rows)} rows for {len(stems)} frames; its rows bear no names, so every "
            "frame needs one; else write rows of 'name tx ty tz qx qy qz qw'"
        )
    return [row.pose for row in rows]
