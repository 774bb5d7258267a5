"""Any recording as a `folder`: depth, colour, infrared, camera and poses in files that every tool reads."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from secrets import token_hex

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from ..errors import DatasetError, FileError, FrameError, InputError
from ..files.atomic import file_error
from ..files.images import INVALID_DEPTH, encode_png
from ..geometry.quaternions import rotation_to_quaternion
from ..types import Frame, PinholeCamera
from .color_camera import write_color_camera
from .file_recording import check_depth_scale
from .folder import CAMERA_FILE, COLOR_CAMERA_FILE
from .loading import load_ahead, recording_of

UNITS = 1000.0  # a metre, where the recording does not say
LARGEST = 65534  # of 16 bits; 65535 means no reading
LEAST_STEP = 1e-6  # [s] of time stamps as names


@dataclass(frozen=True)
class WrittenFolder:
    """What was written, and what was left out and why."""

    path: Path
    frames: int
    poses: int
    depth_scale: float  # units a metre
    skipped: tuple[str, ...]
    named_by_time: bool
    resampled: int  # frames of another camera than the first one's
    stopped: bool = False


def write_folder(
    frames: Sequence[Frame],
    path: Path,
    *,
    depth_scale: float | None = None,
    stop: Callable[[], bool] = lambda: False,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> WrittenFolder:
    """Write frames as the folder `path`, which the format `folder` reads back.

    Depth is written with the recording's own units a metre where these are whole and reach far enough,
    else in millimetres, or as `depth_scale` says. Colour is what the frames have, registered to depth; where
    the recording knows a colour camera, its images as they are, and its calibration beside. Frames are named
    by their time stamps where all have one, else by number. The folder appears when all is written; FileError
    where it exists and is not empty, DatasetError where not one frame can be read.
    """
    path = Path(path)
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FileError(f"{path}: exists already; choose another name for the folder")
    whole = Path(os.path.abspath(path))
    temporary = whole.with_name(f".{whole.name[:200]}.{token_hex(4)}.tmp")
    try:
        temporary.mkdir(parents=True)
        written = _Writer(temporary, frames, depth_scale).write(stop, on_frame)
        if path.exists():
            path.rmdir()
        os.replace(temporary, whole)
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise file_error("write", path, error) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return WrittenFolder(path, *written)


def resampled(frame: Frame, camera: PinholeCamera) -> Frame:
    """The frame as a camera at the same place takes it: depth of the nearest pixel, images between pixels; 0
    outside.
    """
    own, rays = frame.camera, camera.rays()
    columns = np.float32(own.fx) * rays[..., 0].astype(np.float32) + np.float32(own.cx)
    rows = np.float32(own.fy) * rays[..., 1].astype(np.float32) + np.float32(own.cy)

    def moved(image: NDArray, how: int) -> NDArray:
        found = cv2.remap(image, columns, rows, how, borderMode=cv2.BORDER_CONSTANT)
        return np.asarray(found, image.dtype).reshape(*found.shape[:2], *image.shape[2:])

    return replace(
        frame,
        depth=moved(frame.depth, cv2.INTER_NEAREST),
        camera=camera,
        color=None if frame.color is None else moved(frame.color, cv2.INTER_LINEAR),
        images={
            name: moved(image, cv2.INTER_NEAREST)
            for name, image in frame.images.items()
            if name == "infrared"
        },
        features={},
    )


class _Writer:
    """Writes the frames of one recording, all for the camera of the first."""

    def __init__(self, folder: Path, frames: Sequence[Frame], depth_scale: float | None) -> None:
        self.folder, self.frames, self.recording = folder, frames, recording_of(frames)
        self.color_camera = getattr(self.recording, "color_camera", None)
        own = getattr(self.recording, "depth_scale", None)
        self.scale = check_depth_scale(
            depth_scale or (own if own and own >= UNITS else UNITS), "convert"
        )
        self.may_shrink = depth_scale is None
        self.camera: PinholeCamera | None = None
        self.poses: list[NDArray[np.float64] | None] = []
        self.times: list[float | None] = []
        self.skipped: list[str] = []
        self.resampled = 0

    def write(self, stop: Callable[[], bool], on_frame: Callable[[int, int], None]) -> tuple:
        """Counts and sentences for WrittenFolder."""
        stopped = False
        for i, load in enumerate(load_ahead(self.frames)):
            if stopped := stop():
                break
            try:
                frame = load()
                self._write_frame(frame)
            except FrameError as error:
                self.skipped.append(str(error))
            on_frame(i + 1, len(self.frames))
        if self.camera is None:
            reason = f" (first: {self.skipped[0]})" if self.skipped else ""
            raise DatasetError(
                f"{getattr(self.frames, 'name', 'frames')}: no frame to write{reason}"
            )
        names = self._name_by_time()
        self._write_cameras()
        posed = self._write_poses(names)
        return (
            len(self.times),
            posed,
            self.scale,
            tuple(self.skipped),
            names is not None,
            self.resampled,
            stopped,
        )

    def _write_frame(self, frame: Frame) -> None:
        camera = self.camera or self._begin(frame)
        if frame.camera != camera:
            frame = resampled(frame, camera)
            self.resampled += 1
        name = f"{len(self.times):06d}"
        color = frame.color
        if self.color_camera is not None and frame.color is not None:
            color = self.recording.recorded_color(frame.index)  # type: ignore[attr-defined]
        files: dict[str, NDArray] = {"depth": self._units(frame)}
        if color is not None:
            files["color"] = color[..., ::-1]
        if "infrared" in frame.images:
            image = np.nan_to_num(frame.images["infrared"][..., 0])
            files["infrared"] = np.clip(image, 0, 65535).round().astype(np.uint16)
        for kind, image in files.items():
            (self.folder / kind).mkdir(exist_ok=True)
            (self.folder / kind / f"{name}.png").write_bytes(encode_png(image))
        self.poses.append(frame.T_world_camera)
        self.times.append(frame.timestamp)

    def _begin(self, frame: Frame) -> PinholeCamera:
        """The camera and the units, by the first frame."""
        readings = frame.depth[np.isfinite(frame.depth)]
        far = float(readings.max()) if readings.size else 0.0
        if self.may_shrink and far * self.scale > LARGEST:
            self.scale = UNITS
        self.camera = frame.camera
        return frame.camera

    def _units(self, frame: Frame) -> NDArray[np.uint16]:
        """(H, W) units of depth, 0 where there is no reading or it is out of reach."""
        units = np.rint(np.nan_to_num(frame.depth, posinf=0, neginf=0) * np.float64(self.scale))
        return np.where((units > 0) & (units <= LARGEST), units, 0).astype(np.uint16)

    def _name_by_time(self) -> list[str] | None:
        """Rename the files to their time stamps, if these tell all frames apart in their order."""
        times = np.array([np.nan if time is None else time for time in self.times])
        if not np.isfinite(times).all() or (np.diff(times) < LEAST_STEP).any() or times[0] < 0:
            return None
        names = [f"{time:.6f}" for time in times]
        if len(set(names)) < len(names):
            return None
        for kind in ("depth", "color", "infrared"):
            for i, name in enumerate(names):
                file = self.folder / kind / f"{i:06d}.png"
                if file.exists():
                    file.rename(file.with_name(f"{name}.png"))
        return names

    def _write_cameras(self) -> None:
        camera = self.camera
        if camera is None:
            raise InputError("no frame was written")
        values = {
            "width": camera.width,
            "height": camera.height,
            **dict(zip(("fx", "fy", "cx", "cy"), map(float, camera.intrinsics), strict=True)),
            "depth_scale": float(self.scale),
            "depth_invalid": list(INVALID_DEPTH),
        }
        text = yaml.safe_dump(values, sort_keys=False, default_flow_style=None)
        (self.folder / CAMERA_FILE).write_text(text)
        if self.color_camera is not None and (self.folder / "color").exists():
            write_color_camera(self.folder / COLOR_CAMERA_FILE, self.color_camera)

    def _write_poses(self, names: list[str] | None) -> int:
        """Rows `name tx ty tz qx qy qz qw` of the frames that have a pose; how many there are."""
        rows = []
        for i, T in enumerate(self.poses):
            if T is not None:
                numbers = (*T[:3, 3], *rotation_to_quaternion(T[None, :3, :3])[0])
                name = f"{i:06d}" if names is None else names[i]
                rows.append(" ".join([name, *(f"{value:.9f}" for value in numbers)]))
        if rows:
            head = "# name tx ty tz qx qy qz qw, camera to world, metres\n"
            (self.folder / "poses.txt").write_text(head + "\n".join(rows) + "\n")
        return len(rows)
