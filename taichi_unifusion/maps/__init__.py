"""Latent Implicit Maps (Fig. 5). Names load when they are used: the settings need no Taichi, the
maps do.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import lazy_loader

if TYPE_CHECKING:
    from .base_map import BaseMap, Integration
    from .latent_map import LatentMap
    from .property_group import PropertyGroup
    from .property_map import PropertyMap
    from .settings import LatentSettings, MapSettings, PropertySettings, SurfaceSettings
    from .surface_map import SurfaceMap

__all__ = [
    "BaseMap",
    "Integration",
    "LatentMap",
    "LatentSettings",
    "MapSettings",
    "PropertyGroup",
    "PropertyMap",
    "PropertySettings",
    "SurfaceMap",
    "SurfaceSettings",
    "load_map",
]


def load_map(path: str | Path) -> BaseMap:
    """The map in a file, of whatever kind it is; raises MapCorrupt or FileError."""
    # a kind of map registers itself when its module loads
    for module in ("property_map", "latent_map", "surface_map"):
        import_module(f".{module}", __name__)
    return __getattr__("BaseMap").load(path)


__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "base_map": ["BaseMap", "Integration"],
        "property_map": ["PropertyMap"],
        "property_group": ["PropertyGroup"],
        "surface_map": ["SurfaceMap"],
        "latent_map": ["LatentMap"],
        "settings": ["LatentSettings", "MapSettings", "PropertySettings", "SurfaceSettings"],
    },
)
