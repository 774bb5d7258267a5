"""Small frames of the inside of a box, settings for them, and what pipelines make of them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from map_kinds import SMALL, content
from places import DEVICE
from viewpoints import pose, rays

from taichi_unifusion.config import Config
from taichi_unifusion.maps.settings import PropertySettings, SurfaceSettings
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.preprocessing import PreprocessSettings
from taichi_unifusion.types import Frame, PinholeCamera

CAMERA = PinholeCamera(64, 48, 55.0, 55.0, 31.5, 23.5)
WALLS = np.array([1.5, 1.2, 1.8])  # [m] half edges of the box around the origin
CONFIG = Config(
    device=DEVICE,
    window=4,
    preprocess=PreprocessSettings(patch_size=0.05),  # some quads are put together, some are not
    surface=SurfaceSettings(voxel_size=0.1, support_points=1, **SMALL),
    color=PropertySettings(voxel_size=0.1, **SMALL),
)

SINGLE = replace(CONFIG, window=1)
# relative: 64-bit sums of runs that are other ones, of patches or of points of a cloud
RUNS = 5e-6


def seen_from(T: np.ndarray, index: int, camera: PinholeCamera = CAMERA, origin=(0, 0, 0)) -> Frame:
    """What a camera in the box sees, whose walls are coloured by place; `origin` is the box's [m]."""
    eye, directions = T[:3, 3], rays(camera) @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        depth = ((np.sign(directions) * WALLS - eye) / directions).min(axis=2)
    place = eye + depth[..., None] * directions
    color = np.rint(127 + 120 * np.sin(3 * place)).astype(np.uint8)
    there = T.copy()
    there[:3, 3] += origin
    return Frame(depth.astype(np.float32), camera, color, there, index=index)


def place_of(n: int) -> np.ndarray:
    """Where frame n of a walk was taken: 1.5 cm and 1 degree from the one before."""
    return pose((0.012 * n, 0.009 * n, -0.2), 0.0175 * n + 0.3, 0.2)


def turned(n: int) -> np.ndarray:
    """Poses that a cloud is moved by without rounding, looking along x: a quarter turn, and steps
    of 1/64 m.
    """
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = np.array([-8, n, 2 * n]) / 64
    return T


def walk(count: int, **options) -> list[Frame]:
    return [seen_from(place_of(n), n + 1, **options) for n in range(count)]


def with_value(frame: Frame, name: str = "x", holes: bool = False) -> Frame:
    """With an image of one value, green; in a pattern of `holes` it is no number."""
    image = frame.color[..., 1:2].astype(np.float32) / 255
    image[::5, ::7] = np.nan if holes else image[::5, ::7]
    return frame.with_image(name, image)


def empty(frame: Frame) -> Frame:
    return replace(frame, depth=np.zeros_like(frame.depth))


def stepped(frames: Iterable[Frame], config: Config = CONFIG) -> Pipeline:
    """A pipeline after these frames, the last of which may wait to be fused."""
    pipeline = Pipeline(config)
    for frame in frames:
        pipeline.step(frame)
    return pipeline


def assert_close(a, b, tolerance: float) -> None:
    """Same voxels, weights and support; latents within a share of the largest."""
    x, y = a.voxels(), b.voxels()
    for part in ("keys", "weights", "masks"):
        np.testing.assert_array_equal(getattr(x, part), getattr(y, part))
    np.testing.assert_allclose(x.latents, y.latents, atol=tolerance * np.abs(y.latents).max())


def contents(pipeline: Pipeline) -> dict[str, tuple[bytes, ...]]:
    """What every map holds, with evidence."""
    held = {name: content(each) for name, each in pipeline.maps.items()}
    return held | {"evidence": (pipeline.surface.voxels().evidence.tobytes(),)}


def windows(frames: Sequence[Frame], config: Config = CONFIG) -> list[int]:
    """How many frames the open window holds after each of these; 0 where it was just closed."""
    pipeline, lengths = Pipeline(config), []
    for frame in frames:
        pipeline.step(frame)
        lengths.append(len(pipeline.fusion.window) if pipeline.fusion.window else 0)
    pipeline.flush()  # nothing holds its maps then
    return lengths
