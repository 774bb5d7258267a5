"""Which format a recording has, by the names of its files and the first bytes of a file; its images
are not read.
"""

from __future__ import annotations

import os
import re
import sqlite3
from collections.abc import Callable, Collection
from contextlib import closing
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from pathlib import Path

from ..errors import DatasetError
from ..files.sqlite_bag import DAMAGED

MOST_NAMES = 200_000  # of a folder that are looked at
MOST_INSIDE = 50  # folders within a folder that is no recording itself, where one may be
MOST_NAMED = 5  # of them
HEAD = 1 << 20  # [bytes] of either end of a bag, in which the topics are named
DEVICE_TOPIC = b"/device_0/"  # of the RealSense SDK
CALIBRATION = b"calibration.json"  # attached by k4arecorder, before the images
ZIP, MATROSKA = b"PK\x03\x04", b"\x1a\x45\xdf\xa3"
BAG, MCAP, SQLITE = b"#ROSBAG V2.0", b"\x89MCAP", b"SQLite format 3\0"
PACKED, PACKED_BAG = b"\x28\xb5\x2f\xfd", r"\.(bag|db3|mcap)\.zstd?$"  # Zstandard
MESHES = (".glb", ".gltf", ".obj", ".ply")


@dataclass(frozen=True)
class Finding:
    """A format, and by what it was known."""

    format: str
    sign: str


@dataclass(frozen=True)
class Place:
    """A file or a folder that may be a recording."""

    path: Path

    @cached_property
    def names(self) -> frozenset[str]:
        """What lies in the folder; nothing for a file."""
        try:
            with os.scandir(self.path) as entries:
                return frozenset(entry.name for entry in islice(entries, MOST_NAMES))
        except (OSError, ValueError):
            return frozenset()

    @cached_property
    def head(self) -> bytes:
        """The first bytes of the file; nothing for a folder."""
        try:
            with open(self.path, "rb") as file:
                return file.read(64)
        except (OSError, ValueError):
            return b""

    @property
    def suffix(self) -> str:
        return self.path.suffix.lower()

    def inside(self, *names: str) -> Place:
        """A file or folder within."""
        return Place(self.path.joinpath(*names))

    def has(self, pattern: str) -> str:
        """The first name that matches, or nothing."""
        match = re.compile(pattern).fullmatch
        return min((name for name in self.names if match(name)), default="")


# Each says by what it knows the format, or nothing


def _seven_scenes(place: Place) -> str:
    if place.has(r"_info\.txt"):
        return ""
    return place.has(r"frame-\d+\.depth\.png") or _only_sequence(place)


def _only_sequence(place: Place) -> str:
    sequence = place.has(r"seq-\d+")
    found = place.inside(sequence).has(r"frame-\d+\.depth\.png") if sequence else ""
    return f"{sequence}/{found}" if found else ""


def _replica(place: Place) -> str:
    for folder in ("results", "."):
        if found := place.inside(folder).has(r"depth\d+\.png"):
            beside = place.has(r"traj\.txt") or Place(place.path.parent).has(r"traj\.txt")
            return f"{found} and {beside}" if beside else ""
    return ""


def _tum(place: Place) -> str:
    return "rgb.txt and depth.txt" if {"rgb.txt", "depth.txt"} <= place.names else ""


def _scannet(place: Place) -> str:
    if place.suffix == ".sens" and place.head[:4] == b"\x04\0\0\0":
        return "a .sens container"
    if container := place.has(r".*\.sens"):
        return container
    if place.has(r"_info\.txt") and place.has(r"frame-\d+\.depth\.(pgm|png)"):
        return "_info.txt and frame-XXXXXX.depth.pgm"
    numbered = {"color", "depth"} <= place.names and place.inside("depth").has(r"\d+\.png")
    names = "intrinsic", "intrinsic_depth.txt", "intrinsics_depth.txt"
    intrinsics = next((name for name in names if name in place.names), "")
    return f"color/, depth/{numbered} and {intrinsics}" if numbered and intrinsics else ""


def _k4a(place: Place) -> str:
    if not place.head.startswith(MATROSKA):
        return ""
    with open(place.path, "rb") as file:
        return "a Matroska video with calibration.json" if CALIBRATION in file.read(HEAD) else ""


def _folder(place: Place) -> str:
    return "camera.yaml and depth/" if {"camera.yaml", "depth"} <= place.names else ""


def _stanford(place: Place) -> str:
    for folder in ("data", "."):
        pattern = r"camera_.*_frame_\d+_domain_+depth\.png"
        if found := place.inside(folder, "depth").has(pattern):
            return found
    return ""


def _scene(place: Place) -> str:
    return f"a mesh ({place.suffix})" if place.suffix in MESHES and place.head else ""


def _record3d(place: Place) -> str:
    if place.suffix == ".r3d" and place.head.startswith(ZIP):
        return "an .r3d archive"
    for folder in ("EXR_RGBD", "."):
        export = place.inside(folder)
        exr = export.inside("depth").has(r"\d+\.exr")
        if exr and {"metadata.json", "rgb"} <= export.names:
            return f"metadata.json, rgb/ and depth/{exr}"
    return ""


def _strayscanner(place: Place) -> str:
    if {"camera_matrix.csv", "depth"} <= place.names:
        return "camera_matrix.csv and depth/"
    return ""


def _polycam(place: Place) -> str:
    for folder in ("keyframes", "."):
        inner = place.inside(folder)
        cameras = inner.has(r"(corrected_)?cameras")
        if "depth" in inner.names and cameras and inner.inside(cameras).has(r"\d+\.json"):
            return f"{cameras}/T.json and depth/"
    return ""


def _nerfstudio(place: Place) -> str:
    if place.suffix == ".json" and place.head.lstrip()[:1] == b"{":
        return "a .json file" if "transforms" in place.path.name else ""
    return place.has(r"transforms\.json")


def _arkitscenes(place: Place) -> str:
    found = {"lowres_depth", "lowres_wide_intrinsics"} <= place.names
    return "lowres_depth/ and lowres_wide_intrinsics/" if found else ""


def _scannetpp(place: Place) -> str:
    for folder in ("iphone", "."):
        if place.inside(folder).has(r"pose_intrinsic_imu\.json"):
            return "pose_intrinsic_imu.json"
    return ""


def _hypersim(place: Place) -> str:
    found = {"_detail", "images"} <= place.names
    return "images/ and _detail/" if found and _hdf5(place.inside("images")) else ""


def _hdf5(images: Place) -> str:
    return images.has(r"scene_cam_\d+_geometry_hdf5")


def _matterport(place: Place) -> str:
    folders = ("matterport_depth_images", "undistorted_depth_images", ".")
    for folder in folders:
        if found := place.inside(folder).has(r"[0-9a-f]{32}_d\d_\d\.png"):
            return found
    return ""


def _open3d(place: Place) -> str:
    if "depth" not in place.names or "camera.yaml" in place.names:
        return ""
    camera = place.has(r"(camera_)?intrinsic\.json|camera_primesense\.json")
    path = place.has(r"trajectory\.(log|json)") or (
        "scene/trajectory.log" if place.inside("scene").has(r"trajectory\.log") else ""
    )
    return f"depth/ and {camera or path}" if camera or path else ""


def _realsense(place: Place) -> str:
    return "topics /device_0/... in a bag" if _has_device_topics(place) else ""


def _rosbag(place: Place) -> str:
    if place.head.startswith(BAG):
        return "" if _has_device_topics(place) else "a bag of ROS 1"
    if place.head.startswith(MCAP):
        return "an .mcap file"
    if place.head.startswith(SQLITE) and place.suffix == ".db3":
        return "" if _has_device_topics(place) else "a .db3 bag of ROS 2"
    if place.head.startswith(PACKED) and re.search(PACKED_BAG, place.path.name):
        return "a bag that is packed as a whole"
    pattern = rf".*(\.db3|\.mcap|{PACKED_BAG})"
    bag = place.has(pattern) if "metadata.yaml" in place.names else ""
    return f"metadata.yaml and {bag}" if bag else ""


def _has_device_topics(place: Place) -> bool:
    """Whether the SDK of RealSense has written a bag."""
    if place.head.startswith(BAG):
        with open(place.path, "rb") as file:
            start = file.read(HEAD)
            file.seek(max(0, os.path.getsize(place.path) - HEAD))
            return DEVICE_TOPIC in start or DEVICE_TOPIC in file.read()
    if place.head.startswith(SQLITE) and place.suffix == ".db3":
        try:
            with closing(
                sqlite3.connect(f"{place.path.absolute().as_uri()}?mode=ro", uri=True)
            ) as base:
                names = base.execute("select name from topics limit 1000").fetchall()
        except DAMAGED:
            return False
        return any(str(name).startswith(DEVICE_TOPIC.decode()) for (name,) in names)
    return False


@dataclass(frozen=True)
class Sign:
    """How a format is known, and what is looked for, for people."""

    seen_in: Callable[[Place], str]
    looked_for: str


SIGNS = {
    "7scenes": Sign(_seven_scenes, "frame-XXXXXX.depth.png"),
    "replica": Sign(_replica, "traj.txt and depthXXXXXX.png"),
    "tum": Sign(_tum, "rgb.txt and depth.txt"),
    "scannet": Sign(_scannet, "a .sens file, or depth/N.png and intrinsic/"),
    "k4a": Sign(_k4a, "an .mkv file of k4arecorder"),
    "folder": Sign(_folder, "camera.yaml and depth/"),
    "2d3ds": Sign(_stanford, "depth/camera_..._domain_depth.png"),
    "scene": Sign(_scene, "a .glb, .obj or .ply file"),
    "record3d": Sign(_record3d, "an .r3d file, or metadata.json and depth/N.exr"),
    "strayscanner": Sign(_strayscanner, "camera_matrix.csv and depth/"),
    "polycam": Sign(_polycam, "keyframes/"),
    "nerfstudio": Sign(_nerfstudio, "transforms.json"),
    "arkitscenes": Sign(_arkitscenes, "lowres_depth/ and lowres_wide_intrinsics/"),
    "scannetpp": Sign(_scannetpp, "iphone/pose_intrinsic_imu.json"),
    "hypersim": Sign(_hypersim, "_detail/ and images/scene_cam_XX_geometry_hdf5/"),
    "matterport": Sign(_matterport, "UUID_d0_0.png"),
    "open3d": Sign(_open3d, "depth/ with intrinsic.json or trajectory.log"),
    "realsense": Sign(_realsense, "a .bag or .db3 of the RealSense SDK"),
    "rosbag": Sign(_rosbag, "a .bag, .mcap or .db3 file"),
}


def find_format(path: Path, formats: Collection[str]) -> Finding:
    """The one of the `formats` that the recording at `path` has.

    Raises DatasetError, with what was looked for, where it has none or several could be meant.
    """
    if not os.path.exists(path):
        raise DatasetError(f"{path}: no such file or folder")
    found = _findings(Place(path), formats)
    if len(found) == 1:
        return found[0]
    if found:
        said = ", ".join(f"{each.format} ({each.sign})" for each in found)
        raise DatasetError(
            f"{path}: could be {said}; write the one that is meant instead of 'auto'"
        )
    raise DatasetError(f"{path}: {_nothing_found(Place(path), formats)}")


def other_format(path: Path, format: str, formats: Collection[str]) -> str:
    """The end of a sentence about a recording that is none of this format: which one it is instead, as
    its files say; nothing where they do not say it.
    """
    found = [each for each in _findings(Place(path), formats) if each.format != format]
    if len(found) != 1 or len(_findings(Place(path), (format,))):
        return ""
    return f"; these look like files of format '{found[0].format}' ({found[0].sign}): give that instead of '{format}'"


def _findings(place: Place, formats: Collection[str]) -> list[Finding]:
    signs = {name: sign for name, sign in SIGNS.items() if name in formats}
    seen = [(name, sign.seen_in(place)) for name, sign in signs.items()]
    return [Finding(name, by) for name, by in seen if by]


def _nothing_found(place: Place, formats: Collection[str]) -> str:
    """What to say of a place where no format was found."""
    if place.head.startswith(ZIP):
        return "is a ZIP archive; unpack it and give the folder"
    inner = [
        f"{name} ({found[0].format})"
        for name in sorted(place.names)[:MOST_INSIDE]
        if (found := _findings(place.inside(name), formats))
    ]
    if inner:
        more = f" and {len(inner) - MOST_NAMED} more" if len(inner) > MOST_NAMED else ""
        return f"is no recording itself, but holds {', '.join(inner[:MOST_NAMED])}{more}; give the path of one"
    looked = "; ".join(f"{name}: {SIGNS[name].looked_for}" for name in SIGNS if name in formats)
    return f"no format was recognised; looked for {looked}"
