"""Frames rendered from a textured scene: depth, colour and objects against ray casting, the noise, and bad files."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion import runtime
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.scene import SceneDataset, kinect_camera
from taichi_unifusion.datasets.synthetic import look_at
from taichi_unifusion.datasets.textured_scene import LIGHT, load_scene
from taichi_unifusion.errors import DatasetError, FileError, InputError
from taichi_unifusion.io import write_trajectory
from taichi_unifusion.types import PinholeCamera, Trajectory

trimesh = pytest.importorskip("trimesh")
image_module = pytest.importorskip("PIL.Image")

DEPTH_TOLERANCE = 1e-6    # relative: depth is float64 until it is stored as float32
COLOR_TOLERANCE = 2       # of 255: float32 of texture coordinates, and rounding to bytes twice
EDGE_BAND = 1e-4          # barycentric: closer to an edge either triangle may win
CAMERA = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)
POSE = look_at((0.3, -3.0, 0.9), (0.0, 0.0, 0.1))
SHADE = 0.35


def checkers(size: int = 64, squares: int = 8) -> np.ndarray:
    """A checkerboard with a colour ramp, so that every place of it is known by its colour."""
    v, u = np.mgrid[:size, :size]
    board = (u * squares // size + v * squares // size) % 2
    return np.stack([60 + 120 * board, 40 + 3 * u, 40 + 3 * v], axis=-1).astype(np.uint8)
