"""The record of a run: what is written reads back, and what cannot be read is told."""

from __future__ import annotations

import json

import pytest

from taichi_unifusion.errors import FileError
from taichi_unifusion.results.record import (
    SCHEMA_VERSION,
    FrameCounts,
    Lacking,
    MapRecord,
    MeshRecord,
    Milliseconds,
    PointCounts,
    PropertyRecord,
    RunRecord,
    Seconds,
    Skipped,
    SkipReason,
    Source,
    read_record,
    write_record,
)

LEAST = {  # what any file has to say
    "device_name": "CPU",
    "frames": {"used": 2, "skipped": 0, "interrupted": False, "skipped_frames": []},
    "milliseconds": {"frame": {"median": 5, "mean": 6.5}},
    "versions": {"taichi_unifusion": "0.1.0"},
}
FULL = RunRecord(
    recording=Source(
        format="k4a",
        path="a.mkv",
        start=2,
        end=None,
        every=3,
        reading={"align": "color", "depth_scale": 1000.0},
        frames=4,
    ),
    tracking={"mode": "rgbd", "verdicts": {"tracked": 4}, "seconds": 1.5},
    device="cpu",
    device_name="CPU",
    frames=FrameCounts(
        used=3,
        skipped=1,
        interrupted=True,
        reasons=(SkipReason("no usable depth", 1, "frame 5: empty"),),
        skipped_frames=(Skipped(5, "frame 5: empty"),),
        without={"features": Lacking((2, 8), "frame 2: no file")},
    ),
    milliseconds={"surface": Milliseconds(2.0, 2.5), "frame": Milliseconds(3.0, 3.5)},
    seconds=Seconds(1.0, 2.0, 0.5),
    points=PointCounts(100.5, 402),
    maps={"surface": MapRecord(0.05, 10, 2000, 1000)},
    properties={
        "style": PropertyRecord(3, "style", "viridis", (0.0, 1.0)),
        "empty": PropertyRecord(0, "empty", "viridis", None),
    },
    mesh=MeshRecord(30, 20),
    peak_memory_bytes=1 << 30,
    files={"mesh.ply": 1234},
    warnings=("one",),
    errors=("two",),
    versions={"taichi_unifusion": "0.1.0"},
)


def test_what_is_written_reads_back(tmp_path):
    write_record(tmp_path / "record.json", FULL)
    assert read_record(tmp_path / "record.json") == FULL
    values = json.loads((tmp_path / "record.json").read_text())
    assert values["schema_version"] == SCHEMA_VERSION and next(iter(values)) == "schema_version"
    assert values["recording"]["reading"] == {"align": "color", "depth_scale": 1000.0}
    assert values["properties"]["style"]["range"] == [0, 1] and values["mesh"]["vertices"] == 30


def test_a_record_without_recording_tracking_or_mesh_reads_back():
    record = RunRecord.from_json(LEAST)
    assert (record.recording, record.tracking, record.mesh) == (None, None, None)
    assert not {"recording", "tracking"} & set(record.to_json()) and "mesh" in record.to_json()
    assert RunRecord.from_json(record.to_json()) == record
    assert type(record.milliseconds["frame"].median) is float


def test_older_files_without_a_version_and_unknown_keys_are_read():
    assert RunRecord.from_json({**LEAST, "weather": "fine"}) == RunRecord.from_json(LEAST)


def test_the_frames_asked_for_are_counted_in_the_recording():
    assert FULL.recording is not None and list(FULL.recording.asked) == [2, 5, 8, 11]


@pytest.mark.parametrize(
    ("values", "told"),
    [
        ([], "the file: expected names and values, got []"),
        ({}, "'device_name' is missing"),
        ({**LEAST, "frames": 3}, "frames: expected names and values, got 3"),
        (
            {**LEAST, "frames": {**LEAST["frames"], "used": "x"}},
            "frames.used: expected a whole number, got 'x'",
        ),
        (
            {**LEAST, "frames": {**LEAST["frames"], "used": True}},
            "frames.used: expected a whole number",
        ),
        (
            {**LEAST, "milliseconds": {"frame": {"median": 1}}},
            "milliseconds.frame: 'mean' is missing",
        ),
        ({**LEAST, "recording": {"format": "tum"}}, "recording: 'path' is missing"),
        ({**LEAST, "warnings": "one"}, "warnings: expected a list, got 'one'"),
        ({**LEAST, "warnings": [1]}, "warnings[0]: expected text, got 1"),
        ({**LEAST, "schema_version": SCHEMA_VERSION + 1}, "update taichi_unifusion"),
    ],
)
def test_what_is_no_record_is_told_by_its_place(tmp_path, values, told):
    file = tmp_path / "record.json"
    file.write_text(json.dumps(values))
    with pytest.raises(FileError) as raised:
        read_record(file)
    assert str(raised.value).startswith(f"{file}: ") and told in str(raised.value)


@pytest.mark.parametrize("content", [b"", b"{", b"\xff\xfe", b"[" * 100_000])
def test_what_is_no_json_is_told(tmp_path, content):
    file = tmp_path / "record.json"
    file.write_bytes(content)
    with pytest.raises(FileError, match="damaged file"):
        read_record(file)
    with pytest.raises(FileError, match="no such file"):
        read_record(tmp_path / "none.json")
