"""A results folder as evaluation needs it: which frames of which recording it was made from, its mesh, poses and settings."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..config import Config, load_config
from ..datasets import Dataset, open_dataset
from ..errors import DatasetError, FileError, FrameError
from ..io import read_bytes, read_mesh, read_trajectory
from ..types import Mesh, PinholeCamera, Trajectory
from .visibility import Views


@dataclass(frozen=True)
class Run:
    """What a results folder of `unifusion reconstruct` says about itself."""

    directory: Path
    format: str
    path: Path | None              # of the recording
    reading: Mapping[str, Any]     # options that it was opened with
    start: int                     # the frames asked for: every `every`-th from `start` to before `stop`
    stop: int
    every: int
    used: tuple[int, ...]          # the frames fused, by their place in the recording
    camera: PinholeCamera | None   # of the depth images

    def recording(self) -> Dataset:
        """The recording that the run read; raises DatasetError where it is no longer there."""
        try:
            return open_dataset(self.format, self.path, **self.reading)
        except DatasetError as error:
            raise DatasetError(f"{self.directory} was made from {self.format} {self.path or ''}, which cannot be opened: "
                               f"{error}") from None

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
        """The recording's own poses of the frames used; a frame without one is left out. Raises DatasetError if all are."""
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
            raise DatasetError(f"{recording.name}: has no poses of the {len(self.used)} frames that {self.directory} was made "
                               "from")
        return Trajectory(np.array(numbers if None in stamps else stamps, np.float64), np.stack(poses))

    def views(self) -> Views:
        """Where its cameras looked from, within the depth that it used; raises FileError where it does not say so."""
        if self.camera is None:
            raise FileError(f"{self.directory}/metrics.json: does not say which camera was used; reconstruct again")
        limits = self.config().preprocess
        return Views(self.camera, self.trajectory().T_world_camera, limits.depth_min, limits.depth_max)


def read_run(directory: str | Path) -> Run:
    """Read what `unifusion reconstruct` wrote beside its maps; raises FileError where that is missing or damaged."""
    directory = Path(directory)
    file = directory / "metrics.json"
    if not file.exists():
        raise FileError(f"{directory}: holds no metrics.json; give the results folder of `unifusion reconstruct`")
    try:
        metrics = json.loads(read_bytes(file))
        about, frames = metrics["recording"], metrics["frames"]
        skipped = {int(frame["frame"]) for frame in frames["skipped_frames"]}
        start, every, count = int(about["start"]), int(about["every"]), int(about["frames"])
        asked = range(start, start + count * every, every)
        done = asked[:int(frames["used"]) + len(skipped)]  # it may have been stopped early
        camera = about.get("camera")
        return Run(directory, str(about["format"]), Path(about["path"]) if about["path"] else None,
                   dict(about.get("reading", {})), start, asked.stop, every, tuple(i for i in done if i not in skipped),
                   None if camera is None else PinholeCamera(**camera))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FileError(f"{file}: not the metrics of a run, or a damaged file ({type(error).__name__}: {error})") from None
