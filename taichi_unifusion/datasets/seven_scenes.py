"""7-Scenes and 3DMatch: `frame-XXXXXX.color.png` (or .jpg), `frame-XXXXXX.depth.png`,
`frame-XXXXXX.pose.txt` in one folder.

Depth: 16 bits, millimetres, 0 and 65535 no reading. Poses: 4x4 camera-to-world in metres, camera x
right, y down, z forward. Intrinsics: `camera-intrinsics.txt` (3x3) beside the frames or one folder
up (3DMatch), else 7-Scenes' own 585 585 320 240. 7-Scenes' colour is not registered to its depth:
the two cameras sit a few centimetres apart.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import DatasetError
from ..files.frame_files import file_of, first_existing, list_names, numbered_files
from ..files.trajectories import read_pose_file
from ..types import PinholeCamera
from .depth_camera import Intrinsics, check_size, make_camera, read_matrix_camera
from .file_recording import FrameFiles, Recording, depth_size

DEPTH_SCALE = 1000.0
DEFAULT_SIZE, DEFAULT_INTRINSICS = (640, 480), (585.0, 585.0, 320.0, 240.0)  # fx fy cx cy
PATTERN = "frame-XXXXXX.{color.png|color.jpg|depth.png|pose.txt}"


def open_seven_scenes(
    path: Path,
    *,
    depth_scale: float | None = None,
    camera: PinholeCamera | Intrinsics | None = None,
    drop_alpha: bool = False,
) -> Recording:
    """The sequence in folder `path`; frames are the numbers for which any of the three files
    exists.
    """
    folder, frames = path, flat_frames(path)
    if not frames:
        folder = _only_sequence(path)
        frames = flat_frames(folder)
    if not frames:
        raise DatasetError(f"{folder}: no {PATTERN} here")
    return Recording(
        f"7scenes {folder}",
        frames,
        _camera(folder, frames, camera),
        DEPTH_SCALE if depth_scale is None else depth_scale,
        drop_alpha=drop_alpha,
        no_poses=no_flat_poses(folder, frames),
    )


def flat_frames(folder: Path, depth_suffix: str = "png") -> list[FrameFiles]:
    """The frames that lie as frame-XXXXXX.* in `folder`, in the order of their numbers, with their
    poses.
    """
    color = numbered_files(folder, r"frame-(\d+)\.color\.(?:png|jpg|jpeg)")
    depth = numbered_files(folder, rf"frame-(\d+)\.depth\.(?:{depth_suffix})")
    pose = numbered_files(folder, r"frame-(\d+)\.pose\.txt")
    return [
        FrameFiles(
            file_of(number, depth, folder, "frame-{:06d}.depth.png"),
            file_of(number, color, folder, "frame-{:06d}.color.png"),
            read_pose_file(file_of(number, pose, folder, "frame-{:06d}.pose.txt"))
            if pose
            else None,
        )
        for number in sorted({*color, *depth, *pose})
    ]


def no_flat_poses(folder: Path, frames: Sequence[FrameFiles]) -> str:
    """What is missing where none of the flat frames has a pose."""
    return "" if any(frame.pose for frame in frames) else f"{folder}: no frame-XXXXXX.pose.txt here"


def _only_sequence(path: Path) -> Path:
    """The one seq-XX folder of a scene."""
    sequences = [
        name for name in list_names(path) if name.startswith("seq-") and (path / name).is_dir()
    ]
    if not sequences:
        raise DatasetError(f"{path}: no {PATTERN} here, nor a seq-XX folder of them")
    if len(sequences) > 1:
        raise DatasetError(
            f"{path}: is a scene of {len(sequences)} sequences, open one of them: {', '.join(sequences)}"
        )
    return path / sequences[0]


def _camera(
    folder: Path, frames: Sequence[FrameFiles], camera: PinholeCamera | Intrinsics | None
) -> PinholeCamera:
    size = depth_size(frames)
    if camera is not None:
        return check_size(camera, size, "camera")
    file = first_existing(
        (folder / "camera-intrinsics.txt", folder.parent / "camera-intrinsics.txt")
    )
    if file is not None:
        return read_matrix_camera(file, size)
    return check_size(
        make_camera("7-Scenes", DEFAULT_SIZE, *DEFAULT_INTRINSICS),
        size,
        f"{folder}: no camera-intrinsics.txt beside or above, so 7-Scenes' own were taken",
    )
