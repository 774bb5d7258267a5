"""Formats are found by the files, and not guessed."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path

import dataset_writers
import k4a_writer
import phone_writers
import pytest
from dataset_writers import make_samples
from phone_writers import views
from places import DATA

from taichi_unifusion.datasets import FORMATS, known_format, open_dataset
from taichi_unifusion.datasets.detection import SIGNS
from taichi_unifusion.errors import DatasetError

WRITTEN = {  # name -> format, writer of samples
    "7scenes": ("7scenes", dataset_writers.write_seven_scenes),
    "replica": ("replica", dataset_writers.write_replica),
    "replica-flat": ("replica", partial(dataset_writers.write_replica, images=".")),
    "tum": ("tum", dataset_writers.write_tum),
    "scannet": ("scannet", dataset_writers.write_scannet),
    "scannet-flat": ("scannet", dataset_writers.write_scannet_flat),
    "scannet-sens": ("scannet", dataset_writers.write_sens),
    "2d3ds": ("2d3ds", dataset_writers.write_stanford),
    "folder": ("folder", partial(dataset_writers.write_folder, poses="folder")),
}
PHONES = {
    "r3d": ("record3d", phone_writers.write_r3d),
    "polycam": ("polycam", phone_writers.write_polycam),
    "nerfstudio": ("nerfstudio", phone_writers.write_transforms),
    "arkitscenes": ("arkitscenes", phone_writers.write_arkitscenes),
    "matterport": ("matterport", phone_writers.write_matterport),
}


def test_every_format_of_files_has_a_sign():
    assert set(FORMATS) - {"synthetic"} <= set(SIGNS)


@pytest.mark.parametrize("name", WRITTEN)
def test_what_is_written_is_found(tmp_path, name):
    format, write = WRITTEN[name]
    assert known_format("auto", write(tmp_path / "scene", make_samples())) == format


@pytest.mark.parametrize("name", PHONES)
def test_what_phones_write_is_found(tmp_path, name):
    format, write = PHONES[name]
    path = write(tmp_path, views(count=1))
    assert known_format("auto", path) == format
    assert len(open_dataset("auto", path)) == 1


@pytest.mark.parametrize(("given", "name"), [("replica", "7scenes"), ("folder", "tum")])
def test_a_recording_of_another_format_says_which(tmp_path, given, name):
    path = WRITTEN[name][1](tmp_path / "scene", make_samples())
    with pytest.raises(
        DatasetError, match=f"look like files of format '{name}'.*instead of '{given}'"
    ):
        open_dataset(given, path)


def test_a_broken_recording_of_the_right_format_says_what_is_broken(tmp_path):
    path = WRITTEN["tum"][1](tmp_path / "scene", make_samples())
    (path / "rgb.txt").write_text("")
    with pytest.raises(DatasetError) as told:
        open_dataset("tum", path)
    assert "look like files" not in str(told.value)


def test_a_kinect_is_told_from_another_video(tmp_path):
    pytest.importorskip("av")
    path = k4a_writer.write_k4a(tmp_path / "a.mkv", 1)
    assert known_format("auto", path) == "k4a"
    other = tmp_path / "b.mkv"
    phone_writers.write_video(other, [view.color for view in views(count=1)])
    with pytest.raises(DatasetError, match="no format was recognised"):
        known_format("auto", other)


def test_a_file_of_another_kind_is_no_recording(tmp_path):
    for name in ("a.r3d", "a.sens", "a.mkv", "a.bag", "a.mcap", "a.db3", "transforms.json"):
        (tmp_path / name).write_bytes(b"nothing")
        with pytest.raises(DatasetError, match="no format was recognised; looked for 7scenes"):
            known_format("auto", tmp_path / name)


def test_two_formats_in_one_folder_are_both_named(tmp_path):
    phone_writers.write_polycam(tmp_path, views(count=1))
    phone_writers.write_transforms(tmp_path, views(count=1))
    with pytest.raises(
        DatasetError, match=r"could be polycam \(.*\), nerfstudio \(transforms.json\)"
    ):
        known_format("auto", tmp_path)


def test_recordings_in_a_folder_are_named(tmp_path):
    phone_writers.write_polycam(tmp_path / "first", views(count=1))
    phone_writers.write_transforms(tmp_path / "second", views(count=1))
    with pytest.raises(DatasetError, match=r"holds first \(polycam\), second \(nerfstudio\)"):
        known_format("auto", tmp_path)


def test_a_zip_is_to_be_unpacked(tmp_path):
    path = phone_writers.write_r3d(tmp_path, views(count=1)).rename(tmp_path / "scan.zip")
    with pytest.raises(DatasetError, match="unpack it"):
        known_format("auto", path)


def test_nothing_and_nowhere_are_said(tmp_path):
    with pytest.raises(DatasetError, match="no such file or folder"):
        known_format("auto", tmp_path / "missing")
    with pytest.raises(DatasetError, match="needs the path"):
        known_format("auto", None)


REAL = {
    "7scenes-redkitchen": "7scenes",
    "replica-office0": "replica",
    "tum-fr1desk9": "tum",
    "k4a-infrared/recording.mkv": "k4a",
    "aws-small-house/house.glb": "scene",
    "formats/record3d-exr": "record3d",
    "formats/record3d-r3d/doorhandle8.r3d": "record3d",
    "formats/nerfstudio-depth": "nerfstudio",
    "formats/polycam-raw": "polycam",
    "formats/stray-scanner": "strayscanner",
    "formats/realsense-bag/software_device.db3": "realsense",
    "formats/ros1-bag/tum3.bag": "rosbag",
    "formats/ros2-db3/tum3": "rosbag",
    "formats/ros2-db3/tum3/tum3.db3": "rosbag",
    "formats/ros2-mcap/tum3": "rosbag",
    "formats/ros2-mcap/tum3/tum3.mcap": "rosbag",
}
NO_RECORDING = (
    "aws-small-house",
    "clip-text-embeddings",
    "clip-tokenizer",
    "formats",
    "k4a-infrared",
)


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_are_found(data, name):
    data(Path(name).parts[0])
    if REAL[name] not in FORMATS:
        pytest.skip(f"format {REAL[name]} is not there")
    assert known_format("auto", DATA / name) == REAL[name]


@pytest.mark.parametrize("name", NO_RECORDING)
def test_folders_that_are_no_recordings_are_not_taken_for_one(data, name):
    with pytest.raises(DatasetError, match="no recording itself|no format was recognised"):
        known_format("auto", data(name))


@pytest.mark.parametrize("format", ["auto", "rosbag", "realsense"])
def test_names_in_a_bag_that_are_no_text_are_damage(tmp_path, format):
    """SQLite repeats them in its messages, which Python decodes."""
    pytest.importorskip("rosbags", reason="bags are read with rosbags, extra 'ros'")
    path = tmp_path / "r.db3"
    with closing(sqlite3.connect(path)) as base, base:
        base.execute("create table topics (id, name, type, serialization_format)")
        base.execute("pragma writable_schema=on")
        base.execute("update sqlite_master set name=cast(x'74b6' as text), sql='create table'")
    with pytest.raises(DatasetError):
        open_dataset(format, path)
