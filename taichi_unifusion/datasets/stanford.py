"""Stanford's 2D-3D-S: the perspective images of an area, `data/rgb`, `data/depth` and `data/pose`.

Files are `camera_UUID_ROOM_frame_N_domain_rgb.png`, `..._depth.png`, `..._pose.json`. Depth: 16
bits, 512 units a metre, along the camera's axis; 65535 means no reading. A pose file holds
`camera_rt_matrix`, three rows of [R | t] from the area's world to the camera (x right, y down, z
forward), metres, and `camera_k_matrix`, which every image has of its own and which counts pixels
from the image's corner: half a pixel is taken off, as pixel centres are whole numbers here.
Equirectangular images (`pano/`) are not read.
"""

from __future__ import annotations

import re
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, InputError, PoseError, did_you_mean
from ..files.atomic import read_bytes
from ..files.frame_files import list_names
from ..files.images import INVALID_DEPTH, read_color, read_depth
from ..files.json_text import parse_json
from ..types import Frame, PinholeCamera, check_rigid
from .dataset import Dataset
from .file_recording import check_depth_scale

DEPTH_SCALE = 512.0
FOLDERS = {"rgb": "png", "depth": "png", "pose": "json"}  # folder and domain -> suffix
_NAME = re.compile(r"camera_([^_]+)_+(.+?)_frame_(\d+)_domain_+(rgb|depth|pose)\.(?:png|json)")


@dataclass(frozen=True)
class Shot:
    """One perspective image: its camera's place, room and number."""

    room: str
    uuid: str
    number: int


def open_stanford(
    path: Path,
    *,
    room: str | None = None,
    depth_scale: float | None = None,
    camera: PinholeCamera | None = None,
    drop_alpha: bool = True,
) -> StanfordArea:
    """The images in an area's folder (or in its `data/`), of one room or of all: by room, place and
    number.
    """
    folder = path / "data" if (path / "data").is_dir() else path
    files: dict[Shot, dict[str, Path]] = {}
    for domain in FOLDERS:
        for name in list_names(folder / domain) if (folder / domain).is_dir() else ():
            if (found := _NAME.fullmatch(name)) and found[4] == domain:
                shot = Shot(found[2], found[1], int(found[3]))
                files.setdefault(shot, {})[domain] = folder / domain / name
    if not any("depth" in each for each in files.values()):
        raise DatasetError(f"{folder / 'depth'}: no camera_UUID_ROOM_frame_N_domain_depth.png here")
    rooms = sorted({shot.room for shot in files})
    if room is not None and room not in rooms:
        raise InputError(
            f"room: {folder} has no '{room}'{did_you_mean(room, rooms)}; rooms: {', '.join(rooms)}"
        )
    kept = {shot: files[shot] for shot in files if room in (None, shot.room)}
    return StanfordArea(folder, room, kept, depth_scale, camera, drop_alpha)


class StanfordArea(Dataset):
    """The images of an area or a room, each with a camera of its own, read when asked for."""

    registered = True

    def __init__(
        self,
        folder: Path,
        room: str | None,
        files: dict[Shot, dict[str, Path]],
        depth_scale: float | None,
        camera: PinholeCamera | None,
        drop_alpha: bool,
    ) -> None:
        self.name = f"2d3ds {folder}" + (f" {room}" if room else "")
        self.folder, self.fixed_camera, self.drop_alpha = folder, camera, drop_alpha
        self.depth_scale = check_depth_scale(
            DEPTH_SCALE if depth_scale is None else depth_scale, self.name
        )
        self.shots = tuple(sorted(files, key=lambda shot: (shot.room, shot.uuid, shot.number)))
        self.files, self.posed = files, True
        if not any("pose" in each for each in files.values()):
            self.no_poses = f"{folder / 'pose'}: no camera_UUID_ROOM_frame_N_domain_pose.json here"
            self.warnings = (f"{self.no_poses}, so the frames have no poses",)

    def __len__(self) -> int:
        return len(self.shots)

    @cached_property
    def rooms(self) -> tuple[str, ...]:
        """The rooms that images were taken in."""
        return tuple(dict.fromkeys(shot.room for shot in self.shots))

    def without_poses(self) -> StanfordArea:
        """The same frames, their poses left out."""
        bare = copy(self)
        bare.posed = False
        return bare

    def load(self, index: int) -> Frame:
        """Read frame `index`; FrameError (PoseError, SizeMismatch) names the faulty file."""
        shot = self.shots[index]
        depth = read_depth(self._file(shot, "depth"), self.depth_scale, INVALID_DEPTH)
        color_file = self._file(shot, "rgb")
        color = read_color(color_file, drop_alpha=self.drop_alpha)
        pose_file = self._file(shot, "pose")
        posed = self.posed and not self.no_poses
        stated = {} if self.fixed_camera and not posed else _read_pose(pose_file)
        camera = self.fixed_camera or _camera(stated, depth.shape[1], depth.shape[0], pose_file)
        T_world_camera = _pose(stated, pose_file) if posed else None
        # named after the colour image, as files of features are
        return Frame(depth, camera, color, T_world_camera, index, name=str(color_file))

    def _file(self, shot: Shot, domain: str) -> Path:
        """The file of an image, or where it should be."""
        name = f"camera_{shot.uuid}_{shot.room}_frame_{shot.number}_domain_{domain}"
        missing = self.folder / domain / f"{name}.{FOLDERS[domain]}"
        return self.files[shot].get(domain, missing)


def _read_pose(file: Path) -> dict[str, NDArray[np.float64]]:
    """The matrices of a pose file."""
    try:
        values = parse_json(read_bytes(file).decode("utf-8-sig"))
        keys = ("camera_rt_matrix", "camera_k_matrix")
        return {key: np.array(values[key], np.float64) for key in keys}
    except KeyError as error:
        raise FrameError(f"{file}: no {error} in it") from None
    except (OSError, ValueError, TypeError) as error:
        raise FrameError(f"{file}: not a pose file of 2D-3D-S ({str(error)[:120]})") from None


def _camera(
    stated: dict[str, NDArray[np.float64]], width: int, height: int, file: Path
) -> PinholeCamera:
    """The camera of one image, of pixels whose centres are whole numbers."""
    K = stated["camera_k_matrix"]
    if K.shape != (3, 3):
        raise FrameError(f"{file}: camera_k_matrix must be 3x3, got {K.shape}")
    try:
        return PinholeCamera(
            width,
            height,
            float(K[0, 0]),
            float(K[1, 1]),
            float(K[0, 2]) - 0.5,
            float(K[1, 2]) - 0.5,
        )
    except InputError as error:
        raise FrameError(f"{file}: {error}") from None


def _pose(stated: dict[str, NDArray[np.float64]], file: Path) -> NDArray[np.float64]:
    """T_world_camera (4, 4) of one image."""
    T_camera_world = stated["camera_rt_matrix"]
    if T_camera_world.shape == (3, 4):
        T_camera_world = np.vstack([T_camera_world, [0.0, 0.0, 0.0, 1.0]])
    if T_camera_world.shape != (4, 4):
        raise PoseError(f"{file}: camera_rt_matrix must be 3x4, got {T_camera_world.shape}")
    return np.asarray(np.linalg.inv(check_rigid(T_camera_world, str(file))), np.float64)
