"""WindowStore: the windows of a run, in memory or in a file that grows, and where each lies now."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError
from ..files.atomic import file_error
from ..files.record_file import Record, RecordLog, pack, scan, unpack_record
from ..types import PinholeCamera
from .kept_cells import KeptCells, Levels
from .kept_window import KeptFeatures, KeptViews, KeptWindow

WINDOW, POSES = "window", "poses"  # kinds of records
DEPTH = "depth"  # the array of a record with the images of the views
WAITING = 8  # windows at most that wait to be compressed


@dataclass
class Kept:
    """One window: where it is stored, and where it lies in the maps."""

    frames: tuple[int, ...]  # places in the recording
    T_world_keyframe: NDArray[np.float64]  # (4, 4) where it was fused first
    T_keyframe_camera: NDArray[np.float64]  # (K, 4, 4) of its frames
    place: NDArray[np.float64] | None  # (4, 4) where it is fused now; None: it was taken out
    packed: Future[bytes] | None = None  # in memory
    record: Record | None = None  # in the file
    size: int = 0  # [bytes] compressed


class WindowStore:
    """Keeps windows by number, compressed: in memory, or, with a `path`, in that file.

    store = WindowStore(folder.windows)
    pipeline = Pipeline(config, keep=store)
    """

    def __init__(self, path: Path | None = None) -> None:
        self.path = path
        self.first = 0  # added to the places of frames of windows that come from now on
        self.windows: list[Kept] = []
        self._log = None if path is None else RecordLog(path)
        self._packer = ThreadPoolExecutor(1, "packs windows")
        self._stored = 0  # windows in the file
        for record in self._log.kept if self._log else ():
            self._read(record)
        self._stored = len(self.windows)

    @classmethod
    def open(cls, path: Path) -> WindowStore:
        """The store in a file, to read; raises FileError where there is none, or another one."""
        store = cls()
        store.path = path
        for record in scan(path):
            store._read(record)
        store._stored = len(store.windows)
        return store

    def __len__(self) -> int:
        return len(self.windows)

    def __call__(self, window: KeptWindow) -> None:
        """Keep a window that was fused where it lies, or nowhere if it is apart."""
        if self.first:
            window = replace(window, frames=tuple(self.first + i for i in window.frames))
        values, arrays = to_record(window)
        self.windows.append(
            Kept(
                window.frames,
                window.T_world_keyframe,
                window.views.T_keyframe_camera,
                None if window.apart else window.T_world_keyframe,
                self._packer.submit(pack, values, arrays),
            )
        )
        if len(self.windows) > WAITING and (late := self.windows[-WAITING].packed):
            late.result()
        self._spill()

    def __getitem__(self, number: int) -> KeptWindow:
        """A window by value; raises FileError where its file is gone or damaged."""
        kept = self.windows[number]
        if kept.record is not None:
            return from_record(kept.record.values, kept.record.read())
        assert kept.packed is not None
        return from_record(*unpack_record(kept.packed.result()))

    def views(self, number: int) -> KeptViews:
        """The depth images of a window alone; raises as reading all of it."""
        kept = self.windows[number]
        if kept.record is not None:
            return _views(kept.record.values, kept.record.read((DEPTH,)))
        assert kept.packed is not None
        return _views(*unpack_record(kept.packed.result(), (DEPTH,)))

    def place(self, places: Mapping[int, NDArray[np.float64] | None]) -> None:
        """Note where windows lie now, by number; None: they were taken out."""
        for number, T in places.items():
            self.windows[number].place = T
        if self._log is not None and places:
            self.save()
            listed = {str(n): None if T is None else T.tolist() for n, T in places.items()}
            self._log.append(pack({"kind": POSES, "places": listed}, {}))

    def resident(self) -> Iterator[int]:
        """Numbers of the windows that are in the maps."""
        return (n for n, kept in enumerate(self.windows) if kept.place is not None)

    @property
    def nbytes(self) -> int:
        """Bytes of all windows, compressed."""
        for kept in self.windows:
            if kept.packed is not None:
                kept.size = len(kept.packed.result())
        return sum(kept.size for kept in self.windows)

    def save(self) -> None:
        """Write all windows that are in memory alone to the file, if there is one."""
        self._spill(everything=True)

    def sync(self) -> None:
        """As `save`, and wait until it is on the disk."""
        self.save()
        if self._log is not None:
            self._log.sync()

    def close(self) -> None:
        """Write what is not written yet, and let go of the file."""
        self.save()
        self._packer.shutdown()
        if self._log is not None:
            self._log.close()
            self._log = None

    @property
    def file_size(self) -> int:
        """Bytes of the file, which is open."""
        return self._log.size if self._log is not None else 0

    def move(self, path: Path) -> None:
        """Go on in the same file at another place, on the same disk; raises FileError."""
        self.sync()
        if self._log is None or self.path is None:
            return
        self._log.close()
        try:
            self.path.replace(path)
        except OSError as error:
            self._log = RecordLog(self.path)
            raise file_error("write", path, error) from error
        self._log = RecordLog(path)
        self.moved_to(path)

    def moved_to(self, path: Path) -> None:
        """Note that the file, which is closed, has another name now."""
        self.path = path
        for kept in self.windows:
            if kept.record is not None:
                kept.record = replace(kept.record, path=path)

    def _spill(self, everything: bool = False) -> None:
        """Write windows that are packed, in order."""
        if self._log is None:
            return
        while self._stored < len(self.windows):
            kept = self.windows[self._stored]
            assert kept.packed is not None
            if not everything and not kept.packed.done():
                break
            packed = kept.packed.result()
            kept.record, kept.packed, kept.size = self._log.append(packed), None, len(packed)
            self._stored += 1

    def _read(self, record: Record) -> None:
        """Take over what a record of the file says."""
        values = record.values
        try:
            if values["kind"] == WINDOW:
                T = _pose(values["T_world_keyframe"])
                frames = tuple(int(n) for n in values["frames"])
                views = np.array(values["T_keyframe_camera"], np.float64).reshape(-1, 4, 4)
                size = record.size
                place = None if values.get("apart") else T
                self.windows.append(Kept(frames, T, views, place, None, record, size))
            elif values["kind"] == POSES:
                for number, T in values["places"].items():
                    kept = self.windows[int(number)]
                    at = None if T is None else _pose(T)
                    home = at is not None and np.array_equal(at, kept.T_world_keyframe)
                    kept.place = kept.T_world_keyframe if home else at
        except (KeyError, ValueError, TypeError, IndexError) as error:
            raise FileError(f"{record.path}: damaged ({error}); make the results again") from None


def _pose(values: Any) -> NDArray[np.float64]:
    return np.array(values, np.float64).reshape(4, 4)


def to_record(window: KeptWindow) -> tuple[dict[str, Any], dict[str, NDArray]]:
    """A window as JSON values and arrays."""
    arrays: dict[str, NDArray] = {DEPTH: window.views.depth}
    parts = [
        _put_cells(f"part{i}", names, cells, arrays)
        for i, (names, cells) in enumerate(window.cells.items())
    ]
    features = []
    for i, each in enumerate(window.features):
        arrays[f"feature{i}.numbers"], arrays[f"feature{i}.scales"] = each.numbers, each.scales
        features.append(
            {
                **_put_cells(f"feature{i}", (each.name,), each.cells, arrays),
                "camera": _camera_values(each.camera),
                "T_camera_world": each.T_camera_world.tolist(),
            }
        )
    values = {
        "kind": WINDOW,
        "frames": list(window.frames),
        "T_world_keyframe": window.T_world_keyframe.tolist(),
        "T_keyframe_camera": window.views.T_keyframe_camera.tolist(),
        "camera": _camera_values(window.views.camera),
        "lenses": window.views.lenses.tolist(),
        "parts": parts,
        "features": features,
        "apart": window.apart,
    }
    return values, arrays


def from_record(values: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> KeptWindow:
    """The window that `to_record` gave."""
    cells = {
        tuple(part["names"]): _get_cells(f"part{i}", part, arrays)
        for i, part in enumerate(values["parts"])
    }
    features = [
        KeptFeatures(
            each["names"][0],
            _get_cells(f"feature{i}", each, arrays),
            arrays[f"feature{i}.numbers"],
            arrays[f"feature{i}.scales"],
            PinholeCamera(*each["camera"]),
            _pose(each["T_camera_world"]),
        )
        for i, each in enumerate(values["features"])
    ]
    frames, T = tuple(values["frames"]), _pose(values["T_world_keyframe"])
    views = _views(values, arrays)
    return KeptWindow(frames, T, cells, views, features, bool(values.get("apart")))


def _views(values: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> KeptViews:
    T_keyframe_camera = np.array(values["T_keyframe_camera"], np.float64).reshape(-1, 4, 4)
    same = [[1.0, 1.0, 0.0, 0.0]] * len(T_keyframe_camera)  # results of before have one lens
    return KeptViews(
        arrays[DEPTH],
        PinholeCamera(*values["camera"]),
        T_keyframe_camera,
        np.array(values.get("lenses", same), np.float64).reshape(-1, 4),
    )


def _camera_values(camera: PinholeCamera) -> list[float]:
    return [camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy]


def _put_cells(
    at: str, names: Sequence[str], cells: KeptCells, arrays: dict[str, NDArray]
) -> dict[str, Any]:
    low = cells.keys.min(axis=0) if len(cells.keys) else np.zeros(3, np.int32)
    arrays[f"{at}.keys"] = (cells.keys - low).astype(np.uint16)
    arrays[f"{at}.frames"] = cells.frames
    arrays[f"{at}.masks"] = cells.masks
    arrays[f"{at}.counts"] = cells.counts
    for i, each in enumerate(cells.levels):
        arrays[f"{at}.values{i}"] = each.numbers
    scales = [[each.first.tolist(), each.step.tolist()] for each in cells.levels]
    return {
        "names": list(names),
        "low": low.tolist(),
        "exponents": list(cells.exponents),
        "scales": scales,
    }


def _get_cells(at: str, values: Mapping[str, Any], arrays: Mapping[str, NDArray]) -> KeptCells:
    keys = arrays[f"{at}.keys"].astype(np.int32) + np.array(values["low"], np.int32)
    levels = tuple(
        Levels(arrays[f"{at}.values{i}"], np.array(first, np.float32), np.array(step, np.float32))
        for i, (first, step) in enumerate(values["scales"])
    )
    return KeptCells(
        keys,
        arrays[f"{at}.frames"],
        arrays[f"{at}.masks"],
        arrays[f"{at}.counts"],
        levels,
        tuple(values["exponents"]),
    )
