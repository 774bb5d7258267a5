"""The paper's metrics (Sec. VI-A): surface, rendering, trajectory and segmentation. Names load when they are used."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from .rendering import RenderingResult, evaluate_rendering
    from .segmentation import SegmentationResult, evaluate_segmentation, transfer_labels
    from .surface import SurfaceResult, evaluate_surface
    from .trajectory import TrajectoryResult, evaluate_trajectory
    from .visibility import Views

_MODULES = {
    "SurfaceResult": "surface", "evaluate_surface": "surface", "Views": "visibility",
    "RenderingResult": "rendering", "evaluate_rendering": "rendering",
    "TrajectoryResult": "trajectory", "evaluate_trajectory": "trajectory",
    "SegmentationResult": "segmentation", "evaluate_segmentation": "segmentation", "transfer_labels": "segmentation",
}

__all__ = list(_MODULES)


def __getattr__(name: str):
    if name not in _MODULES:
        raise AttributeError(f"module '{__name__}' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(f".{_MODULES[name]}", __name__), name)
    return value


def __dir__() -> list[str]:
    return __all__
