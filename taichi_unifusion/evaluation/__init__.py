"""The paper's metrics (Sec. VI-A): surface, rendering, trajectory and segmentation. Names load when they are used."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..lazy_names import lazy_names

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

__getattr__, __dir__ = lazy_names(__name__, _MODULES, __all__)
