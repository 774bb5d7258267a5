"""Writes small recordings as Open3D's reconstruction system and Redwood have them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from dataset_writers import CAMERA, Sample, matrix_text, tum_row, write_image


def write_recording(
    folder: Path,
    samples: list[Sample],
    *,
    color: str = "color",
    camera: str = "intrinsic.json",
) -> Path:
    """Images and, unless its name is empty, the file of the camera."""
    for i, sample in enumerate(samples):
        write_image(folder / "depth" / f"{i:06d}.png", sample.units)
        write_image(folder / color / f"{i:06d}.png", sample.color)
    if camera:
        K = CAMERA.matrix.T.ravel().tolist()
        values = {"width": CAMERA.width, "height": CAMERA.height, "intrinsic_matrix": K}
        (folder / camera).write_text(json.dumps(values))
    return folder


def log_text(samples: list[Sample]) -> str:
    return "".join(
        f"{i} {i} {i + 1}\n{matrix_text(s.T_world_camera)}" for i, s in enumerate(samples)
    )


def json_text(samples: list[Sample]) -> str:
    entries = [
        {"extrinsic": np.linalg.inv(s.T_world_camera).T.ravel().tolist(), "intrinsic": {}}
        for s in samples
    ]
    return json.dumps({"class_name": "PinholeCameraTrajectory", "parameters": entries})


TRAJECTORIES = {
    "trajectory.log": log_text,
    "scene/trajectory.log": log_text,
    "livingroom1-traj.txt": log_text,
    "trajectory.json": json_text,
    "trajectory.txt": lambda samples: "\n".join(
        tum_row(s.T_world_camera, i) for i, s in enumerate(samples)
    ),
}
