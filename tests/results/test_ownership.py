"""Which files of a results folder runs wrote, and that nothing else is touched."""

from __future__ import annotations

import json
import os
import shutil

import pytest
from tiny_recording import CONFIG, FLAGS, make_frames, write_folder

from taichi_unifusion.cli import main as cli
from taichi_unifusion.errors import FileError, InputError
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.properties import SurfaceProperty
from taichi_unifusion.results import RunFolder, inspect, read_record, write_results, writer
from taichi_unifusion.results.ownership import (
    add_answers,
    answer_files,
    describe_earlier,
    is_unfinished,
    mark_unfinished,
    owned_files,
    strangers,
)


@pytest.fixture(scope="module")
def frames():
    return make_frames(2)


@pytest.fixture(scope="module")
def made(frames, tmp_path_factory):
    """The results of a run."""
    pipeline = Pipeline(CONFIG)
    out = tmp_path_factory.mktemp("results") / "made"
    write_results(out, pipeline, pipeline.run(frames))
    return out


@pytest.fixture
def folder(made, tmp_path):
    return RunFolder(shutil.copytree(made, tmp_path / "out"))


def files_in(folder: RunFolder) -> list[str]:
    found = (path for path in folder.path.rglob("*") if path.is_file())
    return sorted(folder.relative(path) for path in found)


def test_c6_a_run_owns_what_its_record_lists(folder):
    assert owned_files(folder) == set(files_in(folder))
    assert describe_earlier(folder) == "an earlier run (maps color, surface; a mesh)"
    (folder.path / "photo.png").touch()
    folder.map("mine").touch()
    assert strangers(folder, [folder.mesh, folder.path / "photo.png", folder.map("mine")]) == [
        "maps/mine.safetensors",
        "photo.png",
    ]


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "[]",
        "{}",
        '{"files": 3}',
        '{"files": [3, null, {}]}',
        "[" * 5000,
        '{"files": "a.ply"}',
    ],
)
def test_a_record_that_makes_no_sense_owns_nothing_else(content, tmp_path):
    folder = RunFolder(tmp_path)
    assert owned_files(folder) == set() and describe_earlier(folder) == ""
    folder.record.write_text(content)
    assert owned_files(folder) <= {folder.record.name}


def test_M7_a_record_cannot_name_files_outside_the_folder_or_of_another_kind(tmp_path):
    folder = RunFolder(tmp_path / "out")
    folder.path.mkdir()
    bad = [
        "../x.ply",
        "/etc/x.png",
        "maps/../../x.ply",
        "sub/x.ply",
        "notes.txt",
        "maps/x.ply",
        "a\0.ply",
    ]
    folder.record.write_text(json.dumps({"files": [*bad, "x.ply", "maps/x.safetensors"]}))
    assert owned_files(folder) == {"metrics.json", "x.ply", "maps/x.safetensors"}


def test_answers_are_owned_by_the_record_or_by_their_own_list(folder):
    for file in (folder.answer_mesh("a"), folder.answer_picture("a"), folder.answer_mesh("b")):
        file.touch()
    (folder.path / "photo.png").touch()
    add_answers(folder, [folder.answer_mesh("b")])
    assert read_record(folder.record).answers == ("query-b.ply",)
    assert "query-b.ply" in owned_files(folder) and "query-a.ply" not in owned_files(folder)
    listed = [{"text": "a", "mesh": "query-a.ply", "picture": "photo.png"}]
    folder.answers.write_text(json.dumps(listed))  # as older versions left it
    assert {"query-a.ply", "query.json"} <= owned_files(folder)
    assert "photo.png" not in owned_files(folder)
    (folder.path / "query-mine.png").touch()  # somebody's own
    named = [folder.relative(file) for file in answer_files(folder)]
    assert named == ["query-a.ply", "query-b.ply", "query.json"]
    told = inspect(folder.path).text
    assert "query-b.ply" in told and "query-mine.png" not in told
    add_answers(RunFolder(folder.path / "none"), [])  # no record, nothing to do


def test_R7_a_mark_says_that_a_run_was_ended_and_keeps_what_is_whose(folder):
    owned = owned_files(folder)
    mark_unfinished(folder, {*owned, "style.ply"})
    assert is_unfinished(folder) and owned_files(folder) == {*owned, "style.ply"}
    with pytest.raises(FileError, match="was ended before it was done, or still writes"):
        read_record(folder.record)
    assert describe_earlier(folder).startswith("what is left of a run that was ended (maps color")
    (problem,) = inspect(folder.path).problems
    assert "ended before it was done" in str(problem)


def test_c10_R7_a_run_that_dies_while_it_writes_is_seen_and_the_next_one_cleans_up(
    frames, folder, monkeypatch, capsys, tmp_path
):
    """As kill -9 leaves it: new maps beside an old mesh, and no word of the old run."""
    (folder.path / "style.png").touch()
    record = json.loads(folder.record.read_text())
    record["files"]["style.png"] = 0
    folder.record.write_text(json.dumps(record))

    class Killed(BaseException):
        pass

    def killed(*arguments):
        raise Killed

    pipeline = Pipeline(CONFIG)
    run = pipeline.run(frames[:1])
    with monkeypatch.context() as patch:
        patch.setattr(writer, "write_mesh", killed)
        with pytest.raises(Killed):
            write_results(folder.path, pipeline, run)
    assert is_unfinished(folder) and inspect(folder.path).problems
    assert cli.main(["info", str(folder.path)]) == 2
    assert "ended before it was done" in capsys.readouterr().err
    write_results(folder.path, pipeline, run)
    assert not inspect(folder.path).problems and "style.png" not in files_in(folder)
    assert read_record(folder.record).frames.used == 1


def test_c10_R7_info_compares_sizes_with_the_record(folder, capsys):
    assert inspect(folder.path).problems == ()
    folder.mesh_file("glb").unlink()  # to save room
    assert inspect(folder.path).problems == ()
    folder.trajectory.write_text("0 0 0 0 0 0 0 1\n")
    (problem,) = inspect(folder.path).problems
    assert "trajectory.txt: holds 16 bytes, not the" in str(problem)


def test_R5_files_of_an_earlier_run_that_could_not_be_replaced_stay_owned(
    frames, folder, monkeypatch
):
    def full(path, *arguments):
        raise OSError(28, "No space left on device")

    pipeline = Pipeline(CONFIG)
    run = pipeline.run(frames[:1])
    with monkeypatch.context() as patch:
        patch.setattr(writer, "write_mesh", full)
        results = write_results(folder.path, pipeline, run)
    assert len(results.failures) == 2
    assert read_record(folder.record).earlier_files == ("mesh.glb", "mesh.ply")
    assert {"mesh.glb", "mesh.ply"} <= owned_files(folder)
    (problem,) = inspect(folder.path).problems
    assert "mesh.glb, mesh.ply are of an earlier run" in str(problem)


def test_c6_an_older_run_is_not_emptied_and_a_file_of_others_is_not_replaced_in_silence(
    frames, tmp_path, capsys, monkeypatch
):
    recording, out = write_folder(tmp_path / "recording", frames), tmp_path / "out"
    out.mkdir()
    for name in ("mesh.ply", "config.yaml", "photo.png", "mesh.obj"):
        (out / name).write_text("mine")
    arguments = ["reconstruct", "folder", str(recording), *FLAGS]
    assert cli.main([*arguments, "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert f"{out}: holds config.yaml and mesh.ply, which no run here" in said
    assert "--overwrite" in said and "frame 1" not in said
    assert all(file.read_text() == "mine" for file in out.iterdir() if file.is_file())
    assert cli.main([*arguments, "--out", str(out), "--overwrite"]) == 0
    assert (out / "mesh.ply").read_bytes()[:3] == b"ply"
    assert (out / "photo.png").read_text() == (out / "mesh.obj").read_text() == "mine"

    monkeypatch.chdir(tmp_path)
    for folder, told in (("", "the name of a folder is empty"), ("a\0b", "NUL")):
        assert cli.main([*arguments, "--out", folder]) == 2
        assert told in " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert {path.name for path in tmp_path.iterdir()} == {"recording", "out"}


def test_c7_properties_cannot_take_the_names_of_other_files():
    for name in ("segmentation", "query-x", "part-1", "mesh", "preview"):
        with pytest.raises(InputError, match="is none of surface"):
            SurfaceProperty(name, 1, lambda frame: frame.depth)
    assert SurfaceProperty("queries", 1, lambda frame: frame.depth).name == "queries"


def test_c13_links_stay_links_but_not_those_of_other_users(folder, frames, tmp_path):
    if os.geteuid() != 0:
        pytest.skip("only root can make a link of another user")
    victim = tmp_path / "victim"
    victim.write_text("mine")
    folder.trajectory.unlink()
    folder.trajectory.symlink_to(victim)
    os.lchown(folder.trajectory, 12345, 12345)
    pipeline = Pipeline(CONFIG)
    results = write_results(folder.path, pipeline, pipeline.run(frames[:1]))
    (failure,) = results.failures
    assert "a link of another user" in str(failure) and victim.read_text() == "mine"
