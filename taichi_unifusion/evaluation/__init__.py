"""The paper's metrics (Sec. VI-A): surface, rendering, trajectory and segmentation. Names load when
they are used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .rendering import RenderingResult, evaluate_rendering
    from .segmentation import SegmentationResult, evaluate_segmentation, transfer_labels
    from .surface import SurfaceResult, evaluate_surface
    from .trajectory import TrajectoryResult, evaluate_trajectory
    from .viewpoints import Viewpoints

__all__ = [
    "SurfaceResult",
    "evaluate_surface",
    "Viewpoints",
    "RenderingResult",
    "evaluate_rendering",
    "TrajectoryResult",
    "evaluate_trajectory",
    "SegmentationResult",
    "evaluate_segmentation",
    "transfer_labels",
]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "surface": ["SurfaceResult", "evaluate_surface"],
        "viewpoints": ["Viewpoints"],
        "rendering": ["RenderingResult", "evaluate_rendering"],
        "trajectory": ["TrajectoryResult", "evaluate_trajectory"],
        "segmentation": ["SegmentationResult", "evaluate_segmentation", "transfer_labels"],
    },
)
