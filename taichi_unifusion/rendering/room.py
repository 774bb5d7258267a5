"""A furnished room as a list of primitives, and what they are made of.

World: metres, z up, floor at z = 0; the room's centre is the origin of x and y.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .kernels.solids import ROOM
from .primitives import Primitive, box, cylinder, ellipsoid, place, rotation

ROOM_SIZE = (5.0, 4.0, 2.6)  # [m]


@dataclass(frozen=True)
class Material:
    """A pattern of the texture kernel with its numbers; `colors` are three RGB colours as
    hexadecimal text.
    """

    pattern: str
    colors: str
    size: float = 0.1  # [m] of the pattern's repeat
    grain: float = 0.25  # strength of the solid noise under it
    stretch: float = 1.0  # of that noise along the primitive's longest axis


MATERIALS = {
    "floor": Material("planks", "b98d5f a3764a 6b4a2e", 0.14, 0.40, 7),
    "wallpaper": Material("wallpaper", "ede7d4 d8dfcd a3b59d", 0.22, 0.08),
    "ceiling": Material("plain", "efece4 e4e0d6 d8d4ca", grain=0.1),
    "white wood": Material("plain", "e9e5da dcd6c8 c9c2b2", grain=0.14, stretch=6),
    "door": Material("panels", "efe8d9 e2d9c8 a89c86", grain=0.10, stretch=6),
    "oak": Material("plain", "c1935d 97683a 6d4826", grain=0.5, stretch=9),
    "walnut": Material("plain", "7d5233 583720 3e2616", grain=0.55, stretch=9),
    "drawer": Material("panels", "7d5233 583720 341f12", grain=0.55, stretch=9),
    "sofa": Material("weave", "3f6f7c 5c8d97 2c525d", 0.026, 0.35),
    "cushion": Material("weave", "d98a3d e6ad5f f3e2bd", 0.03, 0.2),
    "plaid": Material("weave", "b5473c d77a5a f0dfc0", 0.034, 0.2),
    "seat": Material("weave", "8a9a5b b1bd82 e8e6c8", 0.024, 0.25),
    "rug": Material("rug", "8e3238 e2cda2 27374f", 0.20, 0.30),
    "landscape": Material("landscape", "8fb9d4 6f8f55 3f5f3c", grain=0.22),
    "dusk": Material("landscape", "efb27a a45a5c 4b3457", grain=0.22),
    "view": Material("landscape", "bcdcf2 9cbb76 6d9553", grain=0.2),
    "mosaic": Material("mosaic", "e8dcc0 d0583f 2d5f8a", 0.075, 0.2),
    "brass": Material("plain", "c9a24f a9823a 8a6a2c", grain=0.2),
    "steel": Material("plain", "5b6066 4a4f55 3d4247", grain=0.3),
    "shade": Material("bands", "f7e7bd eccf8d c79b52", 0.07, 0.15),
    "vase": Material("bands", "2f6690 e9e6da c9a24f", 0.08, 0.25),
    "clay": Material("bands", "b8623c 94472a e0b48c", 0.09, 0.35),
    "leaf": Material("plain", "4f8a4a 2f6238 a7c080", grain=0.5, stretch=4),
    "globe": Material("globe", "3c7fb1 c8b06b f2eee0", 0.07, 0.25),
    "ball": Material("mosaic", "e4573d f2c14e 3a7ca5", 0.09, 0.12),
    "stone": Material("plain", "c9c4ba 8f8a82 6e6a64", grain=0.45),
    "wicker": Material("weave", "b98f56 8e6637 5f4223", 0.03, 0.4),
    "clock": Material("rug", "f3efe2 2b2b2b b5473c", 0.10, 0.1),
    "book red": Material("bands", "9e3a34 d9b36b ece4d0", 0.07, 0.25),
    "book blue": Material("bands", "31527c c9d3dc e7c872", 0.06, 0.25),
    "book green": Material("bands", "47704f e4dcb8 c2873f", 0.08, 0.25),
    "book cream": Material("bands", "e0d3b0 8a5a3c 40506a", 0.065, 0.25),
    "book dark": Material("bands", "3a3540 b9a06a d8d3c6", 0.075, 0.25),
}


def legs(
    material: str, width: float, depth: float, height: float, thickness: float
) -> list[Primitive]:
    """Four square legs whose outer faces span width x depth."""
    x, y, h = width / 2, depth / 2, thickness
    return [
        box(
            material,
            (sx - h * (sx > 0), sy - h * (sy > 0), 0),
            (sx + h * (sx < 0), sy + h * (sy < 0), height),
        )
        for sx in (-x, x)
        for sy in (-y, y)
    ]


def chair(seat: str = "seat") -> list[Primitive]:
    """A chair that faces +y."""
    return [
        *legs("oak", 0.42, 0.42, 0.43, 0.035),
        box("oak", (-0.22, -0.22, 0.43), (0.22, 0.22, 0.455)),
        box(seat, (-0.19, -0.18, 0.455), (0.19, 0.19, 0.49)),
        box("oak", (-0.21, -0.215, 0.455), (-0.175, -0.18, 0.92)),
        box("oak", (0.175, -0.215, 0.455), (0.21, -0.18, 0.92)),
        *(box("oak", (-0.175, -0.21, z), (0.175, -0.185, z + 0.07)) for z in (0.58, 0.70, 0.82)),
    ]


def table() -> list[Primitive]:
    """A dining table, long side along x, laid with a bowl of fruit, mugs and a book."""
    fruit = [
        ellipsoid(m, (x, y, 0.835), (0.042, 0.042, 0.04))
        for m, x, y in (("ball", -0.05, 0.03), ("cushion", 0.05, 0.03), ("leaf", 0.0, -0.05))
    ]
    return [
        box("oak", (-0.65, -0.42, 0.715), (0.65, 0.42, 0.75)),
        *legs("oak", 1.2, 0.74, 0.715, 0.06),
        cylinder("vase", (0, 0, 0.75), 0.14, 0.06),
        *fruit,
        cylinder("book red", (-0.42, 0.12, 0.75), 0.042, 0.1),
        cylinder("book blue", (0.40, -0.2, 0.75), 0.042, 0.1),
        *place([box("book green", (-0.11, -0.08, 0), (0.11, 0.08, 0.03))], 0.38, 0.16, 0.75, 25),
        *place([box("mosaic", (-0.15, -0.1, 0), (0.15, 0.1, 0.012))], -0.36, -0.16, 0.75, -8),
    ]


def sofa() -> list[Primitive]:
    """A two-seat sofa that faces -y, with rounded arms and back, and cushions."""
    return [
        box("sofa", (-0.95, -0.42, 0.10), (0.95, 0.42, 0.30)),
        box("sofa", (-0.95, 0.22, 0.30), (0.95, 0.42, 0.78)),
        cylinder("sofa", (-0.95, 0.32, 0.78), 0.1, 1.9, axis=0),
        *(box("sofa", (x - 0.39, -0.36, 0.30), (x + 0.39, 0.22, 0.44)) for x in (-0.395, 0.395)),
        *(cylinder("sofa", (x - 0.39, -0.36, 0.37), 0.07, 0.78, axis=0) for x in (-0.395, 0.395)),
        *(box("sofa", (x - 0.08, -0.42, 0.30), (x + 0.08, 0.22, 0.55)) for x in (-0.87, 0.87)),
        *(cylinder("sofa", (x, -0.42, 0.55), 0.09, 0.64, axis=1) for x in (-0.87, 0.87)),
        *(cylinder("walnut", (x, y, 0), 0.03, 0.1) for x in (-0.85, 0.85) for y in (-0.34, 0.34)),
        ellipsoid("cushion", (-0.52, 0.14, 0.63), (0.21, 0.1, 0.2), rotation(0, -20)),
        ellipsoid(
            "plaid", (0.50, 0.13, 0.62), (0.2, 0.1, 0.19), rotation(2, 14) @ rotation(0, -20)
        ),
    ]


def books(rng: np.random.Generator, width: float) -> list[Primitive]:
    """A row of books of varying size from x = 0 along x, backs towards -y, the last one leaning."""
    covers, row, x = ("book red", "book blue", "book green", "book cream", "book dark"), [], 0.0
    while x < width:
        thick, tall, deep = (
            rng.uniform(0.028, 0.06),
            rng.uniform(0.19, 0.28),
            rng.uniform(0.17, 0.22),
        )
        row.append(
            box(covers[rng.integers(len(covers))], (x, 0.22 - deep, 0), (x + thick, 0.22, tall))
        )
        x += thick + rng.choice((0.0, 0.0, 0.004))
    lean = replace(row[-1], center=row[-1].center - (x - 0.03, 0, 0))
    tilt = rotation(1, -14)
    return row[:-1] + [replace(lean, center=tilt @ lean.center + (x + 0.022, 0, 0.0), R=tilt)]


def bookcase() -> list[Primitive]:
    """A bookcase 1.2 m wide that faces -y and stands with its back at y = 0.3."""
    rng = np.random.default_rng(7)
    floors = (0.06, 0.42, 0.78, 1.14, 1.50)
    parts = [
        box("walnut", (-0.6, 0, 0), (-0.57, 0.3, 1.84)),
        box("walnut", (0.57, 0, 0), (0.6, 0.3, 1.84)),
        box("walnut", (-0.57, 0.28, 0.06), (0.57, 0.3, 1.84)),
        box("walnut", (-0.57, 0, 1.81), (0.57, 0.28, 1.84)),
        *(box("walnut", (-0.57, 0.01, z - 0.025), (0.57, 0.28, z)) for z in floors),
    ]
    for z, x, width in (
        (0.42, -0.56, 0.55),
        (0.78, -0.56, 0.85),
        (1.14, -0.2, 0.6),
        (1.50, -0.56, 0.45),
    ):
        parts += place(books(rng, width), x, 0.05, z)
    return parts + [
        box("wicker", (-0.53, 0.03, 0.06), (-0.05, 0.26, 0.29)),
        box("wicker", (0.05, 0.03, 0.06), (0.53, 0.26, 0.29)),
        box("mosaic", (0.22, 0.04, 0.42), (0.52, 0.25, 0.60)),
        box("plaid", (0.28, 0.06, 0.60), (0.50, 0.22, 0.68)),
        ellipsoid("clay", (-0.40, 0.14, 1.24), (0.10, 0.10, 0.10)),
        cylinder("clay", (-0.40, 0.14, 1.32), 0.045, 0.07),
        ellipsoid("globe", (0.32, 0.14, 1.64), (0.1, 0.1, 0.1)),
        cylinder("brass", (0.32, 0.14, 1.50), 0.06, 0.045),
    ]


def sideboard() -> list[Primitive]:
    """A sideboard that faces -y with its back at y = 0.42, with a globe, a vase and books on it."""
    doors = [box("drawer", (x, -0.015, 0.17), (x + 0.44, 0.0, 0.63)) for x in (-0.69, -0.22, 0.25)]
    knobs = [ellipsoid("brass", (x, -0.03, 0.42), (0.02, 0.02, 0.02)) for x in (-0.29, 0.18, 0.29)]
    pile = [
        p
        for i, (m, turn) in enumerate((("book blue", 4), ("book cream", -9), ("book red", 12)))
        for p in place(
            [box(m, (-0.13, -0.09, 0), (0.13, 0.09, 0.035))], -0.05, 0.2, 0.67 + 0.035 * i, turn
        )
    ]
    return [
        box("walnut", (-0.72, 0, 0.14), (0.72, 0.42, 0.64)),
        box("walnut", (-0.75, -0.03, 0.64), (0.75, 0.42, 0.67)),
        *place(legs("walnut", 1.36, 0.36, 0.14, 0.045), 0, 0.21),
        *doors,
        *knobs,
        *pile,
        cylinder("brass", (-0.46, 0.2, 0.67), 0.09, 0.02),
        cylinder("brass", (-0.46, 0.2, 0.69), 0.0125, 0.08),
        ellipsoid("globe", (-0.46, 0.2, 0.90), (0.15, 0.15, 0.15)),
        ellipsoid("vase", (0.45, 0.2, 0.81), (0.11, 0.11, 0.15)),
        cylinder("vase", (0.45, 0.2, 0.92), 0.05, 0.13),
    ]


def plant() -> list[Primitive]:
    """A pot with broad leaves."""
    leaves = []
    for i in range(9):
        R = rotation(2, 40.0 * i) @ rotation(1, 18 + 13 * (i % 3))
        leaves.append(
            ellipsoid(
                "leaf", R @ (0, 0, 0.34) + (0, 0, 0.34), (0.018, 0.075, 0.32 - 0.03 * (i % 3)), R
            )
        )
    return [
        cylinder("clay", (0, 0, 0), 0.15, 0.34),
        cylinder("clay", (0, 0, 0.30), 0.17, 0.05),
        *leaves,
    ]


def floor_lamp() -> list[Primitive]:
    """A floor lamp with a pole 2.6 cm thick."""
    return [
        cylinder("steel", (0, 0, 0), 0.15, 0.025),
        cylinder("steel", (0, 0, 0.025), 0.013, 1.40),
        cylinder("shade", (0, 0, 1.38), 0.19, 0.28),
    ]


def coffee_table() -> list[Primitive]:
    """A round table on three slim legs, with a tray, a mug and a book."""
    feet = [
        cylinder("oak", (0.3 * np.cos(a), 0.3 * np.sin(a), 0), 0.018, 0.40)
        for a in np.radians((90, 210, 330))
    ]
    return [
        cylinder("oak", (0, 0, 0.40), 0.42, 0.035),
        *feet,
        cylinder("vase", (-0.12, 0.1, 0.435), 0.045, 0.1),
        *place(
            [
                box("book dark", (-0.14, -0.1, 0), (0.14, 0.1, 0.025)),
                box("book red", (-0.1, -0.08, 0.025), (0.1, 0.08, 0.05)),
            ],
            0.12,
            -0.1,
            0.435,
            35,
        ),
        ellipsoid("stone", (0.16, 0.2, 0.475), (0.07, 0.07, 0.04)),
    ]


def framed(
    material: str, width: float, height: float, frame: str = "oak", border: float = 0.05
) -> list[Primitive]:
    """A picture or a window with its frame, facing -y, its back at y = 0.03, centred on the origin."""
    w, h, b = width / 2, height / 2, border
    return [
        box(material, (-w, 0.012, -h), (w, 0.03, h)),
        box(frame, (-w - b, 0, h), (w + b, 0.03, h + b)),
        box(frame, (-w - b, 0, -h - b), (w + b, 0.03, -h)),
        box(frame, (-w - b, 0, -h), (-w, 0.03, h)),
        box(frame, (w, 0, -h), (w + b, 0.03, h)),
    ]


def window() -> list[Primitive]:
    """A window with bars and a sill, facing -y, its back at y = 0.03."""
    return [
        *framed("view", 1.3, 1.05, "white wood", 0.07),
        box("white wood", (-0.02, 0.002, -0.525), (0.02, 0.012, 0.525)),
        box("white wood", (-0.65, 0.002, -0.02), (0.65, 0.012, 0.02)),
        box("white wood", (-0.8, -0.14, -0.63), (0.8, 0.03, -0.595)),
    ]


def furnished_room() -> tuple[Primitive, ...]:
    """The room, its inner faces first, and everything in it; backs stand at the walls, so no face
    lies in another's plane.
    """
    x, y, z = np.array(ROOM_SIZE) / 2
    shell = Primitive(ROOM, "wallpaper", np.array([0.0, 0.0, z]), np.array([x, y, z]), np.eye(3))
    skirting = [
        box("white wood", (-x, y - 0.018, 0), (x, y, 0.09)),
        box("white wood", (-x, -y, 0), (0.83, -y + 0.018, 0.09)),
        box("white wood", (1.87, -y, 0), (x, -y + 0.018, 0.09)),
        *(
            box("white wood", (sx - 0.018 * (sx > 0), -y, 0), (sx + 0.018 * (sx < 0), y, 0.09))
            for sx in (-x, x)
        ),
    ]
    door = [
        box("door", (-0.45, 0.0, 0.005), (0.45, 0.03, 2.02)),
        ellipsoid("brass", (-0.37, -0.035, 1.02), (0.03, 0.03, 0.03)),
        cylinder("brass", (-0.37, -0.03, 1.02), 0.012, 0.03, axis=1),
        *(box("white wood", (sx, -0.012, 0), (sx + 0.07, 0.03, 2.02)) for sx in (-0.52, 0.45)),
        box("white wood", (-0.52, -0.012, 2.02), (0.52, 0.03, 2.09)),
    ]
    back = 0.03  # depth of everything that hangs on a wall
    parts = [
        *skirting,
        *place(door, 1.35, -y + back, turn=180),
        *place(window(), -x + back, 0.15, 1.52, 90),
        *place(framed("landscape", 1.15, 0.62), -0.7, y - back, 1.45),
        *place(framed("mosaic", 0.45, 0.60, "walnut"), 1.75, y - back, 1.45),
        *place(framed("dusk", 0.95, 0.6, "walnut"), x - back, -0.35, 1.5, -90),
        *place([cylinder("clock", (0, 0, 0), 0.15, 0.03, axis=1)], 0.35, -y + back, 1.75, 180),
        *place(sofa(), -0.7, 1.53),
        *place(floor_lamp(), 0.62, 1.62),
        *place(plant(), -2.1, 1.6),
        *place(bookcase(), -0.75, -y + 0.32, turn=180),
        *place(sideboard(), -x + 0.44, 0.1, turn=90),
        *place(table(), 1.55, 0.35, turn=90),
        *place(chair(), 1.55, -0.62, turn=8),
        *place(chair(), 0.93, 0.15, turn=-84),
        *place(chair("plaid"), 1.0, 0.75, turn=-98),
        *place(chair(), 1.6, 1.33, turn=174),
        *place([box("rug", (-0.95, -0.65, 0), (0.95, 0.65, 0.012))], -0.65, 0.35, turn=4),
        *place(coffee_table(), -0.65, 0.4, 0.012),
        *place(
            [
                cylinder("wicker", (0, 0, 0), 0.24, 0.36),
                ellipsoid("seat", (0, 0, 0.36), (0.24, 0.24, 0.06)),
            ],
            0.25,
            -1.1,
        ),
        ellipsoid("ball", (-1.55, -0.95, 0.13), (0.13, 0.13, 0.13)),
        *place(
            [
                box("wicker", (-0.2, -0.15, 0), (0.2, 0.15, 0.3)),
                box("plaid", (-0.16, -0.11, 0.3), (0.16, 0.11, 0.36)),
            ],
            2.1,
            -1.2,
            turn=-70,
        ),
    ]
    return (shell, *parts)
