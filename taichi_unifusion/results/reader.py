"""A results folder as evaluation needs it: which frames of which recording it was made from, its
mesh, poses and settings.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..config import Config, load_config
from ..datasets import Dataset, open_dataset
from ..errors import DatasetError, FileError
from ..evaluation.trajectory import align_poses, match_poses
from ..evaluation.viewpoints import Viewpoints
from ..files.mesh_reading import read_mesh
from ..files.trajectories import read_trajectory
from ..geometry.gravity import Up
from ..tracking.sequence import read_tracked_poses, with_poses
from ..types import Mesh, Trajectory
from .outlook import read_up
from .record import ColorRecord, Source, read_record
from .run_folder import RunFolder

logger = logging.getLogger(__name__)
CAMERA = "camera"  # in the place of a format


@dataclass(frozen=True)
class Run:
    """What a results folder of `unifusion reconstruct` says about itself; its mesh, maps and poses
    are in its own world.
    """

    folder: RunFolder
    source: Source  # the frames asked for
    used: tuple[int, ...]  # the frames fused, by their place in the recording
    tracked: bool  # its poses are not the recording's

    @cached_property
    def recording(self) -> Dataset:
        """The recording that the run read, with the poses that the run found where it has none of its own;
        raises DatasetError where it is no longer there.
        """
        source = self.source
        try:
            opened = open_dataset(source.format, source.path or None, **source.reading)
            if self.tracked and opened.no_poses and self.folder.tracked_poses.exists():
                files = self.folder.tracking, self.folder.tracked_poses
                opened = with_poses(opened, read_tracked_poses(*files))
            return registered_as(opened, source.color)
        except DatasetError as error:
            raise DatasetError(
                f"{self.folder.path} was made from {source.format} {source.path}, which cannot be opened: "
                f"{error}"
            ) from None

    def config(self) -> Config:
        """The settings of the run."""
        return load_config(self.folder.config)

    def mesh(self) -> Mesh:
        """The mesh that the run made; raises FileError where there is none."""
        path = self.folder.mesh
        if not path.exists():
            raise FileError(
                f"{path}: no such file; make it with: unifusion mesh {self.folder.path}"
            )
        return read_mesh(path)

    def up(self) -> Up:
        """Which way is up in the run's world, and where the floor is."""
        return read_up(self.folder, self.mesh())

    def trajectory(self) -> Trajectory:
        """The poses that the run used, one a frame of `used`."""
        return read_trajectory(self.folder.trajectory)

    def tracked_trajectory(self) -> tuple[Trajectory, tuple[int, ...]]:
        """The poses that a tracker found, those of frames that were not mapped too, and the places of
        these in the recording; raises FileError where there are none.
        """
        table, file = self.folder.tracking, self.folder.tracked_poses
        if not (table.exists() and file.exists()):
            raise FileError(
                f"{self.folder.path}: holds no {file.name} and {table.name}: its poses were not tracked"
            )
        poses, frames = read_trajectory(file), tuple(read_tracked_poses(table, file))
        if len(frames) != len(poses):
            raise FileError(f"{file}: is not of the frames of {table.name}; track them again")
        return poses, frames

    def true_trajectory(
        self, estimate: Trajectory | None = None, frames: Sequence[int] | None = None
    ) -> Trajectory:
        """The recording's own poses of the frames of an estimate, by default of those used, with its
        time stamps; a frame without one is left out. Raises DatasetError if all are.
        """
        estimate, frames = estimate or self.trajectory(), frames or self.used
        if len(estimate) != len(frames):
            raise FileError(
                f"{self.folder.path}: {len(estimate)} poses for {len(frames)} frames; make it again"
            )
        recording = self.recording
        places = [i for i in range(len(frames)) if frames[i] < len(recording)]
        known = {} if recording.no_poses else {i: recording.pose_at(frames[i])[1] for i in places}
        poses = {i: pose for i, pose in known.items() if pose is not None}
        if not poses:
            raise DatasetError(
                f"{recording.name}: has no poses of the {len(frames)} frames of {self.folder.path}"
            )
        return Trajectory(estimate.timestamps[list(poses)], np.array(list(poses.values())))

    def T_recording_run(self) -> NDArray[np.float64]:
        """Takes the run's world to the recording's: the identity, unless poses were tracked; then
        these are fitted to the recording's own, which is said once.
        """
        return self._T_recording_run

    @cached_property
    def _T_recording_run(self) -> NDArray[np.float64]:
        if not self.tracked:
            return np.eye(4)
        if self.recording.no_poses:
            logger.info(
                "%s: frames are compared where the run found them: errors of poses do not show",
                self.folder.path,
            )
            return np.eye(4)
        tracked, true = match_poses(self.trajectory(), self.true_trajectory())
        T = align_poses(tracked, true)
        off = np.linalg.norm((T @ tracked)[:, :3, 3] - true[:, :3, 3], axis=1)
        logger.info(
            "%s: its poses are not the recording's, so its world is fitted to the recording's by the means of "
            "the cameras' rotations and positions, %.1f cm off in the mean (ATE is of another fit, of positions alone)",
            self.folder.path,
            100 * off.mean(),
        )
        return T

    def views(self) -> Viewpoints:
        """Where its cameras looked from, in the recording's world, within the depth that it used."""
        limits = self.config().preprocess
        camera = self.recording[self.used[0]].camera
        return Viewpoints(
            camera,
            self.T_recording_run() @ self.trajectory().T_world_camera,
            limits.depth_min,
            limits.depth_max,
        )


def registered_as(recording: Dataset, color: ColorRecord | None) -> Dataset:
    """The recording with its colour registered as a run's was."""
    from ..datasets.color_camera import ColorCamera

    if color is None or (color.camera is None and color.choice != "none"):
        return recording
    if color.camera is None:
        return recording.with_color_camera(None)
    return recording.with_color_camera(
        ColorCamera.from_values(color.camera, "the record of the run")
    )


def sources_of(folder: RunFolder) -> tuple[Source, ...]:
    """The recordings that maps were made from, in order; CAMERA is the format of one that came live from a
    camera. Raises FileError where there is no record, or a damaged one.
    """
    record = read_record(folder.record)
    if (source := record.recording) is not None:
        return (*source.before, replace(source, before=()))
    seen = record.frames.used + len(record.frames.skipped_frames)
    return (Source(format=CAMERA, path="", start=0, end=None, every=1, frames=seen),)


def find_run(path: Path) -> Run | None:
    """The run of a results folder, or None for a file; raises FileError where there is neither."""
    if not path.exists():
        raise FileError(f"{path}: no such file or folder")
    return read_run(path) if path.is_dir() else None


def read_run(directory: str | Path) -> Run:
    """Read what `unifusion reconstruct` wrote beside its maps; raises FileError where that is
    missing or damaged.
    """
    folder = RunFolder(Path(directory))
    if not folder.record.exists():
        raise FileError(
            f"{directory}: holds no {folder.record.name}; give the results folder of `unifusion reconstruct`"
        )
    record = read_record(folder.record)
    source, frames = record.recording, record.frames
    if source is None:
        raise FileError(
            f"{folder.record}: does not say which recording the run was made from; only runs of `unifusion` do"
        )
    skipped = {each.frame for each in frames.skipped_frames}
    done = source.asked[
        : frames.used + len(skipped)
    ]  # the rest was never reached, if the run was stopped early
    used = tuple(i for i in done if i not in skipped)
    return Run(folder, source, used, record.tracking is not None)
