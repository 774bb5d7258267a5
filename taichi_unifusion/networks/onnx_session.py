"""Networks in ONNX files, opened by onnxruntime: what users bring for properties and features."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, MissingDependency, check_choice

if TYPE_CHECKING:
    from onnxruntime import InferenceSession

DEVICES = ("auto", "cpu", "cuda")


def open_session(file: str | Path, device: str = "auto") -> InferenceSession:
    """The network in a file, on CUDA where onnxruntime has it, else on the CPU, or on the `device`
    that is named.

    Raises FileError for a file that is missing or no model, InputError for an unknown device,
    MissingDependency without onnxruntime or its CUDA.
    """
    check_choice("device", device, DEVICES)
    if not Path(file).is_file():
        raise FileError(f"{file}: no such file")
    try:
        import onnxruntime
    except ImportError:
        raise MissingDependency(
            "ONNX models are run by onnxruntime: pip install 'taichi-unifusion[models]'"
        ) from None
    has_cuda = "CUDAExecutionProvider" in onnxruntime.get_available_providers()
    if device == "cuda" and not has_cuda:
        raise MissingDependency(
            "device: this onnxruntime has no CUDA; pip install onnxruntime-gpu, or choose cpu"
        )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # fatal only: our own messages say what failed
    providers = ["CUDAExecutionProvider"] * (has_cuda and device != "cpu") + [
        "CPUExecutionProvider"
    ]
    try:  # by path, so that weights in files beside it are found
        return onnxruntime.InferenceSession(str(file), options, providers=providers)
    except Exception as error:  # onnxruntime has no common class of errors
        raise FileError(
            f"{file}: not an ONNX model that onnxruntime can run ({first_line(error)})"
        ) from error


def run_session(
    session: InferenceSession,
    feeds: Mapping[str, NDArray],
    output: str | None = None,
    *,
    failure: str,
) -> NDArray:
    """The network's output of that name, or its first; raises InputError that begins with `failure`
    where it fails.
    """
    try:
        return np.asarray(session.run(None if output is None else [output], dict(feeds))[0])
    except Exception as error:  # onnxruntime has no common class of errors
        raise InputError(f"{failure} ({first_line(error)})") from error


def first_line(error: Exception) -> str:
    """What an error says, in one line."""
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
