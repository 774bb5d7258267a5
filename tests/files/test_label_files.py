"""Files of labels and of class names: what is refused, and how it is said."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from meshes import rectangle

from taichi_unifusion.errors import FileError, InputError
from taichi_unifusion.files.labels import read_class_names, read_labels


def test_M6_an_array_with_a_payload_is_refused_and_not_run(tmp_path):
    class Payload:
        def __reduce__(self):
            return Path.touch, (tmp_path / "ran",)

    (tmp_path / "labels.npy").write_bytes(pickle.dumps(Payload()))
    np.save(tmp_path / "objects.npy", np.array([Payload()], dtype=object), allow_pickle=True)
    for name in ("labels.npy", "objects.npy"):
        with pytest.raises(FileError, match="not an array that NumPy wrote|can run code"):
            read_labels(tmp_path / name)
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    ("name", "content", "error", "told_by"),
    [
        ("x.txt", b"1\ntwo\n", FileError, "line 2: expected one number, got 'two'"),
        ("x.txt", b"# nothing\n", FileError, "holds no labels"),
        ("x.txt", b"\xff\xfe\x00", FileError, "not a text file"),
        ("x.npy", b"", FileError, "not an array"),
        ("x.csv", b"1\n", InputError, "labels are read from .ply, .txt, .npy"),
        ("x.ply", b"plx", FileError, "not a PLY file"),
    ],
)
def test_bad_label_files_are_told(tmp_path, name, content, error, told_by):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(error, match=told_by):
        read_labels(tmp_path / name)


@pytest.mark.parametrize(
    "array", [np.zeros((3, 2)), np.array(["a"]), np.zeros((0, 2)), np.array(3)]
)
def test_arrays_that_are_no_labels_are_told(tmp_path, array):
    np.save(tmp_path / "x.npy", array)
    with pytest.raises(InputError, match="expected one number a point"):
        read_labels(tmp_path / "x.npy")


def test_a_mesh_without_labels_names_what_it_has(tmp_path):
    rectangle((0, 0), (1, 1), 0.0, color=(1, 0, 0)).save(tmp_path / "mesh.ply")
    with pytest.raises(InputError, match="no vertex property 'label', only color"):
        read_labels(tmp_path / "mesh.ply")
    with pytest.raises(InputError, match="'color' has 3 columns"):
        read_labels(tmp_path / "mesh.ply", "color")


@pytest.mark.parametrize(
    ("text", "told_by"),
    [
        ("chair 3\n", "line 1: expected 'label name'"),
        ("3\n", "line 1"),
        ("3 chair\n3 sofa\n", "line 2: label 3 has a name already"),
        ("", "holds no names"),
    ],
)
def test_bad_names_are_told(tmp_path, text, told_by):
    (tmp_path / "names.txt").write_text(text)
    with pytest.raises(FileError, match=told_by):
        read_class_names(tmp_path / "names.txt")
