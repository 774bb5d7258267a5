"""Which way is up in a map: the normal of its floor, or else what the poses of its cameras say.

The world of a recording may lie in any way: its first camera's, a volume's, a levelled one. Floors,
tables and seats face up and are flat; cameras are held level and look ahead or down. Both together
tell a floor from a wall.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .triangles import areas, sample_patches

How = Literal["given", "recording", "floor", "convention", "cameras", "guess"]

SAMPLES = 20_000  # points of the surface, evenly over its area
DIRECTIONS = 600  # normals of samples that are tried as up
ALIKE = np.cos(np.radians(10))  # normals of one direction; a Kinect's noise is about as large
OTHER = np.cos(np.radians(25))  # directions farther apart than this are different answers
STARTS = 8  # directions that planes are fitted to
SHIFTS = 10  # of a mean of normals until it rests
DOWN = 0.5  # what a surface that faces down counts, against one that faces up
# mean cosine between up and the cameras' own: they may look down by 75 degrees, up by 45
LEAST_LIFT, LEAST_LIFT_UPWARDS = 0.25, 0.7
ROLL = 0.35  # sine of the roll of cameras held by hand, rarely more
LEAST_SHARE = 0.02  # of the surface's area that lies in level planes, or no floor is believed
CLEAR = 0.7  # score of the second best direction over the best, or neither is believed
FLAT = np.cos(np.radians(20))  # normals of a plane's samples
SMEARED = 0.65  # scatter of a plane's heights over that of evenly spread ones: less is a plane
BIN = 0.02  # [m] of heights, looked for level planes
# [m] of a plane's samples to either side: a direction that is some degrees off smears a plane
THICKNESSES = (0.12, 0.06, 0.04, 0.04)
PLANE_SHARE = 0.1  # of the largest level plane's area that makes another one
FLOOR_SHARE = 0.2  # the floor is the lowest plane of at least this share of the largest one's area
LEAST_EXTENT = (
    0.15  # [m] standard deviation of a plane's samples along its narrow side, to be fitted
)
CONVENTION = np.sin(np.radians(1.5))  # how level all cameras of a levelled recording are
LEVELLED = np.cos(np.radians(0.5))  # a floor's normal so near an axis of the world is that axis
LEAST_MEAN = 0.2  # length of the mean of the cameras' up, below which it says nothing
AXES = (
    (0, 0, 1.0),
    (0, -1.0, 0),
    (0, 1.0, 0),
    (0, 0, -1.0),
)  # ups that worlds have, likeliest first
SAID = {  # how up was found, for people
    "given": "up is as given",
    "recording": "up is as the recording says",
    "floor": "up is the floor's normal",
    "convention": "up is the axis of the world that all cameras are level to; no floor could be told",
    "cameras": "up is the mean of the cameras' own, a guess: no floor could be told; --up x,y,z gives it",
    "guess": "up is a guess: no floor could be told and there are no poses; --up x,y,z gives it",
}


@dataclass(frozen=True)
class Up:
    """The direction against gravity, how it was found, and where the floor is."""

    direction: NDArray[np.float64]  # (3,) unit, world
    how: How
    floor: float = 0.0  # height of the floor along `direction` [m]; 0 where it is not known

    @property
    def T_up_world(self) -> NDArray[np.float64]:
        """(4, 4) from the world to one with z up and the floor at z = 0, by the smallest turn."""
        T = np.eye(4)
        T[:3, :3] = smallest_turn(self.direction, np.array([0.0, 0.0, 1.0]))
        T[2, 3] = -self.floor
        return T

    @property
    def sentence(self) -> str:
        """How it was found, in words."""
        return SAID[self.how]


def parse_up(text: str) -> Up:
    """Up as a user writes it: an axis of the world, as in "z" or "-y", or three numbers "x,y,z"."""
    name = text.strip().lower()
    if name.removeprefix("-") in ("x", "y", "z"):
        axis = np.eye(3)["xyz".index(name[-1])]
        return Up(-axis if name[0] == "-" else axis, "given")
    try:
        direction = np.array([float(word) for word in name.split(",")])
        length = float(np.linalg.norm(direction))
    except ValueError:
        direction, length = np.zeros(0), 0.0
    if direction.shape != (3,) or not 0 < length < np.inf:
        raise InputError(
            f"up: expected an axis as z or -y, or three numbers as 0,-0.9,0.1, got '{text[:80]}'"
        )
    return Up(direction / length, "given")


def up_of_transform(T_up_world: NDArray, how: How) -> Up:
    """The Up whose T_up_world (4, 4) this is."""
    return Up(np.array(T_up_world[2, :3], np.float64), how, -float(T_up_world[2, 3]))


def smallest_turn(a: NDArray, b: NDArray) -> NDArray[np.float64]:
    """The rotation (3, 3) by the smallest angle that takes unit vector a to b; about x or y where
    they are opposite.
    """
    cosine = float(a @ b)
    if cosine < -1 + 1e-12:
        axis = np.eye(3)[int(np.abs(b).argmin())]
        axis -= (axis @ b) * b
        axis /= np.linalg.norm(axis)
        return 2 * np.outer(axis, axis) - np.eye(3)
    half = (a + b) / np.sqrt(2 * (1 + cosine))  # unit, midway: two reflections make a rotation
    return (np.eye(3) - 2 * np.outer(half, half)) @ (np.eye(3) - 2 * np.outer(a, a))


def find_up(vertices: NDArray, faces: NDArray, T_world_camera: NDArray) -> Up:
    """Up of a mesh, vertices (V, 3) [m] and faces (F, 3) that face free space, seen by the cameras
    (N, 4, 4), of which there may be none.

    The normal of the level planes if these are told from everything else; the world's axis that all
    cameras are level to; the mean of the cameras' up; what worlds usually have.
    """
    cameras = np.asarray(T_world_camera, np.float64).reshape(-1, 4, 4)
    bad = ~np.isfinite(vertices)
    if bad.any():
        faces = faces[~bad[faces].any(axis=(1, 2))]
    fallback = _from_poses(cameras)
    if not len(faces) or not areas(vertices, faces).sum() > 0:
        return fallback
    points, normals = sample_patches(vertices, faces, SAMPLES, np.random.default_rng(0))
    if not len(cameras):
        fallback = Up(_guess(normals), "guess")
    prior = _Prior.of(cameras, fallback.direction)
    found = [
        _fit_levels(points, normals, start, prior) for start in _facing_directions(normals, prior)
    ]
    found = sorted((each for each in found if each.score > LEAST_SHARE * SAMPLES), reverse=True)
    others = [each.score for each in found if each.direction @ found[0].direction < OTHER]
    if not found or max(others, default=0.0) > CLEAR * found[0].score:
        return fallback
    return Up(_levelled(found[0].direction), "floor", found[0].floor)


def _levelled(direction: NDArray[np.float64]) -> NDArray[np.float64]:
    """The axis of the world that is so near that the world was levelled, or the direction itself."""
    place = int(np.abs(direction).argmax())
    axis = np.eye(3)[place] * np.sign(direction[place])
    return axis if axis @ direction > LEVELLED else direction


@dataclass(frozen=True)
class _Prior:
    """What cameras say about a direction's chance to be up; without any, how near it is to a guess."""

    rights: NDArray[np.float64]  # (N, 3) x of the cameras
    up: NDArray[np.float64]  # (3,) mean of the cameras' -y, not of unit length; or the guess
    forward: NDArray[np.float64]  # (3,) mean of the cameras' z; 0 without any
    eyes: NDArray[np.float64]  # (N, 3) world [m]

    @classmethod
    def of(cls, cameras: NDArray, guess: NDArray) -> _Prior:
        if not len(cameras):
            return cls(np.empty((0, 3)), guess, np.zeros(3), np.empty((0, 3)))
        down, forward = cameras[:, :3, 1:3].mean(axis=0).T
        return cls(cameras[:, :3, 0], -down, forward, cameras[:, :3, 3])

    def weigh(self, directions: NDArray) -> NDArray[np.float64]:
        """(M,) weights of directions (M, 3): cameras look ahead or down, and are not rolled."""
        lift = directions @ self.up
        roll = (directions @ self.rights.T) ** 2
        straight = np.exp(-0.5 * roll.mean(axis=1) / ROLL**2) if len(self.rights) else 1.0
        upwards = directions @ self.forward > 0
        allowed = lift > np.where(upwards, LEAST_LIFT_UPWARDS * np.linalg.norm(self.up), LEAST_LIFT)
        return np.where(allowed, lift * straight, 0.0)


def _facing_directions(normals: NDArray, prior: _Prior) -> list[NDArray[np.float64]]:
    """Directions that much of the surface faces and cameras allow to be up, most first."""
    tried = normals[:: max(1, len(normals) // DIRECTIONS)]
    tried = np.concatenate([tried, -tried])
    weights = prior.weigh(tried)
    tried, weights = tried[weights > 0], weights[weights > 0]
    cosines = tried @ normals.T
    facing = (cosines > ALIKE).mean(axis=1) + DOWN * (cosines < -ALIKE).mean(axis=1)
    scores, starts = weights * facing, []
    while len(starts) < STARTS and scores.any():
        best = int(scores.argmax())
        starts.append(_fullest_direction(normals, tried[best]))
        scores = np.where(tried @ tried[best] > ALIKE, 0.0, scores)
    return starts


def _fullest_direction(normals: NDArray, start: NDArray) -> NDArray[np.float64]:
    """The direction near `start` around which the normals, or their opposites, lie densest: the
    prior pulls the best of those tried towards the cameras' up.
    """
    direction = start
    for _ in range(SHIFTS):
        cosines = normals @ direction
        alike = np.abs(cosines) > ALIKE
        mean = np.sign(cosines[alike]) @ normals[alike]
        direction = mean / np.linalg.norm(mean)
    return direction


@dataclass(frozen=True, order=True)
class _Levels:
    """A direction whose level planes were looked for."""

    score: float  # samples that lie in them, by the direction's weight
    direction: NDArray[np.float64] = field(compare=False)  # (3,) unit
    floor: float = field(compare=False, default=0.0)  # height along it [m]


def _fit_levels(points: NDArray, normals: NDArray, start: NDArray, prior: _Prior) -> _Levels:
    """The direction near `start` that has the level planes which fit it best."""
    direction, planes = start, []
    for thickness in THICKNESSES:
        planes = _level_planes(points, normals, direction, prior.eyes, thickness)
        direction = _common_normal(planes, direction)
    smeared = SMEARED * THICKNESSES[-1] / np.sqrt(3)  # of heights that are spread evenly
    planes = [plane for plane in planes if (plane.points @ direction).std() < smeared]
    if not planes:
        return _Levels(0.0, direction)
    below = [plane for plane in planes if plane.below] or planes  # only ceilings, or tables above
    largest = max(len(plane.points) for plane in below)
    heights = [
        float(np.median(plane.points @ direction))
        for plane in below
        if len(plane.points) >= FLOOR_SHARE * largest
    ]
    weight = float(prior.weigh(direction[None])[0])
    return _Levels(weight * sum(len(plane.points) for plane in planes), direction, min(heights))


@dataclass(frozen=True)
class _Plane:
    """Samples of the surface that lie at one height."""

    points: NDArray[np.float64]  # (N, 3) world [m]
    normals: NDArray[np.float64]  # (N, 3)
    below: bool  # it faces up, and the cameras are above it


def _level_planes(
    points: NDArray, normals: NDArray, up: NDArray, eyes: NDArray, thickness: float
) -> list[_Plane]:
    """The heights along `up` at which much of the surface lies level, facing up or down."""
    planes: list[_Plane] = []
    ceiling = np.median(eyes @ up) if len(eyes) else np.inf
    for side in (1, -1):
        level = side * (normals @ up) > FLAT
        level_points, level_normals = points[level], side * normals[level]
        heights = level_points @ up
        free = np.ones(len(heights), bool)
        while free.sum() > 10:
            height = _fullest_height(heights[free], thickness)
            plane = np.abs(heights - height) < thickness
            free &= np.abs(heights - height) >= 2 * thickness
            below = side > 0 and height < ceiling
            planes.append(_Plane(level_points[plane], level_normals[plane], bool(below)))
            if len(planes[-1].points) < PLANE_SHARE * max(len(each.points) for each in planes):
                planes.pop()
                break
    return planes


def _fullest_height(heights: NDArray, thickness: float) -> float:
    """The middle of the slab of a plane's thickness that holds most of the heights."""
    low = heights.min()
    counts = np.bincount(((heights - low) / BIN).astype(int))
    width = round(2 * thickness / BIN)
    sums = np.convolve(counts, np.ones(width), "full")
    start = low + (int(sums.argmax()) - width + 1) * BIN
    inside = heights[(heights >= start) & (heights < start + width * BIN)]
    return float(np.median(inside))


def _common_normal(planes: list[_Plane], up: NDArray) -> NDArray[np.float64]:
    """The normal that fits all planes best, each about its own centre: the direction in which their
    samples scatter least; where they are too narrow for that, the mean of their normals.
    """
    scatter, count = np.zeros((3, 3)), 0
    for plane in planes:
        centered = plane.points - plane.points.mean(axis=0)
        scatter += centered.T @ centered
        count += len(centered)
    variances, axes = np.linalg.eigh(scatter / max(count, 1))
    fitted = axes[:, 0] * np.sign(axes[:, 0] @ up)
    if variances[1] >= LEAST_EXTENT**2 and fitted @ up > ALIKE:
        return fitted
    mean = sum((plane.normals.sum(axis=0) for plane in planes), np.zeros(3))
    return mean / np.linalg.norm(mean)


def _from_poses(cameras: NDArray) -> Up:
    """What poses alone say: an axis of the world that every camera is level to, or the mean."""
    mean = -cameras[:, :3, 1].mean(axis=0) if len(cameras) else np.zeros(3)
    length = float(np.linalg.norm(mean))
    for axis in np.array(AXES):
        level = np.abs(cameras[:, :3, 0] @ axis) < CONVENTION
        if len(cameras) > 1 and level.all() and axis @ mean > LEAST_LIFT:
            return Up(axis, "convention")
    if length > LEAST_MEAN:
        return Up(mean / length, "cameras")
    return Up(np.array(AXES[0]), "guess")


def _guess(normals: NDArray) -> NDArray[np.float64]:
    """+z, unless the surface faces that way less than another usual up: then the likeliest that it
    does face.
    """
    axes = np.array(AXES)
    shown = np.maximum(normals @ axes.T, 0).mean(axis=0)
    return axes[int((shown >= 0.6 * shown.max()).argmax())]
