"""A short walk through the synthetic room, and what a tracker made of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from taichi_unifusion.datasets import Dataset
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.geometry import se3
from taichi_unifusion.tracking import TrackingResult
from taichi_unifusion.types import Frame


class Listed(Dataset):
    """Frames in memory, or errors in their place."""

    name = "listed"

    def __init__(self, items):
        self.items = list(items)

    def __len__(self):
        return len(self.items)

    def load(self, index):
        if isinstance(self.items[index], Exception):
            raise self.items[index]
        return self.items[index]


def first_frames(count: int) -> list[Frame]:
    """Neighbouring frames, 5 cm apart, and their true poses."""
    room = SyntheticRoom(frames=120, width=320, height=240)
    return [room[i] for i in range(count)]


def bare(frame):
    return replace(frame, T_world_camera=None)


def black(frame):
    return replace(frame, depth=np.zeros_like(frame.depth), color=np.zeros_like(frame.color))


def errors(result: TrackingResult, frames) -> np.ndarray:
    """Distances [m] from the true positions, both seen from the first tracked frame."""
    pairs = [
        (f.T_world_camera, frames[f.index].T_world_camera)
        for f in result.frames
        if f.T_world_camera is not None
    ]
    ours, truth = (np.array(poses) for poses in zip(*pairs, strict=True))
    return np.linalg.norm(
        (se3.inverse(ours[0]) @ ours - se3.inverse(truth[0]) @ truth)[:, :3, 3], axis=1
    )


def verdicts(result: TrackingResult) -> list[str]:
    return [str(frame.verdict) for frame in result.frames]
