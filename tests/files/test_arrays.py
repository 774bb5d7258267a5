"""Arrays in files: what they say is checked against what they hold before memory is taken (C8, M5, M6)."""

from __future__ import annotations

import gzip
import io
import struct
import time
import zipfile

import numpy as np
import pytest
from memory import peak_memory

from taichi_unifusion.errors import FileError, InputError, UniFusionError
from taichi_unifusion.files.arrays import open_planes, read_archive, read_array, read_point_features
from taichi_unifusion.files.json_text import parse_json
from taichi_unifusion.files.labels import read_class_names, read_labels
from taichi_unifusion.language.embeddings import read_embeddings
from taichi_unifusion.language.folder import read_features
from taichi_unifusion.networks.tokenizer import ClipTokenizer
from taichi_unifusion.results import inspect

RNG = np.random.default_rng(0)
ARRAYS = {
    "plain": RNG.normal(size=(3, 4, 5)).astype(np.float32),
    "fortran": np.asfortranarray(RNG.normal(size=(3, 4, 5))),
    "big": RNG.normal(size=7).astype(">f8"),
    "bools": np.array([True, False]),
    "texts": np.array(["chair", "Stühle"]),
    "scalar": np.array(5, np.int8),
    "empty": np.zeros((0, 3), np.float16),
    "strided": np.arange(20)[::3],
}


def npy_header(shape, descr="<f4") -> bytes:
    text = f"{{'descr': {descr!r}, 'fortran_order': False, 'shape': {shape!r}, }}\n".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def test_arrays_come_back_as_numpy_wrote_them(tmp_path):
    np.savez(tmp_path / "all.npz", **ARRAYS)
    np.savez_compressed(tmp_path / "packed.npz", **ARRAYS)
    for name, array in ARRAYS.items():
        np.save(tmp_path / "one.npy", array)
        archives = (read_archive(tmp_path / f, [name])[name] for f in ("all.npz", "packed.npz"))
        for read in (read_array(tmp_path / "one.npy"), *archives):
            assert read.dtype == array.dtype and read.shape == array.shape
            assert read.tobytes() == array.tobytes()


@pytest.mark.parametrize("shape", [(10**10,), (2**63, 2), (-5, 3), (1,) * 60, (10, 10**9)])
def test_c8_headers_that_promise_more_than_there_is(tmp_path, shape):
    path = tmp_path / "a.npy"
    path.write_bytes(npy_header(shape) + b"\0" * 72)
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(path, "a.npy")
    with peak_memory() as peak:
        for read in (
            lambda: read_array(path),
            lambda: read_labels(path),
            lambda: read_features(path),
            lambda: read_archive(tmp_path / "a.npz", ["a"]),
        ):
            with pytest.raises(FileError, match="cut off or damaged"):
                read()
    assert peak.megabytes < 100


@pytest.mark.parametrize(
    "header",
    [b"{'descr'", b"(((((", b"{" * 900, b"{'shape': (" + b"9" * 5000, b"\0\0\0", b"[1]", b""],
)
def test_c8_headers_that_are_no_headers(tmp_path, header):
    path = tmp_path / "a.npy"
    path.write_bytes(b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header)
    for read in (read_array, read_features, read_labels):
        with pytest.raises(FileError, match="not an array that NumPy wrote"):
            read(path)


def test_m5_archives_that_would_fill_the_memory_are_refused_at_once(tmp_path):
    np.savez_compressed(tmp_path / "x.npz", np.zeros((1, 4096, 8192), np.float32))  # 134 MB of 0.1
    np.savez_compressed(
        tmp_path / "e.npz", names=np.array(["a"]), vectors=np.zeros((9000, 4096), np.float32)
    )
    start = time.perf_counter()
    with peak_memory() as peak:
        for read, name in ((read_features, "x.npz"), (read_embeddings, "e.npz")):
            with pytest.raises(FileError, match="would unpack to 1[34].* MB, more than 100 times"):
                read(tmp_path / name)
    assert peak.megabytes < 20 and time.perf_counter() - start < 1


def test_m5_little_that_is_packed_tightly_is_read(tmp_path):
    mask = np.ones(4_000_000, bool)
    np.savez_compressed(
        tmp_path / "p.npz", feat=np.ones((len(mask), 1), np.float32), mask_full=mask
    )
    features, found = read_point_features(tmp_path / "p.npz")
    assert features.shape == (4_000_000, 1) and found.all()


def test_m5_a_list_of_merges_that_unpacks_without_end(tmp_path):
    path = tmp_path / "merges.txt.gz"
    path.write_bytes(gzip.compress(b"version\n" + b"a b\n" * 16_000_000))
    with peak_memory() as peak, pytest.raises(FileError, match="more than any list of merges"):
        ClipTokenizer(path)
    assert peak.megabytes < 100


def test_c8_what_is_wrong_with_archives_is_said(tmp_path):
    vectors = np.ones((1, 8), np.float32)
    np.savez(tmp_path / "e.npz", names=np.array(["chair"]), vectors=vectors)
    whole = (tmp_path / "e.npz").read_bytes()
    assert read_embeddings(tmp_path / "e.npz").names == ("chair",)
    for cut in range(0, len(whole), 7):
        (tmp_path / "cut.npz").write_bytes(whole[:cut])
        with pytest.raises(FileError, match="cut.npz"):
            read_embeddings(tmp_path / "cut.npz")
    flags = bytearray(whole)
    at = flags.rfind(b"PK\x01\x02")
    for place, value in ((8, 1), (10, 99), (10, 12)):  # encrypted, unknown method, bzip2
        changed = bytearray(flags)
        changed[at + place] = value
        (tmp_path / "kind.npz").write_bytes(changed)
        with pytest.raises(FileError, match="kind.npz"):
            read_archive(tmp_path / "kind.npz", ["names", "vectors"])
    changed = bytearray(flags)
    changed[at + 9], changed[at + 47] = 8, 0xCF  # a name that is said to be UTF-8, and is none
    (tmp_path / "name.npz").write_bytes(changed)
    with pytest.raises(FileError, match="name.npz.*damaged"):
        read_archive(tmp_path / "name.npz", ["names", "vectors"])
    with zipfile.ZipFile(tmp_path / "twice.npz", "w") as archive, pytest.warns(UserWarning):
        for _ in range(2):
            content = io.BytesIO()
            np.save(content, vectors)
            archive.writestr("vectors.npy", content.getvalue())
    with pytest.raises(FileError, match="two arrays of the name"):
        read_archive(tmp_path / "twice.npz", ["vectors"])
    with pytest.raises(InputError, match="must hold arrays a, it holds names, vectors"):
        read_archive(tmp_path / "e.npz", ["a"])


def test_c5_c8_a_damaged_stream_in_the_middle(tmp_path):
    path = tmp_path / "3.npz"
    np.savez_compressed(path, np.round(RNG.normal(size=(12, 16, 16)), 1).astype(np.float32))
    data = bytearray(path.read_bytes())
    start = 30 + sum(struct.unpack("<HH", data[26:30]))
    data[start + 40 : start + 80] = b"\xff" * 40
    path.write_bytes(data)
    with pytest.raises(FileError, match="damaged"):
        read_features(path)
    with pytest.raises(FileError, match="damaged"), open_planes(path) as (_, planes):
        list(planes)


class RunsWhenRead:
    def __init__(self, trace: str) -> None:
        self.trace = trace

    def __reduce__(self):
        return open, (self.trace, "w")


def test_m6_pickles_in_arrays_are_refused_and_do_not_run(tmp_path):
    payload = np.array([RunsWhenRead(str(tmp_path / "ran"))], object)
    np.save(tmp_path / "a.npy", payload, allow_pickle=True)
    np.savez(tmp_path / "a.npz", names=payload, vectors=payload)
    np.savez(tmp_path / "p.npz", feat=payload, mask_full=payload)
    for read, name in (
        (read_array, "a.npy"),
        (read_features, "a.npy"),
        (read_labels, "a.npy"),
        (read_embeddings, "a.npz"),
        (read_point_features, "p.npz"),
    ):
        with pytest.raises(UniFusionError, match="can run code"):
            read(tmp_path / name)
    assert not (tmp_path / "ran").exists()


def test_c8_json_of_thousands_of_brackets_is_a_sentence(tmp_path):
    with pytest.raises(ValueError, match="within each other"):
        parse_json("[" * 100_000)
    np.save(tmp_path / "e.npy", np.ones((1, 4), np.float32))
    (tmp_path / "e.json").write_text("[" * 2000)
    with pytest.raises(FileError, match="not a list of names"):
        read_embeddings(tmp_path / "e.npy")
    (tmp_path / "metrics.json").write_text("[" * 100_000)
    (problem,) = inspect(tmp_path).problems
    assert isinstance(problem, FileError)


def test_c8_labels_of_thousands_of_digits(tmp_path):
    path = tmp_path / "names.txt"
    path.write_text("9" * 5000 + " chair\n")
    with pytest.raises(FileError, match="expected 'label name'"):
        read_class_names(path)
    from taichi_unifusion.cli.segment import read_labels_file

    assert read_labels_file(path) == {0: "9" * 5000 + " chair"}  # a name that begins with digits
