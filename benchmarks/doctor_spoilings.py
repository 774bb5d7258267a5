"""Ways to spoil a recording, and what the doctor is to say then; benchmarks/doctor.py tries them all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from taichi_unifusion.datasets.mended import pose_at_time
from taichi_unifusion.geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion
from taichi_unifusion.geometry.se3 import FLIP_YZ
from taichi_unifusion.types import Frame, PinholeCamera

Frames = list[Frame]
Change = Callable[[Frames], Frames]


@dataclass(frozen=True)
class Spoiling:
    """A way to spoil a recording, and what is to be said then."""

    cause: str
    change: Change
    depth_scale: float = 1000.0  # that the recording would be read with
    poses: int = 2  # frames with poses that it needs
    moving: bool = False  # whether frames must look from different places


# Spoiling


def by_pose(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def spoil(frames: Frames) -> Frames:
        return [replace(f, T_world_camera=change(f.require_pose())) for f in frames]

    return spoil


def longer(factor: float) -> Change:
    def change(T: np.ndarray) -> np.ndarray:
        changed = T.copy()
        changed[:3, 3] *= factor
        return changed

    return by_pose(change)


def w_first(T: np.ndarray) -> np.ndarray:
    x, y, z, w = rotation_to_quaternion(T[None, :3, :3])[0]
    changed = T.copy()
    changed[:3, :3] = quaternion_to_rotation(np.array([[w, x, y, z]]))[0]
    return changed


def transposed(T: np.ndarray) -> np.ndarray:
    changed = T.copy()
    changed[:3, :3] = T[:3, :3].T
    return changed


def deeper(factor: float) -> Change:
    return lambda frames: [
        replace(f, depth=(f.depth * np.float32(factor)).astype(np.float32)) for f in frames
    ]


def resized(factor: float, centre: bool = True) -> Change:
    def spoil(frames: Frames) -> Frames:
        spoiled = []
        for f in frames:
            c, move = f.camera, factor if centre else 1.0
            numbers = (
                c.fx * factor,
                c.fy * factor,
                (c.cx + 0.5) * move - 0.5,
                (c.cy + 0.5) * move - 0.5,
            )
            spoiled.append(replace(f, camera=PinholeCamera(c.width, c.height, *numbers)))
        return spoiled

    return spoil


def later(seconds: float) -> Change:
    """Poses of another moment."""

    def spoil(frames: Frames) -> Frames:
        times = np.array([f.timestamp for f in frames], np.float64)
        poses = np.array([f.require_pose() for f in frames])
        found = [pose_at_time(times, poses, time + seconds) for time in times]
        return [
            replace(f, T_world_camera=T)
            for f, T in zip(frames, found, strict=True)
            if T is not None
        ]

    return spoil


def beside(right: float, down: float) -> Change:
    """Colour moved by so many pixels of images 640 wide."""

    def spoil(frames: Frames) -> Frames:
        spoiled = []
        for f in frames:
            wide = f.camera.width / 640
            moved = np.array([[1, 0, right * wide], [0, 1, down * wide]], np.float32)
            color = np.asarray(f.color, np.uint8)
            size = color.shape[1], color.shape[0]
            color = cv2.warpAffine(color, moved, size, borderMode=cv2.BORDER_REPLICATE)
            spoiled.append(replace(f, color=color))
        return spoiled

    return spoil


def far_plane(value: float) -> Change:
    """What is farthest, and what has no reading, as a number."""

    def spoil(frames: Frames) -> Frames:
        spoiled = []
        for f in frames:
            depth = f.depth.copy()
            depth[(depth == 0) | (depth > np.percentile(depth[depth > 0], 90))] = value
            spoiled.append(replace(f, depth=depth))
        return spoiled

    return spoil


def exchanged(frames: Frames) -> Frames:
    """Two frames in each other's place."""
    a, b = len(frames) // 4, 3 * len(frames) // 4
    spoiled = list(frames)
    spoiled[a] = replace(frames[a], depth=frames[b].depth, color=frames[b].color)
    spoiled[b] = replace(frames[b], depth=frames[a].depth, color=frames[a].color)
    return spoiled


def twice(frames: Frames) -> Frames:
    """Every picture twice."""
    return [
        replace(f, depth=frames[i - i % 2].depth, color=frames[i - i % 2].color)
        for i, f in enumerate(frames)
    ]


def brighter(factor: float, begin: float = 0.5) -> Change:
    """A jump of exposure after that share of the frames."""

    def spoil(frames: Frames) -> Frames:
        first = int(begin * len(frames))
        return [
            f
            if i < first
            else replace(f, color=cv2.convertScaleAbs(np.asarray(f.color), alpha=factor))
            for i, f in enumerate(frames)
        ]

    return spoil


def neighbors_exchanged(frames: Frames) -> Frames:
    """The pictures of the second third of frames in reverse order."""
    a, b = len(frames) // 3, 2 * len(frames) // 3
    order = [*range(a), *reversed(range(a, b)), *range(b, len(frames))]
    return [
        replace(f, depth=frames[i].depth, color=frames[i].color)
        for f, i in zip(frames, order, strict=True)
    ]


def one_pose(frames: Frames) -> Frames:
    return [replace(f, T_world_camera=frames[0].T_world_camera) for f in frames]


SPOILINGS = {
    "depth_scale 200 for 1000": Spoiling("depth-scale", deeper(5), 200.0),
    "depth_scale 5000 for 1000": Spoiling("depth-scale", deeper(0.2), 5000.0),
    "depth_scale 500 for 1000": Spoiling("depth-scale", deeper(2), 500.0, moving=True),
    "depth_scale 1 for 1000": Spoiling("depth-scale", deeper(1000), 1.0, poses=0),
    "world to camera": Spoiling("pose-reading", by_pose(np.linalg.inv), moving=True),
    "OpenGL axes": Spoiling("pose-reading", by_pose(lambda T: T @ FLIP_YZ), moving=True),
    "w first": Spoiling("pose-reading", by_pose(w_first), moving=True),
    "transposed": Spoiling("pose-reading", by_pose(transposed), moving=True),
    "centimetres": Spoiling("pose-scale", longer(100)),
    "millimetres": Spoiling("pose-scale", longer(1000)),
    "times 0.37": Spoiling("pose-scale", longer(0.37), moving=True),
    "times 3": Spoiling("pose-scale", longer(3), moving=True),
    "clock 0.2 s late": Spoiling("clock-offset", later(0.2), poses=20, moving=True),
    "clock 0.3 s early": Spoiling("clock-offset", later(-0.3), poses=20, moving=True),
    "intrinsics of half the size": Spoiling("intrinsics", resized(0.5), poses=0),
    "intrinsics of 1.5 times": Spoiling("intrinsics", resized(1.5), poses=0),
    "focal length times 1.4": Spoiling("intrinsics", resized(1.4, False), moving=True),
    "colour beside depth": Spoiling("color", beside(-14, 8), poses=0),
    "far plane 1e10": Spoiling("far-plane", far_plane(1e10), poses=0),
    "far plane 65504": Spoiling("far-plane", far_plane(65504.0), poses=0),
    "far plane 65.535 m": Spoiling("far-plane", far_plane(65.535), poses=0),
    "far plane 100 m": Spoiling("far-plane", far_plane(100.0), poses=0),
    "one pose for all": Spoiling("still", one_pose, poses=4, moving=True),
    "every picture twice": Spoiling("repeated", twice, poses=4),
    "two frames exchanged": Spoiling("swapped", exchanged, poses=8, moving=True),
    "jump of exposure": Spoiling("exposure", brighter(1.6), poses=4),
}

MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
FORWARD_X = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # T_camera_robot

# Written by hand after the doctor was done, and not used to make it: --held-out
HELD_OUT = {
    "depth_scale 4000 for 1000": Spoiling("depth-scale", deeper(0.25), 4000.0),
    "depth_scale 6553.5 for 1000": Spoiling("depth-scale", deeper(0.1526), 6553.5),
    "depth_scale 100 for 1000": Spoiling("depth-scale", deeper(10), 100.0),
    "depth 1.7 times": Spoiling("depth-scale", deeper(1.7), 588.2, moving=True),
    "poses in inches": Spoiling("pose-scale", longer(39.37)),
    "poses in feet": Spoiling("pose-scale", longer(3.281), moving=True),
    "poses times 0.1": Spoiling("pose-scale", longer(0.1), moving=True),
    "poses times 0.6": Spoiling("pose-scale", longer(0.6), moving=True),
    "poses times 12": Spoiling("pose-scale", longer(12)),
    "a robot's axes": Spoiling("pose-reading", by_pose(lambda T: T @ FORWARD_X), moving=True),
    "OpenGL, world to camera": Spoiling(
        "pose-reading", by_pose(lambda T: np.linalg.inv(T @ FLIP_YZ)), moving=True
    ),
    "left-handed": Spoiling("pose-reading", by_pose(lambda T: MIRROR @ T @ MIRROR), moving=True),
    "w first, world to camera": Spoiling(
        "pose-reading", by_pose(lambda T: w_first(np.linalg.inv(T))), moving=True
    ),
    "clock 0.15 s late": Spoiling("clock-offset", later(0.15), poses=20, moving=True),
    "clock 0.12 s early": Spoiling("clock-offset", later(-0.12), poses=20, moving=True),
    "intrinsics of three quarters": Spoiling("intrinsics", resized(0.75), poses=0),
    "intrinsics of five quarters": Spoiling("intrinsics", resized(1.25), poses=0),
    "focal length times 0.75": Spoiling("intrinsics", resized(0.75, False), moving=True),
    "colour 25 pixels aside": Spoiling("color", beside(25, 0), poses=0),
    "colour 10 pixels above": Spoiling("color", beside(0, -10), poses=0),
    "far plane 1000 m": Spoiling("far-plane", far_plane(1000.0), poses=0),
    "far plane 40 m": Spoiling("far-plane", far_plane(40.0), poses=0),
    "a stretch in reverse": Spoiling("swapped", neighbors_exchanged, poses=8, moving=True),
    "exposure times 0.6": Spoiling("exposure", brighter(0.6, 0.3), poses=4),
}
