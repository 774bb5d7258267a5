"""In which ways poses are written: direction, order of the quaternion, the camera's axes.

A reading is a name of one to three words joined by "+", as "w2c+opengl", which `pose_reading` of
`open_dataset` takes too: what is to be done to poses that were read as x y z w, camera to world, x
right, y down, z forward.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, check_choice
from ..geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion
from ..geometry.se3 import FLIP_YZ

AS_READ = "c2w"  # the reading that changes nothing
Change = Callable[[NDArray], NDArray]

FLIP_Y = np.diag([1.0, -1.0, 1.0, 1.0])
BODY = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
QUARTER = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


def _w_first(T: NDArray[np.float64]) -> NDArray[np.float64]:
    return _with_quaternions(T, [1, 2, 3, 0])


def _w_last(T: NDArray[np.float64]) -> NDArray[np.float64]:
    return _with_quaternions(T, [3, 0, 1, 2])


def _with_quaternions(T: NDArray[np.float64], order: list[int]) -> NDArray[np.float64]:
    changed = T.copy()
    q = rotation_to_quaternion(T[:, :3, :3])
    changed[:, :3, :3] = quaternion_to_rotation(q[:, order])
    return changed


def _transposed(T: NDArray[np.float64]) -> NDArray[np.float64]:
    changed = T.copy()
    changed[:, :3, :3] = T[:, :3, :3].transpose(0, 2, 1)
    return changed


def _right(matrix: NDArray[np.float64]) -> Change:
    return lambda T: T @ matrix


# word -> what it does to (N, 4, 4), in the order in which they apply: one of each group
ROTATIONS: dict[str, Change] = {
    "w-first": _w_first,
    "w-last": _w_last,
    "transposed": _transposed,
}
DIRECTIONS: dict[str, Change] = {"w2c": lambda T: np.linalg.inv(T)}
AXES: dict[str, Change] = {
    "opengl": _right(FLIP_YZ),
    "body": _right(BODY),
    "left-handed": lambda T: FLIP_Y @ T @ FLIP_Y,
    "turned-left": _right(QUARTER.T),
    "turned-right": _right(QUARTER),
    "turned-over": _right(QUARTER @ QUARTER),
    "opengl-turned-left": _right(FLIP_YZ @ QUARTER.T),
    "opengl-turned-right": _right(FLIP_YZ @ QUARTER),
}
GROUPS = (ROTATIONS, DIRECTIONS, AXES)
PHRASES = {
    "w-first": "quaternions written w x y z, where x y z w was read",
    "w-last": "quaternions written x y z w, where w x y z was read",
    "transposed": "rotations that are transposed (the quaternion of the opposite turn)",
    "w2c": "world-to-camera matrices: invert them",
    "opengl": "OpenGL's axes (y up, z backward): multiply them from the right by diag(1, -1, -1, 1)",
    "w2c+opengl": "world-to-camera matrices with OpenGL's axes: invert diag(1, -1, -1, 1) times each",
    "body": "the axes of a robot (x forward, y left, z up), not the camera's",
    "left-handed": "a left-handed world (Unity's: y up)",
    "turned-left": "of a camera turned by 90 degrees to the left against the images",
    "turned-right": "of a camera turned by 90 degrees to the right against the images",
    "turned-over": "of a camera that is upside down against the images",
    "opengl-turned-left": "OpenGL's axes of a camera turned by 90 degrees to the left",
    "opengl-turned-right": "OpenGL's axes of a camera turned by 90 degrees to the right",
}


def _name(words: tuple[str, ...]) -> str:
    return "+".join(word for word in words if word) or AS_READ


# every reading, simple ones first
NAMES = tuple(
    sorted(
        (_name(words) for words in product(*(("", *group) for group in GROUPS))),
        key=lambda name: (name != AS_READ, name.count("+")),
    )
)
SINGLE = tuple(name for name in NAMES if "+" not in name)


def read_as(name: str, T_world_camera: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (N, 4, 4) that were read as usual, under the reading `name`; InputError for an unknown
    one.
    """
    check_reading(name)
    T = np.asarray(T_world_camera, np.float64)
    words = name.split("+")
    for group in GROUPS:
        for word, change in group.items():
            if word in words:
                T = change(T)
    return T


def check_reading(name: str) -> str:
    """The name of a reading, or InputError with the words that it is made of."""
    if name in NAMES:
        return name
    known = [AS_READ, *(word for group in GROUPS for word in group)]
    for word in name.split("+"):
        check_choice("pose_reading", word, known)
    raise InputError(
        f"pose_reading: '{name[:80]}' must be one word of each group at most, joined by '+', in this order: "
        f"{'; '.join(' '.join(group) for group in GROUPS)}"
    )


def describe(name: str) -> str:
    """A reading as the end of the sentence "they are ..."."""
    if name == AS_READ:
        return "camera-to-world poses, as they were read"
    if name in PHRASES:
        return PHRASES[name]
    words = name.split("+")
    first, rest = (words[0], "+".join(words[1:])) if words[0] in ROTATIONS else ("", name)
    parts = [PHRASES[first]] if first else []
    if rest:
        parts += [PHRASES[rest]] if rest in PHRASES else [PHRASES[word] for word in rest.split("+")]
    return ", and ".join(parts)
