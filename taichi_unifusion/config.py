"""Config: one frozen dataclass that is schema, defaults and `--help` text, with a strict YAML
overlay.

Defaults < `--config FILE` < flags. A file holds the differences from the defaults; a run saves all
that it used.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_type_hints

import yaml

from .errors import (
    ConfigError,
    InputError,
    as_path,
    check_box,
    check_choice,
    check_range,
    check_types,
    convert,
    did_you_mean,
    shortened,
    strict,
)
from .files.strict_yaml import read_yaml
from .maps.detail import ROOM, Detail, choose_voxel_size, sight_of
from .maps.settings import (
    MAX_RESOLUTION,
    MAX_WINDOW,
    FeatureSettings,
    MapSettings,
    PropertySettings,
    SurfaceSettings,
    check_voxel_size,
    color_settings,
    parse_bytes,
)
from .preprocessing import PreprocessSettings
from .runtime import MAX_THREADS
from .tracking.base import TrackingSettings
from .types import Frame

S = TypeVar("S", bound=MapSettings)


@strict
@dataclass(frozen=True)
class MeshSettings:
    """The mesh that is extracted at the end."""

    resolution: int = 4
    """Marching-cubes cells along the edge of a surface voxel; 8 gives 4 times the triangles of 4.
    """
    formats: tuple[Literal["ply", "glb", "obj"], ...] = ("ply", "glb")
    """Files to write the mesh to."""
    min_area: float = 0.001
    """Connected parts of less than this area, in square metres, are left out: mostly stray
    readings. 0 keeps all.
    """
    bounds: tuple[float, float, float, float, float, float] | None = None
    """Only what lies in this box of the world: x, y, z of its lowest corner, then of its highest, in
    metres.
    """
    extract: bool = True
    """Extract a mesh at the end; without one, `unifusion mesh` makes it later from the maps.
    """

    def __post_init__(self) -> None:
        check_types(self)
        check_range("resolution", self.resolution, 1, MAX_RESOLUTION, "cells a voxel")
        check_range("min_area", self.min_area, 0, 1e6, "square metres")
        if not self.formats or len(set(self.formats)) < len(self.formats):
            raise InputError(
                f"formats: must name one or more of ply, glb and obj, each once, got {self.formats}"
            )
        if self.bounds is not None:
            check_box(self.bounds[:3], self.bounds[3:])


@strict
@dataclass(frozen=True)
class Config:
    """Every setting of a reconstruction."""

    detail: Detail = "auto"
    """Which voxel sizes. auto: those that fit what the first frames see, 5 cm in a room, less where all
    is near and more in a hall; fine, coarse: half and twice that.
    """
    voxel_size: float = 0.0
    """Voxel edge of the surface in metres, with half of it for colour, and other properties in
    proportion; 0: as `detail` says. The sizes of single maps count more.
    """
    device: Literal["auto", "cuda", "cpu"] = "auto"
    """Where to compute; auto: on a CUDA GPU if there is one, else on the CPU."""
    threads: int = 0
    """CPU threads to use; 0: all."""
    preprocess: PreprocessSettings = field(default_factory=PreprocessSettings)
    """Which pixels become points."""
    tracking: TrackingSettings = field(default_factory=TrackingSettings)
    """How poses are found and refined, with --tracking internal or rgbd."""
    window: int = 10
    """Consecutive frames that are summed up before they are fused; 1 fuses each by itself, as
    published, and is slower.
    """
    map_memory: str = ""
    """Memory for the maps, as 2GB or 500MB: parts of them that were not seen for longest lie on disk.
    Empty: all of them are in memory.
    """
    surface: SurfaceSettings = field(default_factory=SurfaceSettings)
    """The map of the surface."""
    color: PropertySettings = field(default_factory=color_settings)
    """The map of its colour."""
    properties: tuple[str, ...] = ()
    """What else to map, as NAME[=METHOD[:FILE]][,option=value...], for example saliency or
    style=sketch.
    """
    property_map: PropertySettings = field(default_factory=PropertySettings)
    """The maps of these; a property may say otherwise, as in saliency,voxel_size=0.05."""
    feature_map: FeatureSettings = field(default_factory=FeatureSettings)
    """The map of image-text features."""
    mesh: MeshSettings = field(default_factory=MeshSettings)
    """The mesh."""

    @property
    def scale(self) -> float:
        """How large voxels are beside those of a room; 0 where nothing has settled it yet."""
        return self.voxel_size / ROOM

    def settled(self, frames: Iterable[Frame]) -> Config:
        """The same with the voxel sizes of surface, colour and features that fit these frames, as
        `detail` says; what is given already stays. No frame, or none with a reading, is a room.
        """
        near, far = self.preprocess.depth_min, self.preprocess.depth_max
        size = self.voxel_size or choose_voxel_size(sight_of(frames, near, far), self.detail)
        scale = size / ROOM
        return replace(
            self,
            voxel_size=size,
            surface=_sized(self.surface, scale),
            color=_sized(self.color, scale),
            feature_map=_sized(self.feature_map, scale),
        )

    def __post_init__(self) -> None:
        check_types(self)
        check_choice("detail", self.detail, get_args(Detail))
        check_voxel_size(self.voxel_size)
        check_range("threads", self.threads, 0, MAX_THREADS)
        if not 1 <= self.window <= MAX_WINDOW:
            raise InputError(f"window: must lie in 1..{MAX_WINDOW} frames, got {self.window}")
        if self.map_memory:
            parse_bytes(self.map_memory, "map_memory")


def _sized(settings: S, scale: float) -> S:
    """The settings of a map with the voxel size that is usual for it times `scale`, if they have
    none.
    """
    size = float(f"{scale * settings.usual_voxel_size:.6g}")
    return settings if settings.voxel_size else replace(settings, voxel_size=size)


def checked(config: object) -> Config:
    """The configuration, or the defaults for None; raises InputError for anything else."""
    if config is None:
        return Config()
    if not isinstance(config, Config):
        raise InputError(
            f"Pipeline: expected Config(...), got {type(config).__name__}; load_config reads a file"
        )
    return config


def load_config(path: str | Path, base: Config | None = None) -> Config:
    """`base` (the defaults) with what the YAML file says instead.

    Raises FileError where the file cannot be read, ConfigError, with the key's path, for an unknown
    key or a value of the wrong type or range.
    """
    path = as_path("load_config", path)
    try:
        values = read_yaml(path)
    except InputError as error:
        raise ConfigError(str(error)) from None
    return config_of(values, str(path), base)


def config_of(values: Any, source: str, base: Config | None = None) -> Config:
    """`base` (the defaults) with the mapping `values` over it; errors, which name their `source`, as
    in `load_config`.
    """
    return _overlay(base or Config(), values, source, "")


def dump_config(config: Config) -> str:
    """The whole configuration as YAML that `load_config` reads back."""
    return yaml.safe_dump(_plain(asdict(config)), sort_keys=False, default_flow_style=False)


def _overlay(base: Any, values: Any, source: str, at: str) -> Any:
    """The dataclass `base` with the mapping `values` over it; None, an empty section, changes
    nothing.
    """
    if values is None:
        return base
    if not isinstance(values, Mapping):
        raise ConfigError(
            f"{source}: {at or 'the file'}: expected keys and values, got {shortened(values)}"
        )
    types, changes = get_type_hints(type(base)), {}
    for key, value in values.items():
        here = f"{at}.{key}" if at else str(key)
        if key not in types:
            raise ConfigError(
                f"{source}: unknown key '{here[:80]}'{did_you_mean(key, types)}; keys{' there' if at else ''}: "
                f"{', '.join(types)}"
            )
        current = getattr(base, key)
        if is_dataclass(current):
            changes[key] = _overlay(current, value, source, here)
            continue
        try:
            changes[key] = convert(value, types[key], f"{source}: {here}")
        except InputError as error:
            raise ConfigError(str(error)) from None
    try:
        return replace(base, **changes)
    except InputError as error:
        raise ConfigError(f"{source}: {f'in {at}: ' if at else ''}{error}") from None


def _plain(value: Any) -> Any:
    """Tuples as lists: YAML's safe dialect has no tuples."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value
