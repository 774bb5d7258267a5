"""Charts of the paper's tables, drawn with OpenCV: bars by method, and curves over sorted scenes as
in Fig. 8.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_unifusion.files.images import write_png

WIDTH, HEIGHT = 1000, 300  # of a panel [pixels]
LEFT, RIGHT, TOP, BOTTOM = 60, 230, 34, 40  # of them around the axes; the legend is on the right
INK, GRID, PAPER = (40, 40, 40), (215, 215, 215), 255
OURS = ((214, 39, 40), (255, 127, 14), (148, 103, 189))  # RGB
PUBLISHED = (31, 119, 180)  # of the paper's own method
OTHERS = (
    *((166, 176, 190), (120, 140, 165), (200, 190, 165), (140, 165, 140)),
    *((175, 150, 175), (215, 175, 160), (110, 110, 110)),
)
TICKS = 4


class Panel:
    """Axes from 0 to `top` over an x of 0..1, with a title."""

    def __init__(self, title: str, top: float) -> None:
        self.image = np.full((HEIGHT, WIDTH, 3), PAPER, np.uint8)
        self.top, self.lines = top, 0
        self._text(title, LEFT, 20, 0.55)
        for value in np.linspace(0, top, TICKS + 1):
            _, y = self.at(0, value)
            cv2.line(self.image, (LEFT, y), (WIDTH - RIGHT, y), GRID, 1)
            self._text(f"{value:.4g}", 8, y + 5, 0.42)

    def at(self, x: float, value: float) -> tuple[int, int]:
        """The pixel of a place."""
        return (
            round(LEFT + x * (WIDTH - LEFT - RIGHT)),
            round(HEIGHT - BOTTOM - value / self.top * (HEIGHT - TOP - BOTTOM)),
        )

    def bar(self, left: float, right: float, value: float, color: tuple[int, ...]) -> None:
        cv2.rectangle(self.image, self.at(left, value), self.at(right, 0), color, cv2.FILLED)

    def curve(self, values: Sequence[float], color: tuple[int, ...]) -> None:
        """Values over 0..1, the first at 0; one alone is a level."""
        values = list(values) * (2 if len(values) == 1 else 1)
        places = [self.at(i / (len(values) - 1), value) for i, value in enumerate(values)]
        cv2.polylines(self.image, [np.array(places, np.int32)], False, color, 2, cv2.LINE_AA)

    def label(self, x: float, text: str) -> None:
        """Text below the axis, about x."""
        (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.42, 1)
        self._text(text, self.at(x, 0)[0] - width // 2, HEIGHT - BOTTOM + 18, 0.42)

    def legend(self, name: str, color: tuple[int, ...]) -> None:
        y, x = TOP + 20 * self.lines, WIDTH - RIGHT + 16
        cv2.rectangle(self.image, (x, y), (x + 12, y + 12), color, cv2.FILLED)
        self._text(name, x + 18, y + 11, 0.42)
        self.lines += 1

    def _text(self, text: str, x: int, y: int, scale: float) -> None:
        cv2.putText(self.image, text, (x, y), cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)


def colors_of(paper: Sequence[str], ours: Sequence[str]) -> dict[str, tuple[int, ...]]:
    """Muted colours for the paper's methods, strong ones for ours."""
    muted = {
        name: PUBLISHED if "as published" in name else OTHERS[i % len(OTHERS)]
        for i, name in enumerate(paper)
    }
    return muted | {name: OURS[i % len(OURS)] for i, name in enumerate(ours)}


def bars(
    title: str,
    groups: Sequence[str],
    rows: Mapping[str, Sequence[float | None]],
    colors: Mapping[str, tuple[int, ...]],
) -> NDArray[np.uint8]:
    """A panel of one bar a method in every group; a method's row has a value or None a group."""
    largest = max((v for row in rows.values() for v in row if v is not None), default=0.0)
    panel, step = Panel(title, 1.05 * largest or 1.0), 1 / len(groups)
    width = 0.84 * step / max(len(rows), 1)
    for i, (name, values) in enumerate(rows.items()):
        panel.legend(name, colors[name])
        for group, value in enumerate(values):
            if value is not None:
                left = (group + 0.08) * step + i * width
                panel.bar(left, left + 0.92 * width, value, colors[name])
    for group, name in enumerate(groups):
        panel.label((group + 0.5) * step, name)
    return panel.image


def curves(
    title: str,
    rows: Mapping[str, Sequence[float]],
    levels: Mapping[str, float],
    colors: Mapping[str, tuple[int, ...]],
) -> NDArray[np.uint8]:
    """A panel of every method's values over its scenes, worst first, and of means as levels."""
    panel = Panel(title, 100.0)
    for name, value in levels.items():
        panel.legend(name, colors[name])
        panel.curve([value], colors[name])
    for name, values in rows.items():
        panel.legend(f"{name} (mean {np.mean(values):.2f})", colors[name])
        panel.curve(sorted(values), colors[name])
    panel.label(0.5, "scenes, worst first; levels are means over scenes")
    return panel.image


def write_panels(path: Path, panels: Sequence[NDArray[np.uint8]]) -> None:
    """Panels one below the other."""
    write_png(path, np.vstack(panels))
