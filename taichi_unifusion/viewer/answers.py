"""Answers to questions as things to see: heat on the mesh, boxes and labels where something was
found, and a list of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..language.pictures import HEAT, heat_mesh
from ..language.regions import Region
from ..types import Mesh
from .scene import Box, Label, Layer, Legend

SHOWN = 10  # regions of an answer that are listed


@dataclass(frozen=True)
class ShownAnswer:
    """An answer as parts of a scene; of what was found, the strongest comes first."""

    text: str
    layer: Layer
    boxes: tuple[Box, ...]
    labels: tuple[Label, ...]
    rows: tuple[str, ...]  # one a box: rank, score and area in words
    sentence: str  # what was found, or that nothing was

    def placed(self, T: NDArray) -> ShownAnswer:
        """The same answer elsewhere in the scene, moved and turned by a rigid T (4, 4)."""
        return replace(
            self,
            boxes=tuple(each.placed(T) for each in self.boxes),
            labels=tuple(each.placed(T) for each in self.labels),
        )


def show_answer(
    mesh: Mesh, text: str, relevance: NDArray, regions: Sequence[Region]
) -> ShownAnswer:
    """What to show of the relevance (V,) of a text to a coloured mesh, and of its regions."""
    shown = regions[:SHOWN]
    names = [f"{text} {rank}" for rank in range(1, len(shown) + 1)]
    boxes = [Box(name, each.box) for name, each in zip(names, shown, strict=True)]
    labels = [Label(name, each.centroid) for name, each in zip(names, shown, strict=True)]
    rows = [f"{rank}. {_describe(each)}" for rank, each in enumerate(shown, start=1)]
    more = ", the strongest first" if len(regions) > 1 else ""
    more += f", {SHOWN} of them listed" if len(regions) > SHOWN else ""
    sentence = (
        f"{text}: {len(regions)} place{'s' * (len(regions) != 1)}{more}"
        if regions
        else f"{text}: not here; its relevance is {float(np.max(relevance, initial=0)):.2f} at most, and "
        "something else is nearer everywhere"
    )
    layer = relevance_layer(mesh, text, relevance)
    return ShownAnswer(text, layer, tuple(boxes), tuple(labels), tuple(rows), sentence)


def relevance_layer(mesh: Mesh, text: str, relevance: NDArray) -> Layer:
    """The relevance (V,) of a text as heat over the light and dark of a coloured mesh."""
    colors = heat_mesh(mesh, relevance).attributes["color"]
    levels = np.linspace(0, 1, 256)
    at, heat = zip(*HEAT, strict=True)
    table = np.stack([np.interp(levels, at, np.array(heat)[:, k]) for k in range(3)], axis=1)
    legend = Legend(f"relevance to '{text}', 0.5: a draw", (255 * table + 0.5).astype(np.uint8))
    values = np.asarray(relevance, np.float32)[:, None]
    shown = (255 * colors + 0.5).astype(np.uint8)
    return Layer(layer_name(text), shown, values, legend, shaded=True)


def layer_name(text: str) -> str:
    """The name of the layer that answers a text."""
    return f"query: {text}"


def _describe(region: Region) -> str:
    return f"score {region.score:.2f}, {region.area:.2f} m²"
