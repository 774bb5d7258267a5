"""The properties that have a name, and the methods that make them."""

from __future__ import annotations

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
