"""ScanNet's `.sens` recordings: one file that holds all frames; `files.sens_container` describes it.

Opening walks the records without reading images.
"""

from __future__ import annotations

from copy import copy
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..files.images import INVALID_DEPTH, depth_to_metres
from ..files.sens_container import decode_sens_color, decode_sens_depth, open_sens, read_images
from ..files.trajectories import Pose
from ..types import Frame, PinholeCamera
from .camera_pair import CameraPair
from .depth_camera import Intrinsics, check_size, make_camera
from .file_recording import check_depth_scale
from .plausibility import camera_warnings, pose_warnings


class SensFile(CameraPair):
    """The frames of a .sens file, each read when asked for."""

    def __init__(
        self,
        path: Path,
        *,
        depth_scale: float | None = None,
        camera: PinholeCamera | Intrinsics | None = None,
        drop_alpha: bool = False,
    ) -> None:
        self.name, self.path, self.drop_alpha = f"scannet {path}", path, drop_alpha
        self.header, self.records, warnings = open_sens(path)
        self.depth_scale = check_depth_scale(
            self.header.depth_scale if depth_scale is None else depth_scale, str(path)
        )
        K, size = self.header.intrinsic_depth, self.header.depth_size
        self.camera = (
            make_camera(str(path), size, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
            if camera is None
            else check_size(camera, size, "camera")
        )
        self.poses: list[Pose] | None = [record.pose for record in self.records]
        self.other_warnings = (*warnings, *camera_warnings(self.camera))
        self.warnings = (*self.other_warnings, *pose_warnings(self.poses))

    def __len__(self) -> int:
        return len(self.records)

    def without_poses(self) -> SensFile:
        """The same frames, their poses left out; so are the warnings about those."""
        bare = copy(self)
        bare.poses, bare.twists, bare.warnings = None, None, self.other_warnings
        return bare

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        return self.records[index].timestamp, self.poses[index].usable if self.poses else None

    def load(self, index: int) -> Frame:
        """Read frame `index`; FrameError names the file and the frame."""
        record, where = self.records[index], f"{self.path} frame {index}"
        T_world_camera = self.poses[index].checked() if self.poses else None
        color_data, depth_data = read_images(self.path, record)
        raw = decode_sens_depth(depth_data, self.header, f"{where} depth")
        depth = depth_to_metres(raw, f"{where} depth", self.depth_scale, INVALID_DEPTH)
        frame = Frame(depth, self.camera, None, T_world_camera, index, record.timestamp, where)
        if not record.color_bytes:
            return frame
        color = decode_sens_color(
            color_data, self.header, f"{where} colour", drop_alpha=self.drop_alpha
        )
        return self.with_color(frame, color, f"{where} colour")
