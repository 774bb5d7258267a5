"""Image and text encoders in ONNX files: a small converted CLIP, and what is none."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from taichi_unifusion import Frame, PinholeCamera
from taichi_unifusion.errors import FileError, FrameError, InputError
from taichi_unifusion.language import (
    feature_image,
    make_image_encoder,
    make_text_encoder,
    unit_length,
)
from taichi_unifusion.networks.clip import NORMALIZATION

onnx = pytest.importorskip("onnx", reason="writing test networks needs the package onnx")
pytest.importorskip("onnxruntime", reason="needs onnxruntime: pip install onnxruntime")

FLOAT, INT32, INT64 = 1, 6, 7  # ONNX's numbers of the types
CLOSE = 1e-4
CHANNELS, PATCH = 12, 8


def write(path: Path, nodes, constants, inputs, output) -> Path:
    helper = onnx.helper
    graph = helper.make_graph(
        [
            helper.make_node(operator, taken, given, **attributes)
            for operator, taken, given, attributes in nodes
        ],
        "test",
        [helper.make_tensor_value_info(name, kind, shape) for name, kind, shape in inputs],
        [helper.make_tensor_value_info("result", FLOAT, output)],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, str(path))
    return path


KERNEL = np.random.default_rng(0).standard_normal((CHANNELS, 3, PATCH, PATCH)).astype(np.float32)
TABLE = np.random.default_rng(1).standard_normal((600, CHANNELS)).astype(np.float32)


def image_network(path: Path, shape, tokens: bool = False) -> Path:
    """One linear feature a patch, as an image (1, c, h, w) or as a row a patch after one for the
    whole (1, 1 + h w, c).
    """
    nodes = [("Conv", ["image", "kernel"], ["patches"], {"strides": [PATCH, PATCH]})]
    if tokens:
        nodes += [
            ("Reshape", ["patches", "shape"], ["flat"], {}),
            ("Transpose", ["flat"], ["rows"], {"perm": [0, 2, 1]}),
            ("ReduceMean", ["rows"], ["whole"], {"axes": [1], "keepdims": 1}),
            ("Concat", ["whole", "rows"], ["result"], {"axis": 1}),
        ]
        return write(
            path,
            nodes,
            {"kernel": KERNEL, "shape": np.array([1, CHANNELS, -1], np.int64)},
            [("image", FLOAT, shape)],
            [1, "tokens", CHANNELS],
        )
    nodes[0] = ("Conv", ["image", "kernel"], ["result"], {"strides": [PATCH, PATCH]})
    return write(
        path, nodes, {"kernel": KERNEL}, [("image", FLOAT, shape)], [1, CHANNELS, "h", "w"]
    )


def text_network(path: Path, kind=INT64, batch="n", mask: bool = False) -> Path:
    """The mean of the tokens' vectors."""
    nodes = [
        ("Gather", ["table", "input_ids"], ["words"], {}),
        ("ReduceMean", ["words"], ["result"], {"axes": [1], "keepdims": 0}),
    ]
    inputs = [("input_ids", kind, [batch, 77])] + (
        [("attention_mask", kind, [batch, 77])] if mask else []
    )
    return write(path, nodes, {"table": TABLE}, inputs, [batch, CHANNELS])


@pytest.fixture
def merges(tmp_path):
    (tmp_path / "merges.txt").write_text("#version: 0.2\ns o\nf a</w>\n")
    return tmp_path / "merges.txt"


def frame(height=48, width=64) -> Frame:
    color = np.random.default_rng(0).integers(0, 255, (height, width, 3)).astype(np.uint8)
    return Frame(
        np.ones((height, width), np.float32),
        PinholeCamera(width, height, 50, 50, width / 2, height / 2),
        color=color,
    )


def by_hand(color):
    """Features (h, w, c) of an image as large as the network's."""
    mean, std = (np.array(values) for values in NORMALIZATION["clip"])
    image = (color / 255 - mean) / std
    h, w = (side // PATCH for side in color.shape[:2])
    patches = image.reshape(h, PATCH, w, PATCH, 3)
    return unit_length(np.einsum("hiwjc,dcij->hwd", patches, KERNEL.astype(float)))


@pytest.mark.parametrize("tokens", [False, True])
@pytest.mark.parametrize("shape", [[1, 3, 48, 64], [1, 3, "height", "width"]])
def test_features_are_what_the_network_gives_where_it_looks(tmp_path, tokens, shape):
    path = image_network(tmp_path / "image.onnx", shape, tokens)
    encoder = make_image_encoder(
        f"onnx:{path}", patch=PATCH, **({} if shape[2] == 48 else {"size": (64, 48)})
    )
    assert np.abs(feature_image(encoder, frame()) - by_hand(frame().color)).max() < CLOSE


def test_an_open_network_sees_whole_patches_of_the_image_s_shape(tmp_path):
    path = image_network(tmp_path / "image.onnx", [1, 3, "height", "width"])
    found = make_image_encoder(f"onnx:{path}", patch=PATCH).image_features(frame())
    assert found.shape == (42, 56, CHANNELS)


@pytest.mark.parametrize("options", [{}, {"kind": INT32}, {"batch": 2}, {"mask": True}])
def test_texts_are_what_the_network_makes_of_their_tokens(tmp_path, merges, options):
    encoder = make_text_encoder(
        f"onnx:{text_network(tmp_path / 'text.onnx', **options)}", tokenizer=merges
    )
    texts = ["a sofa", "bed", "lamp"]
    wanted = unit_length(TABLE[encoder.tokenizer(texts)].mean(axis=1))
    assert np.abs(encoder.text_features(texts) - wanted).max() < CLOSE


def test_what_is_no_encoder_is_said(tmp_path, merges):
    (tmp_path / "broken.onnx").write_bytes(b"no model")
    text, image = (
        text_network(tmp_path / "text.onnx"),
        image_network(tmp_path / "image.onnx", [1, 3, 48, 64], True),
    )
    for make, where, options, error, message in (
        (make_image_encoder, "absent.onnx", {}, FileError, "no such file"),
        (make_image_encoder, "broken.onnx", {}, FileError, "not an ONNX model"),
        (make_image_encoder, "text.onnx", {}, InputError, "not one RGB image"),
        (
            make_image_encoder,
            "image.onnx",
            {"size": (32, 32)},
            InputError,
            r"48, 64\].* size=32x32 does not fit",
        ),
        (make_text_encoder, "image.onnx", {"tokenizer": merges}, InputError, "not token numbers"),
        (make_text_encoder, "text.onnx", {}, InputError, "--tokenizer"),
    ):
        with pytest.raises(error, match=message):
            make(f"onnx:{tmp_path / where}", **options)
    with pytest.raises(InputError, match="patch size"):
        make_image_encoder(f"onnx:{image}", patch=16).image_features(frame())
    with pytest.raises(FrameError, match="no colour"):
        make_image_encoder(f"onnx:{image}", patch=PATCH).image_features(
            Frame(np.ones((4, 4), np.float32), PinholeCamera(4, 4, 4, 4, 2, 2))
        )
    assert text.exists()
