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
from .pictures import HEAT
from .questions import Answer
from .regions import Region

LONGEST_NAME = 60  # letters of a text in a file's name
NUMBERED = 9  # regions whose boxes are drawn
FONT, INK = cv2.FONT_HERSHEY_SIMPLEX, (40, 40, 40)
HEADER = 64  # [pixels] above the picture
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
    """The edges of a box that lie before the camera, and a number that covers no other."""
    corners = region.box[CORNERS, np.arange(3)]  # (8, 3)
    T = np.linalg.inv(view.T_world_camera)
    p = corners @ T[:3, :3].T + T[:3, 3]
    if (p[:, 2] < max(view.near, 0.05)).any():
        return
    camera = view.camera
    at = np.stack(
        [camera.fx * p[:, 0] / p[:, 2] + camera.cx, camera.fy * p[:, 1] / p[:, 2] + camera.cy],
        axis=1,
    )
    at = np.clip(at, -(10**4), 10**4).round().astype(int)
    for color, width in (((255, 255, 255), 3), (INK, 1)):
        for a, b in EDGES:
            cv2.line(panel, tuple(at[a]), tuple(at[b]), color, width, cv2.LINE_AA)
    u, v = at[at[:, 1].argmin()]
    if not (0 <= u < camera.width and 0 <= v < camera.height):
        return
    (wide, high), _ = cv2.getTextSize(str(number), FONT, 0.6, 2)
    x, y = int(np.clip(u - wide // 2, 2, camera.width - wide - 8)), int(max(v - 8, high + 8))
    while any(x < d and x + wide + 8 > c and y - high - 8 < f and y > e for c, e, d, f in taken):
        y += high + 10
    taken.append((x, y - high - 8, x + wide + 8, y))
    cv2.rectangle(panel, (x, y - high - 8), (x + wide + 8, y), INK, -1)
    cv2.putText(panel, str(number), (x + 4, y - 4), FONT, 0.6, (255, 255, 255), 2, cv2.LINE_AA)


def _header(width: int, text: str, found: int) -> NDArray[np.uint8]:
    """The text, how many regions it has, and which colour is which relevance."""
    strip = np.full((HEADER, width, 3), 255, np.uint8)
    shown = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().strip()
    regions = f"{found} region{'s' * (found != 1)}" if found else "not here"
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
