"""Uni-Fusion: RGB-D frames to Latent Implicit Maps of surface, colour and any property, with Taichi on CUDA and CPU.

Names load when they are first used, so that `import taichi_unifusion` is quick and starts nothing.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING

os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")  # read by Taichi's first import, wherever that happens

if TYPE_CHECKING:
    from .config import Config, load_config
    from .datasets import open_dataset
    from .errors import UniFusionError
    from .maps import PropertyMap, SurfaceMap, load_map
    from .pipeline import Pipeline
    from .preprocessing import preprocess
    from .runtime import init
    from .types import Frame, Mesh, PinholeCamera, PointCloud, Trajectory

    __version__: str

_MODULES = {
    "init": "runtime", "open_dataset": "datasets", "preprocess": "preprocessing",
    "SurfaceMap": "maps", "PropertyMap": "maps", "load_map": "maps",
    "Frame": "types", "PinholeCamera": "types", "PointCloud": "types", "Mesh": "types", "Trajectory": "types",
    "Pipeline": "pipeline", "Config": "config", "load_config": "config", "UniFusionError": "errors",
}

__all__ = ["Config", "Frame", "Mesh", "PinholeCamera", "Pipeline", "PointCloud", "PropertyMap", "SurfaceMap", "Trajectory",
           "UniFusionError", "__version__", "init", "load_config", "load_map", "open_dataset", "preprocess"]


def __getattr__(name: str):
    if name == "__version__":
        from importlib.metadata import PackageNotFoundError, version

        try:
            value = version("taichi-unifusion")
        except PackageNotFoundError:  # the source tree on the path, not installed
            value = "0+unknown"
    elif name in _MODULES:
        value = getattr(import_module(f".{_MODULES[name]}", __name__), name)
    else:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
