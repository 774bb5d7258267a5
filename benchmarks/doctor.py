"""What the doctor is worth: every recording x every way to spoil it, and which cause it names.

    python benchmarks/doctor.py PATH/data

`PATH/data` holds the shared recordings; what is not there is left out. Printed is a row for each
spoiling: in how many recordings the right cause was named, in how many a wrong one too. A
spoiling that changes nothing in a recording (poses of one that has none, frames out of order where the
camera hardly moves) is not counted there, and printed as "-".
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
import yaml

from taichi_unifusion.datasets import Dataset, open_dataset
from taichi_unifusion.datasets.doctor import Diagnosis, examine
from taichi_unifusion.datasets.mended import pose_at_time
from taichi_unifusion.datasets.pose_fit import has_moved
from taichi_unifusion.errors import UniFusionError
from taichi_unifusion.geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion
from taichi_unifusion.geometry.se3 import FLIP_YZ
from taichi_unifusion.types import Frame, PinholeCamera

MOST = 24  # frames of a recording
FEW = 6  # of one that is written to files
Frames = list[Frame]
Change = Callable[[Frames], Frames]


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


@dataclass(frozen=True)
class Spoiling:
    """A way to spoil a recording, and what is to be said then."""

    cause: str
    change: Change
    depth_scale: float = 1000.0  # that the recording would be read with
    poses: int = 2  # frames with poses that it needs
    moving: bool = False  # whether frames must look from different places


# Spoiling


def by_pose(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def spoil(frames: Frames) -> Frames:
        return [replace(f, T_world_camera=change(f.require_pose())) for f in frames]

    return spoil


def longer(factor: float) -> Change:
    def change(T: np.ndarray) -> np.ndarray:
        changed = T.copy()
        changed[:3, 3] *= factor
        return changed

    return by_pose(change)


def w_first(T: np.ndarray) -> np.ndarray:
    x, y, z, w = rotation_to_quaternion(T[None, :3, :3])[0]
    changed = T.copy()
    changed[:3, :3] = quaternion_to_rotation(np.array([[w, x, y, z]]))[0]
    return changed


def transposed(T: np.ndarray) -> np.ndarray:
    changed = T.copy()
    changed[:3, :3] = T[:3, :3].T
    return changed


def deeper(factor: float) -> Change:
    return lambda frames: [
        replace(f, depth=(f.depth * np.float32(factor)).astype(np.float32)) for f in frames
    ]


def resized(factor: float, centre: bool = True) -> Change:
    def spoil(frames: Frames) -> Frames:
        spoiled = []
        for f in frames:
            c, move = f.camera, factor if centre else 1.0
            numbers = (
                c.fx * factor,
                c.fy * factor,
                (c.cx + 0.5) * move - 0.5,
                (c.cy + 0.5) * move - 0.5,
            )
            spoiled.append(replace(f, camera=PinholeCamera(c.width, c.height, *numbers)))
        return spoiled

    return spoil


def later(seconds: float) -> Change:
    """Poses of another moment."""

    def spoil(frames: Frames) -> Frames:
        times = np.array([f.timestamp for f in frames], np.float64)
        poses = np.array([f.require_pose() for f in frames])
        found = [pose_at_time(times, poses, time + seconds) for time in times]
        return [
            replace(f, T_world_camera=T)
            for f, T in zip(frames, found, strict=True)
            if T is not None
        ]

    return spoil


def beside(right: float, down: float) -> Change:
    """Colour moved by so many pixels of images 640 wide."""

    def spoil(frames: Frames) -> Frames:
        spoiled = []
        for f in frames:
            wide = f.camera.width / 640
            moved = np.array([[1, 0, right * wide], [0, 1, down * wide]], np.float32)
            color = np.asarray(f.color, np.uint8)
            size = color.shape[1], color.shape[0]
            color = cv2.warpAffine(color, moved, size, borderMode=cv2.BORDER_REPLICATE)
            spoiled.append(replace(f, color=color))
        return spoiled

    return spoil


def far_plane(value: float) -> Change:
    """What is farthest, and what has no reading, as a number."""

    def spoil(frames: Frames) -> Frames:
        spoiled = []
        for f in frames:
            depth = f.depth.copy()
            depth[(depth == 0) | (depth > np.percentile(depth[depth > 0], 90))] = value
            spoiled.append(replace(f, depth=depth))
        return spoiled

    return spoil


def exchanged(frames: Frames) -> Frames:
    """Two frames in each other's place."""
    a, b = len(frames) // 4, 3 * len(frames) // 4
    spoiled = list(frames)
    spoiled[a] = replace(frames[a], depth=frames[b].depth, color=frames[b].color)
    spoiled[b] = replace(frames[b], depth=frames[a].depth, color=frames[a].color)
    return spoiled


def twice(frames: Frames) -> Frames:
    """Every picture twice."""
    return [
        replace(f, depth=frames[i - i % 2].depth, color=frames[i - i % 2].color)
        for i, f in enumerate(frames)
    ]


def brighter(frames: Frames) -> Frames:
    """A jump of exposure half-way."""
    half = len(frames) // 2
    return [
        f if i < half else replace(f, color=cv2.convertScaleAbs(np.asarray(f.color), alpha=1.6))
        for i, f in enumerate(frames)
    ]


def one_pose(frames: Frames) -> Frames:
    return [replace(f, T_world_camera=frames[0].T_world_camera) for f in frames]


SPOILINGS = {
    "depth_scale 200 for 1000": Spoiling("depth-scale", deeper(5), 200.0),
    "depth_scale 5000 for 1000": Spoiling("depth-scale", deeper(0.2), 5000.0),
    "depth_scale 500 for 1000": Spoiling("depth-scale", deeper(2), 500.0, moving=True),
    "depth_scale 1 for 1000": Spoiling("depth-scale", deeper(1000), 1.0, poses=0),
    "world to camera": Spoiling("pose-reading", by_pose(np.linalg.inv), moving=True),
    "OpenGL axes": Spoiling("pose-reading", by_pose(lambda T: T @ FLIP_YZ), moving=True),
    "w first": Spoiling("pose-reading", by_pose(w_first), moving=True),
    "transposed": Spoiling("pose-reading", by_pose(transposed), moving=True),
    "centimetres": Spoiling("pose-scale", longer(100)),
    "millimetres": Spoiling("pose-scale", longer(1000)),
    "times 0.37": Spoiling("pose-scale", longer(0.37), moving=True),
    "times 3": Spoiling("pose-scale", longer(3), moving=True),
    "clock 0.2 s late": Spoiling("clock-offset", later(0.2), poses=20, moving=True),
    "clock 0.3 s early": Spoiling("clock-offset", later(-0.3), poses=20, moving=True),
    "intrinsics of half the size": Spoiling("intrinsics", resized(0.5), poses=0),
    "intrinsics of 1.5 times": Spoiling("intrinsics", resized(1.5), poses=0),
    "focal length times 1.4": Spoiling("intrinsics", resized(1.4, False), moving=True),
    "colour beside depth": Spoiling("color", beside(-14, 8), poses=0),
    "far plane 1e10": Spoiling("far-plane", far_plane(1e10), poses=0),
    "far plane 65504": Spoiling("far-plane", far_plane(65504.0), poses=0),
    "far plane 65.535 m": Spoiling("far-plane", far_plane(65.535), poses=0),
    "far plane 100 m": Spoiling("far-plane", far_plane(100.0), poses=0),
    "one pose for all": Spoiling("still", one_pose, poses=4, moving=True),
    "every picture twice": Spoiling("repeated", twice, poses=4),
    "two frames exchanged": Spoiling("swapped", exchanged, poses=8, moving=True),
    "jump of exposure": Spoiling("exposure", brighter, poses=4),
}
ON_DISK = {"numbered images": "time-stamps", "nanoseconds": "time-stamps"}


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

    from taichi_unifusion.types import Trajectory

    whole = trajectory(path)
    part = slice(third * len(whole) // 3, third * len(whole) // 3 + MOST)
    recording = open_dataset(
        "scene",
        data / "aws-small-house" / "house.glb",
        trajectory=Trajectory(whole.timestamps[part], whole.T_world_camera[part]),
        camera=PinholeCamera(320, 240, 287.5, 287.5, 159.5, 119.5),
        seed=third,
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
    """What it says is wrong."""
    return {finding.cause for finding in diagnosis.findings if finding.wrong}


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


def row_of(task: tuple[str, str]) -> tuple[str, set[str], dict[str, tuple[bool, set[str]]]]:
    """What is said of one recording: name, causes named of it unspoiled, and for every spoiling
    whether the right cause was named and which others.
    """
    name, data = task
    make = dict(recordings(Path(data)))[name]
    try:
        frames = timed(make())
    except (UniFusionError, ImportError, OSError) as error:
        print(f"{name}: left out ({error})", file=sys.stderr, flush=True)
        return name, set(), {}
    plain = causes(examined(frames))
    found: dict[str, tuple[bool, set[str]]] = {}
    for title, spoiling in SPOILINGS.items():
        if not applies(spoiling, frames):
            continue
        diagnosis = examined(spoiling.change(frames), spoiling.depth_scale)
        named = {finding.cause for finding in diagnosis.findings}
        found[title] = spoiling.cause in named, causes(diagnosis) - plain - {spoiling.cause}
    posed = [f for f in frames if f.T_world_camera is not None]
    for title, cause in ON_DISK.items():
        if len(posed) == len(frames) >= 4 and len({f.camera for f in frames}) == 1:
            named = on_disk(title, frames)
            found[title] = cause in named, set()
    return name, plain, found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--only", nargs="*", help="recordings whose name begins so")
    parser.add_argument("--processes", type=int, default=1)
    options = parser.parse_args()
    names = [name for name, _ in recordings(options.data)]
    if options.only:
        names = [name for name in names if name.startswith(tuple(options.only))]
    started = time.perf_counter()
    tasks = [(name, str(options.data)) for name in names]
    rows = []
    with get_context("spawn").Pool(options.processes, maxtasksperchild=1) as pool:
        for row in pool.imap(row_of, tasks):
            rows.append(row)
            show(*row)
    summarize([row for row in rows if row[2]])
    print(f"{time.perf_counter() - started:.0f} s")


def show(name: str, plain: set[str], found: dict[str, tuple[bool, set[str]]]) -> None:
    """What went wrong in one recording."""
    missed = [title for title, (right, _) in found.items() if not right]
    others = {title: sorted(wrong) for title, (_, wrong) in found.items() if wrong}
    print(
        f"{name}: unspoiled {sorted(plain) or 'sound'}; missed {missed}; wrong {others}", flush=True
    )


def summarize(rows: Sequence[tuple[str, set[str], dict[str, tuple[bool, set[str]]]]]) -> None:
    """The matrix: a row for every spoiling."""
    print("\n| spoiled by | recordings | right cause | a wrong one |\n|---|---|---|---|")
    total = np.zeros(3, int)
    for title in (*SPOILINGS, *ON_DISK):
        cells = [found[title] for _, _, found in rows if title in found]
        counts = np.array([len(cells), sum(r for r, _ in cells), sum(bool(w) for _, w in cells)])
        total += counts
        print(f"| {title} | {counts[0]} | {counts[1]} | {counts[2]} |")
    print(
        f"| **all** | {total[0]} | {total[1]} ({total[1] / total[0]:.1%}) | {total[2]} ({total[2] / total[0]:.1%}) |"
    )
    said = {name: sorted(plain) for name, plain, _ in rows if plain}
    print(f"| nothing | {len(rows)} | {len(rows) - len(said)} sound | {said or ''} |")


if __name__ == "__main__":
    main()
