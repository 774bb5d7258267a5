"""A rig of a depth camera and a colour camera that is not registered to it, in the synthetic room."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from taichi_unifusion.datasets.camera_pair import CameraPair
from taichi_unifusion.datasets.color_camera import ColorCamera
from taichi_unifusion.datasets.synthetic import FRAME_RATE, SyntheticRoom, camera_on_loop
from taichi_unifusion.geometry import se3
from taichi_unifusion.types import Frame


class TwoCameras(CameraPair):
    """`frames` views of the room at 30 Hz on a `share` of its loop; colour is what `rig` sees.

    `pose_noise` [m, rad] is the standard deviation of each number of the poses that are told.
    """

    name = "two cameras"
    runs_kernels = True

    def __init__(
        self,
        rig: ColorCamera,
        *,
        frames: int = 60,
        share: float = 1.0,
        size: tuple[int, int] = (160, 120),
        noise: bool = True,
        pose_noise: float = 0.0,
    ) -> None:
        self.rig, self.share, self.frames = rig, share, frames
        self.room = SyntheticRoom(frames=frames, width=size[0], height=size[1], noise=noise)
        self.room.T_world_camera = np.stack([self.pose(i) for i in range(frames)])
        self.camera = self.room.camera
        off = np.random.default_rng(3).normal(size=(frames, 6)) * pose_noise
        self.told = self.room.T_world_camera @ se3.exp(off)

    def __len__(self) -> int:
        return self.frames

    def pose(self, i: float) -> np.ndarray:
        """Of the depth camera, also between frames."""
        return camera_on_loop(i / self.frames * self.share % 1)

    def pose_at(self, index):
        return index / FRAME_RATE, self.told[index]

    def color_of(self, index: int) -> np.ndarray:
        """What the colour camera sees, at its own time."""
        moved = self.pose(index + self.rig.clock_offset * FRAME_RATE)
        T_world_color = moved @ se3.inverse(self.rig.T_color_depth)
        scene = self.room._scene
        depth, hit = scene.cast(self.rig.pinhole, T_world_color)
        return scene.shade(self.rig.pinhole, T_world_color, depth, hit)[0]

    def load(self, index: int) -> Frame:
        frame = replace(self.room[index], color=None, T_world_camera=self.told[index].copy())
        return self.with_color(frame, self.color_of(index), f"colour {index}")


def rig_beside(
    camera,  # PinholeCamera of depth
    turn: tuple[float, float, float] = (0, 0, 0),  # [degrees]
    move: tuple[float, float, float] = (0, 0, 0),  # [m]
    focal: float = 1.0,  # by the depth camera's
    offset: float = 0.0,  # [s]
) -> ColorCamera:
    """A colour camera of the same image size."""
    T_color_depth = se3.exp(np.array([0, 0, 0, *np.radians(turn)]))
    T_color_depth[:3, 3] = move
    pinhole = replace(camera, fx=camera.fx * focal, fy=camera.fy * focal)
    return ColorCamera(pinhole, T_color_depth, clock_offset=offset)
