"""Replica as rendered for iMAP and NICE-SLAM: `results/frameXXXXXX.jpg`, `results/depthXXXXXX.png`,
`traj.txt`.

The images may also lie beside traj.txt. Depth: 16 bits, 6553.5 units a metre; 65535 is 10 m or more
and taken as no reading. Poses: row i of traj.txt, 16 numbers, is the 4x4 camera-to-world matrix of
frame *number* i in metres, camera x right, y down, z forward; without the file frames have none.
Intrinsics and depth scale: `cam_params.json` beside traj.txt or one folder up, else 1200x680, fx =
fy = 600, cx 599.5, cy 339.5.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import DatasetError
from ..files.atomic import read_bytes
from ..files.frame_files import file_of, first_existing, numbered_files
from ..files.json_text import parse_json
from ..files.trajectories import REPLICA, Pose, read_pose_rows
from ..types import PinholeCamera
from .depth_camera import Intrinsics, check_size, make_camera
from .file_recording import FrameFiles, Recording, check_depth_scale, depth_size

DEPTH_SCALE = 6553.5
DEFAULT_CAMERA = PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5)


def open_replica(
    path: Path,
    *,
    depth_scale: float | None = None,
    camera: PinholeCamera | Intrinsics | None = None,
    drop_alpha: bool = False,
) -> Recording:
    """The scene in folder `path`, which holds traj.txt (or is the results folder beside it)."""
    beside = path.parent if path.name == "results" else path  # where the trajectory is expected
    trajectory = first_existing([path / "traj.txt", beside / "traj.txt"])
    images = path / "results" if (path / "results").is_dir() else path
    color = numbered_files(images, r"frame(\d+)\.(?:jpg|jpeg|png)")
    depth = numbered_files(images, r"depth(\d+)\.png")
    if not color and not depth:
        raise DatasetError(f"{images}: no frameXXXXXX.jpg or depthXXXXXX.png here")
    numbers = sorted({*color, *depth})
    poses, warnings = (
        ([None] * len(numbers), []) if trajectory is None else _read_poses(numbers, trajectory)
    )
    frames = [
        FrameFiles(
            file_of(number, depth, images, "depth{:06d}.png"),
            file_of(number, color, images, "frame{:06d}.jpg"),
            pose,
        )
        for number, pose in zip(numbers, poses, strict=True)
    ]
    read_camera, read_scale = _read_parameters(trajectory.parent if trajectory else beside)
    source = (
        "camera" if camera is not None else f"{path}: Replica's usual camera or cam_params.json"
    )
    camera = check_size(camera or read_camera, depth_size(frames), source)
    return Recording(
        f"replica {path}",
        frames,
        camera,
        read_scale if depth_scale is None else depth_scale,
        drop_alpha=drop_alpha,
        warnings=warnings,
        no_poses="" if trajectory else f"{beside / 'traj.txt'}: no such file",
    )


def _read_poses(numbers: Sequence[int], trajectory: Path) -> tuple[list[Pose], list[str]]:
    """The pose of every frame number, ascending, and a warning where the trajectory holds more."""
    rows = read_pose_rows(trajectory, (REPLICA,))
    poses = [
        rows[number].pose
        if number < len(rows)
        else Pose(
            str(trajectory),
            problem=f"holds {len(rows)} rows, none for frame number {number} (the first is number 0)",
        )
        for number in numbers
    ]
    if len(rows) <= numbers[-1] + 1:
        return poses, []
    return poses, [
        f"{trajectory}: holds {len(rows)} poses but the last frame is number {numbers[-1]}; row i is taken for "
        "number i"
    ]


def _read_parameters(folder: Path) -> tuple[PinholeCamera, float]:
    """Camera and depth scale from cam_params.json, or Replica's usual ones where there is none."""
    file = first_existing((folder / "cam_params.json", folder.parent / "cam_params.json"))
    if file is None:
        return DEFAULT_CAMERA, DEPTH_SCALE
    try:
        values = parse_json(read_bytes(file).decode("utf-8-sig"))
        values = values.get("camera", values)
        w, h, fx, fy, cx, cy = (float(values[key]) for key in ("w", "h", "fx", "fy", "cx", "cy"))
        scale = float(values.get("scale", DEPTH_SCALE))
        size = int(w), int(h)
    except KeyError as error:
        raise DatasetError(
            f"{file}: no {error} in it; expected w, h, fx, fy, cx, cy (and scale)"
        ) from None
    except (OSError, ValueError, TypeError, AttributeError, OverflowError) as error:
        raise DatasetError(f"{file}: not the camera of a Replica recording ({error})") from error
    return make_camera(str(file), size, fx, fy, cx, cy), check_depth_scale(scale, str(file))
