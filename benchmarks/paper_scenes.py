"""The scenes of the paper's experiments in a root folder, as the data sets unpack, and the lists of
their names.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import FileError, InputError, did_you_mean
from taichi_unifusion.files.atomic import read_bytes

LISTS = Path(__file__).resolve().parent / "paper"
ANNOTATIONS = "Stanford3dDataset_v1.2"  # S3DIS as it unpacks, with a room's labels as points


@dataclass(frozen=True)
class Scene:
    """A recording and what is known about it."""

    name: str  # as the tables have it
    format: str
    path: Path
    options: tuple[str, ...] = ()  # of the format, as NAME=VALUE
    truth: Path | None = None  # the true surface, or the points with true labels

    @property
    def key(self) -> str:
        """The name of its files among the results."""
        return self.name.replace("/", "-")


@dataclass(frozen=True)
class Found:
    """Scenes that a root holds, and those on the list that it does not."""

    scenes: tuple[Scene, ...]
    missing: tuple[str, ...] = ()


def read_list(path: str | Path) -> list[str]:
    """The lines of a text file; empty lines and # comments are left out."""
    try:
        lines = read_bytes(Path(path)).decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise FileError(f"{path}: not a text file") from None
    kept = [line.strip() for line in lines if line.strip() and not line.lstrip().startswith("#")]
    if not kept:
        raise FileError(f"{path}: holds no names; expected one a line")
    return kept


def scannet(root: Path, names: Sequence[str] | None = None, labels: bool = False) -> Found:
    """Scans of ScanNet in `root/scans/` or `root/`, by default those of the validation split.

    A scan's truth is `NAME_vh_clean_2.ply`, with `labels` `NAME_vh_clean_2.labels.ply`. Frames may
    lie in the scan's `.sens`, in its folder, or in its `frames/`.
    """
    folder = root / "scans" if (root / "scans").is_dir() else root
    found, missing = [], []
    for name in names or read_list(LISTS / "scannetv2_val.txt"):
        scan = folder / name
        if not scan.is_dir():
            missing.append(name)
            continue
        frames = scan / "frames" if (scan / "frames").is_dir() else scan
        truth = scan / f"{name}_vh_clean_2{'.labels' * labels}.ply"
        found.append(Scene(name, "scannet", frames, truth=truth))
    return _some(found, missing, f"{folder}: no scan of the list here (sceneXXXX_XX/)")


def tum(root: Path, names: Sequence[str] | None = None) -> Found:
    """Sequences of TUM RGB-D in `root`, by default the three of Table II."""
    found, missing = [], []
    for name, folder in _named(LISTS / "tum.txt", names).items():
        path = root / folder
        if path.is_dir():
            found.append(Scene(name, "tum", path, truth=path / "groundtruth.txt"))
        else:
            missing.append(name)
    return _some(found, missing, f"{root}: no rgbd_dataset_freiburg... of Table II here")


def replica(root: Path, names: Sequence[str] | None = None) -> Found:
    """Scenes of Replica in `root`, by default the eight of Table III; true meshes where they are."""
    found, missing = [], []
    for name, folder in _named(LISTS / "replica.txt", names).items():
        if (root / folder).is_dir():
            mesh = root / f"{folder}_mesh.ply"
            truth = mesh if mesh.exists() else None
            found.append(Scene(name, "replica", root / folder, truth=truth))
        else:
            missing.append(name)
    return _some(found, missing, f"{root}: none of office0 ... room2 here")


def stanford(root: Path, names: Sequence[str] | None = None) -> Found:
    """Rooms of the areas of 2D-3D-S in `root`, as area_1/office_1; all of them, unless `names` says
    otherwise, of areas or rooms.

    The truth is S3DIS' folder of labelled points, `Stanford3dDataset_v1.2/Area_1/office_1`.
    """
    wanted, found = dict.fromkeys(names or ()), []
    for area in sorted(root.glob("area_*")):
        number = area.name.removeprefix("area_").rstrip("ab")
        for room in open_dataset("2d3ds", area).rooms:  # pyright: ignore[reportAttributeAccessIssue]
            name = f"{area.name}/{room}"
            if names and not {area.name, name} & set(wanted):
                continue
            wanted.pop(name, None)
            truth = root / ANNOTATIONS / f"Area_{number}" / room
            found.append(Scene(name, "2d3ds", area, (f"room={room}",), truth))
    areas = {scene.path.name for scene in found}
    missing = [name for name in wanted if name not in areas]
    return _some(found, missing, f"{root}: no area_1 ... area_6 of 2D-3D-S with such rooms here")


def _named(path: Path, names: Sequence[str] | None) -> dict[str, str]:
    """Name and folder of the scenes of a list, all or some, which may be called by either."""
    listed = dict(line.split(maxsplit=1) for line in read_list(path))
    if names is None:
        return listed
    by_folder = {folder: name for name, folder in listed.items()}
    chosen = [by_folder.get(name, name) for name in names]
    for name in chosen:
        if name not in listed:
            raise InputError(
                f"scenes: '{name}' is unknown{did_you_mean(name, listed)}; there are "
                f"{', '.join(listed)}"
            )
    return {name: listed[name] for name in listed if name in chosen}


def _some(found: list[Scene], missing: list[str], nothing: str) -> Found:
    if not found:
        raise FileError(f"{nothing}; docs/paper.md shows how the root is laid out")
    return Found(tuple(found), tuple(missing))
