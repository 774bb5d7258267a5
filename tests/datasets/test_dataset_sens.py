"""ScanNet's .sens container: every encoding, and headers and records that lie (I2)."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from dataset_writers import CAMERA, HEIGHT, WIDTH, make_samples, sens_bytes

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import DatasetError, FrameError, UniFusionError

REFUSED_COST = 1 << 20  # [bytes] allocated while refusing a lie of terabytes
DAMAGES = 300


@pytest.fixture
def container(tmp_path):
    def write(data: bytes):
        (tmp_path / "scan.sens").write_bytes(data)
        return tmp_path / "scan.sens"

    return write


@pytest.mark.parametrize("color_compression", [0, 1])
@pytest.mark.parametrize("depth_compression", [0, 1])
def test_every_encoding_loads_the_same(container, color_compression, depth_compression):
    samples = make_samples(3)
    dataset = open_dataset(
        "scannet",
        container(
            sens_bytes(
                samples, color_compression=color_compression, depth_compression=depth_compression
            )
        ),
    )
    assert dataset.camera == CAMERA
    for frame, sample in zip(dataset, samples, strict=True):
        np.testing.assert_array_equal(frame.color, sample.color)
        np.testing.assert_array_equal(frame.depth, sample.metres(1000.0))


@pytest.mark.parametrize(
    "lie, said",
    [
        ({"frame_count": 1 << 40}, "promises 1099511627776 frames"),
        ({"frame_count": (1 << 64) - 1}, "promises 18446744073709551615 frames"),  # -1
        ({"name_bytes": 1 << 60}, "name would have"),
        ({"size": (0xFFFFFFFF, 12)}, "depth of 4294967295x12"),  # -1
        ({"size": (65000, 65000)}, "depth of 65000x65000"),
        ({"size": (0, 12)}, "depth of 0x12"),
        ({"color_bytes": (1 << 64) - 1}, "frame 0: damaged record"),
        ({"depth_bytes": 1 << 50}, "frame 0: damaged record"),
        ({"version": 3}, "version 3"),
        ({"color_compression": 9}, "colour compression 9 is unknown"),
        ({"depth_compression": 2}, "Occipital"),
        ({"depth_compression": -1}, "depth compression -1 is unknown"),
    ],
)
def test_I2_lies_are_refused_before_anything_is_allocated(container, lie, said):
    options = dict(lie)
    if {"color_compression", "depth_compression"} & set(lie):  # samples cannot be written that way
        options["frame_count"] = 1
    file = container(sens_bytes(make_samples(0 if "frame_count" in options else 2), **options))
    tracemalloc.start()
    try:
        with pytest.raises(DatasetError, match=said) as caught:
            open_dataset("scannet", file)
        assert tracemalloc.get_traced_memory()[1] < REFUSED_COST
    finally:
        tracemalloc.stop()
    assert str(file) in str(caught.value)


def test_I2_a_cut_file_keeps_the_frames_before_the_cut(container):
    samples = make_samples(4)
    data = sens_bytes(samples)
    dataset = open_dataset("scannet", container(data[: int(len(data) * 0.7)]))
    assert 0 < len(dataset) < 4
    assert any(f"ends within frame {len(dataset)} of 4" in warning for warning in dataset.warnings)
    np.testing.assert_array_equal(dataset[-1].depth, samples[len(dataset) - 1].metres(1000.0))


def test_I2_every_cut_is_an_error_or_a_shorter_recording(container):
    data, lengths = sens_bytes(make_samples(2)), set()
    for cut in (*range(0, len(data), 37), len(data)):
        try:
            lengths.add(len(open_dataset("scannet", container(data[:cut]))))
        except DatasetError:
            lengths.add(0)
    assert lengths == {0, 1, 2}


def test_I2_damaged_bytes_never_escape_as_another_error(container):
    data, rng, outcomes = sens_bytes(make_samples(2)), np.random.default_rng(0), set()
    for _ in range(DAMAGES):
        damaged = bytearray(data)
        damaged[rng.integers(400) if rng.random() < 0.5 else rng.integers(len(data))] = (
            rng.integers(256)
        )
        try:
            frame = open_dataset("scannet", container(bytes(damaged)))[0]
            outcomes.add("loaded")
            assert frame.depth.shape == frame.color.shape[:2]
        except UniFusionError as error:
            outcomes.add(type(error).__name__)
            assert "scan.sens" in str(error) or "camera" in str(error)
    assert {"loaded", "DatasetError", "FrameError"} <= outcomes


def test_I2_depth_is_never_inflated_beyond_the_image(container):
    small = make_samples(1)[0]
    # 8 MB in 8 kB
    zeros = type(small)(
        small.color, np.zeros((4096, 1024), np.uint16), small.T_world_camera, small.timestamp
    )
    dataset = open_dataset("scannet", container(sens_bytes([zeros])))
    tracemalloc.start()
    try:
        with pytest.raises(
            FrameError, match=f"frame 0 depth: {WIDTH}x{HEIGHT} pixels need 384 bytes, found more"
        ):
            dataset[0]
        assert tracemalloc.get_traced_memory()[1] < REFUSED_COST
    finally:
        tracemalloc.stop()


def test_S4_no_frames_at_all(container):
    with pytest.raises(DatasetError, match="holds no whole frame"):
        open_dataset("scannet", container(sens_bytes([])))
    with pytest.raises(DatasetError, match="too short"):
        open_dataset("scannet", container(b""))
