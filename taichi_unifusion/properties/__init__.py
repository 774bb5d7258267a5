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
    from .registry import PROPERTIES
    from .specification import make_property

__all__ = ["PROPERTIES", "Look", "SurfaceProperty", "make_property"]

__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "base": ["Look", "SurfaceProperty"],
        "registry": ["PROPERTIES"],
        "specification": ["make_property"],
    },
)
