"""Writes tiny recordings in every format, from the formats' public descriptions and independently
of the loaders.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from taichi_unifusion.types import PinholeCamera

WIDTH, HEIGHT = 16, 12
CAMERA = PinholeCamera(WIDTH, HEIGHT, 15.0, 14.0, 7.5, 5.5)
START, PERIOD = 1305031453.25, 1 / 32  # [s] of time stamps, exact in binary


@dataclass(frozen=True)
class Sample:
    """One frame as it goes into a file."""

    color: np.ndarray  # (H, W, 3) uint8 RGB
    units: np.ndarray  # (H, W) uint16, with 0 and 65535 among them
    T_world_camera: np.ndarray  # (4, 4)
    timestamp: float  # [s]

    def metres(self, depth_scale: float) -> np.ndarray:
        """What a loader must return: (H, W) float32, 0 where there is no reading."""
        readings = np.where(self.units == 65535, 0, self.units)
        return readings.astype(np.float32) / np.float32(depth_scale)


def make_samples(count: int = 4) -> list[Sample]:
    rng = np.random.default_rng(7)
    samples = []
    for i in range(count):
        units = rng.integers(1, 65535, (HEIGHT, WIDTH), dtype=np.uint16)
        units[0, :3], units[1, :3] = 0, 65535
        color = rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        samples.append(Sample(color, units, make_pose(i), START + i * PERIOD))
    return samples


def make_pose(i: int) -> np.ndarray:
    a, b = 0.1 * i, 0.3 - 0.05 * i
    about_y = np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    T = np.eye(4)
    T[:3, :3] = about_y @ about_x
    T[:3, 3] = 0.05 * i, -0.02 * i, 1.5
    return T


def quaternion(R: np.ndarray) -> np.ndarray:
    """(x, y, z, w) of a rotation by less than 180 degrees."""
    w = np.sqrt(1 + np.trace(R)) / 2
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 4 * w * w]) / (4 * w)


def numbers_of(camera: PinholeCamera) -> tuple[float, ...]:
    return (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)


def numbers(values) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def matrix_text(T: np.ndarray) -> str:
    return "\n".join(numbers(row) for row in T) + "\n"


def tum_row(T: np.ndarray, name) -> str:
    return f"{name} {numbers(T[:3, 3])} {numbers(quaternion(T[:3, :3]))}"


def write_image(path: Path, image: np.ndarray) -> None:
    """Colour is given as RGB; OpenCV wants BGR."""
    path.parent.mkdir(parents=True, exist_ok=True)
    ok, data = cv2.imencode(path.suffix, image[..., ::-1] if image.ndim == 3 else image)
    assert ok
    path.write_bytes(data.tobytes())


def enlarged(color: np.ndarray) -> np.ndarray:
    """Every pixel twice in both directions: averaging it down gives the original exactly."""
    return color.repeat(2, axis=0).repeat(2, axis=1)


def write_seven_scenes(folder: Path, samples: list[Sample]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera-intrinsics.txt").write_text(matrix_text(CAMERA.matrix))
    for i, sample in enumerate(samples):
        write_image(folder / f"frame-{i:06d}.color.png", sample.color)
        write_image(folder / f"frame-{i:06d}.depth.png", sample.units)
        (folder / f"frame-{i:06d}.pose.txt").write_text(matrix_text(sample.T_world_camera))
    return folder


def write_replica(
    folder: Path, samples: list[Sample], images: str = "results", camera: PinholeCamera = CAMERA
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "traj.txt").write_text(
        "\n".join(numbers(sample.T_world_camera) for sample in samples) + "\n"
    )
    values = dict(zip(("w", "h", "fx", "fy", "cx", "cy"), numbers_of(camera), strict=True))
    (folder / "cam_params.json").write_text(json.dumps({"camera": values | {"scale": 6553.5}}))
    for i, sample in enumerate(samples):
        write_image(folder / images / f"frame{i:06d}.png", sample.color)
        write_image(folder / images / f"depth{i:06d}.png", sample.units)
    return folder


def write_tum(folder: Path, samples: list[Sample]) -> Path:
    color, depth, truth = ["# color images"], ["# depth maps"], ["# timestamp tx ty tz qx qy qz qw"]
    for sample in samples:
        t = sample.timestamp
        write_image(folder / "rgb" / f"{t:.6f}.png", sample.color)
        write_image(folder / "depth" / f"{t:.6f}.png", sample.units)
        color.append(f"{t + 0.004:.6f} rgb/{t:.6f}.png")
        depth.append(f"{t:.6f} depth/{t:.6f}.png")
        truth.append(tum_row(sample.T_world_camera, f"{t - 0.002:.4f}"))
    for name, lines in (("rgb.txt", color), ("depth.txt", depth), ("groundtruth.txt", truth)):
        (folder / name).write_text("\n".join(lines) + "\n")
    return folder


def write_scannet(folder: Path, samples: list[Sample]) -> Path:
    K = np.eye(4)
    K[:3, :3] = CAMERA.matrix
    (folder / "intrinsic").mkdir(parents=True)
    (folder / "pose").mkdir()
    (folder / "intrinsic" / "intrinsic_depth.txt").write_text(matrix_text(K))
    for i, sample in enumerate(samples):
        write_image(folder / "color" / f"{i}.png", enlarged(sample.color))
        write_image(folder / "depth" / f"{i}.png", sample.units)
        (folder / "pose" / f"{i}.txt").write_text(matrix_text(sample.T_world_camera))
    return folder


def write_scannet_flat(folder: Path, samples: list[Sample]) -> Path:
    write_seven_scenes(folder, samples)
    (folder / "camera-intrinsics.txt").unlink()
    for i, sample in enumerate(samples):
        (folder / f"frame-{i:06d}.depth.png").unlink()
        head = f"P5\n# data values are 16-bit each; depth shift is 1000\n{WIDTH} {HEIGHT}\n65535\n"
        (folder / f"frame-{i:06d}.depth.pgm").write_bytes(
            head.encode() + sample.units.astype(">u2").tobytes()
        )
    (folder / "_info.txt").write_text(
        "m_versionNumber = 4\nm_sensorName = StructureSensor\nm_depthShift = 1000\n"
        "m_calibrationDepthIntrinsic = 15 0 7.5 0 0 14 5.5 0 0 0 1 0 0 0 0 1 \n"
    )
    return folder


def sens_bytes(
    samples: list[Sample],
    *,
    version: int = 4,
    name: bytes = b"StructureSensor",
    name_bytes: int | None = None,
    frame_count: int | None = None,
    size: tuple[int, int] | None = None,
    camera: PinholeCamera = CAMERA,
    color_compression: int = 1,
    depth_compression: int = 1,
    color_bytes: int | None = None,
    depth_bytes: int | None = None,
) -> bytes:
    """A .sens file; the options write lies into its header or its records."""
    K = np.eye(4, dtype="<f4")
    K[:3, :3] = camera.matrix
    out = [struct.pack("<IQ", version, len(name) if name_bytes is None else name_bytes), name]
    out += [matrix.astype("<f4").tobytes() for matrix in (np.eye(4), np.eye(4), K, np.eye(4))]
    out.append(
        struct.pack(
            "<iiIIIIf",
            color_compression,
            depth_compression,
            2 * camera.width,
            2 * camera.height,
            *(size or camera.size),
            1000.0,
        )
    )
    out.append(struct.pack("<Q", len(samples) if frame_count is None else frame_count))
    for sample in samples:
        color = enlarged(sample.color)
        color = (
            color.tobytes()
            if color_compression == 0
            else cv2.imencode(".png", color[..., ::-1])[1].tobytes()
        )
        depth = sample.units.astype("<u2").tobytes()
        depth = depth if depth_compression == 0 else zlib.compress(depth)
        stamp = round(sample.timestamp * 1e6)
        out.append(sample.T_world_camera.astype("<f4").tobytes())
        out.append(
            struct.pack(
                "<QQQQ",
                stamp - 5,
                stamp,
                len(color) if color_bytes is None else color_bytes,
                len(depth) if depth_bytes is None else depth_bytes,
            )
        )
        out += [color, depth]
    out.append(struct.pack("<Q", 0))  # no IMU frames
    return b"".join(out)


def write_sens(
    folder: Path,
    samples: list[Sample],
    name: str = "scene0000_00",
    camera: PinholeCamera = CAMERA,
) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.sens").write_bytes(sens_bytes(samples, camera=camera))
    return folder


def write_stanford(
    folder: Path, samples: list[Sample], room: str = "office_1", camera: PinholeCamera = CAMERA
) -> Path:
    """An area of 2D-3D-S; images of the same room are of one place."""
    (folder / "data" / "pose").mkdir(parents=True, exist_ok=True)
    # as their K has it: pixels begin at whole numbers
    K = camera.matrix + [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    for i, sample in enumerate(samples):
        name = f"camera_{'0' * 31}{i}_{room}_frame_{i}_domain"
        write_image(folder / "data" / "rgb" / f"{name}_rgb.png", sample.color)
        write_image(folder / "data" / "depth" / f"{name}_depth.png", sample.units)
        pose = {
            "camera_k_matrix": K.tolist(),
            "camera_rt_matrix": np.linalg.inv(sample.T_world_camera)[:3].tolist(),
            "camera_location": sample.T_world_camera[:3, 3].tolist(),
            "room": f"{room}_1",
        }
        (folder / "data" / "pose" / f"{name}_pose.json").write_text(json.dumps(pose))
    return folder


CAMERA_YAML = "width: 16\nheight: 12\nfx: 15.0\nfy: 14.0\ncx: 7.5\ncy: 5.5\n"


def write_folder(
    folder: Path, samples: list[Sample], poses: str = "folder", depth: str = "png"
) -> Path:
    """`poses`: "folder" (one file each), "rows" (16 numbers), "named" (name and quaternion) or
    "none".
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "camera.yaml").write_text(CAMERA_YAML)
    (folder / "depth").mkdir()
    for i, sample in enumerate(samples):
        write_image(folder / "color" / f"{i:06d}.png", sample.color)
        if depth == "png":
            write_image(folder / "depth" / f"{i:06d}.png", sample.units)
        else:
            np.save(folder / "depth" / f"{i:06d}.npy", sample.metres(1000.0))
    if poses == "folder":
        (folder / "poses").mkdir()
        for i, sample in enumerate(samples):
            (folder / "poses" / f"{i:06d}.txt").write_text(matrix_text(sample.T_world_camera))
    elif poses == "rows":
        (folder / "poses.txt").write_text(
            "\n".join(numbers(sample.T_world_camera) for sample in samples)
        )
    elif poses == "named":
        (folder / "poses.txt").write_text(
            "\n".join(tum_row(s.T_world_camera, f"{i:06d}") for i, s in enumerate(samples))
        )
    return folder
