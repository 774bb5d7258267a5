"""What the doctor is worth: every recording x every way to spoil it, and which cause it names.

    python benchmarks/doctor.py PATH/data
    python benchmarks/doctor.py PATH/data --cache FOLDER --rows clock focal --only house
    python benchmarks/doctor.py PATH/data --held-out    other recordings, spoiled in other ways

`PATH/data` holds the shared recordings; what is not there is left out. Printed is a row for each
spoiling: in how many recordings the right cause was named, in how many nothing at all was said, and in
how many a wrong cause was named, alone or too. A spoiling that changes nothing in a recording (poses of
one that has none, frames out of order where the camera hardly moves) is not counted there.
`--cache` keeps the frames of each recording in a file, so that they are rendered once.
"""

from __future__ import annotations

import argparse
import pickle
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import yaml
from doctor_spoilings import HELD_OUT, SPOILINGS, Frames, Spoiling

from taichi_unifusion.datasets import Dataset, open_dataset
from taichi_unifusion.datasets.doctor import Diagnosis, examine
from taichi_unifusion.datasets.pose_fit import has_moved
from taichi_unifusion.errors import UniFusionError
from taichi_unifusion.geometry.quaternions import rotation_to_quaternion
from taichi_unifusion.types import Frame, PinholeCamera

MOST = 24  # frames of a recording
FEW = 6  # of one that is written to files


class InMemory(Dataset):
    """Frames as a recording whose depth images have `depth_scale` units a metre."""

    def __init__(self, frames: Sequence[Frame], depth_scale: float = 1000.0) -> None:
        self.name, self.frames, self.depth_scale = "spoiled", list(frames), depth_scale

    def __len__(self) -> int:
        return len(self.frames)

    def load(self, index: int) -> Frame:
        return replace(self.frames[index], index=index)

    def pose_at(self, index: int) -> tuple[float | None, np.ndarray | None]:
        return self.frames[index].timestamp, self.frames[index].T_world_camera


ON_DISK = {"numbered images": "time-stamps", "nanoseconds": "time-stamps"}


@dataclass(frozen=True)
class Row:
    """What is said of one recording: causes named of it unspoiled, and for every spoiling whether the
    right cause was named (alone, as one of two that cannot be told apart, or not) and which others.
    """

    name: str
    plain: frozenset[str] = frozenset()
    found: Mapping[str, Cell] = field(default_factory=dict)


Cell = tuple[str, frozenset[str]]  # right, one of two, silent or wrong; and wrong causes


# Recordings


def recordings(data: Path) -> Iterator[tuple[str, Callable[[], Frames]]]:
    """Name and frames of every recording that is there."""
    for seed, start in ((0, 0), (1, 80), (2, 160)):
        yield (
            f"synthetic {seed}",
            lambda seed=seed, start=start: _some(
                open_dataset("synthetic", frames=240, width=320, height=240, seed=seed), start, 2
            ),
        )
    yield (
        "synthetic exact",
        lambda: _some(
            open_dataset("synthetic", frames=120, width=320, height=240, noise=False), 20, 1
        ),
    )
    kitchen = data / "7scenes-redkitchen"
    for name, start, step in (("0", 0, 4), ("150", 150, 4), ("300", 300, 1)):
        yield (
            f"kitchen {name}",
            lambda start=start, step=step: _some(open_dataset("7scenes", kitchen), start, step),
        )
    yield "desk", lambda: list(open_dataset("tum", data / "tum-fr1desk9"))
    yield "office0", lambda: list(open_dataset("replica", data / "replica-office0"))
    yield "k4a", lambda: list(open_dataset("k4a", data / "k4a-infrared" / "recording.mkv"))
    from house import PATHS

    for path in PATHS:
        for third in range(3):
            yield f"house {path} {third}", lambda path=path, third=third: _house(data, path, third)
    for format, place in SAMPLES.items():
        yield (
            format,
            lambda format=format, place=place: list(
                open_dataset(format.partition(" ")[0], data / "formats" / place)
            ),
        )


def held_out(data: Path) -> Iterator[tuple[str, Callable[[], Frames]]]:
    """Stretches of twenty frames that `recordings` has none of, and two of its formats."""
    kitchen = data / "7scenes-redkitchen"
    for start, step in ((0, 1), (110, 2), (240, 2)):
        yield (
            f"kitchen, 20 from {start}",
            lambda start=start, step=step: list(
                open_dataset("7scenes", kitchen)[start : start + 20 * step : step]
            ),
        )
    yield (
        "synthetic, 20 from 40",
        lambda: list(open_dataset("synthetic", frames=200, width=320, height=240, seed=9)[40:60]),
    )
    for path, start in (("living", 30), ("tour", 440), ("bedroom", 60)):
        yield (
            f"house {path}, 20 from {start}",
            lambda path=path, start=start: _part_of_house(data, path, slice(start, start + 20), 5),
        )
    for format in ("polycam", "rosbag mcap"):
        yield (
            f"{format} again",
            lambda format=format: list(
                open_dataset(format.partition(" ")[0], data / "formats" / SAMPLES[format])
            ),
        )


SAMPLES = {
    "record3d": "record3d-r3d/doorhandle8.r3d",
    "record3d exr": "record3d-exr/EXR_RGBD",
    "strayscanner": "stray-scanner",
    "polycam": "polycam-raw",
    "nerfstudio": "nerfstudio-depth",
    "rosbag 1": "ros1-bag/tum3.bag",
    "rosbag db3": "ros2-db3/tum3",
    "rosbag mcap": "ros2-mcap/tum3",
    "realsense": "realsense-bag/software_device.db3",
}


def _some(recording: Dataset, start: int, step: int) -> Frames:
    return list(recording[start : start + MOST * step : step])


def _house(data: Path, path: str, third: int) -> Frames:
    from house import trajectory

    start = third * len(trajectory(path)) // 3
    return _part_of_house(data, path, slice(start, start + MOST), third)


def _part_of_house(data: Path, path: str, part: slice, seed: int) -> Frames:
    from house import trajectory

    from taichi_unifusion.types import Trajectory

    whole = trajectory(path)
    recording = open_dataset(
        "scene",
        data / "aws-small-house" / "house.glb",
        trajectory=Trajectory(whole.timestamps[part], whole.T_world_camera[part]),
        camera=PinholeCamera(320, 240, 287.5, 287.5, 159.5, 119.5),
        seed=seed,
    )
    return list(recording)


def timed(frames: Frames) -> Frames:
    """The frames with time stamps, those of 30 Hz where they have none."""
    if all(f.timestamp is not None for f in frames):
        return frames
    return [replace(f, timestamp=i / 30) for i, f in enumerate(frames)]


# The matrix


def applies(spoiling: Spoiling, frames: Frames) -> bool:
    """Whether the spoiling changes something that frames can show."""
    posed = [f for f in frames if f.T_world_camera is not None]
    if len(posed) < spoiling.poses:
        return False
    if spoiling.cause in ("color", "exposure") and any(f.color is None for f in frames):
        return False
    if spoiling.moving and (
        len(posed) < 2 or not has_moved(posed[0], posed[-1], (0.1, np.radians(5)))
    ):
        return False
    return spoiling.poses == 0 or len(posed) == len(frames)


def examined(frames: Frames, depth_scale: float = 1000.0) -> Diagnosis:
    return examine(InMemory(frames, depth_scale))


def causes(diagnosis: Diagnosis) -> set[str]:
    """What it says is wrong; of causes that it cannot tell apart the first."""
    return {finding.cause for finding in diagnosis.findings if finding.wrong}


def verdict(diagnosis: Diagnosis, cause: str, plain: frozenset[str]) -> Cell:
    """Whether the right cause was named, and which others, but those that are named anyhow."""
    right = [f for f in diagnosis.findings if cause in (f.cause, *f.rivals)]
    others = {f.cause for f in diagnosis.findings if f.wrong and f not in right} - plain
    alone = any(not f.rivals for f in right)
    return (
        "right" if alone else "one of two" if right else "wrong" if others else "silent",
        frozenset(others),
    )


def write_numbered(
    folder: Path, frames: Frames, stamps: Sequence[str], names: Sequence[str]
) -> Path:
    """A folder recording of a few frames, with rows that begin with the stamps."""
    (folder / "depth").mkdir(parents=True)
    camera = frames[0].camera
    keys = ("width", "height", "fx", "fy", "cx", "cy")
    values = {key: float(getattr(camera, key)) for key in keys}
    (folder / "camera.yaml").write_text(yaml.safe_dump(values))
    rows = []
    for f, stamp, name in zip(frames, stamps, names, strict=True):
        units = np.clip(np.nan_to_num(f.depth) * 1000, 0, 65534).astype(np.uint16)
        cv2.imwrite(str(folder / "depth" / f"{name}.png"), units)
        T = f.require_pose()
        numbers = [*T[:3, 3], *rotation_to_quaternion(T[None, :3, :3])[0]]
        rows.append(" ".join([stamp, *(repr(float(n)) for n in numbers)]))
    (folder / "poses.txt").write_text("\n".join(rows))
    return folder


def on_disk(name: str, frames: Frames) -> set[str]:
    """What is said of a recording whose time stamps are odd, noted or wrong."""
    few = frames[:FEW]
    seconds = [f"{i / 5:.3f}" for i in range(len(few))]
    nano = [str(1_763_000_000_000_000_000 + 33_333_333 * i) for i in range(len(few))]
    stamps, names = (
        (seconds, [f"{i:06d}" for i in range(len(few))]) if "numbered" in name else (nano, nano)
    )
    with tempfile.TemporaryDirectory() as folder:
        path = write_numbered(Path(folder) / "r", few, stamps, names)
        return {finding.cause for finding in examine(open_dataset("folder", path)).findings}


def frames_of(name: str, data: Path, cache: Path | None) -> Frames:
    """The frames of a recording, from the cache where they are in it; raises what reading does."""
    kept = cache / f"{name.replace(' ', '_')}.pickle" if cache else None
    if kept is not None and kept.exists():
        return pickle.loads(kept.read_bytes())  # ours
    frames = timed(dict([*recordings(data), *held_out(data)])[name]())
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps(frames))
    return frames


def row_of(name: str, data: Path, cache: Path | None, titles: Sequence[str]) -> Row:
    """What is said of one recording, spoiled in the ways of `titles`."""
    try:
        frames = frames_of(name, data, cache)
    except (UniFusionError, ImportError, OSError) as error:
        print(f"{name}: left out ({error})", file=sys.stderr, flush=True)
        return Row(name)
    plain = frozenset(causes(examined(frames)))
    found: dict[str, Cell] = {}
    for title in titles:
        spoiling = (SPOILINGS | HELD_OUT).get(title)
        if spoiling is None or not applies(spoiling, frames):
            continue
        diagnosis = examined(spoiling.change(frames), spoiling.depth_scale)
        found[title] = verdict(diagnosis, spoiling.cause, plain)
    posed = [f for f in frames if f.T_world_camera is not None]
    for title in (title for title in titles if title in ON_DISK):
        if len(posed) == len(frames) >= 4 and len({f.camera for f in frames}) == 1:
            right = ON_DISK[title] in on_disk(title, frames)
            found[title] = "right" if right else "silent", frozenset()
    return Row(name, plain, found)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="*", default=[""], help="recordings whose name begins so")
    parser.add_argument("--rows", nargs="*", default=[""], help="spoilings whose name begins so")
    parser.add_argument("--cache", type=Path, help="folder that keeps the recordings' frames")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--held-out", action="store_true", help="what the doctor was not made on")
    options = parser.parse_args()
    known = held_out if options.held_out else recordings
    ways = HELD_OUT if options.held_out else (*SPOILINGS, *ON_DISK)
    names = [n for n, _ in known(options.data) if n.startswith(tuple(options.only))]
    titles = [t for t in ways if t.startswith(tuple(options.rows))]
    started = time.perf_counter()
    rows = []
    task = partial(row_of, data=options.data, cache=options.cache, titles=titles)
    with get_context("spawn").Pool(options.processes, maxtasksperchild=1) as pool:
        for row in pool.imap(task, names):
            rows.append(row)
            show(row)
    summarize([row for row in rows if row.found])
    print(f"{time.perf_counter() - started:.0f} s")


def show(row: Row) -> None:
    """What went wrong in one recording."""
    missed = [title for title, (said, _) in row.found.items() if said in ("silent", "wrong")]
    others = {title: sorted(wrong) for title, (_, wrong) in row.found.items() if wrong}
    plain = sorted(row.plain) or "sound"
    print(f"{row.name}: unspoiled {plain}; missed {missed}; wrong {others}", flush=True)


def summarize(rows: Sequence[Row]) -> None:
    """The matrix: a row for every spoiling."""
    print("\n| spoiled by | recordings | right | of these one of two | silent | a wrong cause |")
    print("|---|---|---|---|---|---|")
    total = np.zeros(5, int)
    for title in (*SPOILINGS, *ON_DISK, *HELD_OUT):
        cells = [row.found[title] for row in rows if title in row.found]
        if not cells:
            continue
        said = [said for said, _ in cells]
        both, wrong = said.count("one of two"), sum(bool(others) for _, others in cells)
        counts = [len(cells), said.count("right") + both, both, said.count("silent"), wrong]
        total += counts
        print(f"| {title} | {' | '.join(map(str, counts))} |")
    shares = [f"{count} ({count / max(1, total[0]):.1%})" for count in total[1:]]
    print(f"| **all** | {total[0]} | {' | '.join(shares)} |")
    said = {row.name: sorted(row.plain) for row in rows if row.plain}
    print(f"| nothing | {len(rows)} | {len(rows) - len(said)} | | | {said or 0} |")


if __name__ == "__main__":
    main()
