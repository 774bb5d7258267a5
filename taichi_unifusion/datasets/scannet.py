"""ScanNet, as its tools leave it: an extracted folder, an older flat folder, or the `.sens`
container itself.

Extracted: `color/N.jpg`, `depth/N.png`, `pose/N.txt`, `intrinsic/intrinsic_depth.txt` (4x4), and
`infrared/N.png` where a rig has it. Flat: `frame-XXXXXX.color.jpg`, `frame-XXXXXX.depth.pgm` (or
.png), `frame-XXXXXX.pose.txt`, `_info.txt`. Container: see sens.py. Depth: 16 bits, millimetres, 0
no reading. Poses: 4x4 camera-to-world in metres, camera x right, y down, z forward; where tracking
was lost they are -inf, and that frame is refused. Colour (1296x968) is registered to depth
(640x480) and resampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import DatasetError
from ..files.frame_files import file_of, first_existing, list_names, numbered_files
from ..files.text_rows import parse_numbers, read_lines
from ..files.trajectories import read_pose_file
from ..types import PinholeCamera
from .depth_camera import Intrinsics, check_size, make_camera, read_matrix_camera
from .file_recording import FrameFiles, Recording, check_depth_scale, depth_size
from .sens import SensFile
from .seven_scenes import flat_frames, no_flat_poses

DEPTH_SCALE = 1000.0
# the last: frames_25k
INTRINSIC_FILES = ("intrinsic/intrinsic_depth.txt", "intrinsic_depth.txt", "intrinsics_depth.txt")
INFO_FILE = "_info.txt"


def open_scannet(
    path: Path,
    *,
    depth_scale: float | None = None,
    camera: PinholeCamera | Intrinsics | None = None,
    drop_alpha: bool = False,
) -> Recording | SensFile:
    """The scan at `path`: a .sens file, a folder with exactly one, or a folder of extracted frames."""
    options = {"depth_scale": depth_scale, "camera": camera, "drop_alpha": drop_alpha}
    if path.is_file():
        return SensFile(path, **options)
    names = list_names(path)
    if "depth" in names:
        return _open_extracted(path, **options)
    if INFO_FILE in names or any(name.startswith("frame-") for name in names):
        return _open_flat(path, **options)
    containers = [name for name in names if name.endswith(".sens")]
    if len(containers) == 1:
        return SensFile(path / containers[0], **options)
    if containers:
        raise DatasetError(
            f"{path}: holds {len(containers)} .sens files, open one of them: {', '.join(containers)}"
        )
    raise DatasetError(f"{path}: no depth/N.png, frame-XXXXXX.depth.pgm or *.sens here")


def _open_extracted(
    path: Path,
    depth_scale: float | None,
    camera: PinholeCamera | Intrinsics | None,
    drop_alpha: bool,
) -> Recording:
    depth = numbered_files(path / "depth", r"(\d+)\.png")
    color = numbered_files(path / "color", r"(\d+)\.(?:jpg|jpeg|png)")
    pose = numbered_files(path / "pose", r"(\d+)\.txt") if (path / "pose").is_dir() else {}
    infrared = (
        numbered_files(path / "infrared", r"(\d+)\.png") if (path / "infrared").is_dir() else {}
    )
    frames = [
        FrameFiles(
            file_of(number, depth, path / "depth", "{}.png"),
            file_of(number, color, path / "color", "{}.jpg"),
            read_pose_file(file_of(number, pose, path / "pose", "{}.txt")) if pose else None,
            infrared=infrared.get(number),
        )
        for number in sorted({*depth, *color, *pose})
    ]
    if not frames:
        raise DatasetError(f"{path}: no color/N.jpg, depth/N.png or pose/N.txt here")
    size = depth_size(frames)
    if camera is None:
        file = first_existing(path / name for name in INTRINSIC_FILES)
        if file is None:
            raise DatasetError(
                f"{path}: no {INTRINSIC_FILES[0]} here; extract the intrinsics too, or pass "
                "camera=PinholeCamera(...)"
            )
        camera = read_matrix_camera(file, size)
    return _recording(
        path,
        frames,
        check_size(camera, size, "camera"),
        depth_scale,
        drop_alpha,
        "" if pose else f"{path / 'pose'}: no N.txt here",
    )


def _open_flat(
    path: Path,
    depth_scale: float | None,
    camera: PinholeCamera | Intrinsics | None,
    drop_alpha: bool,
) -> Recording:
    frames = flat_frames(path, depth_suffix="pgm|png")
    if not frames:
        raise DatasetError(f"{path}: no frame-XXXXXX.{{color.jpg|depth.pgm|pose.txt}} here")
    size, file = depth_size(frames), path / INFO_FILE
    info = _read_info(file) if file.exists() else {}
    if camera is None:
        numbers = parse_numbers(info.get("m_calibrationDepthIntrinsic", "").split(), str(file))
        if len(numbers) < 7:
            raise DatasetError(
                f"{file}: no m_calibrationDepthIntrinsic there; pass camera=PinholeCamera(...)"
            )
        camera = make_camera(
            str(file), size, fx=numbers[0], fy=numbers[5], cx=numbers[2], cy=numbers[6]
        )
    if depth_scale is None and "m_depthShift" in info:
        depth_scale = check_depth_scale(
            parse_numbers([info["m_depthShift"]], str(file))[0], str(file)
        )
    return _recording(
        path,
        frames,
        check_size(camera, size, "camera"),
        depth_scale,
        drop_alpha,
        no_flat_poses(path, frames),
    )


def _recording(
    path: Path,
    frames: Sequence[FrameFiles],
    camera: PinholeCamera,
    depth_scale: float | None,
    drop_alpha: bool,
    no_poses: str,
) -> Recording:
    return Recording(
        f"scannet {path}",
        frames,
        camera,
        DEPTH_SCALE if depth_scale is None else depth_scale,
        fit_color=True,
        drop_alpha=drop_alpha,
        no_poses=no_poses,
    )


def _read_info(file: Path) -> dict[str, str]:
    """The `key = value` lines of _info.txt."""
    rows = (line.partition("=") for _, line in read_lines(file))
    return {key.strip(): value.strip() for key, _, value in rows}
