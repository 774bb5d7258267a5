"""Which row of a trajectory belongs to which image: by its name, by its number, by time, or in
order.

A frame's number is never taken for a time: image 000003 has nothing to do with the time stamp
3.000000 of a trajectory whose other stamps are 2.8 and 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import DatasetError
from ..files.frame_files import stem_of
from ..files.text_rows import is_stamp
from ..files.trajectories import Pose, PoseRow
from ..geometry.time_stamps import (
    SECONDS,
    nearest,
    range_of,
    since,
    to_nanoseconds,
    unit_of,
)

SECOND = 10**9  # [ns]
LARGEST_NUMBER = 10**8  # of a frame; whole numbers beyond it are times
ENOUGH = 0.75  # of the frames, or of the rows, must have a partner of the same number


@dataclass(frozen=True)
class NamedPoses:
    """A pose for every frame, and what is to be said of how they were paired."""

    poses: list[Pose]
    warnings: tuple[str, ...] = ()


def say_unit(source: Path, unit: str, warnings: list[str]) -> None:
    """Add a sentence where time stamps are in another unit than seconds."""
    if unit != SECONDS:
        warnings.append(f"{source}: its time stamps are {unit}, by their size, and taken as such")


def said_in_order(source: Path, count: int) -> str:
    """The sentence on rows that were paired with images one to one."""
    return (
        f"{source}: the images are numbered but its {count} rows have time stamps; as there is one for each "
        "image they are paired in their order"
    )


def times_of(stems: Sequence[str]) -> list[int]:
    """Time stamps [ns] of images that are named by time; empty where they are not."""
    if not all(is_stamp(stem) for stem in stems):
        return []
    whole = all("." not in stem and abs(float(stem)) < LARGEST_NUMBER for stem in stems)
    if whole:
        return []
    unit = unit_of(stems)
    return [to_nanoseconds(stem, unit) for stem in stems]


def are_numbers(frames: Sequence[int], rows: Sequence[int]) -> bool:
    """Whether the stamps [ns] of frames are their numbers, 0, 1, 2 ..., while those of a
    trajectory's rows are times: two clocks that do not fit.
    """
    if any(stamp % SECOND or abs(stamp) >= LARGEST_NUMBER * SECOND for stamp in frames):
        return False
    if all(stamp % SECOND == 0 for stamp in rows):
        return len(rows) == len(frames) and _paired_by_number(frames, rows) < ENOUGH
    covered = min(rows) <= min(frames) + SECOND and max(rows) >= max(frames) - SECOND
    return len(rows) == len(frames) or not covered


def _paired_by_number(frames: Sequence[int], rows: Sequence[int]) -> float:
    """Share of frames, or of rows if that is larger, that have a partner of the same number."""
    both = len(set(frames) & set(rows))
    return both / max(1, min(len(set(frames)), len(set(rows))))


def rows_of_frames(
    rows: Sequence[PoseRow], source: Path, stems: Sequence[str], max_difference: float
) -> NamedPoses:
    """The pose of every image, by its name without suffix.

    Raises DatasetError where a name appears twice, or where names and time stamps tell of no
    partners: it names what both run from and to.
    """
    by_name: dict[str, PoseRow] = {}
    for row in rows:
        if by_name.setdefault(row.name, row) is not row:
            raise DatasetError(
                f"{row.pose.source}: '{row.name}' appears again (first: {by_name[row.name].pose.source}), keep one"
            )
    timed, times = all(is_stamp(row.name) for row in rows), times_of(stems)
    if timed and times:
        return _by_time(rows, source, stems, times, max_difference)
    numbers = [int(stem) for stem in stems] if all(stem.isdecimal() for stem in stems) else []
    if timed and numbers:
        found = _by_number(rows, numbers)
    else:
        by_stem = {**{stem_of(row.name): row for row in rows}, **by_name}
        found = [by_stem.get(stem) for stem in stems]
    if any(found):
        return NamedPoses(_poses(found, source, stems, "no row for it"))
    if not timed:
        raise DatasetError(
            f"{source}: no row belongs to a frame; the first column must be a frame's name like '{stems[0]}', "
            f"but is '{rows[0].name}'"
        )
    return _in_order(rows, source, stems)


def _by_number(rows: Sequence[PoseRow], numbers: Sequence[int]) -> list[PoseRow | None]:
    """Rows whose first column is the number of an image, if most are."""
    stamps = [to_nanoseconds(row.name) for row in rows]
    frames = [number * SECOND for number in numbers]
    whole = all(stamp % SECOND == 0 for stamp in stamps)
    if not whole or _paired_by_number(frames, stamps) < ENOUGH:
        return [None] * len(numbers)
    of = dict(zip(stamps, rows, strict=True))
    return [of.get(frame) for frame in frames]


def _by_time(
    rows: Sequence[PoseRow],
    source: Path,
    stems: Sequence[str],
    times: Sequence[int],
    max_difference: float,
) -> NamedPoses:
    """The row nearest in time, where it is near enough."""
    unit = unit_of([row.name for row in rows])
    warnings: list[str] = []
    say_unit(source, unit, warnings)
    stamped = sorted(
        ((to_nanoseconds(row.name, unit), row) for row in rows), key=lambda pair: pair[0]
    )
    stamps = since([stamp for stamp, _ in stamped], times[0])
    wanted = since(times, times[0])
    at = nearest(stamps, wanted)
    near = np.abs(stamps[at] - wanted) <= max_difference
    found = [stamped[i][1] if close else None for i, close in zip(at, near, strict=True)]
    if not any(found):
        raise DatasetError(
            f"{source}: no row belongs to a frame: its time stamps run from "
            f"{range_of([stamp for stamp, _ in stamped])} s, those of the images from {range_of(times)} s, and none "
            f"are within {max_difference} s"
        )
    nothing = f"no row for it (a time stamp within {max_difference} s)"
    return NamedPoses(_poses(found, source, stems, nothing), tuple(warnings))


def _in_order(rows: Sequence[PoseRow], source: Path, stems: Sequence[str]) -> NamedPoses:
    """Rows one by one where there are as many as images and their stamps ascend."""
    stamps = [float(row.name) for row in rows]
    if len(rows) == len(stems) and (np.diff(stamps) > 0).all():
        return NamedPoses([row.pose for row in rows], (said_in_order(source, len(rows)),))
    raise DatasetError(
        f"{source}: its {len(rows)} rows have time stamps, {stamps[0]:g} to {stamps[-1]:g}, but the {len(stems)} "
        f"images are named '{stems[0]}' to '{stems[-1]}': a frame's number is no time; name the images by time, "
        "write their names into the first column, or give one row for each image"
    )


def _poses(
    found: Sequence[PoseRow | None], source: Path, stems: Sequence[str], nothing: str
) -> list[Pose]:
    return [
        row.pose if row else Pose(f"{source} frame {stem}", problem=nothing)
        for stem, row in zip(stems, found, strict=True)
    ]
