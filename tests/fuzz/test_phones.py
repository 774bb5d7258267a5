"""Recordings of phones and lists of poses that are damaged anyhow, as in test_readers.py.

A few mutations of each in the suite; UNIFUSION_FUZZ=2000 asks for as many of each.
"""

from __future__ import annotations

import os
from functools import partial
from pathlib import Path

import numpy as np
import phone_writers as phones
import pose_writers
import pytest
from fuzzing import fuzz
from phone_writers import View, views

from taichi_unifusion.errors import UniFusionError
from taichi_unifusion.geometry import se3
from taichi_unifusion.tracking.trajectory_files import read_poses

MUTATIONS = int(os.environ.get("UNIFUSION_FUZZ", "5"))
SURE = np.ones((36, 48), np.uint8)


def tiny(count: int = 2) -> list[View]:
    """Small views: a video of them has some kilobytes."""
    return views(count=count)


def small_iphone(folder: Path, packing: str) -> Path:
    return phones.write_scannetpp(folder, phones.iphone_views(2), packing)


RECORDINGS = {
    "r3d": ("record3d", lambda folder: phones.write_r3d(folder, tiny(), SURE)),
    "record3d export": ("record3d", lambda folder: phones.write_record3d_export(folder, tiny())),
    "polycam": ("polycam", lambda folder: phones.write_polycam(folder, tiny(), SURE, True)),
    "strayscanner": (
        "strayscanner",
        lambda folder: phones.write_strayscanner(folder, tiny(), SURE),
    ),
    "old strayscanner": (
        "strayscanner",
        lambda folder: phones.write_strayscanner(folder, tiny(), old=True),
    ),
    "nerfstudio": ("nerfstudio", lambda folder: phones.write_transforms(folder, tiny())),
    "instant-ngp": (
        "nerfstudio",
        lambda folder: phones.write_transforms(folder, tiny(), "instant-ngp"),
    ),
    "fisheye": ("nerfstudio", lambda folder: phones.write_transforms(folder, tiny(), "fisheye")),
    "arkitscenes": ("arkitscenes", lambda folder: phones.write_arkitscenes(folder, tiny(), SURE)),
    "scannetpp stream": ("scannetpp", partial(small_iphone, packing="stream")),
    "scannetpp lz4": ("scannetpp", partial(small_iphone, packing="lz4")),
    "scannetpp deflate": ("scannetpp", partial(small_iphone, packing="deflate")),
    "matterport": ("matterport", lambda folder: phones.write_matterport(folder, tiny())),
    "hypersim": (
        "hypersim",
        lambda folder: phones.write_hypersim(folder, phones.hypersim_views(2)),
    ),
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_damaged_recordings(name, tmp_path, request):
    for package in ("av", "OpenEXR", "h5py", "lz4"):
        pytest.importorskip(package)
    format, write = RECORDINGS[name]
    (tmp_path / "base").mkdir()
    base = write(tmp_path / "base")
    files = [base] if base.is_file() else [f for f in sorted(base.rglob("*")) if f.is_file()]
    found = fuzz(*(format, base, files, MUTATIONS, sum(map(ord, name))), *places(tmp_path, request))
    print(f"{name}: {dict(found)}")
    assert found.total() == MUTATIONS


POSES = [se3.exp(np.array([0.1 * i, 0, 0.3, 0.2 * i, 0.5, 0])) for i in range(5)]
NAMES = [f"{i:03}.jpg" for i in range(5)]
LISTS = {
    "images.txt": lambda path: pose_writers.colmap_text(path, POSES, NAMES),
    "images.bin": lambda path: pose_writers.colmap_binary(path, POSES, NAMES),
    "transforms.json": lambda path: pose_writers.transforms(path, POSES, NAMES),
    "data.csv": lambda path: pose_writers.euroc(path, POSES),
    "kitti.txt": lambda path: pose_writers.kitti(path, POSES),
    "trajectory.log": lambda path: pose_writers.log(path, POSES),
}


def poses_in(format: str, path: Path) -> str:
    try:
        poses = read_poses(path)
    except UniFusionError as error:
        assert len(str(error)) < 5000
        return "refused"
    assert np.isfinite(poses.T_world_camera).all()
    return "all read" if len(poses.keys) == len(POSES) else "some read"


@pytest.mark.parametrize("name", LISTS)
def test_damaged_lists_of_poses(name, tmp_path, request):
    file = tmp_path / name
    LISTS[name](file)
    seed = sum(map(ord, name))
    found = fuzz("", file, [file], MUTATIONS, seed, *places(tmp_path, request), poses_in)
    print(f"{name}: {dict(found)}")
    assert found.total() == MUTATIONS


def places(tmp_path: Path, request: pytest.FixtureRequest) -> tuple[Path, Path]:
    """Where copies are made, and where one that crashes is left."""
    return tmp_path, Path(request.config.rootpath) / "fuzz-failure"
