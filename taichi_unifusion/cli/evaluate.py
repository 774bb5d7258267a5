"""`unifusion evaluate`: a group of commands, one a metric."""

from __future__ import annotations

from dataclasses import dataclass

from .evaluate_rendering import EvaluateRendering, evaluate_rendering
from .evaluate_segmentation import EvaluateSegmentation, evaluate_segmentation
from .evaluate_surface import EvaluateSurface, evaluate_surface
from .evaluate_trajectory import EvaluateTrajectory, evaluate_trajectory


@dataclass(frozen=True)
class Evaluate:
    """Measure results with the paper's metrics: surface, rendering, trajectory or segmentation.

    Example: unifusion evaluate rendering results/kitchen

    unifusion evaluate METRIC --help: explains one of them
    """


METRICS = {
    "surface": (EvaluateSurface, evaluate_surface),
    "rendering": (EvaluateRendering, evaluate_rendering),
    "trajectory": (EvaluateTrajectory, evaluate_trajectory),
    "segmentation": (EvaluateSegmentation, evaluate_segmentation),
}
