"""Maps of several runs, each in a world of its own, as one in the world of the first: windows of the
others are fused where their cameras find their places.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..config import Config, load_config
from ..errors import FileError, InputError
from ..files.tiles import map_bytes
from ..geometry import se3
from ..maps import load_map
from ..maps.follower import GivenMaps, MapFollower
from ..maps.window_store import WindowStore
from ..tracking.joining import Joined, join
from ..tracking.keyframe_file import write_keyframes
from ..tracking.keyframes import Keyframes
from .keyframes import known_keyframes
from .reader import sources_of
from .record import MapRecord, read_record, write_record
from .reposing import read_windows
from .run_folder import RunFolder

SETTINGS = ("voxel_size", "surface", "color", "property_map", "feature_map", "properties")
TURN = 0.3  # [m] by which cameras count as apart that look a radian elsewhere


@dataclass(frozen=True, eq=False)
class Aligned:
    """A run that was added, and where it lies."""

    folder: RunFolder
    views: int
    windows: int
    joined: Joined


def check_same_maps(folders: list[RunFolder]) -> Config:
    """The settings that all runs share; raises InputError where their maps cannot be added up."""
    first = load_config(folders[0].config)
    for folder in folders:
        config = load_config(folder.config)
        if config.map_memory:
            raise InputError(
                f"merge: {folder.path} holds maps in tiles, which cannot be aligned yet"
            )
        for name in SETTINGS:
            if getattr(config, name) != getattr(first, name):
                raise InputError(
                    f"merge: {folders[0].path} and {folder.path} hold maps of other settings ({name}), which "
                    "cannot be added up"
                )
    return first


def align(
    folders: list[RunFolder], out: RunFolder, config: Config
) -> tuple[GivenMaps, list[Aligned]]:
    """The maps of all runs in the world of the first; windows and keyframes are kept in `out`, under
    names for the time being. Raises NoOverlap where a camera does not find its place.
    """
    kept = [read_windows(folder) for folder in folders]
    maps = GivenMaps(load_map(path) for path in folders[0].maps.values())
    store = continued(folders[0].windows, out)
    follower, known, added = MapFollower(maps, store), known_keyframes(folders[0]), []
    for folder, windows in zip(folders[1:], kept[1:], strict=True):
        new = known_keyframes(folder)
        joined = join(known, new, config.tracking.photometric_weight)
        for number in windows.resident():
            place = windows.windows[number].place
            assert place is not None
            follower.add(windows[number], _moved(place, new, joined))
        store.first = next_frame(store)
        added.append(Aligned(folder, len(new), len(windows), joined))
        for keyframe, T in zip(new.items, joined.T_known_keyframe, strict=True):
            known.append(keyframe, T)
    follower.settle()
    store.sync()
    store.close()
    write_keyframes(out.new_keyframes, known)
    return maps, added


def record_all(
    folders: list[RunFolder], out: RunFolder, maps: GivenMaps, added: list[Aligned]
) -> None:
    """Write the record of the merged map: that of the first run, with the others' recordings."""
    record = read_record(out.record)
    others = [source for folder in folders[1:] for source in sources_of(folder)]
    first = record.recording  # None: of a camera
    sizes = {
        name: MapRecord(
            each.voxel_size, len(each.grid), each.memory_bytes, map_bytes(out.map(name))
        )
        for name, each in maps.maps.items()
    }
    files = dict.fromkeys([*record.files, out.relative(out.windows), out.relative(out.keyframes)])
    write_record(
        out.record,
        replace(
            record,
            recording=first and replace(first, before=(*first.before, *others)),
            tracking={**(record.tracking or {"mode": "given"}), "merged": list(map(_said, added))},
            maps=sizes,
            files={name: (out.path / name).stat().st_size for name in files},
        ),
    )


def _said(aligned: Aligned) -> dict[str, Any]:
    return {
        "folder": str(aligned.folder.path),
        "recognised": aligned.joined.matched,
        "aligned": aligned.joined.aligned,
        "T_first": aligned.joined.T_known_new.tolist(),
    }


def continued(known: Path, out: RunFolder) -> WindowStore:
    """The windows of a map under a name for the time being, to which those of another recording are
    added: its frames are counted on. Raises FileError.
    """
    try:
        shutil.copyfile(known, out.new_windows)
    except OSError as error:
        raise FileError(f"{out.new_windows}: cannot be written: {error}") from None
    store = WindowStore(out.new_windows)
    store.first = next_frame(store)
    return store


def next_frame(store: WindowStore) -> int:
    """From where on frames of another recording are counted."""
    return 1 + max((max(kept.frames) for kept in store.windows), default=-1)


def _moved(place: NDArray[np.float64], new: Keyframes, joined: Joined) -> NDArray[np.float64]:
    """Where a window belongs that lies at `place`: it moves with the nearest keyframe."""
    T = np.array(new.T_world_keyframe)
    apart = [d + TURN * angle for d, angle in (se3.distance(place, each) for each in T)]
    nearest = int(np.argmin(apart))
    motion = joined.T_known_keyframe[nearest] @ se3.inverse(T[nearest])
    return se3.normalized(motion @ place)
