"""How options show in `--help`: whole sentences, no empty defaults, and few settings, first.

tyro reads help from docstrings and keeps the line breaks of indented ones; struct rules, which say
what options a class has, are its way to say otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Any, get_args

from tyro.conf import arg
from tyro.constructors import (
    ConstructorRegistry,
    StructConstructorSpec,
    StructFieldSpec,
    StructTypeInfo,
)

from ..config import Config
from ..maps.detail import Detail
from ..preprocessing import PreprocessSettings
from .options import Device

NO_DEFAULT = "(none by default)"
# names that people try first -> the settings that they are
SHORT = {
    "--depth-max": "--preprocess.depth-max",
    "--depth-min": "--preprocess.depth-min",
    "--bounds": "--mesh.bounds",
    "--no-mesh": "--mesh.no-extract",
}


def with_long_names(arguments: Sequence[str]) -> list[str]:
    """The arguments with short names of settings as the settings' own."""
    parts = (word.partition("=") for word in arguments)
    return [SHORT.get(name, name) + equals + value for name, equals, value in parts]


def whole_sentences() -> ConstructorRegistry:
    """While it is entered, help texts are whole sentences, and no default is shown as nothing."""
    registry, asking = ConstructorRegistry(), []

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if asking:  # the rules below this one
            return None
        asking.append(info)
        try:
            spec = ConstructorRegistry.get_struct_spec(info)
        finally:
            asking.pop()
        if not isinstance(spec, StructConstructorSpec):
            return None
        fields = [_shown(field) for field in spec.fields]
        first = [field for field in fields if field.name == "settings"]
        rest = [field for field in fields if field.name != "settings"]
        return replace(spec, fields=(*first, *rest))

    return registry


def few_settings() -> ConstructorRegistry:
    """While it is entered, settings have the options that people need first: help would list a
    hundred, which `unifusion config --help` does already.
    """
    registry = ConstructorRegistry()

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        if info.type is not Config:
            return None
        return StructConstructorSpec(Config, tuple(_first_settings()))

    return registry


def no_settings() -> ConstructorRegistry:
    """While it is entered, settings have no options."""
    registry = ConstructorRegistry()

    @registry.struct_rule
    def rule(info: StructTypeInfo) -> StructConstructorSpec | None:
        return StructConstructorSpec(Config, ()) if info.type is Config else None

    return registry


def _first_settings() -> list[StructFieldSpec]:
    detail: Any = Detail
    device: Any = Device
    size: Any = Annotated[
        float, arg(metavar="METRES", help_behavior_hint="(default: as --detail says)")
    ]
    depth: Any = Annotated[float, arg(metavar="METRES")]
    return [
        StructFieldSpec(
            "detail",
            detail,
            "auto",
            "Voxels that fit what the first frames see, 5 cm in a room, less where all is near, more in a hall (auto), "
            "half of that (fine) or twice (coarse).",
        ),
        StructFieldSpec(
            "voxel_size",
            size,
            0.0,
            "Edge of the surface's voxels; colour takes half, other properties in proportion.",
        ),
        StructFieldSpec(
            "depth_max", depth, PreprocessSettings.depth_max, "Farthest reading that is used."
        ),
        StructFieldSpec(
            "device",
            device,
            "auto",
            "Where to compute; auto: on a CUDA GPU if there is one, else on the CPU.",
        ),
    ]


def _shown(field: StructFieldSpec) -> StructFieldSpec:
    """The field with a help text of one paragraph, and a word where the default is nothing."""
    text = field.helptext
    kind: Any = field.type
    hinted = any(getattr(note, "help_behavior_hint", None) for note in get_args(kind))
    if field.default in ((), "") and not hinted:
        kind = Annotated[kind, arg(help_behavior_hint=NO_DEFAULT)]
    elif field.default is False and not hinted:  # a flag
        kind = Annotated[kind, arg(help_behavior_hint="")]
    return replace(field, helptext=_joined(text) if text is not None else None, type=kind)


def _joined(text: str | Callable[[], str | None]) -> str | Callable[[], str | None]:
    if isinstance(text, str):
        return " ".join(text.split())
    return lambda: " ".join((text() or "").split()) or None
