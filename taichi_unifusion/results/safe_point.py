"""Safe points of a run: what another process needs to go on with it and end with the same map.

They lie in a folder of their own inside the results folder:

    state.json              names the generation that counts; replaced at once, after all else is there
    generation-N/           the maps between two windows, when all frames so far are in them, and the
                            settings with what was chosen by the first frames
    steps.jsonl             a line a frame, appended; `journal_bytes` of the state are valid
    windows.log             what maps that can follow a loop were fused from; generation-N/*.sums: exact sums
    tracking.json           the poses that a tracker found, once it was through
    placement.json          where a recording lies in the map that it is added to; keyframes.log: of both

A process that is killed while it saves leaves files that no state names; the next one removes them.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml

from ..config import Config, load_config
from ..errors import FileError, InputError
from ..files.atomic import file_error, read_bytes, write_text
from ..files.tiles import TileFolder
from ..maps import BaseMap, Integration, PropertyMap, SurfaceMap, load_map
from ..maps.tiled_mesh import joined_mesh
from ..pipeline import extract_mesh
from ..run_log import RunSoFar, SkippedFrame, StepResult
from ..tracking import TrackedFrame, TrackingResult, Verdict
from ..types import Mesh
from .record import Source, decoded
from .run_folder import RunFolder
from .safe_windows import StoredWindows, fuse_waiting, restore_sums
from .tiled import open_memory

logger = logging.getLogger(__name__)

T = TypeVar("T")

VERSION = 1


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What decides which map a run ends with: one that goes on must have the same."""

    config: str  # all settings, as YAML
    recording: Source
    poses: Mapping[str, Any]  # where they come from
    color_camera: str  # as asked for
    features: str  # what makes them, "" where nothing does


@dataclass(frozen=True, kw_only=True)
class State:
    """What `state.json` holds."""

    version: int
    generation: int
    recipe: Recipe
    recording: Source  # with the colour camera that was found
    tracking: Mapping[str, Any] | None  # what the tracker said, for the record
    done: int  # frames tried
    maps: tuple[str, ...]
    journal_bytes: int
    borders: tuple[int, int]  # of WindowFusion
    warnings: tuple[str, ...]
    seconds: float
    scale_checked: bool
    poses_judged: bool
    doubts: tuple[str, ...]
    readings: tuple[int, ...]
    windows: StoredWindows | None = None  # of a run that keeps them


def read_state(folder: RunFolder) -> State | None:
    """The state of the last safe point; None where there is none. Raises FileError where it is
    damaged, or of a newer version.
    """
    if not folder.state.exists():
        return None
    try:
        values = json.loads(read_bytes(folder.state))
        if (
            isinstance(values, dict)
            and isinstance(values.get("version"), int)
            and values["version"] > VERSION
        ):
            raise FileError(
                f"{folder.state}: a safe point of version {values['version']}, this program reads version "
                f"{VERSION}; update taichi_unifusion"
            )
        return decoded(State, values)
    except (ValueError, RecursionError) as error:
        raise FileError(
            f"{folder.state}: not a safe point, or a damaged one ({error}); run without --resume"
        ) from None


def read_maps(folder: RunFolder, state: State) -> dict[str, BaseMap]:
    """The maps of a safe point; Taichi must run. Raises FileError, MapCorrupt."""
    there = folder.generation(state.generation)
    maps = {name: load_map(folder.map_in(there, name)) for name in state.maps}
    restore_sums(folder, there, maps)
    return maps


def restore_tiles(folder: RunFolder, state: State) -> bool:
    """Lay out the maps of a safe point where a run keeps its tiles, if they are in tiles; whether they
    are. Raises FileError, MapCorrupt.
    """
    there = folder.generation(state.generation)
    shutil.rmtree(folder.working_tiles, ignore_errors=True)
    found = [name for name in state.maps if TileFolder.is_one(folder.tiles_in(there, name))]
    for name in found:
        TileFolder.open(folder.tiles_in(there, name)).snapshot(folder.working_tiles / name)
    return bool(found)


def read_settings(folder: RunFolder, state: State) -> Config:
    """The settings of a safe point, nothing of which is left to choose; raises FileError."""
    return load_config(folder.config_in(folder.generation(state.generation)))


def read_so_far(folder: RunFolder, state: State) -> RunSoFar:
    """What the run did until a safe point; raises FileError."""
    steps, skipped, stamps, poses = [], [], [], []
    lines = read_bytes(folder.journal)[: state.journal_bytes].splitlines()
    try:
        for values in map(json.loads, lines):
            if "message" in values:
                skipped.append(SkippedFrame(**values))
                continue
            stamps.append(values.pop("timestamp"))
            poses.append(np.array(values.pop("T_world_camera"), np.float64).reshape(4, 4))
            done = values.pop("integrations")
            steps.append(
                StepResult(**values, integrations={k: Integration(*v) for k, v in done.items()})
            )
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise FileError(
            f"{folder.journal}: a damaged file ({error}); run without --resume"
        ) from None
    return RunSoFar(
        state.done,
        tuple(steps),
        tuple(skipped),
        tuple(stamps),
        tuple(poses),
        state.warnings,
        state.seconds,
        state.scale_checked,
        state.poses_judged,
        state.doubts,
        state.readings,
    )


def write_tracking_state(folder: RunFolder, recipe: Recipe, result: TrackingResult) -> None:
    """Keep what a tracker found; raises FileError."""
    frames = [
        {
            **asdict(replace(frame, T_world_camera=None)),
            "T_world_camera": None if (T := frame.T_world_camera) is None else T.ravel().tolist(),
        }
        for frame in result.frames
    ]
    values = {
        "version": VERSION,
        "recipe": asdict(recipe),
        "frames": frames,
        "keyframes": result.keyframes,
        "loops": result.loops,
        "details": dict(result.details),
    }
    write_text(folder.tracking_state, json.dumps(values) + "\n")


def read_tracking(folder: RunFolder, recipe: Recipe) -> TrackingResult | None:
    """What the tracker of a run found that is to go on; None where it was not through. Raises
    InputError where the run had other settings, FileError where the file is damaged.
    """

    def parse(values: Mapping[str, Any]) -> TrackingResult:
        frames = tuple(_tracked_frame(frame) for frame in values["frames"])
        keyframes, loops = values["keyframes"], [tuple(pair) for pair in values["loops"]]
        return TrackingResult(frames, tuple(keyframes), tuple(loops), values["details"])

    return read_for(recipe, folder.tracking_state, parse)


def read_for(recipe: Recipe, file: Path, parse: Callable[[Mapping[str, Any]], T]) -> T | None:
    """What `parse` makes of a JSON file that was written by a run with this recipe; None where there is
    none. Raises InputError where that run had other settings, FileError where the file is damaged.
    """
    if not file.exists():
        return None
    try:
        values = json.loads(read_bytes(file))
        theirs, found = decoded(Recipe, values["recipe"]), parse(values)
    except (ValueError, TypeError, KeyError, RecursionError) as error:
        raise FileError(f"{file}: a damaged file ({error}); run without --resume") from None
    check_same(recipe, theirs)
    return found


def _tracked_frame(values: dict[str, Any]) -> TrackedFrame:
    T = values["T_world_camera"]
    pose = None if T is None else np.array(T, np.float64).reshape(4, 4)
    return TrackedFrame(**{**values, "T_world_camera": pose, "verdict": Verdict(values["verdict"])})


def mesh_of_safe_point(folder: RunFolder) -> Mesh | None:
    """The mesh of the last safe point of a run that is not done; None where there is none. Starts
    Taichi where it does not run yet.
    """
    state = read_state(folder)
    if state is None:
        return None
    logger.info(
        "%s: not done: %d of %d frames", folder.path, state.done, state.recipe.recording.frames
    )
    config, there = read_settings(folder, state), folder.generation(state.generation)
    paths = {name: folder.tiles_in(there, name) for name in state.maps}
    if (memory := open_memory(paths)) is not None:
        return joined_mesh(memory, config.mesh.resolution, config.mesh.min_area)
    maps = read_maps(folder, state)
    if state.windows is not None:
        fuse_waiting(folder, maps)
    surface = maps["surface"]
    assert isinstance(surface, SurfaceMap)
    shown = {name: each for name, each in maps.items() if isinstance(each, PropertyMap)}
    return extract_mesh(surface, shown, config.mesh.resolution, config.mesh.min_area)


def check_same(ours: Recipe, theirs: Recipe) -> None:
    """Raise InputError that names the first difference between the recipes of this run and of one
    that is to go on.
    """
    mine, other = _flat(ours), _flat(theirs)
    for name in (*mine, *(name for name in other if name not in mine)):
        if mine.get(name) != other.get(name):
            raise InputError(
                f"resume: {name} is {_shown(mine.get(name))}, and {_shown(other.get(name))} in the run that "
                "is to go on; give the same, or leave out --resume to begin anew"
            )


def _flat(recipe: Recipe) -> dict[str, Any]:
    """Every setting by its name with dots."""
    values = json.loads(json.dumps(asdict(replace(recipe, config="")), default=str))
    found: dict[str, Any] = {}

    def walk(value: Any, name: str) -> None:
        if isinstance(value, dict):
            for key, inner in value.items():
                walk(inner, f"{name}.{key}".lstrip("."))
        else:
            found[name] = value

    walk(yaml.safe_load(recipe.config), "")
    walk({name: value for name, value in values.items() if name != "config"}, "")
    return found


def _shown(value: Any) -> str:
    return "not given" if value in (None, "") else str(value)[:80]


def remove_safe_point(folder: RunFolder, but: Path | None = None) -> None:
    """Remove what safe points left, and nothing else; one unfinished file may be left out."""
    with suppress(OSError):
        folder.state.unlink()
    keep_generation(folder, None)
    own = (folder.journal, folder.tracking_state, folder.placement, folder.placed_keyframes)
    for file in (*own, folder.safe_windows):
        with suppress(OSError):
            file.unlink()
    remove_temporaries(folder, but)
    with suppress(OSError):
        folder.unfinished.rmdir()


def remove_temporaries(folder: RunFolder, but: Path | None = None) -> None:
    """Remove the unfinished files that a process leaves which is ended at once, `but` one."""
    for path in {*folder.temporaries} - {but}:
        with suppress(OSError):
            path.unlink()


def keep_generation(folder: RunFolder, number: int | None) -> None:
    """Remove all generations but one."""
    for other in folder.generations:
        if number is None or other != folder.generation(number):
            shutil.rmtree(other, ignore_errors=True)


def lines_of(so_far: RunSoFar, steps: int, skipped: int) -> Iterable[str]:
    """The lines of the journal after so many steps and skipped frames."""
    for i, step in enumerate(so_far.steps[steps:], steps):
        yield json.dumps(
            {
                "index": step.index,
                "name": step.name,
                "points": step.points,
                "integrations": {
                    name: [each.points, each.voxels, each.total_voxels]
                    for name, each in step.integrations.items()
                },
                "milliseconds": dict(step.milliseconds),
                "lacking": dict(step.lacking),
                "timestamp": so_far.timestamps[i],
                "T_world_camera": so_far.T_world_camera[i].ravel().tolist(),
            }
        )
    for frame in so_far.skipped[skipped:]:
        yield json.dumps(asdict(frame))


def append(path: Path, at: int, text: str) -> int:
    """Write text at a place of a file and cut off what is behind it; returns the file's size, which
    is then on the disk. Raises FileError.
    """
    data = text.encode()
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            os.ftruncate(descriptor, at)
            written = 0
            while written < len(data):
                written += os.pwrite(descriptor, data[written:], at + written)
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        raise file_error("write", path, error) from error
    return at + len(data)


def write_state(folder: RunFolder, state: State) -> None:
    """Let a safe point count; raises FileError."""
    write_text(folder.state, json.dumps(asdict(state)) + "\n")


def now() -> float:
    """Seconds by a clock that nobody sets."""
    return time.monotonic()
