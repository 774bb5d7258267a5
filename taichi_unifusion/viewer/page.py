"""A scene as one HTML file that needs no server and asks for nothing: layers, legend, clicks, cameras
and a cut by height work offline. `page.html` beside this file is the program; here is the data.

The data is one gzip stream, as base64 text: the length of a JSON header, the header, then arrays as
byte planes. Numbers are differences to the one before, which compresses well where vertices that are
near stand near each other: they are sorted along a space-filling curve.
"""

from __future__ import annotations

import base64
import gzip
import json
import os
import struct
from collections.abc import Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.atomic import write_text
from ..results.tables import format_bytes
from .decimation import decimate_scene
from .scene import Layer, Legend, Scene, SceneMesh

MOST_BYTES = 15_000_000  # of a page; what is more is decimated
BYTES_PER_TRIANGLE = 9  # of a page with one layer, at most: where the first try begins
TRIES = 6
SMALLER = 0.92  # a further try takes this share of the triangles that should fit
GRID = 65535  # steps of a coordinate over the extent of a mesh: 0.15 mm in 10 m
STEPS = 254  # of a value over the range of its layer; 0 stands for unknown
MORTON_BITS = 16


def write_page(scene: Scene, path: str | os.PathLike[str], most_bytes: int = MOST_BYTES) -> str:
    """Write the page atomically; says in words what it holds and what was left out for its size.

    Raises InputError for a scene without triangles, FileError, MissingDependency where triangles
    must be fewer and fast-simplification is missing.
    """
    if not scene.triangles:
        raise InputError(f"{path}: the scene holds no triangle, there is nothing to show")
    text, shown = fitted_page(scene, most_bytes)
    write_text(Path(path), text)
    said = (
        f"{shown.triangles:,} triangles, {len(shown.layer_names)} layers, {format_bytes(len(text))}"
    )
    notes = [mesh.note for mesh in shown.meshes if mesh.note]
    return "; ".join([said, *notes])


def fitted_page(scene: Scene, most_bytes: int) -> tuple[str, Scene]:
    """The text of a page of at most so many bytes, and the scene that it shows: as many triangles
    as fit.
    """
    template = files("taichi_unifusion.viewer").joinpath("page.html").read_text(encoding="utf-8")
    triangles = min(scene.triangles, most_bytes // BYTES_PER_TRIANGLE)
    for _ in range(TRIES):
        shown = decimate_scene(scene, triangles)
        data = base64.b64encode(encode_scene(shown)).decode()
        text = template.replace("__TITLE__", escape(scene.name)).replace("__DATA__", data)
        if len(text) <= most_bytes:
            return text, shown
        triangles = int(SMALLER * shown.triangles * most_bytes / len(text))
    raise InputError(f"page: {most_bytes:,} bytes hold no useful part of {scene.name}; allow more")


def encode_scene(scene: Scene) -> bytes:
    """The data of a page: everything in the upright frame, whose z is up."""
    blob, header = _Blob(), _describe(scene)
    header["meshes"] = [_encode_mesh(blob, scene, shown) for shown in scene.meshes]
    text = json.dumps(header, separators=(",", ":")).encode()
    return gzip.compress(struct.pack("<I", len(text)) + text + b"".join(blob.parts), 9, mtime=0)


def _describe(scene: Scene) -> dict[str, Any]:
    """All but the meshes: poses and corners in the upright frame."""
    T = scene.T_up_world
    eye, center = (_moved(T, point[None])[0] for point in scene.overview())
    return {
        "name": scene.name,
        "layers": scene.layer_names,
        "T_up_world": _rounded(T),
        "heights": _rounded(scene.heights()),
        "eye": _rounded(eye),
        "center": _rounded(center),
        "cameras": [
            {
                "name": camera.name,
                "T": _rounded(T @ camera.T_world_camera),
                "fov": 2 * float(np.arctan(0.5 * camera.camera.height / camera.camera.fy)),
                "aspect": camera.camera.width / camera.camera.height,
            }
            for camera in scene.cameras
        ],
        "boxes": [
            {
                "name": box.name,
                "color": list(box.color),
                "corners": _rounded(
                    _moved(T, np.array(np.meshgrid(*box.corners.T, indexing="ij")).reshape(3, -1).T)
                ),
            }
            for box in scene.boxes
        ],
        "labels": [
            {"text": label.text, "at": _rounded(_moved(T, label.position[None])[0])}
            for label in scene.labels
        ],
    }


def _encode_mesh(blob: _Blob, scene: Scene, shown: SceneMesh) -> dict[str, Any]:
    points = _moved(scene.T_up_world, shown.mesh.vertices)
    low, high = points.min(axis=0), points.max(axis=0)
    scale = np.maximum(high - low, 1e-6) / GRID
    grid = np.rint((points - low) / scale).astype(np.int64)
    order = np.argsort(_morton(grid), kind="stable")
    number = np.empty(len(order), np.int64)
    number[order] = np.arange(len(order))
    faces = _turned(number[shown.mesh.faces])
    return {
        "name": shown.name,
        "note": shown.note,
        "T_map": _rounded(np.linalg.inv(scene.T_up_world @ shown.T_scene_map)),
        "low": _rounded(low),
        "scale": scale.tolist(),
        "vertices": len(order),
        "positions": [blob.add_differences(grid[order, k]) for k in range(3)],
        "faces": [blob.add_differences(column) for column in _columns(faces)],
        "layers": [_encode_layer(blob, layer.take(order)) for layer in shown.layers],
    }


def _turned(faces: NDArray[np.int64]) -> NDArray[np.int64]:
    """Faces (F, 3) that begin with their lowest corner, in its order; seen from the same side."""
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return turned[np.argsort(turned[:, 0], kind="stable")]


def _columns(faces: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Three columns of numbers that are small: corners two and three by their distance to one."""
    return [faces[:, 0], faces[:, 1] - faces[:, 0], faces[:, 2] - faces[:, 0]]


def _encode_layer(blob: _Blob, layer: Layer) -> dict[str, Any]:
    """Values of one channel as steps of their range; else the colours."""
    legend = layer.legend
    said: dict[str, Any] = {"name": layer.name, "lit": layer.lit}
    if legend is not None:
        said["legend"] = _encode_legend(legend)
    if layer.values is not None and layer.values.shape[1] == 1 and legend is not None:
        said["steps"] = blob.add_bytes(_steps(layer.values[:, 0], legend))
        if not _is_table(layer, legend):  # as the heat of an answer, which keeps light and dark
            said["colors"] = [blob.add_bytes(layer.colors[:, k]) for k in range(3)]
    else:
        said["colors"] = [blob.add_bytes(layer.colors[:, k]) for k in range(3)]
    return said


def _steps(values: NDArray, legend: Legend) -> NDArray[np.uint8]:
    """1..255 for values from the low to the high end, or the classes from 1; 0 for unknown."""
    known = np.isfinite(values)
    if legend.names:
        place = np.clip(values, 0, STEPS)
    else:
        place = np.clip((values - legend.low) / (legend.high - legend.low), 0, 1) * STEPS
    return np.where(known, np.rint(np.nan_to_num(place)) + 1, 0).astype(np.uint8)


def _is_table(layer: Layer, legend: Legend) -> bool:
    """Whether the colours are those of the legend at the values."""
    assert layer.values is not None
    values = layer.values[:, 0]
    if legend.names:
        return len(legend.names) <= STEPS
    place = np.clip((values - legend.low) / (legend.high - legend.low), 0, 1)
    row = np.rint(np.nan_to_num(place) * (len(legend.colors) - 1)).astype(int)
    off = np.abs(legend.colors[row].astype(int) - layer.colors)[np.isfinite(values)]
    return not len(off) or float(np.percentile(off, 99)) <= 4


def _encode_legend(legend: Legend) -> dict[str, Any]:
    return {
        "label": legend.label,
        "low": legend.low,
        "high": legend.high,
        "colors": legend.colors.tolist(),
        "names": legend.names,
    }


class _Blob:
    """Arrays one after the other, each in planes of bytes; what is added gives its place."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0

    def add_bytes(self, values: NDArray[np.uint8]) -> list[int]:
        """Bytes as differences; [place, count, 1]."""
        return self._add(np.diff(values, prepend=np.uint8(0)), 1)

    def add_differences(self, values: NDArray[np.int64]) -> list[int]:
        """Integers as zigzag differences in as many planes as they need; [place, count, planes]."""
        steps = np.diff(values, prepend=0)
        folded = np.where(steps < 0, -2 * steps - 1, 2 * steps).astype("<u4")
        planes = max(1, -(-int(folded.max(initial=0)).bit_length() // 8))
        return self._add(folded.view(np.uint8).reshape(-1, 4).T[:planes], planes)

    def _add(self, planes: NDArray[np.uint8], count: int) -> list[int]:
        data = np.ascontiguousarray(planes).tobytes()
        place, self.length = self.length, self.length + len(data)
        self.parts.append(data)
        return [place, len(data) // count, count]


def _morton(grid: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Places (N,) along a curve that keeps neighbours together, of coordinates (N, 3)."""
    code = np.zeros(len(grid), np.uint64)
    for bit in range(MORTON_BITS):
        for k in range(3):
            code |= (grid[:, k].astype(np.uint64) >> np.uint64(bit) & np.uint64(1)) << np.uint64(
                3 * bit + k
            )
    return code


def _moved(T: NDArray, points: NDArray) -> NDArray[np.float64]:
    return np.asarray(points, np.float64) @ T[:3, :3].T + T[:3, 3]


def _rounded(values: NDArray | Sequence[float]) -> list[Any]:
    return np.round(np.asarray(values, np.float64), 6).tolist()
