"""A table top with small things on it, made of the room's solids: what a hand-held camera sees from
some 40 cm. No data needed; depth and colour are exact, or as a Kinect's.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from taichi_unifusion.datasets.synthetic import FRAME_RATE, Scene, SyntheticRoom, look_at
from taichi_unifusion.rendering.kernels.solids import kinect_depth
from taichi_unifusion.rendering.primitives import (
    Primitive,
    box,
    cylinder,
    ellipsoid,
    place,
    rotation,
)
from taichi_unifusion.rendering.room import furnished_room
from taichi_unifusion.types import Frame

HEIGHT = 0.75  # [m] of the board above the floor
SMALLER = np.float32(2)  # than a Kinect is the sensor


class Tabletop(SyntheticRoom):
    """`frames` views from one loop around the table, at a hand's distance."""

    def __init__(self, *, frames: int = 60, noise: bool = True) -> None:
        super().__init__(frames=frames, noise=noise)
        self.name = "table top"
        self.T_world_camera = np.stack([camera_around(i / frames) for i in range(frames)])

    def load(self, index: int) -> Frame:
        """Render frame `index`. Noise is that of a sensor of half a Kinect's size, which reads from
        20 cm on: the scene is twice as large for it.
        """
        T_world_camera = self.T_world_camera[index]
        exact, hit = self._scene.cast(self.camera, T_world_camera)
        color, cosine = self._scene.shade(self.camera, T_world_camera, exact, hit)
        depth = exact
        if self.noise:
            depth, large = np.zeros_like(exact), SMALLER * exact
            kinect_depth(large, cosine, large.min(), self.seed, index, self.camera.fx, depth)
            depth /= SMALLER
        stamp = index / FRAME_RATE
        return Frame(depth, self.camera, color, T_world_camera, index, stamp, f"table {index}")

    @cached_property
    def _scene(self) -> Scene:
        return Scene((furnished_room()[0], *table_top()))


def camera_around(t: float) -> NDArray[np.float64]:
    """T_world_camera at t of [0, 1) of the loop: a little nearer and farther, higher and lower."""
    a = 2 * np.pi * t
    radius, rise = 0.29 + 0.03 * np.sin(3 * a), 0.30 + 0.04 * np.sin(2 * a)
    eye = (radius * np.cos(a), radius * np.sin(a), HEIGHT + rise)
    return look_at(eye, (0.03 * np.cos(2 * a), 0.03 * np.sin(3 * a), HEIGHT + 0.02))


def table_top() -> list[Primitive]:
    """A round table, and on it what lies on tables: mugs, books, fruit, a pen, a ruler, small boxes."""
    things = [
        cylinder("vase", (-0.09, 0.07, 0), 0.038, 0.09),
        cylinder("clay", (-0.09, 0.07, 0.088), 0.032, 0.006),
        box("vase", (-0.052, 0.064, 0.02), (-0.03, 0.076, 0.07)),  # a mug's handle
        *place([box("book red", (-0.065, -0.045, 0), (0.065, 0.045, 0.018))], 0.1, 0.06, 0, 25),
        *place([box("book cream", (-0.06, -0.04, 0), (0.06, 0.04, 0.012))], 0.1, 0.06, 0.018, 8),
        *place([box("mosaic", (-0.03, -0.03, 0), (0.03, 0.03, 0.06))], 0.0, 0.1, 0, 40),
        ellipsoid("ball", (0.02, -0.02, 0.028), (0.028, 0.028, 0.028)),
        ellipsoid("globe", (0.085, -0.05, 0.02), (0.02, 0.02, 0.02)),
        ellipsoid("leaf", (-0.03, -0.09, 0.018), (0.034, 0.02, 0.018), rotation(2, 30)),
        cylinder("brass", (-0.12, -0.05, 0.006), 0.006, 0.14, axis=0),  # a pen
        *place([box("oak", (-0.1, -0.012, 0), (0.1, 0.012, 0.004))], 0.06, -0.11, 0, -20),
        *place([box("plaid", (-0.025, -0.018, 0), (0.025, 0.018, 0.035))], -0.1, -0.02, 0, -15),
        cylinder("steel", (0.16, -0.02, 0), 0.012, 0.1),
        ellipsoid("shade", (0.16, -0.02, 0.115), (0.02, 0.02, 0.02)),
    ]
    board = cylinder("walnut", (0, 0, HEIGHT - 0.03), 0.7, 0.03)
    foot = cylinder("walnut", (0, 0, 0), 0.06, HEIGHT - 0.03)
    return [board, foot, *place(things, 0, 0, HEIGHT)]
