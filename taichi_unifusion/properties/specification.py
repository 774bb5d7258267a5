"""Properties as text: `NAME`, `NAME=METHOD`, `NAME=METHOD:FILE`, each with `,option=value` after
it.

    saliency
    saliency=onnx:u2net.onnx,size=320x320,activation=minmax
    style=sketch,color=true,name=drawing,voxel_size=0.05
    images=heat/,name=heat

Options are those of the method, `name` (of the map and its files), and the settings of a property
map.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
from importlib import import_module
from pathlib import Path
from typing import get_type_hints

from ..errors import InputError, check_range, convert, did_you_mean
from ..maps.settings import LARGEST_VOXEL, LEAST_VOXEL, PropertySettings
from .base import SurfaceProperty
from .registry import PROPERTIES

OPTION = re.compile(r"([A-Za-z_][A-Za-z0-9_]*)=(.*)", re.DOTALL)


def make_property(text: str, settings: PropertySettings | None = None) -> SurfaceProperty:
    """The property that the text names; `settings` of its map where the text says nothing else,
    else the defaults.

    Raises InputError, with the right names, for an unknown property, method or option or a value
    that does not fit, and whatever making it raises: FileError for a model that is missing,
    MissingDependency for a package.
    """
    name, rest = [*re.split("[=,]", text, maxsplit=1), ""][:2]
    methods = PROPERTIES.get(name)
    if methods is None:
        raise InputError(
            f"property '{name}' is unknown{did_you_mean(name, PROPERTIES)}; properties: {', '.join(PROPERTIES)}"
        )
    method, file, options = _split(name, rest, methods)
    module, function = methods[method]
    maker = getattr(import_module(f".{module}", __package__), function)
    parameters = inspect.signature(maker).parameters
    if ("file" in parameters) != bool(file):
        raise InputError(
            f"property '{text}': "
            + (
                f"'{name}={method}' takes no file"
                if file
                else f"give the file, as in {name}={method}:FILE"
            )
        )
    of_map = {
        field.name: field
        for field in dataclasses.fields(PropertySettings)
        if field.name != "encoder"
    }
    known = [key for key in (*parameters, "name", *of_map) if key != "file"]
    for key in options:
        if key not in known:
            raise InputError(
                f"property '{text}': option '{key}' is unknown{did_you_mean(key, known)}; options: {', '.join(known)}"
            )
    types, map_types = get_type_hints(maker), get_type_hints(PropertySettings)
    given = {
        key: convert(value, types[key], f"property '{text}': {key}")
        for key, value in options.items()
        if key in parameters
    }
    changes = {
        key: convert(value, map_types[key], f"property '{text}': {key}")
        for key, value in options.items()
        if key in of_map
    }
    if "voxel_size" in changes:
        check_range(
            f"property '{text}': voxel_size",
            changes["voxel_size"],
            LEAST_VOXEL,
            LARGEST_VOXEL,
            "metres",
        )
    made = maker(Path(file).expanduser(), **given) if file else maker(**given)
    settings = dataclasses.replace(settings or PropertySettings(), **changes)
    return dataclasses.replace(made, name=options.get("name", name), settings=settings)


def name_of(text: str) -> str:
    """The name of the property that the text names, which nothing is made for; raises InputError."""
    name, rest = [*re.split("[=,]", text, maxsplit=1), ""][:2]
    methods = PROPERTIES.get(name)
    return name if methods is None else str(_split(name, rest, methods)[2].get("name", name))


def _split(name: str, rest: str, methods: dict) -> tuple[str, str, dict[str, str]]:
    """Method, file and options of what follows `NAME=`."""
    method, file, words = next(iter(methods)), "", rest.split(",") if rest else []
    if words and not OPTION.fullmatch(words[0].partition(":")[0]):
        first, colon, after = words.pop(0).partition(":")
        if first in methods:
            method, file = first, after
        elif len(methods) == 1:  # only one way to make it: what follows is its file
            file = first + colon + after
        else:
            raise InputError(
                f"property '{name}': method '{first}' is unknown{did_you_mean(first, methods)}; methods: "
                f"{', '.join(methods)}"
            )
    options: dict[str, str] = {}
    for word in words:
        found = OPTION.fullmatch(word)
        if not found or found[1] in options:
            raise InputError(
                f"property '{name}': '{word}' is {'given twice' if found else 'no option=value'}"
            )
        options[found[1]] = found[2]
    return method, file, options
