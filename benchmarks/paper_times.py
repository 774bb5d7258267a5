"""Milliseconds a frame beside Table VIII: each map by itself as the paper counts, all of them in one
pass, and tracking. What makes style, saliency and features from an image is not timed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from gpu_checks import CHANNELS, RandomFeatures, all_together, timed, with_infrared

import taichi_unifusion as uf
from taichi_unifusion.errors import InputError
from taichi_unifusion.maps import BaseMap, FeatureMap
from taichi_unifusion.tracking import make_tracker

SIZE = 1280, 720  # of the paper's images
WARM = 2  # frames that compile, and are not counted
SECTION_VI_A = 0.1  # [m] voxels of properties


def milliseconds(
    recording: Path | None, device: str, frames: int, size: tuple[int, int] = SIZE
) -> dict[str, Any]:
    """Device, frames and `ms` by map, "internal tracking" and "all at once"; of a recording of an
    Azure Kinect, aligned to colour as the paper's, or of the synthetic room.
    """
    live = uf.init(device)
    taken = [with_properties(frame) for frame in _frames(recording, frames, size)]
    if len(taken) <= WARM:
        raise InputError(
            f"times: {recording or 'the room'} gives {len(taken)} frames, more than {WARM} are "
            "needed: the first ones compile"
        )
    ms = by_map(taken)
    ms["internal tracking"] = _tracking(taken)
    ms["all at once"] = all_together(taken)
    camera = taken[0].camera
    return {
        "device": live.description,
        "frames": len(taken) - WARM,
        "size": [camera.width, camera.height],
        "recording": str(recording or "synthetic room"),
        "ms": ms,
    }


def _frames(recording: Path | None, count: int, size: tuple[int, int]) -> Sequence[uf.Frame]:
    if recording is None:
        width, height = size
        return list(uf.open_dataset("synthetic", frames=300, width=width, height=height)[:count])
    frames = uf.open_dataset("k4a", recording, align="color")[:count]
    pose = np.eye(4)  # where there are none: the map then grows as of a camera that stands still
    return [
        frame
        if frame.T_world_camera is not None
        else uf.Frame(
            frame.depth, frame.camera, frame.color, pose, frame.index, images=frame.images
        )
        for frame in frames
    ]


def with_properties(frame: uf.Frame) -> uf.Frame:
    """The frame with images that stand for infrared, style and saliency."""
    grey = np.float32(frame.color).mean(axis=2) / np.float32(255)
    styled = np.float32(frame.color[..., ::-1]) / np.float32(255)
    if "infrared" not in frame.images:
        frame = with_infrared(frame)
    return frame.with_image("style", styled).with_image("saliency", grey)


def by_map(frames: Sequence[uf.Frame]) -> dict[str, float]:
    """Means of every map's `integrate`, each given the same points; "preprocess" is what makes
    these.
    """
    features = RandomFeatures().values
    maps: dict[str, BaseMap] = {
        "surface": uf.SurfaceMap(),
        "color": uf.PropertyMap("color", 3),
        **{
            name: uf.PropertyMap(name, channels, voxel_size=SECTION_VI_A)
            for name, channels in (("infrared", 1), ("style", 3), ("saliency", 1))
        },
        "latent": FeatureMap("latent", CHANNELS),
    }
    laps: dict[str, list[float]] = {name: [] for name in ("preprocess", *maps)}
    for frame in frames:
        ms, cloud = timed(uf.preprocess, frame.with_features("latent", features))
        laps["preprocess"].append(ms)
        cloud = cloud.transformed(frame.require_pose())
        for name, each in maps.items():
            laps[name].append(timed(each.integrate, cloud)[0])
    return {name: float(np.mean(lap[WARM:])) for name, lap in laps.items()}


def _tracking(frames: Sequence[uf.Frame]) -> float:
    tracker = make_tracker("internal")
    laps = [timed(tracker.track, frame)[0] for frame in frames]
    return float(np.mean(laps[WARM:]))
