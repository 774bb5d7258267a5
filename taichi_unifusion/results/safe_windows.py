"""Windows in safe points: the file that a run adds them to, as far as it counts, and the exact sums of
maps that windows are taken out of again.

The file lies in the folder of safe points from the first of them on, and grows; bytes behind those that a
safe point counts are cut off by whoever goes on. Once a run is done it moves among the results.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..errors import FileError
from ..files.atomic import atomic_write, file_error
from ..files.maps import read_map, write_map
from ..maps import BaseMap
from ..maps.follower import GivenMaps, MapFollower
from ..maps.regression_map import RegressionGrid
from ..maps.window_store import WindowStore
from .run_folder import RunFolder


@dataclass(frozen=True, kw_only=True)
class StoredWindows:
    """How far the windows of a run were at a safe point."""

    bytes: int  # of their file
    waiting: int = 0  # windows that are fused when poses are final
    first: int  # added to the places of frames of its windows
    settled: bool  # as `MapFollower.settled`


def keep_windows(folder: RunFolder, follower: MapFollower) -> StoredWindows | None:
    """Let the windows of a run be on the disk, among its safe points; None where they are kept in memory.
    Raises FileError.
    """
    store = follower.store
    if store.path is None:
        return None
    if store.path == folder.safe_windows:
        store.sync()
    else:
        store.move(folder.safe_windows)
    waiting = len(store) - sum(1 for _ in store.resident())
    return StoredWindows(
        bytes=store.file_size, waiting=waiting, first=store.first, settled=follower.settled
    )


def windows_then(folder: RunFolder, then: StoredWindows) -> WindowStore:
    """The windows of a safe point, to go on with; raises FileError. A run that was ended while it wrote its
    results had moved them there already: these keep them.
    """
    path = folder.safe_windows
    try:
        if not path.exists() and folder.windows.exists():
            with atomic_write(path) as temporary:
                shutil.copyfile(folder.windows, temporary)
        if path.stat().st_size < then.bytes:
            raise FileError(f"{path}: damaged (it is cut off); run without --resume")
        os.truncate(path, then.bytes)
    except OSError as error:
        if isinstance(error, FileError):
            raise
        raise file_error("read", path, error) from error
    store = WindowStore(path)
    store.first = then.first
    return store


def fuse_waiting(folder: RunFolder, maps: Mapping[str, BaseMap]) -> None:
    """Fuse the windows of a run that is not done into its maps, where they lie as far as is known: those that
    wait for their final poses. Raises FileError.
    """
    path = folder.safe_windows if folder.safe_windows.exists() else folder.windows
    store = WindowStore.open(path)
    waiting = {
        n: kept.T_world_keyframe for n, kept in enumerate(store.windows) if kept.place is None
    }
    if waiting:
        follower = MapFollower(GivenMaps(maps.values()), store)
        follower.move_to(waiting)
        follower.finish(alone=len(waiting) == len(store))


def save_sums(folder: RunFolder, there: Path, maps: Mapping[str, BaseMap]) -> None:
    """Write the exact sums of maps that keep some to a generation; raises FileError."""
    for name, each in maps.items():
        grid = each.grid
        if isinstance(grid, RegressionGrid) and grid.steps:
            sums = {key: _as_bytes(rows) for key, rows in grid.exact_sums().items()}
            write_map(folder.sums_in(there, name), sums, {"steps": grid.steps})


def restore_sums(folder: RunFolder, there: Path, maps: Mapping[str, BaseMap]) -> None:
    """Let maps of a generation go on with their exact sums; raises FileError, MapCorrupt."""
    for name, each in maps.items():
        path = folder.sums_in(there, name)
        if not path.exists():
            continue
        sums, manifest = read_map(path)
        try:
            assert isinstance(each.grid, RegressionGrid)
            steps = float(manifest["steps"])
            each.grid.restore_sums(steps, {key: _as_counts(rows) for key, rows in sums.items()})
        except (AssertionError, KeyError, TypeError, ValueError) as error:
            raise FileError(f"{path}: damaged ({error}); run without --resume") from None


def _as_bytes(rows: np.ndarray) -> np.ndarray:
    """Counts of 16 bits as bytes, which map files hold."""
    return rows.view(np.uint8) if rows.dtype == np.uint16 else rows


def _as_counts(rows: np.ndarray) -> np.ndarray:
    return rows.view(np.uint16) if rows.dtype == np.uint8 else rows
