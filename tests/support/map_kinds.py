"""The kinds of maps that the same laws hold for, clouds to fill them, and what they answer as bytes."""

from __future__ import annotations

import numpy as np
from scenes import moved, rough

from taichi_unifusion import PropertyMap, SurfaceMap
from taichi_unifusion.maps.encoding import EncoderSettings

SMALL = {"encoder": EncoderSettings(rank=8, anchors=64), "noise": 0.3}

KINDS = {
    "surface": lambda **settings: SurfaceMap(**{**SMALL, **settings}),
    "property": lambda **settings: PropertyMap(
        "rgb", 3, **{"voxel_size": 0.05, **SMALL, **settings}
    ),
}


def frames() -> list:
    """Three overlapping clouds, one of them across the origin and one with voxels of its own."""
    return [
        rough(0, 1200),
        moved(rough(1, 900), (0.05, 0.02, 0)),
        moved(rough(2, 600), (-0.07, 0.3, 0.1)),
    ]


def probes() -> np.ndarray:
    return np.random.default_rng(11).uniform(-0.2, 0.2, (500, 3))


def answers(target) -> tuple:
    """What a map decodes: values and validity as bytes."""
    values, valid = (
        target.sdf(probes())
        if isinstance(target, SurfaceMap)
        else target.query(probes(), return_valid=True)
    )
    return values.tobytes(), valid.tobytes(), valid.mean()


def content(target) -> tuple[bytes, ...]:
    data = target.voxels()
    return data.keys.tobytes(), data.latents.tobytes(), data.weights.tobytes(), data.masks.tobytes()


def integrated(target, clouds):
    for cloud in clouds:
        target.integrate(cloud)
    return target
