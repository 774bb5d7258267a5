"""Saliency and style by networks: the real loading code on small ONNX files."""

from __future__ import annotations

import builtins
import hashlib

import cv2
import numpy as np
import pytest
from tiny_networks import (
    color_transform,
    edge_detector,
    mean_of_channels,
    not_a_number,
    open_shape,
    write_network,
)

from taichi_unifusion import Frame, PinholeCamera
from taichi_unifusion.errors import FileError, FrameError, InputError, MissingDependency
from taichi_unifusion.networks.image_input import IMAGENET_MEAN, IMAGENET_STD
from taichi_unifusion.properties import make_property

pytest.importorskip("onnxruntime", reason="networks are run by onnxruntime, extra 'models'")

WIDTH, HEIGHT = 48, 32
ROUNDED = 2e-6  # float32 sums of a few terms in [0, 1]
RESIZED = 0.02  # of an image that changes slowly, through a network of another size

SWAP = [[0, 0, 1], [0, 1, 0], [1, 0, 0]]  # red for blue


def frame_of(color: np.ndarray) -> Frame:
    height, width = color.shape[:2]
    return Frame(
        np.ones((height, width), np.float32),
        PinholeCamera(width, height, 40, 40, width / 2, height / 2),
        color,
    )


@pytest.fixture(scope="module")
def colors() -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.fixture(scope="module")
def slow() -> np.ndarray:
    """Colours that change slowly, so that resampling changes them little."""
    u, v = np.meshgrid(np.arange(WIDTH) / WIDTH, np.arange(HEIGHT) / HEIGHT)
    return np.uint8(255 * np.dstack([u, v, 1 - u]))


def test_an_edge_detector_gives_saliency(tmp_path, colors):
    made = make_property(
        f"saliency=onnx:{edge_detector(tmp_path / 'edges.onnx')},mean=0/0/0,std=1/1/1"
    )
    image = made.image(frame_of(colors))
    grey = np.float32(colors).mean(axis=2) / 255
    wanted = np.tanh(
        4
        * np.abs(
            cv2.filter2D(
                grey,
                -1,
                np.float32([[0, -1, 0], [-1, 4, -1], [0, -1, 0]]),
                borderType=cv2.BORDER_CONSTANT,
            )
        )
    )
    assert image.shape == (HEIGHT, WIDTH, 1) and image.dtype == np.float32
    np.testing.assert_allclose(image[..., 0], wanted, atol=10 * ROUNDED)


def test_the_input_is_normalised_as_imagenet_is_unless_told_otherwise(tmp_path, colors):
    file = mean_of_channels(tmp_path / "mean.onnx", open_shape(3), open_shape(1))
    image = make_property(f"saliency=onnx:{file},activation=sigmoid").image(frame_of(colors))
    mean = ((colors / 255 - IMAGENET_MEAN) / IMAGENET_STD).mean(axis=2)
    np.testing.assert_allclose(image[..., 0], 1 / (1 + np.exp(-mean)), atol=ROUNDED)
    stretched = make_property(f"saliency=onnx:{file},activation=minmax").image(frame_of(colors))
    assert stretched.min() == 0 and stretched.max() == 1
    with pytest.raises(
        InputError, match=r"runs from -\S+ to \S+, which is no saliency.*activation=sigmoid"
    ):
        make_property(f"saliency=onnx:{file}").image(frame_of(colors))


@pytest.mark.parametrize("channels_last", [False, True])
@pytest.mark.parametrize("order", ["rgb", "bgr"])
def test_a_colour_transform_gives_style(tmp_path, colors, channels_last, order):
    """Red for blue in either order of channels: what goes in as RGB comes out as RGB."""
    file = color_transform(tmp_path / "swap.onnx", SWAP, channels_last=channels_last)
    image = make_property(f"style=onnx:{file},order={order}").image(frame_of(colors))
    np.testing.assert_allclose(image, colors[..., ::-1] / 255, atol=ROUNDED)


def test_order_matters_where_the_channels_are_not_alike(tmp_path, colors):
    first_only = [[1, 0, 0], [0, 0, 0], [0, 0, 0]]
    file = color_transform(tmp_path / "first.onnx", first_only)
    image = make_property(f"style=onnx:{file},order=bgr").image(frame_of(colors))
    np.testing.assert_allclose(image[..., 2], colors[..., 2] / 255, atol=ROUNDED)
    assert not image[..., :2].any()


def test_the_range_of_an_output_is_told_and_checked(tmp_path, colors):
    file = color_transform(tmp_path / "same.onnx", np.eye(3))
    image = make_property(f"style=onnx:{file},scale=1,output_scale=1").image(frame_of(colors))
    np.testing.assert_allclose(image, colors / 255, atol=ROUNDED)
    with pytest.raises(
        InputError, match="reaches 1, which does not fit a range of 0 to 255; say output_scale=1"
    ):
        make_property(f"style=onnx:{file},scale=1").image(frame_of(colors))
    with pytest.raises(
        InputError, match="reaches 255, which does not fit a range of 0 to 1; say output_scale=255"
    ):
        make_property(f"style=onnx:{file},output_scale=1").image(frame_of(colors))


def test_a_fixed_input_size_is_met_and_undone(tmp_path, slow):
    file = color_transform(tmp_path / "fixed.onnx", np.eye(3), shape=[1, 3, 64, 64])
    image = make_property(f"style=onnx:{file}").image(frame_of(slow))
    assert image.shape == (HEIGHT, WIDTH, 3) and np.abs(image - slow / 255).max() < RESIZED
    with pytest.raises(InputError, match=r"fixed, and size=32x64 does not fit"):
        make_property(f"style=onnx:{file},size=32x64")


def test_an_open_input_takes_the_size_that_is_asked_for(tmp_path, slow):
    file = color_transform(tmp_path / "open.onnx", np.eye(3))
    image = make_property(f"style=onnx:{file},size=24x40").image(frame_of(slow))
    assert image.shape == (HEIGHT, WIDTH, 3) and np.abs(image - slow / 255).max() < 3 * RESIZED


@pytest.mark.parametrize("output_shape", [[1, "h", "w"], [1, 1, "h", "w"]])
def test_one_channel_may_come_in_several_shapes(tmp_path, colors, output_shape):
    file = mean_of_channels(tmp_path / "mean.onnx", open_shape(3), output_shape)
    image = make_property(f"saliency=onnx:{file},mean=0/0/0,std=1/1/1").image(frame_of(colors))
    np.testing.assert_allclose(image[..., 0], colors.mean(axis=2) / 255, atol=ROUNDED)


def test_half_precision_and_bytes_go_in(tmp_path, colors):
    half = write_network(
        tmp_path / "half.onnx",
        [("Cast", ["image"], ["result"], {"to": 1})],
        {},
        open_shape(3),
        open_shape(3),
        input_type=10,
    )
    # 10 bits
    assert (
        np.abs(make_property(f"style=onnx:{half}").image(frame_of(colors)) - colors / 255).max()
        < 1e-3
    )
    byte = write_network(
        tmp_path / "byte.onnx",
        [("Cast", ["image"], ["result"], {"to": 1})],
        {},
        open_shape(3),
        open_shape(3),
        input_type=2,
    )
    np.testing.assert_allclose(
        make_property(f"style=onnx:{byte}").image(frame_of(colors)), colors / 255, atol=ROUNDED
    )


def test_X4_a_network_that_gives_no_number_costs_the_frame_this_property(tmp_path, colors):
    made = make_property(f"style=onnx:{not_a_number(tmp_path / 'nan.onnx')}")
    with pytest.raises(
        FrameError, match=r"property 'style', frame 0: .*nan.onnx gives 100% NaN or infinite values"
    ):
        made.image(frame_of(colors))


def test_X1_a_model_that_is_missing_damaged_or_another_is_said(tmp_path):
    file = edge_detector(tmp_path / "edges.onnx")
    data = file.read_bytes()
    with pytest.raises(FileError, match="none.onnx: no such file"):
        make_property(f"saliency=onnx:{tmp_path / 'none.onnx'}")
    right = hashlib.sha256(data).hexdigest()
    make_property(f"saliency=onnx:{file},sha256={right.upper()}")
    with pytest.raises(
        FileError, match=f"has the SHA-256 {right}, not 00; download the model again"
    ):
        make_property(f"saliency=onnx:{file},sha256=00")
    file.write_bytes(data[: len(data) // 2])
    with pytest.raises(FileError, match="edges.onnx: not an ONNX model that onnxruntime can run"):
        make_property(f"saliency=onnx:{file}")
    file.write_text("nothing of the kind")
    with pytest.raises(FileError, match="not an ONNX model"):
        make_property(f"saliency=onnx:{file}")


def test_a_model_of_another_kind_is_said(tmp_path, colors):
    with pytest.raises(InputError, match=r"is \[1, 4, 8, 8\] tensor\(float\), not one RGB image"):
        make_property(
            f"saliency=onnx:{mean_of_channels(tmp_path / 'four.onnx', [1, 4, 8, 8], [1, 1, 8, 8])}"
        )
    two = write_network(
        tmp_path / "two.onnx",
        [("Mul", ["image", "gain"], ["result"], {})],
        {},
        open_shape(3),
        open_shape(3),
        more_inputs=["gain"],
    )
    with pytest.raises(InputError, match=r"takes 2 inputs \(image, gain\), not one image"):
        make_property(f"style=onnx:{two}")
    three = color_transform(tmp_path / "three.onnx", np.eye(3))
    with pytest.raises(
        InputError,
        match=r"'result' is \(1, 3, 32, 48\) float32, not an image of 1 channel; outputs: result",
    ):
        make_property(f"saliency=onnx:{three}").image(frame_of(colors))
    with pytest.raises(InputError, match="has no output 'mask'; outputs: result"):
        make_property(f"saliency=onnx:{three},output=mask")
    blocky = write_network(
        tmp_path / "blocky.onnx",
        [("Reshape", ["image", "shape"], ["result"], {})],
        {"shape": np.array([1, 3, 64, 64])},
        open_shape(3),
        [1, 3, 64, 64],
    )
    with pytest.raises(
        InputError, match=r"blocky.onnx: fails on an image of 48x32; .*say size=WIDTHxHEIGHT"
    ):
        make_property(f"style=onnx:{blocky}").image(frame_of(colors))


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ("scale=0", "scale above 0"),
        ("std=0/1/1", "three positive stds"),
        ("mean=0.5/0.5", "three means"),
        ("size=4x4", "size: must lie in 8..8192 pixels, got 4x4"),
        ("size=64", "size: expected WIDTHxHEIGHT, got '64'"),
        (
            "order=rbg",
            "order: 'rbg' is unknown \\(did you mean 'rgb'\\?\\); choose one of rgb, bgr",
        ),
        ("device=gpu", "device: 'gpu' is unknown"),
    ],
)
def test_settings_that_do_not_fit(tmp_path, settings, told):
    file = mean_of_channels(tmp_path / "mean.onnx", open_shape(3), open_shape(1))
    with pytest.raises(InputError, match=told):
        make_property(f"saliency=onnx:{file},{settings}")


def test_missing_packages_are_said_with_the_command_that_installs_them(tmp_path, monkeypatch):
    file = edge_detector(tmp_path / "edges.onnx")
    with pytest.raises(MissingDependency, match="no CUDA; pip install onnxruntime-gpu"):
        monkeypatch.setattr("onnxruntime.get_available_providers", lambda: ["CPUExecutionProvider"])
        make_property(f"saliency=onnx:{file},device=cuda")
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "onnxruntime":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependency, match=r"taichi-unifusion\[models\]"):
        make_property(f"saliency=onnx:{file}")
