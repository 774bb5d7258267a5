"""What may be taken in another way than a recording's format says: poses, their clock, intrinsics.
The options that `unifusion check` proposes, the same in every format.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, get_type_hints

from ..errors import InputError, convert
from .pose_readings import check_reading

LONGEST_OFFSET = 3600.0  # [s]


def _says(default: Any, sentence: str) -> Any:
    return field(default=default, metadata={"sentence": sentence})


@dataclass(frozen=True)
class Mending:
    """What to change, as options of `open_dataset` in every format; the defaults change nothing."""

    pose_reading: str | None = _says(
        None, "How poses are written, as w2c, opengl or w-first+w2c; a wrong one lists the words."
    )
    pose_scale: float | None = _says(None, "Metres in a unit of the poses' translations.")
    project_poses: bool | None = _says(
        None,
        "Take the nearest rotation where a pose's is none (scaled, sheared), instead of refusing it.",
    )
    clock_offset: float | None = _says(
        None, "Seconds to add to a frame's time stamp before its pose is looked up."
    )
    intrinsics: tuple[float, float, float, float] | None = _says(
        None, "fx/fy/cx/cy of the depth images in pixels, instead of the recording's."
    )
    depth_limit: float | None = _says(None, "Metres; readings beyond are none, as a far plane is.")

    def __post_init__(self) -> None:
        if self.pose_reading is not None:
            check_reading(self.pose_reading)
        if self.pose_scale is not None and not 0 < self.pose_scale < float("inf"):
            raise InputError(f"pose_scale: must be a positive number, got {self.pose_scale}")
        if self.depth_limit is not None and not self.depth_limit > 0:
            raise InputError(f"depth_limit: must be a positive number, got {self.depth_limit}")
        if self.clock_offset is not None and not abs(self.clock_offset) <= LONGEST_OFFSET:
            raise InputError(
                f"clock_offset: must lie within {LONGEST_OFFSET:g} s, got {self.clock_offset}"
            )

    @classmethod
    def of(cls, options: Mapping[str, Any]) -> Mending:
        """Those of `options` that are kinds of mending, texts converted."""
        types = get_type_hints(cls)
        return cls(
            **{
                name: convert(_listed(value), types[name], f"option '{name}'")
                for name, value in options.items()
                if name in types
            }
        )

    @property
    def changes(self) -> bool:
        """Whether there is anything to change."""
        return any(getattr(self, each.name) is not None for each in fields(self))


MENDINGS = {each.name: each.metadata["sentence"] for each in fields(Mending)}


def _listed(value: Any) -> Any:
    """A tuple as a list, and numbers between commas as between slashes."""
    if isinstance(value, tuple):
        return list(value)
    return value.replace(",", "/") if isinstance(value, str) else value
