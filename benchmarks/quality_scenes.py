"""What quality is measured on: frames to fuse, held-out frames in between to compare with, and the
true surface where known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from house import load_house
from tabletop import Tabletop

from taichi_unifusion.datasets import Dataset, open_dataset
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.tracking import track
from taichi_unifusion.types import Frame, Mesh

DEPTH_RANGE = (0.4, 5.0)  # [m] readings that are fused, and compared with
HELD_OUT = 16  # frames that are compared with, unless a scene says otherwise


@dataclass(frozen=True)
class Scene:
    """Frames of one place. `held_out` have the exact depth where it is known, else the sensor's."""

    name: str
    frames: Sequence[Frame]
    held_out: Sequence[Frame]
    ground_truth: Mesh | None
    nearest: float = DEPTH_RANGE[0]  # [m] of the readings that are fused, and compared with

    @property
    def T_world_camera(self) -> np.ndarray:
        """Poses of the frames to fuse, (N, 4, 4)."""
        return np.stack([frame.T_world_camera for frame in self.frames])


def split(count: int, every: int, held_out: int = HELD_OUT) -> tuple[list[int], list[int]]:
    """Every n-th of `count` frames, and at most so many, evenly, of those half-way between two of
    them.
    """
    fused = list(range(0, count, every))
    between = [i + every // 2 for i in fused if i + every // 2 < count and every > 1]
    kept = np.linspace(0, len(between) - 1, min(held_out, len(between))).round().astype(int)
    return fused, [between[i] for i in kept]


def synthetic(data: Path, frames: int | None) -> Scene:
    """The synthetic room: one loop, twice as many frames as are fused, so that there are some in
    between.
    """
    fused, between = split(2 * (frames or 60), 2)
    noisy, exact = (
        SyntheticRoom(frames=2 * (frames or 60), noise=noise) for noise in (True, False)
    )
    return Scene(
        "synthetic",
        [noisy[i] for i in fused],
        [exact[i] for i in between],
        noisy.ground_truth_mesh(),
    )


def tabletop(data: Path, frames: int | None) -> Scene:
    """Small things on a table, from 40 cm: one loop, as in the synthetic room."""
    fused, between = split(2 * (frames or 40), 2)
    noisy, exact = (Tabletop(frames=2 * (frames or 40), noise=noise) for noise in (True, False))
    return Scene(
        "tabletop",
        [noisy[i] for i in fused],
        [exact[i] for i in between],
        noisy.ground_truth_mesh(),
        nearest=0.15,
    )


def kitchen(data: Path, frames: int | None, *, tracked: bool = False) -> Scene:
    """7-Scenes RedKitchen 0-299: every 10th is fused, the 5th in between compared with. At the given
    poses, or at those of our tracker, which fit this recording better.
    """
    recording = open_dataset("7scenes", data / "7scenes-redkitchen")[:300]
    recording, name = (track(recording), "kitchen-tracked") if tracked else (recording, "kitchen")
    return _of_recording(name, recording, recording, frames or 30, None, held_out=30)


def house(path: str, data: Path, frames: int | None) -> Scene:
    """The flat along one of its paths: every 5th frame of a hand at 30 Hz, some 20 cm apart, is
    fused.
    """
    noisy = load_house(data / "aws-small-house", path)
    exact = load_house(data / "aws-small-house", path, noise=False)
    return _of_recording(
        f"house-{path}", noisy, exact, frames or -(-len(noisy) // 5), noisy.ground_truth_mesh()
    )


def _of_recording(
    name: str,
    noisy: Dataset,
    exact: Dataset,
    frames: int,
    ground_truth: Mesh | None,
    held_out: int = HELD_OUT,
) -> Scene:
    fused, between = split(len(noisy), max(2, len(noisy) // frames), held_out)
    return Scene(name, [noisy[i] for i in fused], [exact[i] for i in between], ground_truth)


# name -> what makes it of the data folder and a number of frames
SCENES: dict[str, Callable[[Path, int | None], Scene]] = {
    "synthetic": synthetic,
    "tabletop": tabletop,
    "kitchen": kitchen,
    "kitchen-tracked": partial(kitchen, tracked=True),
    "house-living": partial(house, "living"),
    "house-bedroom": partial(house, "bedroom"),
    "house-tour": partial(house, "tour"),
}
