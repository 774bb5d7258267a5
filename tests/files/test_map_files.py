"""Map files: round trips, and every way in which a file can be broken."""

from __future__ import annotations

import hashlib
import json
import math
import os
import pickle
import resource
import time

import numpy as np
import pytest

from taichi_unifusion.errors import FileError, InputError, MapCorrupt
from taichi_unifusion.files.maps import FORMAT, is_foreign, read_manifest, read_map, write_map

TENSORS = {
    "features": np.random.default_rng(0).normal(size=(7, 20, 3)).astype(np.float32),
    "half": np.linspace(-1, 1, 5).astype(np.float16),
    "slots": np.arange(-3, 4, dtype=np.int32),
    "sums": np.array([[-(2**62), 2**62]], np.int64),
    "support": np.array([2**63, 1], np.uint64),
    "stamps": np.array([2**32 - 1], np.uint32),
    "bytes": np.arange(5, dtype=np.uint8),
    "exact": np.array([math.pi, np.nan, -0.0]),
    "empty": np.zeros((0, 20), np.float32),
    "scalar": np.array(7, np.int64),
}
MANIFEST = {
    "voxel_size": 0.05,
    "encoder": {"l": 20, "seed": 1},
    "name": "Küche",
    "flags": [True, None],
}
SMALL = {"F": np.arange(6, dtype=np.float32).reshape(2, 3), "w": np.ones(2, np.uint8)}


@pytest.fixture
def path(tmp_path):
    return tmp_path / "map.safetensors"


def assert_same_tensors(a: dict, b: dict) -> None:
    assert a.keys() == b.keys()
    for name, array in a.items():
        assert (
            b[name].dtype == array.dtype
            and b[name].shape == array.shape
            and b[name].tobytes() == array.tobytes()
        ), name


def split(data: bytes) -> tuple[dict, bytes]:
    """Header as JSON, and the bytes after it."""
    length = int.from_bytes(data[:8], "little")
    return json.loads(data[8 : 8 + length]), data[8 + length :]


def join(header: dict, body: bytes) -> bytes:
    head = json.dumps(header).encode()
    return len(head).to_bytes(8, "little") + head + body


def forge(header: dict, change) -> dict:
    """The header with `change` done to its manifest and the manifest's sum made right again, as a
    liar would.
    """
    manifest = json.loads(header["__metadata__"]["taichi_unifusion"])
    change(manifest)
    text = json.dumps(manifest)
    metadata = {
        "taichi_unifusion": text,
        "taichi_unifusion_sha256": hashlib.sha256(text.encode()).hexdigest(),
    }
    return {**header, "__metadata__": metadata}


def test_M8_round_trip_is_equal_bit_for_bit(path):
    write_map(path, TENSORS, MANIFEST)
    tensors, manifest = read_map(path)
    assert_same_tensors(TENSORS, tensors)
    assert all(array.flags.writeable and array.flags.c_contiguous for array in tensors.values())
    assert {key: manifest[key] for key in MANIFEST} == MANIFEST
    assert manifest == read_manifest(path)
    assert manifest["format"] == FORMAT and manifest["format_version"] == 1
    assert manifest["tensors"]["half"] | {"sha256": ""} == {
        "shape": [5],
        "dtype": "float16",
        "sha256": "",
    }
    first = path.read_bytes()
    write_map(path, tensors, manifest)  # what was read can be written again
    assert path.read_bytes() == first


def test_strided_and_big_endian_arrays_are_stored_in_order(path):
    array = np.arange(24, dtype=np.float32).reshape(4, 6)
    write_map(path, {"t": array.T, "s": array[::2, ::-1], "b": array.astype(">f4")}, {})
    tensors, _ = read_map(path)
    assert_same_tensors({"t": array.T.copy(), "s": array[::2, ::-1].copy(), "b": array}, tensors)


def test_empty_maps_are_maps(path):
    write_map(path, {}, {})
    assert read_map(path)[0] == {}
    write_map(path, {"F": np.zeros((0, 20), np.float32)}, {})
    assert read_map(path)[0]["F"].shape == (0, 20)


def test_any_safetensors_library_reads_it(path):
    numpy_io = pytest.importorskip("safetensors.numpy")
    write_map(path, TENSORS, MANIFEST)
    assert_same_tensors(TENSORS, numpy_io.load_file(path))


def test_what_a_map_cannot_hold_is_refused_before_writing(path):
    for tensors, manifest, message in (
        ({"c": np.zeros(2, complex)}, {}, "'c' is complex128"),
        ({"o": np.array([{}])}, {}, "'o' is object"),
        ({"__metadata__": np.zeros(2)}, {}, "cannot be named"),
        ({"d": np.zeros((1,) * 9)}, {}, "9 dimensions"),
        ({}, {"x": np.nan}, "manifest"),
        ({}, {"x": object()}, "manifest"),
    ):
        with pytest.raises(InputError, match=message):
            write_map(path, tensors, manifest)
    assert not path.exists()


def test_M1_truncated_anywhere(path):
    write_map(path, TENSORS, MANIFEST)
    data = path.read_bytes()
    for cut in {*range(0, len(data), max(1, len(data) // 300)), *range(20), len(data) - 1}:
        path.write_bytes(data[:cut])
        for read in (read_map, read_manifest):
            with pytest.raises(MapCorrupt, match="map.safetensors"):
                read(path)
    path.write_bytes(data + b"\0")
    with pytest.raises(MapCorrupt, match="damaged"):
        read_map(path)


def test_M1_truncated_large_map_is_refused_at_once_and_without_memory(path):
    write_map(path, {"F": np.zeros((1 << 25,), np.float32)}, {})  # 128 MiB
    os.truncate(path, path.stat().st_size // 2)
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    with pytest.raises(MapCorrupt, match="truncated"):
        read_map(path)
    # KiB
    assert (
        time.perf_counter() - start < 1
        and resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000
    )


def test_M2_any_flipped_bit_is_found(path):
    write_map(path, SMALL, {"voxel_size": 0.05, "c": "é"})
    data = bytearray(path.read_bytes())
    header_end = 8 + int.from_bytes(data[:8], "little")
    rng = np.random.default_rng(0)
    flips = {
        (i, bit) for i in range(header_end) for bit in rng.choice(8, 3, replace=False).tolist()
    }
    flips |= {(i, bit) for i in range(header_end, len(data)) for bit in range(8)}
    unseen = []
    for i, bit in sorted(flips):
        data[i] ^= 1 << bit
        path.write_bytes(data)
        try:
            read_map(path)
            unseen.append((i, bit))
        except MapCorrupt:
            pass
        data[i] ^= 1 << bit
    assert len(flips) > 1000 and unseen == []


def test_M3_not_ours(path):
    cases = {
        b"": "is empty",
        b"PK\x03\x04" + b"\0" * 100: "zip archive",
        b"ply\nformat ascii 1.0\n" + b" " * 99: "PLY mesh",
        b"\xff" * 100: "not a map file",
        b"hello": "not a map file",
        b"\0" * 8: "not a map file",
        join(
            {"F": {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}}, b"\0" * 4
        ): "no manifest",
        join({"__metadata__": {"format": "pt"}}, b""): "no manifest",
        join([1], b""): "not a map file",
        (6).to_bytes(8, "little") + b"[" * 6: "not a map file",
        (1 << 20).to_bytes(8, "little") + b"[" * (1 << 20): "not a map file",
    }
    for data, message in cases.items():
        path.write_bytes(data)
        for read in (read_map, read_manifest):
            with pytest.raises(MapCorrupt, match=message):
                read(path)
    with pytest.raises(FileError, match="no such map file"):
        read_map(path.with_name("none"))
    with pytest.raises(FileError, match="not a regular file"):
        read_map(path.parent)


@pytest.mark.parametrize(
    ("version", "advice"),
    [(0, "again"), (2, "update"), (-1, "again"), ("1", "again"), (None, "again")],
)
def test_M3_other_version_names_both(path, version, advice):
    write_map(path, SMALL, {})
    header, body = split(path.read_bytes())
    path.write_bytes(join(forge(header, lambda m: m.update(format_version=version)), body))
    with pytest.raises(MapCorrupt, match=f"version {version}, .*version 1; .*{advice}"):
        read_manifest(path)
    path.write_bytes(join(forge(header, lambda m: m.update(format="other")), body))
    with pytest.raises(MapCorrupt, match=f"'other'; expected '{FORMAT}'"):
        read_map(path)


@pytest.mark.parametrize(
    "change",
    [
        {"shape": [2**63, 3]},
        {"shape": [2**31, 2**31]},
        {"shape": [-2, -3]},
        {"shape": [2, 3.0]},
        {"shape": [True, 6]},
        {"shape": [6, 3]},
        {"shape": "23"},
        {"shape": [1] * 40},
        {"shape": [0, 2**63]},
        {"dtype": "F64"},
        {"dtype": "I32"},
        {"dtype": "BOOL"},
        {"dtype": "F99"},
        {"dtype": 5},
        {"data_offsets": [0, 2**63]},
        {"data_offsets": [-24, 0]},
        {"data_offsets": [4, 28]},
        {"data_offsets": [24, 0]},
        {"data_offsets": [0]},
        {"shape": [2**60], "data_offsets": [0, 2**62]},
        {"shape": [0, 3], "data_offsets": [0, 0]},
        {"extra": 1},
    ],
    ids=str,
)
@pytest.mark.parametrize("both", [False, True], ids=["header lies", "manifest agrees"])
def test_M4_lies_are_refused_before_allocation(path, change, both):
    write_map(path, {"F": SMALL["F"]}, {})
    header, body = split(path.read_bytes())
    header["F"].update(change)
    if both:
        names = {"F64": "float64", "I32": "int32"}
        said = {
            key: names.get(value, value) if key == "dtype" else value
            for key, value in change.items()
        }
        header = forge(header, lambda m: m["tensors"]["F"].update(said))
    path.write_bytes(join(header, body))
    # a full forgery of equal size, sums and all, is another valid map
    if both and change == {"dtype": "I32"}:
        assert read_map(path)[0]["F"].dtype == np.int32
        return
    for read in (read_map, read_manifest):
        with pytest.raises(MapCorrupt):
            read(path)


def test_M4_counts_overlaps_and_gaps(path):
    entry = {"dtype": "U8", "shape": [2]}
    write_map(path, {"a": np.zeros(2, np.uint8), "b": np.ones(2, np.uint8)}, {})
    header, body = split(path.read_bytes())
    for offsets in (([0, 2], [0, 2]), ([0, 2], [1, 3]), ([0, 2], [3, 5]), ([2, 4], [4, 6])):
        changed = {
            **header,
            "a": {**entry, "data_offsets": offsets[0]},
            "b": {**entry, "data_offsets": offsets[1]},
        }
        path.write_bytes(join(changed, body + b"\0" * (max(offsets[1][1], 4) - 4)))
        with pytest.raises(MapCorrupt):
            read_map(path)
    swapped = {**header, "a": header["b"], "b": header["a"]}
    path.write_bytes(join(swapped, body))
    with pytest.raises(MapCorrupt, match="checksum"):
        read_map(path)
    for change in (
        lambda m: m["tensors"].pop("a"),
        lambda m: m["tensors"].update(c=m["tensors"]["a"]),
        lambda m: m.pop("tensors"),
        lambda m: m["tensors"].update(a=[]),
        lambda m: m["tensors"]["a"].pop("sha256"),
    ):
        path.write_bytes(join(forge(header, change), body))
        with pytest.raises(MapCorrupt):
            read_map(path)
    twice = json.dumps(header).replace('"a": {', '"a": {}, "a": {').encode()
    path.write_bytes(len(twice).to_bytes(8, "little") + twice + body)
    with pytest.raises(MapCorrupt):
        read_map(path)


class RunsWhenRead:
    """A pickle payload that leaves a file behind when it is read."""

    def __init__(self, trace: str) -> None:
        self.trace = trace

    def __reduce__(self):
        return open, (self.trace, "w")


@pytest.mark.parametrize("name", ["map.npy", "map.pt", "map.lim", "map.safetensors"])
@pytest.mark.parametrize("as_npy", [False, True])
def test_M6_pickles_are_refused_and_do_not_run(tmp_path, name, as_npy):
    trace = tmp_path / "ran"
    with open(tmp_path / name, "wb") as file:
        if as_npy:
            np.save(file, np.array([RunsWhenRead(str(trace))], object), allow_pickle=True)
        else:
            pickle.dump(RunsWhenRead(str(trace)), file)
    for read in (read_map, read_manifest):
        with pytest.raises(MapCorrupt, match="pickle.*not read"):
            read(tmp_path / name)
    assert not trace.exists()
    with open(tmp_path / name, "rb") as file:  # the payload would have run
        np.load(file, allow_pickle=True) if as_npy else pickle.load(file)
    assert trace.exists()


def test_files_of_other_programs_are_told_from_damaged_maps(path):
    tensor = {"weight": {"dtype": "BF16", "shape": [2], "data_offsets": [0, 4]}}
    for header in (tensor, {"__metadata__": {"format": "pt"}, **tensor}):
        text = json.dumps(header).encode()
        path.write_bytes(len(text).to_bytes(8, "little") + text + bytes(4))
        assert is_foreign(path)
        path.write_bytes(path.read_bytes()[:20])
        assert not is_foreign(path)
    for nothing in (b"", b"PK\x03\x04", (2).to_bytes(8, "little") + b"{}"):
        path.write_bytes(nothing)
        assert not is_foreign(path)
    assert not is_foreign(path.parent / "none") and not is_foreign(path.parent)


def test_no_changed_bit_of_its_header_makes_a_map_a_file_of_others(path):
    write_map(path, SMALL, MANIFEST)
    data = path.read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")
    for place in range(end):
        for bit in (1, 2, 4, 32):
            changed = bytearray(data)
            changed[place] ^= bit
            path.write_bytes(changed)
            assert not is_foreign(path), place
