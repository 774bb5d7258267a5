"""Answers as files: names that tell texts apart, the reason where nothing was found, a picture with
title, scale and numbered boxes.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry.triangles import vertex_areas
from ..rendering.drawing import Viewpoint
from ..rendering.preview import draw_views
from ..types import Mesh
from .pictures import FONT, HEAT, drawable
from .questions import Answer
from .regions import Region

LONGEST_NAME = 60  # letters of a text in a file's name
NUMBERED = 9  # regions whose boxes are drawn
INK = (40, 40, 40)
HEADER = 64  # [pixels] above the picture
FAR_AWAY = 10**6  # [pixels] beyond all pictures
CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
EDGES = [(a, a | bit) for a in range(8) for bit in (1, 2, 4) if not a & bit]


def plain_text(text: str) -> str:
    """A text as it is compared: composed letters (NFC), small, single spaces."""
    return " ".join(unicodedata.normalize("NFC", text).casefold().split())


def file_name(text: str) -> str:
    """A text as a part of a file's name: its letters and digits, and a short sum of it where those do
    not say all of it, so that no two texts share a file.
    """
    plain = plain_text(text)
    kept = "".join(letter if letter.isalnum() else " " for letter in plain)
    slug = "-".join(kept.split())
    if slug == plain.replace(" ", "-") and 0 < len(slug) <= LONGEST_NAME:
        return slug
    return f"{slug[:LONGEST_NAME] or 'text'}-{hashlib.sha256(plain.encode()).hexdigest()[:6]}"


def why_not_here(answer: Answer, mesh: Mesh, threshold: float, min_area: float) -> str:
    """Why a text was not found, with the numbers that decided."""
    highest = float(answer.relevance.max(initial=0))
    if highest < threshold:
        return (
            f"its relevance is {highest:.2f} at most, and {threshold:g} makes a region: something else is nearer "
            "everywhere"
        )
    over = vertex_areas(mesh.vertices, mesh.faces)[answer.relevance >= threshold].sum()
    return (
        f"its relevance reaches {highest:.2f} on {over:.4f} m2 in all, and no part of that is as large as "
        f"{min_area:g} m2 (--min-area)"
    )


def answer_picture(
    mesh: Mesh, text: str, regions: Sequence[Region], views: Sequence[Viewpoint]
) -> NDArray[np.uint8]:
    """Views (H, W, 3) RGB of a mesh in heat colours, with the boxes of its best regions, their numbers,
    the text as title and the scale of colours.
    """
    picture, left = draw_views(mesh, views), 0
    gap = max(2, views[0].camera.width // 120)  # as `draw_views` leaves
    for view in views:
        panel = picture[:, left : left + view.camera.width]
        taken: list[tuple[int, int, int, int]] = []
        for number, region in enumerate(regions[:NUMBERED], start=1):
            _draw_box(panel, region, number, view, taken)
        left += view.camera.width + gap
    return np.vstack([_header(picture.shape[1], text, len(regions)), picture])


def _draw_box(
    panel: NDArray[np.uint8],
    region: Region,
    number: int,
    view: Viewpoint,
    taken: list[tuple[int, int, int, int]],
) -> None:
    """The edges of a box as far as they are in the picture, and a number above them that covers no
    other.
    """
    lines = _edges_in_view(region.box, view)
    for color, width in (((255, 255, 255), 3), (INK, 1)):
        for a, b in lines:
            cv2.line(panel, a, b, color, width, cv2.LINE_AA)
    if not lines:
        return
    u, v = min((end for line in lines for end in line), key=lambda end: end[1])
    (wide, high), _ = cv2.getTextSize(str(number), FONT, 0.6, 2)
    wide, high = wide + 8, high + 8
    x, y = _free_place(u - wide // 2, v - 8 - high, (wide, high), panel.shape, taken)
    taken.append((x, y, x + wide, y + high))
    cv2.rectangle(panel, (x, y), (x + wide, y + high), INK, -1)
    at = (x + 4, y + high - 4)
    cv2.putText(panel, str(number), at, FONT, 0.6, (255, 255, 255), 2, cv2.LINE_AA)


def _edges_in_view(box: NDArray, view: Viewpoint) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """The ends [pixels] of what a picture shows of the edges of a box (2, 3)."""
    corners, camera = box[CORNERS, np.arange(3)], view.camera  # (8, 3)
    T, near = np.linalg.inv(view.T_world_camera), max(view.near, 0.05)
    points, lines = corners @ T[:3, :3].T + T[:3, 3], []
    for a, b in EDGES:
        p, q = sorted((points[a], points[b]), key=lambda point: -point[2])
        if p[2] <= near:
            continue
        if q[2] < near:  # as far as it lies before the camera
            q = p + (q - p) * (p[2] - near) / (p[2] - q[2])
        ends = np.stack([p, q]) @ camera.matrix.T
        ends = np.clip(ends[:, :2] / ends[:, 2:], -FAR_AWAY, FAR_AWAY).round().astype(int)
        seen, *line = cv2.clipLine((0, 0, camera.width, camera.height), *map(tuple, ends.tolist()))
        if seen:
            lines.append(tuple(line))
    return lines


def _free_place(
    x: int, y: int, size: tuple[int, int], shape: tuple[int, ...], taken: Sequence[Sequence[int]]
) -> tuple[int, int]:
    """The corner of a box (wide, high) inside a panel that covers none of `taken`, as near to (x, y) as
    there is room.
    """
    wide, high = size
    right, low = shape[1] - wide - 2, shape[0] - high - 2
    x, y = min(max(x, 2), right), min(max(y, 2), low)
    steps = range(-NUMBERED, NUMBERED + 1)
    places = sorted(((i * (wide + 2), j * (high + 2)) for i in steps for j in steps), key=_distance)
    for across, down in places:
        u, v = x + across, y + down
        inside = 2 <= u <= right and 2 <= v <= low
        if inside and not any(
            u < d and u + wide > a and v < e and v + high > b for a, b, d, e in taken
        ):
            return u, v
    return x, y


def _distance(step: tuple[int, int]) -> int:
    return step[0] ** 2 + step[1] ** 2


def _header(width: int, text: str, found: int) -> NDArray[np.uint8]:
    """The text, how many regions it has, and which colour is which relevance."""
    strip = np.full((HEADER, width, 3), 255, np.uint8)
    shown = drawable(text)
    regions = f"{found} region{'s' * (found != 1)}" if found else "not here"
    regions += f", the strongest {NUMBERED} numbered" if found > NUMBERED else ""
    title = f"{shown[:60] or 'a text without letters'}: {regions}"
    cv2.putText(strip, title, (12, 26), FONT, 0.65, INK, 1, cv2.LINE_AA)
    left, right = 12, min(12 + 300, width - 200)
    levels, colors = np.array([level for level, _ in HEAT]), np.array([color for _, color in HEAT])
    share = np.linspace(0, 1, max(right - left, 1))
    bar = np.stack([np.interp(share, levels, colors[:, k]) for k in range(3)], axis=1)
    strip[38:50, left:right] = (255 * bar + 0.5).astype(np.uint8)
    words = "relevance 0 to 1; 0.5 is a draw"
    cv2.putText(strip, words, (right + 12, 50), FONT, 0.45, INK, 1, cv2.LINE_AA)
    return strip
