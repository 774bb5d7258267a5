"""A list of recordings: read strictly, what is done is not run again, and a table of all."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest
import yaml
from direct_engine import Direct
from tiny_recording import make_frames, write_folder

from taichi_unifusion.cli import batch as command
from taichi_unifusion.cluster.batch import Scene, is_done, note_done, read_scenes, tabulate
from taichi_unifusion.errors import InputError

SCENES = {
    "common": {"format": "folder", "options": {"every": 10, "strict": True}},
    "scenes": [
        {"path": "a/flat", "options": {"every": 5}},
        {"name": "second", "path": "b", "command": "transfer", "options": {"property": ["x", "y"]}},
    ],
}


def written(folder: Path, values) -> Path:
    path = folder / "scenes.yaml"
    path.write_text(yaml.safe_dump(values))
    return path


def test_scenes_become_commands(tmp_path):
    first, second = read_scenes(written(tmp_path, SCENES))
    assert first == Scene(
        "flat", ("reconstruct", "folder", str(tmp_path / "a/flat"), "--every", "5", "--strict")
    )
    assert second.name == "second" and second.arguments[:3] == (
        "transfer",
        "folder",
        str(tmp_path / "b"),
    )
    assert second.arguments[3:] == (
        "--every",
        "10",
        "--strict",
        "--property",
        "x",
        "--property",
        "y",
    )


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, "a list of recordings"),
        ({"scenes": []}, "no scenes"),
        ({"scenes": [5]}, r"scenes\[0\]: expected keys"),
        ({"scenes": [{"path": "a", "colour": 1}]}, "unknown key 'colour'"),
        ({"scenes": [{"path": "a"}], "others": 1}, "unknown key 'others'"),
        ({"scenes": [{"path": "a"}, {"path": "b/a"}]}, "called 'a'"),
        ({"scenes": [{"path": "a", "name": "../x"}]}, "name of a folder"),
        ({"scenes": [{"path": "a", "command": "rm"}]}, "command: must be one of"),
        ({"scenes": [{"path": "a", "options": {"out": "x"}}]}, "folder of results"),
    ],
)
def test_other_lists_are_refused(tmp_path, values, message):
    with pytest.raises(InputError, match=message):
        read_scenes(written(tmp_path, values))


def test_a_scene_is_done_when_it_was_run_with_the_same_arguments(tmp_path):
    scene = Scene("synthetic", ("reconstruct", "synthetic", "--end", "2"))
    folder = scene.folder(tmp_path)
    folder.path.mkdir()
    assert not is_done(scene, tmp_path)
    note_done(scene, tmp_path)
    assert not is_done(scene, tmp_path)  # there is no record
    rows, values = tabulate([scene], tmp_path)
    assert rows[1][:2] == ["synthetic", "missing"] and values["synthetic"] is None
    assert not is_done(Scene(scene.name, (*scene.arguments, "--every", "2")), tmp_path)


def test_scenes_run_and_make_a_table(tmp_path, capsys, monkeypatch, caplog):
    """The second time nothing is run but what is missing, which is named."""
    monkeypatch.setattr(
        "taichi_unifusion.cluster.engine.open_engine", lambda _: nullcontext(Direct())
    )
    recording = write_folder(tmp_path / "tiny", make_frames(2))
    scenes = {
        "common": {"format": "folder", "options": {"device": "cpu", "mesh.resolution": 1}},
        "scenes": [{"name": "room", "path": str(recording)}, {"path": "gone"}],
    }
    options = command.Batch(written(tmp_path, scenes), tmp_path / "out")
    assert command.batch(options) == 2
    table = capsys.readouterr().out
    assert "mean of 1" in table and "missing" in table
    assert "no such" in (tmp_path / "out/gone.log").read_text()
    assert "gone: no such file or folder; see" in caplog.text
    record = (tmp_path / "out/room/metrics.json").stat().st_mtime_ns
    assert command.batch(options) == 2
    assert (tmp_path / "out/room/metrics.json").stat().st_mtime_ns == record
