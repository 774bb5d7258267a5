"""Recordings that are damaged anyhow: a clear error or a skipped frame, no hang, no crash, no gigabytes.

A few mutations of each in the suite; UNIFUSION_FUZZ=2000 asks for as many of each:

    UNIFUSION_FUZZ=2000 python -m pytest -q -s tests/fuzz
"""

from __future__ import annotations

import os
import resource
import shutil
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import bag_writer as bags
import numpy as np
import pytest
from dataset_writers import START, make_samples
from open3d_writer import TRAJECTORIES, write_recording
from realsense_writer import write_realsense

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import FrameError, UniFusionError

MUTATIONS = int(os.environ.get("UNIFUSION_FUZZ", "6"))
LONGEST = 20  # [s] for one recording of some kilobytes, on a busy machine; a hang takes for ever
MOST_BYTES = 1 << 30  # that a damaged header may ask for
EXTREMES = [0, 1, 0x7F, 0x80, 0xFF]
WORDS = [b"\xff" * 4, b"\x00" * 4, b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff" * 8]


def mutated(data: bytes, rng: np.random.Generator) -> bytes:
    """The bytes with one to four faults: bits, extreme numbers, cuts, pieces that are gone, doubled or
    moved.
    """
    content = bytearray(data)
    for _ in range(rng.integers(1, 5)):
        if not content:
            break
        # half of them near the start, where headers are
        reach = len(content) if rng.random() < 0.5 else min(len(content), 2000)
        at, kind = int(rng.integers(reach)), rng.integers(7)
        length = int(rng.integers(1, 64))
        if kind == 0:
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[at] = int(rng.choice(EXTREMES))
        elif kind == 2:
            word = WORDS[int(rng.integers(len(WORDS)))]
            content[at : at + len(word)] = word
        elif kind == 3:
            del content[at:]
        elif kind == 4:
            del content[at : at + length]
        elif kind == 5:
            content[at:at] = content[at : at + length]
        else:
            other = int(rng.integers(len(content)))
            content[at : at + length] = content[other : other + length]
    return bytes(content)


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
    "encodings in a bag": ("rosbag", bag_of_all_encodings, "bag"),
    "encodings in a db3": ("rosbag", bag_of_all_encodings, "db3"),
    "realsense db3": ("realsense", realsense, "db3"),
    "realsense bag": ("realsense", realsense, "bag"),
    "open3d log": ("open3d", open3d, "trajectory.log"),
    "open3d json": ("open3d", open3d, "trajectory.json"),
}


def outcome(format: str, path: Path) -> str:
    """What becomes of a recording: every error that is not ours comes through."""
    try:
        dataset = open_dataset(format, path)
    except UniFusionError as error:
        assert len(str(error)) < 5000
        return "refused"
    read = 0
    for i in range(len(dataset)):
        try:
            frame = dataset[i]
        except FrameError as error:
            assert len(str(error)) < 5000
            continue
        assert np.isfinite(frame.depth).all() and (frame.depth >= 0).all()
        read += 1
    return "all read" if read == len(dataset) and read else "some read" if read else "none read"


@contextmanager
def less_memory() -> Iterator[None]:
    """Whoever asks for MOST_BYTES more than there are gets a MemoryError."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MOST_BYTES, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def too_long(number, frame):
    raise AssertionError(f"hangs: more than {LONGEST} s")


@pytest.mark.parametrize("name", RECORDINGS)
def test_i1_damaged_recordings(name, tmp_path):
    pytest.importorskip("rosbags", reason="bags are written and read with rosbags, extra 'ros'")
    format, write, container = RECORDINGS[name]
    (tmp_path / "base").mkdir()
    base = write(tmp_path / "base", container)
    files = [base] if base.is_file() else [f for f in sorted(base.rglob("*")) if f.is_file()]
    if container not in ("trajectory.log", "trajectory.json"):  # of a bag: not its description
        files = [file for file in files if file.suffix in (".bag", ".mcap", ".db3")]
    found, rng = Counter(), np.random.default_rng(sum(map(ord, name)))
    before = signal.signal(signal.SIGALRM, too_long)
    try:
        for n in range(MUTATIONS):
            damaged = tmp_path / f"d{n}"
            shutil.copytree(base, damaged) if base.is_dir() else damaged.mkdir()
            file = files[int(rng.integers(len(files)))]
            relative = file.relative_to(base) if base.is_dir() else Path(file.name)
            (damaged / relative).write_bytes(mutated(file.read_bytes(), rng))
            path = damaged if base.is_dir() else damaged / relative
            signal.alarm(LONGEST)
            try:
                with less_memory():
                    found[outcome(format, path)] += 1
            finally:
                signal.alarm(0)
            shutil.rmtree(damaged)  # one that fails stays in pytest's folder
    finally:
        signal.signal(signal.SIGALRM, before)
    print(f"{name}: {dict(found)}")
    assert found.total() == MUTATIONS
