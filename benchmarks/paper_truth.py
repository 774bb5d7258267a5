"""The labelled points of a room of S3DIS, from its folder `Annotations/` to one PLY file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from taichi_unifusion.errors import FileError
from taichi_unifusion.types import Mesh


def write_room_labels(room: Path, names: Mapping[int, str], path: Path) -> int:
    """Write the points of `room/Annotations/CLASS_N.txt`, rows of x y z r g b in metres, with the
    number of their class as `label`; how many they are.

    Files of other classes are left out. Colours are not read: one file of version 1.2 has a stray
    byte in them. Raises FileError where there is no such file, or one is damaged.
    """
    numbers = {name: number for number, name in names.items()}
    points, labels = [], []
    for file in sorted((room / "Annotations").glob("*.txt")):
        number = numbers.get(file.stem.rpartition("_")[0])
        if number is None:
            continue
        try:
            rows = np.loadtxt(file, np.float32, usecols=(0, 1, 2), ndmin=2)
        except (OSError, ValueError) as error:
            raise FileError(f"{file}: not rows of x y z r g b ({str(error)[:120]})") from None
        points.append(rows)
        labels.append(np.full((len(rows), 1), number, np.float32))
    if not points:
        raise FileError(f"{room / 'Annotations'}: no CLASS_N.txt, such as chair_1.txt, here")
    cloud = Mesh(
        np.concatenate(points),
        np.empty((0, 3), np.int32),
        attributes={"label": np.concatenate(labels)},
    )
    cloud.save(path)
    return len(cloud.vertices)
