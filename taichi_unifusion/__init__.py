"""Uni-Fusion: RGB-D frames to Latent Implicit Maps of surface, colour and any property, with Taichi
on CUDA and CPU.

Names load when they are first used, so that `import taichi_unifusion` is quick and starts nothing.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import lazy_loader

# read by Taichi's first import, wherever that happens
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")

if TYPE_CHECKING:
    from .config import Config, load_config
    from .datasets import open_dataset
    from .errors import UniFusionError
    from .maps import PropertyMap, SurfaceMap, load_map
    from .pipeline import Pipeline, warm_up
    from .preprocessing import preprocess
    from .runtime import init
    from .types import Frame, Mesh, PinholeCamera, PointCloud, Trajectory

    __version__: str

__all__ = [
    "Config",
    "Frame",
    "Mesh",
    "PinholeCamera",
    "Pipeline",
    "PointCloud",
    "PropertyMap",
    "SurfaceMap",
    "Trajectory",
    "UniFusionError",
    "__version__",
    "init",
    "load_config",
    "load_map",
    "open_dataset",
    "preprocess",
    "warm_up",
]


_load, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "runtime": ["init"],
        "datasets": ["open_dataset"],
        "preprocessing": ["preprocess"],
        "maps": ["SurfaceMap", "PropertyMap", "load_map"],
        "types": ["Frame", "PinholeCamera", "PointCloud", "Mesh", "Trajectory"],
        "pipeline": ["Pipeline", "warm_up"],
        "config": ["Config", "load_config"],
        "errors": ["UniFusionError"],
    },
)


def __getattr__(name: str) -> Any:
    if name != "__version__":
        return _load(name)
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("taichi-unifusion")
    except PackageNotFoundError:  # the source tree on the path, not installed
        return "0+unknown"
