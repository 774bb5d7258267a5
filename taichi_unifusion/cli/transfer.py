"""`unifusion transfer`: frames -> properties of theirs on the surface, beside its colour, in one
pass.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from ..errors import InputError
from ..properties import PROPERTIES
from .options import ONE_EACH
from .reconstruct import Reconstruct, reconstruct


@dataclass(frozen=True)
class Transfer(Reconstruct):
    """Map properties (infrared, saliency, style, ...) onto the surface, beside its colour.

    Example: unifusion transfer 7scenes my/redkitchen --property saliency --property style=sketch
    --out results/kitchen

    Each gives a mesh NAME.ply and NAME.glb, a picture NAME.png with a legend, and
    maps/NAME.safetensors.

    A property is NAME, NAME=METHOD or NAME=METHOD:FILE, each with any number of ,OPTION=VALUE after
    it:

    saliency=onnx:u2net.onnx,size=320x320,activation=minmax or
    style=sketch,name=drawing,voxel_size=0.05.
    """

    property: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(
            metavar="NAME[=SETTINGS]",
            help_behavior_hint=ONE_EACH,
            help=f"What to map: {', '.join(PROPERTIES)}; docs/properties.md lists their methods and options.",
        ),
    ] = field(default=(), kw_only=True)


def transfer(options: Transfer) -> int:
    """Frames -> maps -> meshes -> results folder."""
    properties = (*options.settings.properties, *options.property)
    if not properties:
        raise InputError(
            f"transfer: say what to map, with --property NAME; properties: {', '.join(PROPERTIES)}"
        )
    return reconstruct(replace(options, settings=replace(options.settings, properties=properties)))
