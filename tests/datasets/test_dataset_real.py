"""Real recordings, where they are at hand: UNIFUSION_DATA, or shared/data beside the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from places import DATA

from taichi_unifusion.datasets import open_dataset


def recording(name: str) -> Path:
    if not (DATA / name).is_dir():
        pytest.skip(f"no {name} in {DATA}; set UNIFUSION_DATA to a folder that has it")
    return DATA / name


def test_seven_scenes_red_kitchen():
    dataset = open_dataset("7scenes", recording("7scenes-redkitchen"))
    assert len(dataset) == 380 and not dataset.warnings
    assert (dataset.camera.fx, dataset.camera.cx, dataset.camera.cy) == (585.0, 320.0, 240.0)
    frame = dataset[-1]
    assert frame.name.endswith("frame-000695.depth.png")
    assert frame.color.shape == (480, 640, 3) and 0.3 < np.median(frame.depth[frame.depth > 0]) < 5


def test_replica_office_takes_rows_0_and_20():
    dataset = open_dataset("replica", recording("replica-office0"))
    rows = np.loadtxt(DATA / "replica-office0" / "traj.txt")
    assert len(dataset) == 2
    np.testing.assert_array_equal(dataset[0].T_world_camera, rows[0].reshape(4, 4))
    np.testing.assert_array_equal(dataset[1].T_world_camera, rows[20].reshape(4, 4))
    assert dataset[1].depth.shape == (680, 1200) and 1 < np.median(dataset[1].depth) < 4


def test_tum_desk():
    dataset = open_dataset("tum", recording("tum-fr1desk9"))
    assert len(dataset) == 9 and dataset.camera.fx == 517.3
    stamps = [frame.timestamp for frame in dataset]
    assert stamps == sorted(stamps) and stamps[-1] - stamps[0] < 0.3
    path = np.array([frame.T_world_camera[:3, 3] for frame in dataset])
    assert 0.05 < np.linalg.norm(path[-1] - path[0]) < 0.2  # [m] the hand-held camera moved


@pytest.mark.parametrize(
    "name, format, tolerance",
    [
        ("tum-fr1desk9", "tum", 0.02),
        ("replica-office0", "replica", 0.01),
        ("7scenes-redkitchen", "7scenes", 0.05),
    ],
)
def test_consecutive_frames_agree_in_the_world(name, format, tolerance):
    """Depth scale, axes and pose convention together: one frame's points, seen by the next camera,
    lie at its depth.
    """
    dataset = open_dataset(format, recording(name))
    first, second = dataset[0], dataset[1]
    camera = first.camera
    v, u = np.nonzero(first.depth)
    z = first.depth[v, u]
    points = np.stack(
        [(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z, np.ones_like(z)]
    )
    x, y, z, _ = np.linalg.inv(second.T_world_camera) @ first.T_world_camera @ points
    u, v = (
        np.rint(camera.fx * x / z + camera.cx).astype(int),
        np.rint(camera.fy * y / z + camera.cy).astype(int),
    )
    inside = (z > 0) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    seen = second.depth[v[inside], u[inside]]
    error = np.abs(seen - z[inside])[seen > 0]
    assert inside.mean() > 0.5 and np.median(error) < tolerance
