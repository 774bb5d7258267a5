"""Options of commands that need camera poses: where they come from."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import FlagCreatePairsOff, arg

from ..config import Config
from ..datasets import Dataset
from ..errors import DatasetError
from ..results.run_folder import RunFolder
from .recording import RecordingOptions
from .terminal import frame_progress

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class TrackingOptions:
    """Where camera poses come from."""

    tracking: Literal["given", "external", "internal", "rgbd"] = field(
        default="given", kw_only=True
    )
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
        if frames.no_poses and self.trajectory is None and self.tracking in ("given", "internal"):
            raise DatasetError(
                f"{frames.no_poses}, so the frames have no poses; find them from the frames alone with "
                "--tracking rgbd, or take another program's with --tracking external --trajectory FILE"
            )

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
        from ..tracking import make_tracker
        from ..tracking.sequence import PosedFrames, track_sequence, write_tracking

        frames = replace(recording, every=1).frames()
        tracker = make_tracker(
            self.tracking,
            settings.tracking,
            settings.preprocess,
            trajectory=self.trajectory,
            interpolate=self.interpolate,
            max_difference=recording.max_difference,
        )
        runtime.init(settings.device, threads=settings.threads or None)
        logger.info("tracking: %s", self.tracking)
        with frame_progress(len(frames)) as on_frame:
            result = track_sequence(frames, tracker, stop=stop, on_frame=on_frame)
        write_tracking(folder.tracking, result)
        write_trajectory(folder.tracked_poses, result.trajectory)
        return PosedFrames(frames, result)[:: recording.every], {
            "mode": self.tracking,
            **result.details,
        }
