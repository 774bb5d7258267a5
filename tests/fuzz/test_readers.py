"""Recordings that are damaged anyhow: a clear error or a skipped frame, no hang, no crash, no gigabytes.

A few mutations of each in the suite; UNIFUSION_FUZZ=2000 asks for as many of each:

    UNIFUSION_FUZZ=2000 python -m pytest -q -s tests/fuzz
"""

from __future__ import annotations

import os
from pathlib import Path

import bag_writer as bags
import numpy as np
import pytest
from dataset_writers import START, make_samples
from fuzzing import fuzz
from open3d_writer import TRAJECTORIES, write_recording
from realsense_writer import write_realsense

MUTATIONS = int(os.environ.get("UNIFUSION_FUZZ", "6"))


def bag_of_all_encodings(folder: Path, container: str) -> Path:
    units = make_samples(1)[0].units
    topic = "/camera/depth/image_raw/compressedDepth"
    messages = [
        bags.transform(np.eye(4), START, "map"),
        bags.camera_info("/camera/depth/camera_info", START, distortion=(0.1, -0.1, 0, 0, 0)),
    ]
    for i, (data, form) in enumerate(
        [
            (bags.depth_png(units), "16UC1; compressedDepth png"),
            (bags.depth_rvl(units), "16UC1; compressedDepth rvl"),
            (bags.depth_png(units, 100.0, 1.0), "32FC1; compressedDepth png"),
        ]
    ):
        messages.append(bags.compressed(topic, data, form, START + i / 30))
    return bags.write_bag(folder / "r", messages, container)


def plain_bag(folder: Path, container: str) -> Path:
    return bags.write_bag(folder / "r", bags.recording(make_samples(3)), container)


def lone_file(folder: Path, container: str) -> Path:
    """A .db3 without the metadata.yaml beside it, as a robot that was switched off leaves it."""
    (file,) = plain_bag(folder, container).glob(f"*.{container}")
    return file.rename(folder / file.name)


def realsense(folder: Path, container: str) -> Path:
    return write_realsense(folder / "r", container, inverse=container == "db3")


def open3d(folder: Path, name: str) -> Path:
    samples = make_samples(2)
    write_recording(folder / "r", samples)
    (folder / "r" / name).write_text(TRAJECTORIES[name](samples))
    return folder / "r"


RECORDINGS = {
    "bag": ("rosbag", plain_bag, "bag"),
    "bag lz4": ("rosbag", plain_bag, "bag-lz4"),
    "bag bz2": ("rosbag", plain_bag, "bag-bz2"),
    "mcap": ("rosbag", plain_bag, "mcap"),
    "mcap zstd": ("rosbag", plain_bag, "mcap-zstd"),
    "db3": ("rosbag", plain_bag, "db3"),
    "db3 alone": ("rosbag", lone_file, "db3"),
    "encodings in a bag": ("rosbag", bag_of_all_encodings, "bag"),
    "encodings in a db3": ("rosbag", bag_of_all_encodings, "db3"),
    "realsense db3": ("realsense", realsense, "db3"),
    "realsense bag": ("realsense", realsense, "bag"),
    "open3d log": ("open3d", open3d, "trajectory.log"),
    "open3d json": ("open3d", open3d, "trajectory.json"),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_i1_damaged_recordings(name, tmp_path, request):
    pytest.importorskip("rosbags", reason="bags are written and read with rosbags, extra 'ros'")
    format, write, container = RECORDINGS[name]
    (tmp_path / "base").mkdir()
    base = write(tmp_path / "base", container)
    files = [base] if base.is_file() else [f for f in sorted(base.rglob("*")) if f.is_file()]
    if container not in ("trajectory.log", "trajectory.json"):  # of a bag: not its description
        files = [file for file in files if file.suffix in (".bag", ".mcap", ".db3")]
    seed, kept = sum(map(ord, name)), Path(request.config.rootpath) / "fuzz-failure"
    found = fuzz(format, base, files, MUTATIONS, seed, tmp_path, kept)
    print(f"{name}: {dict(found)}")
    assert found.total() == MUTATIONS
