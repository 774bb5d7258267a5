"""Surface points that several frames of a recording see: what says whether colour fits depth."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError
from ..geometry import se3
from ..types import Frame, PinholeCamera
from .dataset import Dataset, velocities_of

MEMBERS = 5  # frames of a group
# [m], [rad] between consecutive frames of a group; the first that gives enough groups
MOVES = ((0.05, np.radians(3.0)), (0.035, np.radians(2.1)), (0.025, np.radians(1.5)))
GROUPS = 8  # enough
MOST_GROUPS = 16
POINTS = 900  # a frame
STEP = 3 / 640  # of the image's width between pixels that points are drawn from
NEAR, FAR = 0.3, 5.0  # [m]
SAME_DEPTH = 0.02  # relative: a frame sees a point where its own reading is no farther off
BORDER = 4  # [pixels] of the depth image that are left out


@dataclass(frozen=True)
class Sightings:
    """Points of G places of a surface as M neighbouring frames see them."""

    camera: PinholeCamera  # of depth, and of the colour images as long as nothing is known
    colors: tuple[NDArray[np.uint8], ...]  # M images (H, W, 3) RGB, not registered
    points: NDArray[np.float32]  # (M, G, 3) in each frame's depth camera [m]
    seen: NDArray[np.bool_]  # (M, G) the frame's own reading is there
    velocity: NDArray[np.float64]  # (M, 6) twists a second of the depth camera


def find_sightings(recording: Dataset, seed: int = 0) -> Iterator[Sightings]:
    """Groups of frames from all over a recording, by its poses, and the points that two or more of a
    group see; groups whose frames cannot be read, or show nothing in common, are left out.
    """
    times_poses = [recording.pose_at(i) for i in range(len(recording))]
    velocities = velocities_of(times_poses)
    rng = np.random.default_rng(seed)
    for members in choose_groups([T for _, T in times_poses]):
        try:
            frames = [recording[i] for i in members]
        except FrameError:
            continue
        if any(frame.color is None for frame in frames):
            continue
        points, seen = _points_of(frames, rng)
        if points.shape[1] >= POINTS // 4:
            colors = tuple(frame.color for frame in frames if frame.color is not None)
            yield Sightings(frames[0].camera, colors, points, seen, velocities[members])


def choose_groups(poses: Sequence[NDArray | None]) -> list[list[int]]:
    """Groups of MEMBERS frames that follow each other, evenly from a recording, each frame a step
    from the one before: far enough that they look from different places, near enough that they see
    the same.
    """
    groups: list[list[int]] = []
    for move, turn in MOVES:
        steps = _steps(poses, move, turn)
        groups = [steps[i : i + MEMBERS] for i in range(0, len(steps) - MEMBERS + 1, MEMBERS)]
        if len(groups) >= GROUPS:
            break
    kept = np.linspace(0, len(groups) - 1, min(len(groups), MOST_GROUPS)).round().astype(int)
    return [groups[i] for i in kept]


def _steps(poses: Sequence[NDArray | None], move: float, turn: float) -> list[int]:
    """Frames that are a step [m] or a turn [rad] from the one chosen before."""
    chosen: list[int] = []
    last = None
    for i, T in enumerate(poses):
        if T is None:
            continue
        if last is None or _apart(last, T, move, turn):
            chosen.append(i)
            last = T
    return chosen


def _apart(T_a: NDArray, T_b: NDArray, move: float, turn: float) -> bool:
    """Whether two poses are at least a move [m] or a turn [rad] apart."""
    cosine = (np.sum(T_a[:3, :3] * T_b[:3, :3]) - 1) / 2
    return bool(np.linalg.norm(T_a[:3, 3] - T_b[:3, 3]) >= move or cosine <= np.cos(turn))


def _points_of(
    frames: Sequence[Frame], rng: np.random.Generator
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Points of all frames in the coordinates of each (M, G, 3), and which frame sees which (M, G)."""
    points, seen = [], []
    for frame in frames:
        own = _readings(frame, rng)
        T_world_own = frame.require_pose()
        found = [_sees(other, own, T_world_own, other is frame) for other in frames]
        shared = np.sum([sees for _, sees in found], axis=0) >= 2
        points.append(np.stack([at[shared] for at, _ in found]))
        seen.append(np.stack([sees[shared] for _, sees in found]))
    return np.concatenate(points, axis=1).astype(np.float32), np.concatenate(seen, axis=1)


def _readings(frame: Frame, rng: np.random.Generator) -> NDArray[np.float64]:
    """Some points (N, 3) of a frame in its camera's coordinates [m]."""
    camera = frame.camera
    step = max(1, round(STEP * camera.width))
    v, u = np.mgrid[step // 2 : camera.height : step, step // 2 : camera.width : step].reshape(
        2, -1
    )
    usable = np.flatnonzero((frame.depth[v, u] > NEAR) & (frame.depth[v, u] < FAR))
    drawn = rng.choice(usable, min(len(usable), POINTS), replace=False)
    u, v = u[drawn], v[drawn]
    return camera.rays(u, v) * frame.depth[v, u][:, None]


def _sees(
    frame: Frame, points: NDArray, T_world_points: NDArray, own: bool
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Points (N, 3) in a frame's coordinates, and which of them it sees."""
    T_frame_points = se3.inverse(frame.require_pose()) @ T_world_points
    at = points @ T_frame_points[:3, :3].T + T_frame_points[:3, 3]
    if own:
        return at, np.ones(len(at), bool)
    height, width = frame.depth.shape
    inner = frame.depth[BORDER : height - BORDER, BORDER : width - BORDER]
    u, v = np.rint(np.nan_to_num(frame.camera.project(at), nan=-1.0)).astype(int).T - BORDER
    inside = (u >= 0) & (v >= 0) & (u < inner.shape[1]) & (v < inner.shape[0])
    reading = np.where(inside, inner[np.where(inside, v, 0), np.where(inside, u, 0)], 0)
    return at, inside & (np.abs(reading - at[:, 2]) < SAME_DEPTH * at[:, 2])
