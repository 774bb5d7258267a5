"""Where a recording lies in the map that it is added to: kept, so that a run that goes on need not look
for its place again, which may no longer be possible while it writes into that very map.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..files.atomic import write_text
from ..tracking.keyframe_file import read_keyframes, write_keyframes
from ..tracking.keyframes import Keyframes
from .record import Source, decoded
from .run_folder import RunFolder
from .safe_point import VERSION, Recipe, read_for


@dataclass(frozen=True, eq=False)
class Placement:
    """How the keyframes of a recording move to the world of a map."""

    places: tuple[int, ...]  # of its keyframes in the recording
    motion: NDArray[np.float64]  # (N, 4, 4) T_map_recording of each
    details: Mapping[str, Any]  # for the record
    sources: tuple[Source, ...]  # what the map was made from, in order


def write_placement(
    folder: RunFolder, recipe: Recipe, placement: Placement, keyframes: Keyframes
) -> None:
    """Keep a placement and the keyframes of the map and the recording; raises FileError."""
    write_keyframes(folder.placed_keyframes, keyframes)
    values = {
        "version": VERSION,
        "recipe": asdict(recipe),
        "places": placement.places,
        "motion": placement.motion.tolist(),
        "details": dict(placement.details),
        "sources": [asdict(source) for source in placement.sources],
    }
    write_text(folder.placement, json.dumps(values) + "\n")


def read_placement(folder: RunFolder, recipe: Recipe) -> tuple[Placement, Keyframes] | None:
    """What `write_placement` kept; None where there is nothing. Raises InputError where the run had other
    settings, FileError where a file is damaged.
    """

    def parse(values: Mapping[str, Any]) -> Placement:
        motion = np.array(values["motion"], np.float64).reshape(len(values["places"]), 4, 4)
        sources = tuple(decoded(Source, each) for each in values["sources"])
        return Placement(tuple(values["places"]), motion, values["details"], sources)

    found = read_for(recipe, folder.placement, parse)
    return None if found is None else (found, read_keyframes(folder.placed_keyframes))
