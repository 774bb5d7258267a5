"""The paper's f_im (Fig. 6): functions that give an image of a property for every frame, by name.

`make_property("style=sketch,voxel_size=0.05")` gives one of these, with options; your own is a
`SurfaceProperty` with a function.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from ..rendering.look import Look
    from .base import SurfaceProperty
    from .specification import make_property

# name -> method -> module here, what makes it; the first is the default
PROPERTIES: dict[str, dict[str, tuple[str, str]]] = {
    "infrared": {"log": ("infrared", "log_infrared"), "linear": ("infrared", "linear_infrared")},
    "saliency": {
        "signature": ("saliency", "signature_saliency"),
        "onnx": ("saliency", "network_saliency"),
    },
    "style": {
        "painting": ("style", "painting_style"),
        "opencv": ("style", "opencv_style"),
        "sketch": ("style", "sketch_style"),
        "onnx": ("style", "network_style"),
    },
    "images": {"folder": ("images", "folder_images")},
    "normal": {"depth": ("shape", "surface_normal")},
    "curvature": {"depth": ("shape", "mean_curvature")},
}

__all__ = ["PROPERTIES", "Look", "SurfaceProperty", "make_property"]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "base": ["Look", "SurfaceProperty"],
        "specification": ["make_property"],
    },
)
