"""A results folder as evaluation needs it: which frames of which recording it was made from, its
mesh, poses and settings.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import Config, load_config
from ..datasets import Dataset, open_dataset
from ..errors import DatasetError, FileError, FrameError
from ..evaluation.trajectory import align_poses, match_poses
from ..evaluation.viewpoints import Viewpoints
from ..files.atomic import read_bytes
from ..files.mesh_reading import read_mesh
from ..files.trajectories import read_trajectory
from ..types import Mesh, Trajectory

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """What a results folder of `unifusion reconstruct` says about itself; its mesh, maps and poses
    are in its own world.
    """

    directory: Path
    format: str
    path: Path | None  # of the recording
    reading: Mapping[str, Any]  # options that it was opened with
    start: int  # the frames asked for: every `every`-th from `start` to before `stop`
    stop: int
    every: int
    used: tuple[int, ...]  # the frames fused, by their place in the recording
    tracked: bool  # its poses are not the recording's

    def recording(self) -> Dataset:
        """The recording that the run read; raises DatasetError where it is no longer there."""
        try:
            return open_dataset(self.format, self.path, **self.reading)
        except DatasetError as error:
            raise DatasetError(
                f"{self.directory} was made from {self.format} {self.path or ''}, which cannot be opened: "
                f"{error}"
            ) from None

    def config(self) -> Config:
        """The settings of the run."""
        return load_config(self.directory / "config.yaml")

    def mesh(self) -> Mesh:
        """The mesh that the run made; raises FileError where there is none."""
        path = self.directory / "mesh.ply"
        if not path.exists():
            raise FileError(f"{path}: no such file; make it with: unifusion mesh {self.directory}")
        return read_mesh(path)

    def trajectory(self) -> Trajectory:
        """The poses that the run used, one a frame of `used`."""
        return read_trajectory(self.directory / "trajectory.txt")

    def true_trajectory(self) -> Trajectory:
        """The recording's own poses of the frames used; a frame without one is left out. Raises
        DatasetError if all are.
        """
        recording, stamps, poses, numbers = self.recording(), [], [], []
        for index in self.used:
            try:
                frame = recording[index]
            except (FrameError, IndexError):
                continue
            if frame.T_world_camera is not None:
                stamps.append(frame.timestamp)
                numbers.append(index)
                poses.append(frame.T_world_camera)
        if not poses:
            raise DatasetError(
                f"{recording.name}: has no poses of the {len(self.used)} frames that {self.directory} was made "
                "from"
            )
        return Trajectory.of(stamps, numbers, poses)

    def T_recording_run(self) -> NDArray[np.float64]:
        """Takes the run's world to the recording's: the same, unless poses were tracked; then these
        are fitted to its own.
        """
        if not self.tracked:
            return np.eye(4)
        tracked, true = match_poses(self.trajectory(), self.true_trajectory())
        T = align_poses(tracked, true)
        off = np.linalg.norm((T @ tracked)[:, :3, 3] - true[:, :3, 3], axis=1)
        logger.info(
            "the poses of this run were tracked: its world is fitted to the recording's, %.1f cm off in the mean",
            100 * off.mean(),
        )
        return T

    def views(self) -> Viewpoints:
        """Where its cameras looked from, in the recording's world, within the depth that it used."""
        limits = self.config().preprocess
        camera = self.recording()[self.used[0]].camera
        return Viewpoints(
            camera,
            self.T_recording_run() @ self.trajectory().T_world_camera,
            limits.depth_min,
            limits.depth_max,
        )


def find_run(path: Path) -> Run | None:
    """The run of a results folder, or None for a file; raises FileError where there is neither."""
    if not path.exists():
        raise FileError(f"{path}: no such file or folder")
    return read_run(path) if path.is_dir() else None


def read_run(directory: str | Path) -> Run:
    """Read what `unifusion reconstruct` wrote beside its maps; raises FileError where that is
    missing or damaged.
    """
    directory = Path(directory)
    file = directory / "metrics.json"
    if not file.exists():
        raise FileError(
            f"{directory}: holds no metrics.json; give the results folder of `unifusion reconstruct`"
        )
    try:
        metrics = json.loads(read_bytes(file))
        about, frames = metrics["recording"], metrics["frames"]
        skipped = {int(frame["frame"]) for frame in frames["skipped_frames"]}
        start, every, count = int(about["start"]), int(about["every"]), int(about["frames"])
        asked = range(start, start + count * every, every)
        done = asked[: int(frames["used"]) + len(skipped)]  # it may have been stopped early
        return Run(
            directory,
            str(about["format"]),
            Path(about["path"]) if about["path"] else None,
            dict(about.get("reading", {})),
            start,
            asked.stop,
            every,
            tuple(i for i in done if i not in skipped),
            bool(metrics.get("tracking")),
        )
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileError(
            f"{file}: not the metrics of a run, or a damaged file ({type(error).__name__}: {error})"
        ) from None
