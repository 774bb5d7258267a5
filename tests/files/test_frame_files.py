"""Which file belongs to which frame."""

from __future__ import annotations

import pytest

from taichi_unifusion.errors import DatasetError, FrameError
from taichi_unifusion.files.frame_files import (
    FrameFolder,
    files_by_stem,
    in_order,
    number_of,
    stem_of,
)


@pytest.mark.parametrize(
    ("name", "stem", "number"),
    [
        ("a/frame-000017.depth.png", "frame-000017.depth", 17),
        ("depth000017.png", "depth000017", 17),
        ("17.npy", "17", 17),
        ("seq-01/frame-000002.pose.txt", "frame-000002.pose", 2),
        ("room2/17.png", "17", 17),
        ("synthetic frame 5", "synthetic frame 5", 5),
        ("k4a/room7.mkv frame 5", "room7.mkv frame 5", 5),
        ("depth/1305031453.359684.png", "1305031453.359684", None),  # a time stamp
        ("1305031453.359684", "1305031453.359684", None),
        ("left.png", "left", None),
        ("", "", None),
    ],
)
def test_stems_and_numbers(name, stem, number):
    assert (stem_of(name), number_of(name)) == (stem, number)


def folder_of(tmp_path, *names: str) -> FrameFolder:
    for name in names:
        (tmp_path / name).touch()
    return FrameFolder(tmp_path, files_by_stem(tmp_path, (".npy", ".png")))


@pytest.mark.parametrize(
    ("names", "frame", "index", "found"),
    [
        (
            ["frame-000017.depth.npy", "17.npy"],
            "x/frame-000017.depth.png",
            0,
            "frame-000017.depth.npy",
        ),
        (["17.npy", "18.npy"], "x/frame-000017.depth.png", 0, "17.npy"),
        (["features_017.NPY"], "depth000017.png", 0, "features_017.NPY"),
        (["3.npy", "4.npy"], "1305031453.359684.png", 3, "3.npy"),  # by its place
        (["1305031453.359684.npy"], "depth/1305031453.359684.png", 3, "1305031453.359684.npy"),
        (["3.npy"], "", 3, "3.npy"),
        (["other.npy"], "left.png", 3, None),
        (["17.npy", ".18.npy", "18.txt"], "18.png", 0, None),
    ],
)
def test_the_file_of_a_frame(tmp_path, names, frame, index, found):
    file = folder_of(tmp_path, *names).file_of(frame, index)
    assert (file and file.name) == found


def test_what_is_ambiguous_is_said(tmp_path):
    folder = folder_of(tmp_path, "a_17.npy", "b_17.npy")
    with pytest.raises(FrameError, match="a_17.npy and b_17.npy have the same number"):
        folder.file_of("17.png", 0)
    (tmp_path / "a_17.png").touch()
    with pytest.raises(DatasetError, match="a_17.npy and a_17.png are two files of one name"):
        files_by_stem(tmp_path, (".npy", ".png"))


def test_names_in_the_order_of_their_numbers():
    assert in_order(["img10", "img9", "img1"]) == ["img1", "img9", "img10"]
    assert in_order(["10.5", "9.25", "2"]) == ["2", "9.25", "10.5"]
