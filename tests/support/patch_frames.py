"""What `make_patches` makes of an image of inverse depths, in runs and in the cells of maps."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import reference_patches as twin
import taichi as ti
from viewpoints import pose, rays

from taichi_unifusion import PinholeCamera
from taichi_unifusion.kernels import patches as kernels

T = pose((0.3, -1.2, 2.0), 0.4, -0.3, 1.0)
RADIUS, JUMP = 2, 0.03
STEEP = float(np.cos(np.radians(80)))
WRITE = kernels.Sinks(write=True, radius=RADIUS)
ALL, NONE = 0.0, float("inf")  # `least` that puts all pixels of a quad together, or none


@dataclass(frozen=True)
class Found:
    """Patches as the kernel writes them, row by row."""

    found: np.ndarray  # (R,)
    points: np.ndarray  # (N, 3)
    normals: np.ndarray
    counts: np.ndarray  # (N,)
    places: np.ndarray
    totals: np.ndarray
    filled: np.ndarray  # (R slots,) which rows are patches
    rows: np.ndarray  # (R slots,) places of all rows


def camera_of(width: int, height: int) -> PinholeCamera:
    return PinholeCamera(width, height, 60.0, 62.0, 0.48 * width, 0.45 * height)


def nothing() -> tuple[np.ndarray, np.ndarray]:
    """Keys and sums of no map."""
    return np.zeros((1, 5), np.int32), np.zeros((1, 1, 1), np.int64)


def make(
    inverse,
    camera,
    *,
    T=T,
    radius=RADIUS,
    jump=JUMP,
    cos_max_angle=STEEP,
    least=ALL,
    color=None,
    weights=None,
    sinks=WRITE,
    now=(1, 0, 0, 0, 0, 0),
    surface=None,
    colors=None,
    blocks=(0, 0),
) -> Found:
    """The patches of an image; `surface` and `colors` are keys and sums that they are added to."""
    runs, slots = kernels.runs_of(*inverse.shape), kernels.slots_of_run()
    totals = np.array([3, 4, *blocks], np.int32)  # totals are added to
    pack = {name: ti.ndarray(ti.i32, (runs * slots,)) for name in ("counts", "places")}
    pack |= {name: ti.ndarray(ti.f32, (runs * slots, 3)) for name in ("points", "normals")}
    pack["found"] = ti.ndarray(ti.i32, (runs,))
    pack["found"].fill(-1)
    kernels.make_patches(
        inverse.astype(np.float32),
        np.zeros((1, 1, 3), np.uint8) if color is None else color,
        np.zeros((1, 1), np.uint8) if weights is None else weights,
        camera.intrinsics,
        T[:3],
        (jump, cos_max_angle, least),
        now,
        replace(sinks, weighted=weights is not None, radius=radius),
        totals,
        *(surface or nothing()),
        *(colors or nothing()),
        kernels.PatchPack(**pack),
    )
    made = {name: array.to_numpy() for name, array in pack.items()}
    found = made.pop("found")
    filled = (np.arange(slots) < found[:, None]).ravel()
    rows = {name: array[filled] for name, array in made.items()}
    return Found(found, **rows, totals=totals - (3, 4, 0, 0), filled=filled, rows=made["places"])


def expected(
    inverse,
    camera,
    *,
    T=T,
    radius=RADIUS,
    jump=JUMP,
    cos_max_angle=STEEP,
    least=ALL,
    weights=None,
):
    # as the kernel is given them, so that both compare the same numbers
    inverse = inverse.astype(np.float32).astype(float)
    settings = radius, jump, cos_max_angle, least
    return twin.make_patches(inverse, camera.intrinsics, T, *settings, weights)


def steps(width: int, height: int) -> np.ndarray:
    """Inverse depths of a near wall on the left, a slanted one on the right whose edge runs through
    quads, with noise and holes, as real depth has.
    """
    camera, rng = camera_of(width, height), np.random.default_rng(width)
    normal = np.array([0.1, 0.6, -0.8])
    depth = np.array([0, 0, 2.0]) @ normal / (rays(camera) @ normal)
    v, u = np.mgrid[:height, :width]
    depth[u < width / 3 + v / 4] = 1.1
    depth *= 1 + 0.001 * rng.normal(size=depth.shape)
    depth[rng.uniform(size=depth.shape) < 0.05] = np.inf
    return np.where((depth > 0.2) & (depth < 20), 1 / depth, 0)
