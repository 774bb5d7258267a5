"""Readers of files that others write: a small sound file of each kind, and how it is read. Recordings of
ROS, RealSense and Open3D are in tests/fuzz/test_readers.py.
"""

from __future__ import annotations

import dataclasses
import gzip
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import dataset_writers as writers
import k4a_writer
import numpy as np
import phone_writers as phones
from meshes import scattered

from taichi_unifusion.cli.segment import read_labels_file
from taichi_unifusion.config import Config, dump_config, load_config
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.camera_yaml import read_camera_yaml
from taichi_unifusion.datasets.color_camera import (
    kinect_color_camera,
    read_color_camera,
    write_color_camera,
)
from taichi_unifusion.files.arrays import read_point_features
from taichi_unifusion.files.images import read_color, read_depth, read_infrared, read_values
from taichi_unifusion.files.labels import read_class_names, read_labels
from taichi_unifusion.files.maps import CONTAINER_KEYS, read_map, write_map
from taichi_unifusion.files.mesh_reading import read_any_mesh, read_mesh
from taichi_unifusion.files.meshes import write_mesh
from taichi_unifusion.files.trajectories import read_trajectory
from taichi_unifusion.language.embeddings import read_embeddings
from taichi_unifusion.language.folder import read_features
from taichi_unifusion.maps.settings import PropertySettings
from taichi_unifusion.maps.stored import describe, read_stored
from taichi_unifusion.maps.voxel_data import property_fields
from taichi_unifusion.networks.tokenizer import ClipTokenizer
from taichi_unifusion.results import read_record

RNG = np.random.default_rng(0)


@dataclass(frozen=True)
class Target:
    """A reader; `make` writes a sound file, or a folder of which one file at a time is changed."""

    make: Callable[[Path], Any]
    read: Callable[[Path], Any]
    name: str = "file"  # of what `make` writes, in a folder of its own
    slow: bool = False  # a tenth of the mutations


def _map_file(path: Path) -> None:
    settings, n = PropertySettings(voxel_size=0.05), 5
    tensors = {"keys": np.arange(3 * n, dtype=np.int32).reshape(n, 3)}
    tensors |= {f.name: np.ones((n, *f.shape), f.dtype) for f in property_fields(3, settings)}
    manifest = {
        "kind": "property",
        "name": "color",
        "channels": 3,
        "voxels": n,
        "settings": dataclasses.asdict(settings),
    }
    write_map(path, tensors, manifest)


def _write_manifest(path: Path) -> None:
    _map_file(path)
    path.write_text(json.dumps(read_map(path)[1]))


def _read_forged_manifest(path: Path) -> None:
    """A manifest whose sums are right, whatever it says."""
    from taichi_unifusion.errors import FileError, InputError

    try:
        manifest = json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise FileError("no JSON") from error
    if not isinstance(manifest, dict):
        raise FileError("no manifest")
    sound = path.with_name("sound.safetensors")
    _map_file(sound)
    tensors, own = read_map(sound)
    try:
        write_map(sound, tensors, {k: v for k, v in manifest.items() if k not in CONTAINER_KEYS})
    except InputError as error:
        raise FileError("not finite") from error
    describe(sound, {**read_map(sound)[1]})
    read_stored(sound)


def _write(make: Callable[[], bytes]) -> Callable[[Path], Any]:
    return lambda path: path.write_bytes(make())


def _npz(**arrays: Any) -> Callable[[Path], Any]:
    return lambda path: np.savez_compressed(path, **arrays)


def _npy(array: Any) -> Callable[[Path], Any]:
    return lambda path: np.save(path, array)


def _picture(suffix: str, image: Any) -> Callable[[Path], Any]:
    return _write(lambda: cv2.imencode(suffix, image)[1].tobytes())


def _text(text: str) -> Callable[[Path], Any]:
    return lambda path: path.write_text(text)


def _recording(format: str, **options: Any) -> Callable[[Path], Any]:
    """Opens it and reads its frames, each on its own: one that is damaged must not cost the others."""

    def read(path: Path) -> None:
        from taichi_unifusion.errors import FrameError

        recording = open_dataset(format, path, **options)
        for i in range(min(len(recording), 3)):
            try:
                recording[i]
            except FrameError:
                continue

    return read


def _dataset(format: str, make: Callable[..., Any], **options: Any) -> Target:
    """A recording that lies in a folder of `make`, or in the file that it returns."""
    return Target(make, _recording(format, **options), "scene", slow=True)


def _phone(make: Callable[..., Any]) -> Callable[[Path], Any]:
    return lambda folder: (folder.mkdir(), make(folder, phones.views()))[1]


def _samples(make: Callable[..., Any], **options: Any) -> Callable[[Path], Any]:
    return lambda folder: make(folder, writers.make_samples(2), **options)


GREY, DEPTH = RNG.integers(0, 255, (12, 16, 3), np.uint8), RNG.integers(500, 5000, (12, 16))
TUM_ROWS = "".join(writers.tum_row(writers.make_pose(i), i / 30) + "\n" for i in range(4))
MERGES = b"version\n" + b"a b\nc d</w>\ne f\n" * 20
CAMERA = writers.CAMERA_YAML if isinstance(writers.CAMERA_YAML, str) else "width: 4\nheight: 4\n"
METRICS = json.dumps(
    {
        "device_name": "CPU",
        "frames": {"used": 2, "skipped": 0, "interrupted": False, "skipped_frames": []},
        "milliseconds": {"frame": {"median": 5, "mean": 6.5}},
        "versions": {"taichi_unifusion": "0.1.0"},
    }
)

TARGETS = {
    "map": Target(_map_file, read_stored, "m.safetensors"),
    "manifest": Target(_write_manifest, _read_forged_manifest, "m.json"),
    "ply": Target(lambda p: write_mesh(p, scattered(color=3, heat=1)), read_mesh, "m.ply"),
    "glb": Target(lambda p: write_mesh(p, scattered(color=3)), read_any_mesh, "m.glb", slow=True),
    "obj": Target(lambda p: write_mesh(p, scattered(color=3)), read_any_mesh, "m.obj", slow=True),
    "trajectory": Target(_text(TUM_ROWS), read_trajectory, "t.txt"),
    "camera-yaml": Target(_text(CAMERA), read_camera_yaml, "camera.yaml"),
    "color-camera-yaml": Target(
        lambda p: write_color_camera(p, kinect_color_camera()),
        read_color_camera,
        "color_camera.yaml",
    ),
    "config-yaml": Target(_text(dump_config(Config())), load_config, "config.yaml", slow=True),
    "png-color": Target(_picture(".png", GREY), read_color, "a.png"),
    "png-values": Target(_picture(".png", GREY), read_values, "a.png"),
    "png-infrared": Target(_picture(".png", GREY[..., 0]), read_infrared, "a.png"),
    "png-depth": Target(
        _picture(".png", DEPTH.astype(np.uint16)), lambda p: read_depth(p, 1000), "a.png"
    ),
    "jpeg": Target(_picture(".jpg", GREY), read_color, "a.jpg"),
    "pgm": Target(
        _picture(".pgm", DEPTH.astype(np.uint16)), lambda p: read_depth(p, 1000), "a.pgm"
    ),
    "npy-depth": Target(_npy(DEPTH.astype(np.float32)), lambda p: read_depth(p, 1000), "a.npy"),
    "features-npy": Target(_npy(RNG.normal(size=(4, 5, 8)).astype("f2")), read_features, "a.npy"),
    "features-npz": Target(_npz(a=RNG.normal(size=(4, 5, 8)).astype("f4")), read_features, "a.npz"),
    "point-features": Target(
        _npz(feat=np.ones((3, 2), np.float32), mask_full=np.ones(3, bool)),
        read_point_features,
        "a.npz",
    ),
    "embeddings": Target(
        _npz(names=np.array(["a", "b"]), vectors=np.eye(2, dtype=np.float32)),
        read_embeddings,
        "e.npz",
    ),
    "labels-npy": Target(_npy(np.arange(5)), read_labels, "l.npy"),
    "labels-txt": Target(_text("1\n2\n-1\n"), read_labels, "l.txt"),
    "class-names": Target(_text("1 chair\n2 table\n"), read_class_names, "n.txt"),
    "segment-labels": Target(_text("1 chair\n2 table\n"), read_labels_file, "n.txt"),
    "merges": Target(_write(lambda: gzip.compress(MERGES)), ClipTokenizer, "m.txt.gz"),
    "metrics": Target(_text(METRICS), read_record, "metrics.json"),
    "sens": _dataset("scannet", _samples(writers.write_sens)),
    "seven-scenes": _dataset("7scenes", _samples(writers.write_seven_scenes)),
    "replica": _dataset("replica", _samples(writers.write_replica)),
    "tum": _dataset("tum", _samples(writers.write_tum), camera=writers.CAMERA),
    "scannet": _dataset("scannet", _samples(writers.write_scannet)),
    "folder": _dataset("folder", _samples(writers.write_folder, poses="named")),
    "2d3ds": _dataset("2d3ds", _samples(writers.write_stanford)),
    "k4a": Target(lambda path: k4a_writer.write_k4a(path), _recording("k4a"), "k.mkv", slow=True),
    "record3d": _dataset("record3d", _phone(phones.write_r3d)),
    "polycam": _dataset("polycam", _phone(phones.write_polycam)),
    "strayscanner": _dataset("strayscanner", _phone(phones.write_strayscanner)),
    "nerfstudio": _dataset("nerfstudio", _phone(phones.write_transforms)),
    "arkitscenes": _dataset("arkitscenes", _phone(phones.write_arkitscenes)),
}
