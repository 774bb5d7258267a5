"""Options of every command that reads a recording: which one, how to read it, which of its frames."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..datasets import FORMATS, Dataset, open_dataset
from ..errors import DatasetError, InputError
from ..results.record import Source

FORMAT_DEFAULT = "(default: the format's)"


@dataclass(frozen=True)
class RecordingOptions:
    """Which frames of which recording; commands add what they make of them."""

    format: Annotated[
        Positional[str], arg(metavar="FORMAT", help=f"The kind of recording: {', '.join(FORMATS)}.")
    ]
    path: Annotated[
        Positional[Path | None], arg(metavar="[PATH]", help_behavior_hint="(synthetic needs none)")
    ] = None
    """Where the recording lies."""
    start: Annotated[int, arg(metavar="A")] = field(default=0, kw_only=True)
    """First frame, counted from 0."""
    end: Annotated[int | None, arg(metavar="B", help_behavior_hint="(default: all)")] = field(
        default=None, kw_only=True
    )
    """Frame to stop before."""
    every: Annotated[int, arg(metavar="N")] = field(default=1, kw_only=True)
    """Use every N-th frame."""
    depth_scale: Annotated[float | None, arg(metavar="S", help_behavior_hint=FORMAT_DEFAULT)] = (
        field(default=None, kw_only=True)
    )
    """Units of the depth images that make a metre."""
    drop_alpha: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Accept colour images with a fourth channel and ignore it."""
    max_difference: Annotated[
        float | None, arg(metavar="SECONDS", help_behavior_hint=FORMAT_DEFAULT)
    ] = field(default=None, kw_only=True)
    """How far time stamps of depth, colour and pose may be apart (tum, folder)."""
    camera_path: Annotated[
        Path | None, arg(metavar="FILE", help_behavior_hint="(scene needs one)")
    ] = field(default=None, kw_only=True)
    """Poses to render a scene from: lines 'timestamp tx ty tz qx qy qz qw', camera to world."""
    strict: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Stop at the first frame that cannot be used, instead of skipping it."""

    @property
    def reading(self) -> dict[str, object]:
        """Options for `open_dataset`: those that were given."""
        options = {
            "depth_scale": self.depth_scale,
            "max_difference": self.max_difference,
            "drop_alpha": self.drop_alpha or None,
            "trajectory": self.camera_path,
        }
        return {name: value for name, value in options.items() if value is not None}

    def frames(self) -> Dataset:
        """The frames asked for; raises DatasetError if there are none."""
        recording = open_dataset(self.format, self.path, **self.reading)
        if self.start < 0 or self.every < 1 or (self.end is not None and self.end <= self.start):
            raise InputError(
                f"frames: need 0 <= start < end and every >= 1, got start {self.start}, end {self.end}, "
                f"every {self.every}"
            )
        frames = recording[self.start : self.end : self.every]
        if not len(frames):
            raise DatasetError(
                f"{recording.name}: there is no frame {self.start}, it has {len(recording)} (0 is the first)"
            )
        return frames

    def source(self, frames: int) -> Source:
        """The recording and the choice of frames, how many they are included, for the record."""
        return Source(
            format=self.format,
            path=str(self.path or ""),
            start=self.start,
            end=self.end,
            every=self.every,
            frames=frames,
            reading={
                name: str(value) if isinstance(value, Path) else value
                for name, value in self.reading.items()
            },
        )
