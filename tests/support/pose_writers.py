"""Camera poses as other programs write them, from their public descriptions."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from phone_writers import quaternion

from taichi_unifusion.geometry import se3

T_BODY_CAMERA = se3.exp(np.array([0.05, -0.02, 0.1, 1.2, -0.3, 0.4]))
START = 1403636579763555584  # [ns]
STEP = 50_000_000  # [ns]


def w2c(T: NDArray) -> list[float]:
    """qw qx qy qz tx ty tz of the inverse."""
    inverse = se3.inverse(T)
    *xyz, w = quaternion(inverse)
    return [w, *xyz, *inverse[:3, 3].tolist()]


def colmap_text(path: Path, poses: list[NDArray], names: list[str]) -> None:
    """Images in another order than their names; some see no point, whose line is empty."""
    lines = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for i, (T, name) in reversed(list(enumerate(zip(poses, names, strict=True)))):
        lines.append(" ".join(map(repr, [i + 1, *w2c(T), 1])) + f" {name}")
        lines.append("" if i % 2 else "512.5 20.25 17 100.0 200.0 -1 3.5 4.5 -1 7.0")
    path.write_text("\n".join(lines) + "\n")


def colmap_binary(path: Path, poses: list[NDArray], names: list[str]) -> None:
    data = struct.pack("<Q", len(poses))
    for i, (T, name) in enumerate(zip(poses, names, strict=True)):
        data += struct.pack("<I7dI", i + 1, *w2c(T), 1) + name.encode() + b"\0"
        data += struct.pack("<Q", i) + struct.pack("<2dq", 1.0, 2.0, -1) * i
    path.write_bytes(data)


def euroc(path: Path, poses: list[NDArray]) -> None:
    """The body's poses, with velocities after them."""
    lines = ["#timestamp [ns], p_RS_R_x [m], p_y, p_z, q_RS_w [], q_x, q_y, q_z, v_x, v_y, v_z"]
    for i, T_world_camera in enumerate(poses):
        T = T_world_camera @ se3.inverse(T_BODY_CAMERA)
        *xyz, w = quaternion(T)
        row = [*T[:3, 3].tolist(), w, *xyz, 0.1, 0.2, 0.3]
        lines.append(",".join([str(START + STEP * i), *map(repr, row)]))
    path.write_text("\n".join(lines))


def sensor_yaml(path: Path) -> None:
    data = ", ".join(map(repr, T_BODY_CAMERA.ravel().tolist()))
    path.write_text(
        f"sensor_type: camera\nT_BS:\n  cols: 4\n  rows: 4\n  data: [{data}]\nrate_hz: 20\n"
    )


def kitti(path: Path, poses: list[NDArray]) -> None:
    path.write_text("\n".join(" ".join(map(repr, T[:3].ravel().tolist())) for T in poses))


def log(path: Path, poses: list[NDArray]) -> None:
    blocks = []
    for i, T in enumerate(poses):
        rows = "\n".join(" ".join(map(repr, row)) for row in T.tolist())
        blocks.append(f"{i} {i} {i + 1}\n{rows}\n")
    path.write_text("".join(blocks))


def transforms(path: Path, poses: list[NDArray], names: list[str]) -> None:
    applied = se3.exp(np.array([1.0, 2, 3, 0.5, 0.2, 0.1]))
    frames = []
    for T, name in zip(poses, names, strict=True):
        stored = applied @ T @ se3.FLIP_YZ
        stored[:3, 3] *= 2
        frames.append({"file_path": f"images/{name}", "transform_matrix": stored.tolist()})
    values = {"applied_transform": applied[:3].tolist(), "applied_scale": 2.0, "frames": frames}
    path.write_text(json.dumps(values))
