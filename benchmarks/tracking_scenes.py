"""Small exact scenes that trackers fail on: what moves, what repeats, what is fixed to the camera,
what turns on the spot, small images and depth that is wrong by its place in the image.

Every one is a list of frames with their true poses; benchmarks and tests track them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from taichi_unifusion.datasets import Dataset
from taichi_unifusion.datasets.synthetic import (
    FOCAL_PER_WIDTH,
    FRAME_RATE,
    Scene,
    SyntheticRoom,
    camera_on_loop,
    look_at,
)
from taichi_unifusion.rendering.kernels.solids import ROOM, kinect_depth
from taichi_unifusion.rendering.primitives import Primitive, box, cylinder
from taichi_unifusion.rendering.room import furnished_room
from taichi_unifusion.types import Frame, PinholeCamera


class Listed(Dataset):
    """Frames in memory."""

    name = "listed"
    registered = True

    def __init__(self, frames: Sequence[Frame]) -> None:
        self.frames = [replace(frame, index=i) for i, frame in enumerate(frames)]

    def __len__(self) -> int:
        return len(self.frames)

    def load(self, index: int) -> Frame:
        return self.frames[index]


def kinect(width: int = 320) -> PinholeCamera:
    """A Kinect's depth camera with images of that width, 4 : 3."""
    height, focal = width * 3 // 4, FOCAL_PER_WIDTH * width
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def rendered(
    scene: Scene, T_world_camera: NDArray, camera: PinholeCamera, index: int, noise: bool = True
) -> Frame:
    """One frame of a scene, with a Kinect's noise."""
    depth, hit = scene.cast(camera, T_world_camera)
    color, cosine = scene.shade(camera, T_world_camera, depth, hit)
    if noise:
        exact, depth = depth, np.zeros_like(depth)
        kinect_depth(exact, cosine, exact.min(), 0, index, camera.fx, depth)
    return Frame(depth, camera, color, T_world_camera, index, index / FRAME_RATE, f"frame {index}")


def walker(
    frames: int = 40,
    camera: PinholeCamera | None = None,
    moving: bool = False,
    radius: float = 0.3,
    stays: int = 0,
) -> list[Frame]:
    """A cylinder crosses the view 1.25 m before a camera that stands still, or walks on the loop
    (`moving`); it may stand in view for its first `stays` frames.
    """
    camera = camera or kinect()
    made = []
    for i in range(frames):
        T = camera_on_loop(0.3 + (i / 400 if moving else 0.0))
        right, forward, eye = (T[:3, k] for k in (0, 2, 3))
        level = np.array([forward[0], forward[1], 0]) / np.hypot(*forward[:2])
        share = max(0, i - stays) / max(1, frames - 1 - stays)
        begin = 0.2 if stays else 1.2
        center = eye + 1.25 * level + (begin * (1 - share) - 1.2 * share) * right
        person = cylinder("plaid", (center[0], center[1], 0.0), radius, 1.8)
        made.append(rendered(Scene((*furnished_room(), person)), T, camera, i))
    return made


def robot_part(frames: int = 40, share: float = 0.22, distance: float = 0.33) -> list[Frame]:
    """A walk on the loop with a fixed pattern over the lowest `share` of every image."""
    room = SyntheticRoom(frames=240, width=320, height=240)
    made = [room[i] for i in range(frames)]
    top = int(round((1 - share) * 240))
    rng = np.random.default_rng(0)
    pattern = np.repeat(np.repeat(rng.integers(0, 255, (30, 40, 3)), 8, 0), 8, 1).astype(np.uint8)
    v, u = np.mgrid[:240, :320]
    shape = (distance + 0.04 * np.sin(u / 23.0) * np.cos(v / 17.0)).astype(np.float32)
    for frame in made:
        frame.depth[top:] = np.round(shape[top:], 3)
        frame.color[top:] = pattern[top:]
    return made


def corridor(frames: int = 100, step: float = 0.05, period: float = 2.0) -> list[Frame]:
    """Straight along a corridor whose boxes and colours repeat every `period` metres."""
    camera, half = kinect(), np.array([30.0, 1.0, 1.2])
    shell = Primitive(ROOM, "wallpaper", np.array([0.0, 0.0, 1.2]), half, np.eye(3))
    boxes = [
        part
        for k in range(-3, 12)
        for part in (
            box("oak", (k * period, 0.6, 0.0), (k * period + 0.5, 1.0, 0.8)),
            box("sofa", (k * period + 1.0, -1.0, 0.0), (k * period + 1.3, -0.7, 1.5)),
            box("mosaic", (k * period + 0.9, 0.96, 1.2), (k * period + 1.5, 1.0, 1.8)),
            box("landscape", (k * period + 0.1, -1.0, 1.1), (k * period + 0.7, -0.97, 1.7)),
        )
    ]
    scene = Scene((shell, *boxes))
    made = []
    for i in range(frames):
        x = i * step
        T = look_at((x, 0.0, 1.2), (x + 2.0, 0.0, 1.0))
        frame = rendered(scene, T, camera, i)
        made.append(replace(frame, color=_repeating_color(frame, period)))
    return made


def _repeating_color(frame: Frame, period: float) -> NDArray[np.uint8]:
    """Colour as a function of x modulo the period, y and z: the shading of long walls is not."""
    camera, T = frame.camera, frame.T_world_camera
    v, u = np.mgrid[: camera.height, : camera.width]
    points = camera.rays(u, v) * frame.depth[..., None]
    world = points @ T[:3, :3].T + T[:3, 3]
    x = 2 * np.pi * np.mod(world[..., 0], period) / period
    waves = [
        np.sin(k * x + 7 * world[..., 1] + 5 * world[..., 2] + k)
        * np.cos(6 * world[..., 2] + k * x)
        for k in (2, 3, 5)
    ]
    color = np.stack([127 + 100 * wave for wave in waves], axis=-1)
    return np.where(frame.depth[..., None] > 0, color, 0).astype(np.uint8)


def turning(frames: int = 90, degrees: float = 4.0) -> list[Frame]:
    """A camera that turns once around on the spot in the furnished room."""
    scene, camera = Scene(furnished_room()), kinect()
    angles = np.radians(degrees) * np.arange(frames)
    return [
        rendered(
            scene, look_at((0.1, -0.2, 1.4), (0.1 + np.cos(a), -0.2 + np.sin(a), 1.25)), camera, i
        )
        for i, a in enumerate(angles)
    ]


def loop(frames: int = 120, width: int = 320, again: int = 0, seed: int = 0) -> list[Frame]:
    """The loop through the synthetic room, and its first frames once more."""
    room = SyntheticRoom(frames=frames, width=width, height=width * 3 // 4, seed=seed)
    return [replace(room[i % frames], index=i) for i in range(frames + again)]


def distorted(frames: Iterable[Frame], amount: float = 0.02) -> list[Frame]:
    """Depth that is up to `amount` of itself too large or small, by its place in the image."""
    made = []
    for frame in frames:
        height, width = frame.depth.shape
        v, u = np.mgrid[:height, :width]
        x, y = u / (width - 1) * 2 - 1, v / (height - 1) * 2 - 1
        factor = 1 + amount * (x * x + y * y - 1) / np.sqrt(1) * 0.7 + 0.3 * amount * x
        made.append(replace(frame, depth=(frame.depth * factor).astype(np.float32)))
    return made
