"""Options of commands that need camera poses: where they come from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, arg

from ..config import Config
from ..datasets import Dataset
from ..results.run_folder import RunFolder
from ..tracking import Mode, check_poses, track
from .recording import RecordingOptions
from .terminal import frame_progress


@dataclass(frozen=True)
class TrackingOptions:
    """Where camera poses come from."""

    tracking: Mode = field(default="given", kw_only=True)
    """Camera poses. given: the recording's; external: from --trajectory; internal: either of them,
    refined; rgbd: from the frames alone."""
    trajectory: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")] = (
        field(default=None, kw_only=True)
    )
    """Poses of another program: TUM, KITTI or Replica file, or a folder of one matrix a frame."""
    interpolate: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Fill gaps of up to a second between the poses of --trajectory."""

    @property
    def tracked(self) -> bool:
        """Whether poses come from elsewhere than the recording, or are meant to."""
        return self.tracking != "given" or self.trajectory is not None or self.interpolate

    def check_poses(self, frames: Dataset) -> None:
        """Say at once that a recording has no poses where they are needed."""
        check_poses(frames, self.tracking, self.trajectory)

    def track(
        self,
        recording: RecordingOptions,
        settings: Config,
        folder: RunFolder,
        stop: Callable[[], bool],
    ) -> tuple[Dataset, dict[str, object]]:
        """The frames that are asked for with their poses, and what to say of them in the metrics.

        All frames between the first and the last are tracked, whatever `--every` leaves for the
        map: small steps are easier. Poses are written at once, so
        that they outlive whatever comes after.
        """
        from .. import runtime
        from ..files.trajectories import write_trajectory
        from ..tracking.sequence import write_tracking

        frames = replace(recording, every=1).frames()
        runtime.init(settings.device, threads=settings.threads or None)
        with frame_progress(len(frames)) as on_frame:
            posed = track(
                frames,
                settings.tracking,
                settings.preprocess,
                mode=self.tracking,
                trajectory=self.trajectory,
                interpolate=self.interpolate,
                max_difference=recording.max_difference,
                stop=stop,
                on_frame=on_frame,
            )
        write_tracking(folder.tracking, posed.tracking)
        write_trajectory(folder.tracked_poses, posed.tracking.trajectory)
        return posed[:: recording.every], {"mode": self.tracking, **posed.tracking.details}
