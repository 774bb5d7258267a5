"""Stretches of recordings to track: real and rendered, as they are and made harder.

Each has a name, `kitchen-every5`, and says which folder of the data it needs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tracking_scenes as scenes

import taichi_unifusion as uf
from taichi_unifusion.datasets import Dataset, DatasetView
from taichi_unifusion.types import Frame

KITCHEN, HOUSE, DESK = "7scenes-redkitchen", "aws-small-house", "tum-fr1desk9"
CROP = 0.6  # of the image's width and height that is kept
DARK, DARK_GAMMA = 0.35, 1.3
NOISE = 0.004  # [m] at 1 m, growing with the square of the distance
MILLIMETRE = 1e-3


@dataclass(frozen=True)
class Stretch:
    """Frames to track, and whether their poses are exact; those of the kitchen are not."""

    load: Callable[[Path], Dataset]
    exact: bool = False


class Changed(DatasetView):
    """Frames of a data set, each changed on its way, numbered from 0."""

    def __init__(self, frames: Dataset, change: Callable[[Frame, int], Frame]) -> None:
        super().__init__(frames, range(len(frames)))
        self.change = change

    def load(self, index: int) -> Frame:
        return replace(self.change(super().load(index), index), index=index)


def cropped(frame: Frame, index: int) -> Frame:
    """The middle of the image: a narrow lens."""
    camera = frame.camera
    width, height = (int(CROP * size) // 16 * 16 for size in camera.size)
    x, y = (camera.width - width) // 2, (camera.height - height) // 2
    part = slice(y, y + height), slice(x, x + width)
    smaller = replace(camera, width=width, height=height, cx=camera.cx - x, cy=camera.cy - y)
    return replace(
        frame,
        depth=np.ascontiguousarray(frame.depth[part]),
        color=None if frame.color is None else np.ascontiguousarray(frame.color[part]),
        camera=smaller,
    )


def halved(frame: Frame, index: int) -> Frame:
    """Every second pixel of depth, colour averaged."""
    camera = frame.camera.shrunk(2)
    size = camera.width, camera.height
    # the centre of a pixel is the corner of four: depth of one of them, half a pixel away
    depth = frame.depth[: 2 * camera.height : 2, : 2 * camera.width : 2]
    color = frame.color
    shifted = replace(camera, cx=frame.camera.cx / 2, cy=frame.camera.cy / 2)
    return replace(
        frame,
        depth=np.ascontiguousarray(depth),
        color=None if color is None else cv2.resize(color, size, interpolation=cv2.INTER_AREA),
        camera=shifted,
    )


def noisy(frame: Frame, index: int) -> Frame:
    """Depth with as much noise again, and noise in colour."""
    rng = np.random.default_rng(index)
    depth = frame.depth + (NOISE * frame.depth**2 * rng.normal(size=frame.depth.shape))
    depth = np.where(frame.depth > 0, np.round(depth / MILLIMETRE) * MILLIMETRE, 0)
    color = frame.color
    if color is not None:
        color = np.clip(color + rng.normal(0, 8, color.shape), 0, 255).astype(np.uint8)
    return replace(frame, depth=depth.astype(np.float32), color=color)


def darkened(frame: Frame, index: int) -> Frame:
    """Colour as in the evening, and with an exposure that wanders."""
    if frame.color is None:
        return frame
    light = DARK * (1 + 0.3 * np.sin(index / 7))
    color = 255 * light * (frame.color / 255.0) ** DARK_GAMMA
    noise = np.random.default_rng(index).normal(0, 2, color.shape)
    return replace(frame, color=np.clip(color + noise, 0, 255).astype(np.uint8))


def _same(frame: Frame, index: int) -> Frame:
    return frame


def _kitchen(part: slice, change: Callable[[Frame, int], Frame] = _same) -> Stretch:
    return Stretch(lambda data: Changed(uf.open_dataset("7scenes", data / KITCHEN)[part], change))


def _house(name: str, every: int = 1) -> Stretch:
    from house import load_house

    return Stretch(
        lambda data: Changed(load_house(data / HOUSE, name, noise=True, seed=0)[::every], _same),
        True,
    )


def _room(seed: int, frames: int = 60) -> Stretch:
    return Stretch(
        lambda data: uf.datasets.open_dataset("synthetic", frames=frames, seed=seed), True
    )


def _made(make: Callable[[], list[Frame]]) -> Stretch:
    return Stretch(lambda data: scenes.Listed(make()), True)


STRETCHES: dict[str, Stretch] = {
    "kitchen": _kitchen(slice(0, 300)),
    "kitchen-later": _kitchen(slice(300, None)),  # every fifth frame of 300 to 695 is there
    "kitchen-backwards": _kitchen(slice(299, None, -1)),
    "kitchen-every2": _kitchen(slice(0, 300, 2)),
    "kitchen-every3": _kitchen(slice(0, 300, 3)),
    "kitchen-every5": _kitchen(slice(0, 300, 5)),
    "kitchen-cropped": _kitchen(slice(0, 300, 2), cropped),
    "kitchen-half": _kitchen(slice(0, 300, 2), halved),
    "kitchen-noisy": _kitchen(slice(0, 300, 2), noisy),
    "kitchen-dark": _kitchen(slice(0, 300, 2), darkened),
    "house-tour": _house("tour"),
    "house-tour-every5": _house("tour", 5),
    "house-bedroom": _house("bedroom"),
    "house-bedroom-every5": _house("bedroom", 5),
    "house-living": _house("living"),
    "house-living-every5": _house("living", 5),
    "room": _room(0),
    "room-seed1": _room(1),
    "room-seed2": _room(2),
    "desk": Stretch(lambda data: uf.open_dataset("tum", data / DESK)),
    "walker": _made(scenes.walker),
    "walker-moving": _made(lambda: scenes.walker(moving=True)),
    "walker-stays": _made(lambda: scenes.walker(stays=10)),
    "robot-part": _made(scenes.robot_part),
    "corridor": _made(scenes.corridor),
    "turning": _made(scenes.turning),
    "80x60": _made(lambda: scenes.loop(120, 80, 10)),
    "distorted": _made(lambda: scenes.distorted(scenes.loop(120, 320, 10))),
}
