"""Small image networks, written as ONNX files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

FLOAT, HALF, BYTE = 1, 10, 2  # ONNX's numbers of the types


def write_network(
    path: Path,
    nodes,
    constants: dict[str, np.ndarray],
    input_shape,
    output_shape,
    *,
    input_type: int = FLOAT,
    output_type: int = FLOAT,
    more_inputs=(),
) -> Path:
    """A graph from "image" to "result"; `nodes` are (operator, inputs, outputs, attributes)."""
    onnx = pytest.importorskip("onnx", reason="writing test networks needs the package onnx")
    helper = onnx.helper
    graph = helper.make_graph(
        [
            helper.make_node(operator, inputs, outputs, **attributes)
            for operator, inputs, outputs, attributes in nodes
        ],
        "test",
        [
            helper.make_tensor_value_info("image", input_type, input_shape),
            *(helper.make_tensor_value_info(name, FLOAT, [1]) for name in more_inputs),
        ],
        [helper.make_tensor_value_info("result", output_type, output_shape)],
        [onnx.numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8  # what onnxruntime of the last years reads
    onnx.save(model, str(path))
    return path


def open_shape(channels: int) -> list:
    return [1, channels, "height", "width"]


def edge_detector(path: Path, gain: float = 4.0) -> Path:
    """Laplacian of the mean colour, its size squashed to [0, 1): one channel as large as the image."""
    kernel = np.tile(np.float32([[0, -1, 0], [-1, 4, -1], [0, -1, 0]]) * gain / 3, (1, 3, 1, 1))
    nodes = [
        ("Conv", ["image", "kernel"], ["raw"], {"pads": [1, 1, 1, 1]}),
        ("Abs", ["raw"], ["size"], {}),
        ("Tanh", ["size"], ["result"], {}),
    ]
    return write_network(path, nodes, {"kernel": kernel}, open_shape(3), open_shape(1))


def color_transform(path: Path, matrix, shape=None, channels_last: bool = False) -> Path:
    """Every pixel's colour by a 3x3 matrix."""
    matrix = np.float32(matrix)
    if channels_last:
        shape = shape or [1, "height", "width", 3]
        return write_network(
            path,
            [("MatMul", ["image", "matrix"], ["result"], {})],
            {"matrix": matrix.T.copy()},
            shape,
            shape,
        )
    shape = shape or open_shape(3)
    nodes = [("Conv", ["image", "matrix"], ["result"], {})]
    return write_network(path, nodes, {"matrix": matrix[:, :, None, None]}, shape, shape)


def mean_of_channels(path: Path, input_shape, output_shape, **types) -> Path:
    """One channel: the mean colour."""
    nodes = [
        (
            "ReduceMean",
            ["image"],
            ["result"],
            {"axes": [1], "keepdims": int(len(output_shape) == 4)},
        )
    ]
    return write_network(path, nodes, {}, input_shape, output_shape, **types)


def not_a_number(path: Path) -> Path:
    """Zero by zero at every pixel."""
    nodes = [
        ("Sub", ["image", "image"], ["nothing"], {}),
        ("Div", ["nothing", "nothing"], ["result"], {}),
    ]
    return write_network(path, nodes, {}, open_shape(3), open_shape(3))
