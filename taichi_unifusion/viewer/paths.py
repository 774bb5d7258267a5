"""Ways through a scene for a camera: along the recorded trajectory, around everything, from side to
side.

A path is an array (N, 4, 4) of T_world_camera, camera x right, y down, z forward.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..types import PinholeCamera

METRES_PER_RADIAN = 0.5  # how far a turn counts as a way
SMOOTHING = 0.3  # [m] of the way, standard deviation of the Gaussian that evens a hand's shake out
SHORTEST = 0.1  # [m] of a trajectory that is worth flying along
SPEED = 0.35  # [m/s] of flights along a trajectory
SECONDS = (4.0, 60.0)  # that a flight takes at least and at most, unless somebody asks
ROUND_SECONDS = 12.0  # once around, or from side to side
STEPS_PER_METRE = 50
ELEVATION = math.radians(38)  # of a circle
SWAY = math.radians(18)  # to either side
LEVEL, STEEP = 0.9, 0.98  # |cosine| of the view and up: level cameras up to here, none from there
STRAY = 0.002  # share of the points that may lie outside the picture, on each side
ROOM = 1.04  # size of the picture over the size of what is fitted into it


def flight_along(
    T_world_camera: NDArray, up: NDArray, steps: int, smoothing: float = SMOOTHING
) -> NDArray[np.float64]:
    """A smooth, level flight of `steps` poses along recorded ones (N, 4, 4), at an even pace."""
    from scipy.ndimage import gaussian_filter1d
    from scipy.spatial.transform import Rotation, Slerp

    T = np.asarray(T_world_camera, np.float64)
    way = _way(T)
    distinct = np.concatenate([[True], np.diff(way) > 0])
    T, way = T[distinct], way[distinct]
    if len(T) == 1:
        return np.repeat(level(T[:, :3, 3], T[:, :3, 2], -T[:, :3, 1], up), steps, axis=0)
    dense = np.linspace(0, way[-1], max(2, math.ceil(way[-1] * STEPS_PER_METRE)))
    eyes = np.stack([np.interp(dense, way, T[:, k, 3]) for k in range(3)], axis=1)
    turns = Slerp(way, Rotation.from_matrix(T[:, :3, :3]))(dense).as_matrix()
    # a short way keeps most of its length
    sigma = min(smoothing, way[-1] / 10) * STEPS_PER_METRE
    smooth = [
        gaussian_filter1d(values, sigma, axis=0, mode="nearest")
        for values in (eyes, turns[:, :, 2], -turns[:, :, 1])
    ]
    at = np.linspace(0, len(dense) - 1, steps)
    eyes, forwards, ups = (
        np.stack([np.interp(at, np.arange(len(dense)), values[:, k]) for k in range(3)], axis=1)
        for values in smooth
    )
    return level(eyes, forwards, ups, up)


def flight_seconds(T_world_camera: NDArray) -> float:
    """How long a flight along recorded poses (N, 4, 4) takes."""
    return float(np.clip(_way(np.asarray(T_world_camera))[-1] / SPEED, *SECONDS))


def is_short(T_world_camera: NDArray) -> bool:
    """Whether poses (N, 4, 4) hardly move, so that a flight along them shows nothing."""
    return bool(_way(np.asarray(T_world_camera))[-1] < SHORTEST)


def circle_round(
    points: NDArray, up: NDArray, camera: PinholeCamera, steps: int, start: NDArray | None = None
) -> NDArray[np.float64]:
    """Once around `points` (N, 3) [m], looking at their middle from above, as near as they stay in
    the picture. It begins with the view along `start` (3,), if there is one.
    """
    side = (
        np.cross(up, np.eye(3)[np.abs(up).argmin()]) if start is None else start - start @ up * up
    )
    if np.linalg.norm(side) < 1e-6:
        side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side = -side / np.linalg.norm(side)
    angles = np.linspace(0, 2 * math.pi, steps, endpoint=False)[:, None]
    towards = np.cos(angles) * side + np.sin(angles) * np.cross(up, side)
    towards = math.cos(ELEVATION) * towards + math.sin(ELEVATION) * up  # from the middle to the eye
    low, high = np.percentile(points, (100 * STRAY, 100 - 100 * STRAY), axis=0)
    middle = (low + high) / 2
    distance = max(_fitting_distance(points - middle, way, up, camera) for way in towards[::8])
    eyes = middle + distance * towards
    return level(eyes, -towards, np.broadcast_to(up, eyes.shape), up)


def sway(T_world_camera: NDArray, depth: float, up: NDArray, steps: int) -> NDArray[np.float64]:
    """From side to side and back around the point that a camera (4, 4) looks at, `depth` [m] away:
    what one frame shows, with parallax.
    """
    T = np.asarray(T_world_camera, np.float64)
    target = T[:3, 3] + depth * T[:3, 2]
    angles = SWAY * np.sin(np.linspace(0, 2 * math.pi, steps, endpoint=False))
    back = -T[:3, 2]
    turned = [
        math.cos(a) * back + math.sin(a) * np.cross(up, back) + (1 - math.cos(a)) * (up @ back) * up
        for a in angles
    ]
    eyes = target + depth * np.array(turned)
    return level(eyes, target - eyes, np.repeat(-T[None, :3, 1], steps, axis=0), up)


def level(eyes: NDArray, forwards: NDArray, ups: NDArray, up: NDArray) -> NDArray[np.float64]:
    """Poses (N, 4, 4) at `eyes` that look along `forwards`, with a level horizon; those that look
    straight up or down keep their own `ups`, all (N, 3).
    """
    forwards = forwards / np.maximum(np.linalg.norm(forwards, axis=1, keepdims=True), 1e-12)
    steep = np.clip((np.abs(forwards @ up) - LEVEL) / (STEEP - LEVEL), 0, 1)[:, None]
    ups = (1 - steep) * up + steep * ups
    rights = np.cross(forwards, ups)
    rights /= np.maximum(np.linalg.norm(rights, axis=1, keepdims=True), 1e-12)
    T = np.zeros((len(eyes), 4, 4))
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2] = rights, np.cross(forwards, rights), forwards
    T[:, :3, 3], T[:, 3, 3] = eyes, 1
    return T


def _way(T: NDArray) -> NDArray[np.float64]:
    """(N,) [m] how far it is from the first pose to each, turns of the view included."""
    moved = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1)
    cosines = np.einsum("nd,nd->n", T[1:, :3, 2], T[:-1, :3, 2])
    turned = np.arccos(np.clip(cosines, -1, 1))
    return np.concatenate([[0.0], np.cumsum(moved + METRES_PER_RADIAN * turned)])


def _fitting_distance(
    points: NDArray, towards: NDArray, up: NDArray, camera: PinholeCamera
) -> float:
    """How far an eye stands off in the direction `towards` so that points about the middle fit."""
    T = level(towards[None], -towards[None], up[None], up)[0]
    x, y, z = (points @ T[:3, :3]).T
    half = camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)
    needed = np.maximum(np.abs(x) * ROOM / half[0], np.abs(y) * ROOM / half[1]) - z
    return float(np.quantile(needed, 1 - 2 * STRAY))
