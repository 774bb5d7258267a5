"""What the page says, as HTML; whatever comes from files or users is escaped."""

from __future__ import annotations

from collections.abc import Iterable
from html import escape

import numpy as np

from .picking import Hit
from .scene import Legend, Scene, short_number

STOPS = 17  # of the gradient of a legend
SMALL = (
    "font-size: 0.85em; line-height: 1.35; padding: 0 0.9em 0.5em 0.9em; overflow-wrap: anywhere;"
)
NAME = (
    "opacity: 0.65; padding-right: 0.8em; vertical-align: top; overflow-wrap: normal"  # whole words
)
SWATCHES = 30  # classes in a legend


def paragraph(text: str) -> str:
    """A sentence."""
    return f'<div style="{SMALL}">{escape(text)}</div>' if text else ""


def table(rows: Iterable[tuple[str, str]]) -> str:
    """Names and values, one a line."""
    lines = "".join(
        f'<tr><td style="{NAME}">{escape(name)}</td><td>{escape(value)}</td></tr>'
        for name, value in rows
    )
    return f'<div style="{SMALL}"><table>{lines}</table></div>'


def legend_html(legend: Legend | None) -> str:
    """What the colours mean: a bar with numbers, or a patch a class."""
    if legend is None:
        return ""
    title = f"<div>{escape(legend.label)}</div>"
    if legend.names:
        patches = "".join(
            f'<div><span style="display: inline-block; width: 0.9em; height: 0.9em; margin-right: 0.5em; '
            f'background: {css(color)}"></span>{escape(name)}</div>'
            for name, color in list(zip(legend.names, legend.colors, strict=True))[:SWATCHES]
        )
        return f'<div style="{SMALL}">{title}{patches}</div>'
    numbers = "".join(
        f"<span>{short_number(value)}</span>" for value in np.linspace(legend.low, legend.high, 3)
    )
    bar = ""
    if len(legend.colors):
        places = np.linspace(0, len(legend.colors) - 1, STOPS).astype(int)
        stops = ", ".join(css(legend.colors[place]) for place in places)
        bar = f'<div style="height: 0.9em; background: linear-gradient(to right, {stops})"></div>'
    return (
        f'<div style="{SMALL}">{title}{bar}<div style="display: flex; justify-content: space-between">'
        f"{numbers}</div></div>"
    )


def css(color: Iterable[int]) -> str:
    """A colour as style sheets write it."""
    return "#" + "".join(f"{int(part):02x}" for part in color)


def describe_hit(scene: Scene, hit: Hit, words: list[tuple[str, float]]) -> list[tuple[str, str]]:
    """What is known of a point: place, normal, colour, the values of every layer, the nearest words."""
    x, y, z = hit.point_in_map
    rows = [("of", hit.shown.name)] if len(scene.meshes) > 1 else []
    rows += [
        ("position", f"{x:z.3f}, {y:z.3f}, {z:z.3f} m"),
        ("height", f"{float(scene.heights_of(hit.point[None])[0]):z.3f} m"),
        ("normal", ", ".join(f"{part:z.2f}" for part in hit.normal_in_map)),
    ]
    for layer in hit.shown.layers:
        values = hit.values(layer)
        if layer.name in ("normals", "height"):  # said above
            continue
        if values is None:
            color = hit.color(layer)
            rows.append((layer.name, f"{', '.join(map(str, color))} ({css(color)})"))
        else:
            rows.append((layer.name, layer.describe(values)))
    if words:
        rows.append(("words", ", ".join(f"{word} {cosine:.2f}" for word, cosine in words)))
    return rows
