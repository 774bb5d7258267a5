"""A few small frames of the synthetic room, in memory and as a `folder` recording, with settings
that fit them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import yaml
from places import DEVICE

from taichi_unifusion.config import Config
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.maps.settings import SurfaceSettings, color_settings
from taichi_unifusion.types import Frame

WIDTH, HEIGHT, DEPTH_SCALE = 160, 120, 1000.0

# A pixel spans 1.4 cm at 2 m: voxels as large as that asks for.
CONFIG = Config(
    device=DEVICE,
    surface=SurfaceSettings(voxel_size=0.1, support_points=1),
    color=replace(color_settings(), voxel_size=0.05),
)
FLAGS = [
    "--device",
    DEVICE,
    "--surface.voxel-size",
    "0.1",
    "--surface.support-points",
    "1",
    "--color.voxel-size",
    "0.05",
]


def make_frames(count: int) -> list[Frame]:
    """Neighbouring frames of one walk through the room."""
    return list(SyntheticRoom(frames=60, width=WIDTH, height=HEIGHT)[:count])


def write_folder(folder: Path, frames: Sequence[Frame]) -> Path:
    """Write frames as `open_dataset("folder", ...)` reads them."""
    for name in ("depth", "color", "poses"):
        (folder / name).mkdir(parents=True)
    camera = frames[0].camera
    (folder / "camera.yaml").write_text(
        yaml.safe_dump(
            {
                "width": camera.width,
                "height": camera.height,
                "fx": camera.fx,
                "fy": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "depth_scale": DEPTH_SCALE,
            }
        )
    )
    for i, frame in enumerate(frames):
        assert cv2.imwrite(
            str(folder / "depth" / f"{i}.png"), np.rint(frame.depth * DEPTH_SCALE).astype(np.uint16)
        )
        assert cv2.imwrite(str(folder / "color" / f"{i}.png"), frame.color[..., ::-1])
        np.savetxt(folder / "poses" / f"{i}.txt", frame.T_world_camera)
    return folder
