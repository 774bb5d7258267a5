"""Writes small recordings as an Azure Kinect's, of a scene that both of its cameras see exactly: a
wall, and a board before it.

Images are rendered ray by ray through the distortion of each camera, by OpenCV's undistortPoints,
independently of the loader.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

DEPTH_SIZE, COLOR_SIZE = (320, 288), (640, 360)
SENSOR, CROP = 512, (96, 90)  # of the depth camera in its 320x288 mode
DISTORTION = {
    "D0": (0.5, -0.02, -0.003, 0.85, 0.08, -0.01, -7e-5, 2e-5),
    "PV0": (0.3, -2.4, 1.4, 0.2, -2.3, 1.37, -1e-4, -2e-4),
}
T_COLOR_DEPTH = np.eye(4)
T_COLOR_DEPTH[:3, :3] = cv2.Rodrigues(np.array([-0.08, 0.01, 0.005]))[0]
T_COLOR_DEPTH[:3, 3] = -0.032, -0.002, 0.004
PERIOD, START = 200_000, 463_945  # [us]

WALL, BOARD = 2.0, 1.2  # [m] depth of the planes in the depth camera's frame
BOARD_CORNERS = (-0.35, -0.25), (0.2, 0.3)  # [m] low and high x and y
WALL_COLOR, BOARD_COLOR = (40, 90, 200), (220, 160, 30)
WALL_INFRARED, BOARD_INFRARED = 900, 30_000


@dataclass(frozen=True)
class WrittenCamera:
    """What the calibration file says of a camera, and its matrix for the images that are written."""

    parameters: list[float]
    matrix: np.ndarray
    distortion: np.ndarray  # in OpenCV's order

    @classmethod
    def of(cls, location: str) -> WrittenCamera:
        k1, k2, k3, k4, k5, k6, p2, p1 = DISTORTION[location]
        cx, cy, fx, fy = (
            (0.513, 0.517, 0.4928, 0.4929) if location == "D0" else (0.4998, 0.5066, 0.478, 0.6374)
        )
        width, height = (
            (SENSOR, SENSOR) if location == "D0" else (COLOR_SIZE[0], COLOR_SIZE[0] * 3 // 4)
        )
        left, top = CROP if location == "D0" else (0, (height - COLOR_SIZE[1]) // 2)
        matrix = np.array(
            [
                [fx * width, 0, cx * width - left - 0.5],
                [0, fy * height, cy * height - top - 0.5],
                [0, 0, 1],
            ]
        )
        return cls(
            [cx, cy, fx, fy, k1, k2, k3, k4, k5, k6, 0, 0, p2, p1],
            matrix,
            np.array([k1, k2, p1, p2, k3, k4, k5, k6]),
        )

    def rays(self, size) -> np.ndarray:
        """(H, W, 3) with z = 1."""
        pixels = (
            np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1)
            .reshape(-1, 1, 2)
            .astype(float)
        )
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-12)
        x = (
            cv2.undistortPointsIter(pixels, self.matrix, self.distortion, None, None, criteria)
            if hasattr(cv2, "undistortPointsIter")
            else cv2.undistortPoints(pixels, self.matrix, self.distortion, criteria=criteria)
        )
        return np.dstack([x.reshape(size[1], size[0], 2), np.ones((size[1], size[0]))])


def seen(rays: np.ndarray, T_depth_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] along z of the depth camera's frame, and whether the board is hit, of rays from a
    camera.
    """
    origin, direction = T_depth_camera[:3, 3], rays @ T_depth_camera[:3, :3].T
    at_board = origin + (BOARD - origin[2]) / direction[..., 2:] * direction
    hit = np.all(
        (at_board[..., :2] > BOARD_CORNERS[0]) & (at_board[..., :2] < BOARD_CORNERS[1]), axis=-1
    )
    return np.where(hit, BOARD, WALL), hit


def images() -> dict[str, np.ndarray]:
    """DEPTH and IR (H, W) uint16 and COLOR (H, W, 3) RGB."""
    depth, board = seen(WrittenCamera.of("D0").rays(DEPTH_SIZE), np.eye(4))
    _, board_in_color = seen(WrittenCamera.of("PV0").rays(COLOR_SIZE), np.linalg.inv(T_COLOR_DEPTH))
    units = np.round(depth * 1000).astype(np.uint16)
    units[:4] = 0  # no reading
    return {
        "DEPTH": units,
        "IR": np.where(board, BOARD_INFRARED, WALL_INFRARED).astype(np.uint16),
        "COLOR": np.where(board_in_color[..., None], BOARD_COLOR, WALL_COLOR).astype(np.uint8),
    }


def calibration() -> dict:
    def camera(location: str, T: np.ndarray) -> dict:
        return {
            "Location": f"CALIBRATION_CameraLocation{location}",
            "MetricRadius": 1.74 if location == "D0" else 0,
            "Intrinsics": {
                "ModelParameterCount": 14,
                "ModelParameters": WrittenCamera.of(location).parameters,
            },
            "Rt": {"Rotation": T[:3, :3].ravel().tolist(), "Translation": T[:3, 3].tolist()},
        }

    return {
        "CalibrationInformation": {
            "Cameras": [camera("D0", np.eye(4)), camera("PV0", T_COLOR_DEPTH)]
        }
    }


def write_k4a(
    path: Path,
    frames: int = 3,
    *,
    tracks=("COLOR", "DEPTH", "IR"),
    attached: bytes | None = b"",
    big_endian: bool = True,
    color_delay: int = 1000,
) -> Path:
    """A recording; `attached` None leaves the calibration out, other bytes replace it. Frame n's
    infrared is n brighter.
    """
    av = pytest.importorskip(
        "av", reason="recordings of an Azure Kinect are written and read with PyAV, extra 'k4a'"
    )
    pictures, ok = (
        images(),
        cv2.imencode(".jpg", images()["COLOR"][..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 95]),
    )
    jpeg = ok[1].tobytes()
    with av.open(
        str(path), "w", format="matroska", options={"allow_raw_vfw": "1", "write_crc32": "0"}
    ) as container:
        streams = {}
        for title in tracks:
            codec, size = ("mjpeg", COLOR_SIZE) if title == "COLOR" else ("rawvideo", DEPTH_SIZE)
            stream = container.add_stream(codec, rate=5)
            stream.width, stream.height = size
            stream.pix_fmt = "yuvj420p" if title == "COLOR" else "gray16be"
            stream.time_base = Fraction(1, 1_000_000)
            stream.metadata["title"] = title
            streams[title] = stream
        if attached is not None:
            data = attached or json.dumps(calibration()).encode()
            container.add_attachment("calibration.json", "application/octet-stream", data)
        for n in range(frames):
            for title, stream in streams.items():
                units = pictures[title] + (n if title == "IR" else 0)
                packet = av.Packet(
                    jpeg
                    if title == "COLOR"
                    else units.astype(">u2" if big_endian else "<u2").tobytes()
                )
                packet.pts = packet.dts = (
                    (START + n * PERIOD + (color_delay if title == "COLOR" else 0)) // 1000 * 1000
                )
                packet.stream, packet.time_base, packet.is_keyframe = (
                    stream,
                    Fraction(1, 1_000_000),
                    True,
                )
                container.mux(packet)
    # mark those tracks as the device's recorder does, in the bitmap header that describes them
    if big_endian:
        width, height = DEPTH_SIZE
        unmarked, marked = (
            struct.pack("<IiiHHI", 40, width, -height, 1, 16, 0),
            struct.pack("<IiiHH", 40, width, height, 1, 16),
        )
        path.write_bytes(path.read_bytes().replace(unmarked, marked + b"b16g"))
    return path
