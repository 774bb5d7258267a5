"""Latent Implicit Maps (Fig. 5). Names load when they are used: the settings need no Taichi, the
maps do.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import lazy_loader

from ..errors import as_path

if TYPE_CHECKING:
    from .base_map import BaseMap, Integration
    from .feature_map import FeatureMap
    from .property_group import PropertyGroup
    from .property_map import PropertyMap
    from .settings import FeatureSettings, MapSettings, PropertySettings, SurfaceSettings
    from .stored import MapDescription
    from .surface_map import SurfaceMap

__all__ = [
    "BaseMap",
    "Integration",
    "FeatureMap",
    "FeatureSettings",
    "MapSettings",
    "PropertyGroup",
    "PropertyMap",
    "PropertySettings",
    "SurfaceMap",
    "SurfaceSettings",
    "load_map",
]


MAP_KINDS = {  # kind, as in files -> module here, class
    "surface": ("surface_map", "SurfaceMap"),
    "property": ("property_map", "PropertyMap"),
    "latent": ("feature_map", "FeatureMap"),
}


def load_map(path: str | Path, *, repair: bool = False) -> BaseMap:
    """The map in a file, or in the folder of its tiles, of whatever kind it is; raises MapCorrupt,
    FileError or CapacityError. With `repair`, voxels of a file that are damaged are left out, and
    that is said.
    """
    from .stored import read_stored

    description, data = read_stored(as_path("load_map", path), repair)
    made = empty_map(description)
    made.grid.add(data)
    return made


def empty_map(description: MapDescription) -> BaseMap:
    """A map as a file describes it, without voxels."""
    module, name = MAP_KINDS[description.kind]
    return getattr(import_module(f".{module}", __name__), name).empty(description)


__getattr__, __dir__, _ = lazy_loader.attach(
    __name__,
    submod_attrs={
        "base_map": ["BaseMap", "Integration"],
        "property_map": ["PropertyMap"],
        "property_group": ["PropertyGroup"],
        "surface_map": ["SurfaceMap"],
        "feature_map": ["FeatureMap"],
        "settings": ["FeatureSettings", "MapSettings", "PropertySettings", "SurfaceSettings"],
    },
)
