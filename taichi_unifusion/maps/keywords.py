"""The keywords of maps, spelled out for editors: those of their settings (a test compares)."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable
from typing import Any, Literal, TypedDict, TypeVar

from ..errors import InputError, check_keywords, check_range, shortened
from .encoding import EncoderSettings
from .settings import LARGEST_VOXEL, LEAST_VOXEL, MapSettings

S = TypeVar("S", bound=MapSettings)
F = TypeVar("F", bound=Callable[..., None])


class MapKeywords(TypedDict, total=False):
    """Of every map; what they mean stands in `MapSettings`."""

    voxel_size: float
    noise: float
    min_points: int
    sampling: Literal["cells", "points"]
    margin: int
    fusion: Literal["mean", "information"]
    encoder: EncoderSettings


class SurfaceKeywords(MapKeywords, total=False):
    """Of `SurfaceMap`; see `SurfaceSettings`."""

    gpis: Literal["samples", "derivatives", "both"]
    sample_distance: float
    support_points: int
    support_closing: int
    carve: bool
    two_sides: bool
    min_evidence: float


class PropertyKeywords(MapKeywords, total=False):
    """Of `PropertyMap`; see `PropertySettings`."""

    prior: Literal["mean", "zero"]
    blend: bool


class FeatureKeywords(MapKeywords, total=False):
    """Of `FeatureMap`; see `FeatureSettings`."""

    precision: Literal["int8", "float16", "float32"]
    source: str


def settings_of(kind: type[S], settings: object, keywords: dict[str, Any], what: str) -> S:
    """Settings with some of them said by keyword, with the usual voxel size where none is given.

    Raises InputError for a keyword that there is not, or for anything else than settings.
    """
    if settings is None:
        settings = kind()
    if not isinstance(settings, kind):
        raise InputError(
            f"{what}: expected {kind.__name__}(...), got {shortened(settings)}; sizes go by keyword, as in "
            "voxel_size=0.05"
        )
    check_keywords(what, keywords, kind.__dataclass_fields__)
    if "voxel_size" in keywords:  # 0 would be the usual one
        check_range("voxel_size", keywords["voxel_size"], LEAST_VOXEL, LARGEST_VOXEL, "metres")
    return dataclasses.replace(settings, **keywords).sized


def shows_keywords(kind: type[MapSettings]) -> Callable[[F], F]:
    """For `__init__(self, ..., **keywords)`: a signature that lists the settings, for notebooks."""

    def decorate(function: F) -> F:
        shown = inspect.signature(function)
        own = [each for each in shown.parameters.values() if each.kind is not each.VAR_KEYWORD]
        more = [
            inspect.Parameter(
                each.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=getattr(kind(), each.name),
                annotation=each.type,
            )
            for each in dataclasses.fields(kind)
        ]
        function.__signature__ = shown.replace(parameters=[*own, *more])  # pyright: ignore[reportFunctionMemberAccess]
        return function

    return decorate
