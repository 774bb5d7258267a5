"""`unifusion transfer`: frames -> properties of theirs on the surface, beside its colour, in one
pass.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Annotated

from tyro.conf import UseAppendAction, arg

from ..config import Config
from ..errors import InputError
from ..properties import PROPERTIES
from .reconstruct import Reconstruct, ReconstructOptions, reconstruct


@dataclass(frozen=True)
class TransferOptions(ReconstructOptions):
    """Map properties of the frames (infrared, saliency, style, ...) onto the surface, beside its
    colour, in one pass.

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
            help_behavior_hint="(give it once for each)",
            help=f"What to map: {', '.join(PROPERTIES)}; docs/properties.md lists their methods and options.",
        ),
    ] = field(default=(), kw_only=True)


@dataclass(frozen=True)
class Transfer(TransferOptions):
    __doc__ = TransferOptions.__doc__

    settings: Annotated[Config, arg(name="")] = field(default_factory=Config, kw_only=True)


def transfer(options: Transfer) -> int:
    """Frames -> maps -> meshes -> results folder."""
    properties = (*options.settings.properties, *options.property)
    if not properties:
        raise InputError(
            f"transfer: say what to map, with --property NAME; properties: {', '.join(PROPERTIES)}"
        )
    given = {
        each.name: getattr(options, each.name) for each in dataclasses.fields(ReconstructOptions)
    }
    return reconstruct(
        Reconstruct(**given, settings=dataclasses.replace(options.settings, properties=properties))
    )
