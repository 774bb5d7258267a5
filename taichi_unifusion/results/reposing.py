"""A finished map at other poses, without its images: its windows are fused again where a trajectory
says that they belong.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError
from ..evaluation.trajectory import align_poses
from ..geometry.se3 import distance, inverse, normalized
from ..geometry.time_stamps import nearest
from ..maps import load_map
from ..maps.follower import GivenMaps, MapFollower
from ..maps.kept_window import placed
from ..maps.window_store import WindowStore
from ..tracking.trajectory_files import read_poses
from ..types import Trajectory
from .reader import read_run
from .record import read_record, write_record
from .run_folder import RunFolder

MAX_DIFFERENCE = 0.02  # [s] between a frame and its new pose


@dataclass(frozen=True)
class NewPoses:
    """Where the frames of a run belong, by place in the recording."""

    by_frame: Mapping[int, NDArray[np.float64]]  # every frame of the run
    given: int  # frames that the trajectory has a pose for; others move as the nearest that has
    trajectory: Trajectory  # of the frames used
    T_new_old: NDArray[np.float64]  # (4, 4) of worlds, in the mean
    file: Path  # that says so


@dataclass(frozen=True)
class Reposed:
    """What moved."""

    windows: int
    moved: int  # by more than the least that counts
    farthest: float  # [m]
    median: float  # [m]


def read_windows(folder: RunFolder) -> WindowStore:
    """The windows of a run; raises FileError where they were not kept."""
    if not folder.windows.exists():
        raise FileError(
            f"{folder.path}: holds no {folder.windows.name}, so what the map was fused from is gone; make the "
            "map again with --keep-windows"
        )
    store = WindowStore.open(folder.windows)
    if not len(store):
        raise FileError(f"{folder.windows}: holds no window; make the map again")
    return store


def read_new_poses(folder: RunFolder, file: Path) -> NewPoses:
    """The poses of a file for the frames of a run: by time stamp, or by number of the frame.

    Raises InputError where it has none for any of them, DatasetError or FileError where it cannot
    be read.
    """
    run, found = read_run(folder.path), read_poses(file)
    if run.source.before:
        raise InputError(
            f"{folder.path}: holds {1 + len(run.source.before)} recordings; move the map of each, before they are added"
        )
    before = run.trajectory()
    frames = np.array(run.used)
    keys = before.timestamps if found.by_time else frames.astype(np.float64)
    rows = nearest(found.keys, keys)
    apart = np.abs(found.keys[rows] - keys)
    known = apart <= (MAX_DIFFERENCE if found.by_time else 0.0)
    if not known.any():
        span = [f"{each[0]:.12g} to {each[-1]:.12g}" for each in (found.keys, keys)]
        raise InputError(
            f"{file}: has no pose of any of the {len(frames)} frames of {folder.path}; its "
            f"{'time stamps' if found.by_time else 'numbers'} are {span[0]}, those of the run {span[1]}"
        )
    there = np.flatnonzero(known)
    source = there[nearest(keys[there], keys)]  # whose motion each frame shares
    motion = found.T_world_camera[rows[source]] @ inverse(before.T_world_camera[source])
    T = normalized(motion @ before.T_world_camera)
    T[known] = found.T_world_camera[rows[known]]
    by_frame = dict(zip(frames.tolist(), T, strict=True))
    return NewPoses(
        by_frame,
        int(known.sum()),
        Trajectory(before.timestamps, T),
        align_poses(before.T_world_camera, T),
        file,
    )


def record_reposed(folder: RunFolder, poses: NewPoses) -> None:
    """Say in the record of the run whose poses it has now, and which way is up among these."""
    record = read_record(folder.record)
    up = None if record.T_up_world is None else record.T_up_world @ inverse(poses.T_new_old)
    write_record(
        folder.record,
        replace(
            record,
            tracking={**(record.tracking or {"mode": "given"}), "reposed": str(poses.file)},
            T_up_world=None if up is None else tuple(map(tuple, up.tolist())),
            views=(),
        ),
    )


def repose(folder: RunFolder, windows: WindowStore, poses: NewPoses) -> tuple[GivenMaps, Reposed]:
    """The maps of a run with all windows at new poses; what they are fused from is kept in
    `folder.new_windows`.
    """
    folder.new_windows.unlink(missing_ok=True)
    maps = GivenMaps(load_map(path).emptied() for path in folder.maps.values())
    store = WindowStore(folder.new_windows)
    follower, moves = MapFollower(maps, store), []
    for number in windows.resident():
        kept = windows.windows[number]
        target = placed(kept.frames, kept.T_keyframe_camera, poses.by_frame)
        assert kept.place is not None
        target = kept.place if target is None else target
        follower.add(windows[number], target)
        moves.append(distance(kept.place, target)[0])
    follower.settle()
    store.sync()
    store.close()
    amount = np.array(moves or [0.0])
    return maps, Reposed(
        len(moves), int((amount > 1e-6).sum()), float(amount.max()), float(np.median(amount))
    )
