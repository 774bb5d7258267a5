"""Keyframes in a file, small: what a camera that comes back another day finds its place by."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from ..errors import FileError
from ..files.record_file import Record, RecordLog, damaged, pack, scan
from ..geometry import se3
from ..types import PinholeCamera
from .features import STORED_FEATURES, Features
from .keyframes import Keyframe, Keyframes
from .pyramid import ReducedFrame

KEYFRAME = "keyframe"  # kind of records
# of a 1/m: ten times finer than the steps of a Kinect's readings
INVERSE_STEPS = 4000.0
LEVELS = 255.0  # of an intensity


def write_keyframes(path: Path, keyframes: Keyframes) -> int:
    """Write keyframes with their poses; returns the bytes that they take. Raises FileError."""
    path.unlink(missing_ok=True)
    log = RecordLog(path)
    try:
        for keyframe, T in zip(keyframes.items, keyframes.T_world_keyframe, strict=True):
            log.append(pack(*_to_record(keyframe, T)))
        log.sync()
    finally:
        log.close()
    return path.stat().st_size


def read_keyframes(path: Path) -> Keyframes:
    """The keyframes of a file; raises FileError where there is none, or it is damaged."""
    found = Keyframes()
    for record in scan(path):
        if record.values.get("kind") != KEYFRAME:
            raise FileError(f"{path}: holds no keyframes; make the results again")
        found.append(*_from_record(record))
    return found


def _to_record(keyframe: Keyframe, T_world_keyframe: np.ndarray) -> tuple[dict[str, Any], dict]:
    reduced, features = keyframe.reduced, keyframe.features
    kept = slice(STORED_FEATURES)
    values = {
        "kind": KEYFRAME,
        "index": keyframe.index,
        "T_world_keyframe": T_world_keyframe.tolist(),
        "camera": _camera_values(reduced.camera),
        "colored": reduced.colored,
        "feature_camera": _camera_values(features.camera),
    }
    inverse = np.clip(np.rint(reduced.inverse * INVERSE_STEPS), 0, 65535).astype(np.uint16)
    return values, {
        "inverse": inverse[None],
        "intensity": np.rint(reduced.intensity.astype(np.float32) * LEVELS).astype(np.uint8)[None],
        "descriptors": features.descriptors[kept],
        "pixels": features.pixels[kept],
        "points": features.points[kept],
    }


def _from_record(record: Record) -> tuple[Keyframe, np.ndarray]:
    values, arrays = record.values, record.read()
    try:
        camera = PinholeCamera(*values["camera"])
        inverse = arrays["inverse"][0].astype(np.float32) / np.float32(INVERSE_STEPS)
        intensity = (arrays["intensity"][0] / np.float32(LEVELS)).astype(np.float16)
        if not inverse.shape == intensity.shape == (camera.height, camera.width):
            raise ValueError("images of another size")
        pixels, points = arrays["pixels"].reshape(-1, 2), arrays["points"].reshape(-1, 3)
        descriptors = arrays["descriptors"].reshape(-1, 32)
        if not len(pixels) == len(points) == len(descriptors):
            raise ValueError("features do not fit each other")
        features = Features(descriptors, pixels, points, PinholeCamera(*values["feature_camera"]))
        reduced = ReducedFrame(inverse, intensity, camera, bool(values["colored"]))
        T = np.array(values["T_world_keyframe"], np.float64).reshape(4, 4)
        return Keyframe(int(values["index"]), reduced, features), se3.normalized(T)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise damaged(record.path, str(error)[:80]) from None


def _camera_values(camera: PinholeCamera) -> list[float]:
    return [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]
