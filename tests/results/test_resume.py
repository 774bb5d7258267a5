"""A run that is killed goes on from its last safe point, and ends with the same map."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from tiny_recording import CONFIG, FLAGS, make_frames, write_folder

from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli import mapping
from taichi_unifusion.config import dump_config
from taichi_unifusion.errors import FileError, InputError
from taichi_unifusion.maps import working_set
from taichi_unifusion.maps.stored import read_stored
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results import RunFolder, inspect, read_record, safe_point, saver
from taichi_unifusion.results.record import Source
from taichi_unifusion.results.saver import RunSaver
from taichi_unifusion.run_log import RunResult
from taichi_unifusion.viewer.results_scene import open_scene

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 120  # [s] for a process that has to start Taichi on a busy machine
SMALL = replace(CONFIG, window=3)
WINDOW = ["--window", "3"]
RECIPE = safe_point.Recipe(
    config=dump_config(SMALL),
    recording=Source(format="folder", path="x", start=0, end=None, every=1, frames=11),
    poses={"tracking": "given"},
    color_camera="auto",
    features="",
)


@pytest.fixture(scope="module")
def frames():
    """Eleven, one of which cannot be used, and a jump of the camera after the fifth."""
    near, far = make_frames(6), make_frames(40)[35:]
    near[3] = replace(near[3], depth=0 * near[3].depth)
    return [replace(frame, index=i) for i, frame in enumerate([*near, *far])]


@pytest.fixture(scope="module")
def whole(frames):
    """The undisturbed run."""
    pipeline = Pipeline(SMALL)
    return pipeline.run(frames), contents(pipeline)


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "out").mkdir()
    return RunFolder(tmp_path / "out")


@pytest.fixture
def at_every_border(monkeypatch):
    """Safe points at every border, whatever they take."""
    monkeypatch.setattr(saver, "SHARE", 1e9)
    monkeypatch.setattr(saver, "now", count().__next__)


def contents(pipeline: Pipeline) -> list[dict[str, bytes]]:
    maps = pipeline.maps.values()
    return [{k: v.tobytes() for k, v in each.voxels().tensors.items()} for each in maps]


def fused(run: RunResult) -> list[tuple[int, dict[str, int]]]:
    """Points and voxels of every step; how many are in the map by then depends on when windows are
    fused.
    """
    return [
        (step.points, {name: each.voxels for name, each in step.integrations.items()})
        for step in run.steps
    ]


class Killed(BaseException):
    pass


def make_saver(folder: RunFolder, *, resume: bool = False, recipe=RECIPE) -> RunSaver:
    made = RunSaver(folder, recipe, 1e-9, resume=resume)
    made.next = 0.0
    return made


def run_until(frames, count: int, folder: RunFolder, *, resume: bool = False):
    """A run that dies when so many frames of it are in; returns what it did, if it did not."""
    keeper = make_saver(folder, resume=resume)
    config, maps, before = SMALL, {}, None
    if keeper.resumed is not None:
        state, before = keeper.resumed.state, keeper.resumed.so_far
        config, maps = safe_point.read_settings(folder, state), safe_point.read_maps(folder, state)
    pipeline = Pipeline(config, maps=maps)
    if keeper.resumed is not None:
        pipeline.fusion.borders = keeper.resumed.state.borders

    def step(frame, done, of):
        if frame.index >= count:
            raise Killed

    try:
        run = pipeline.run(frames, on_step=step, on_border=keeper.at_border, before=before)
    except Killed:
        return None
    return run, contents(pipeline)


def test_M8_R7_a_run_that_is_killed_goes_on_to_the_same_map(frames, whole, folder, at_every_border):
    for i, number in enumerate([0, 4, 4, 9]):
        assert run_until(frames, number, folder, resume=i > 0) is None
    run, maps = run_until(frames, 99, folder, resume=True)
    expected, expected_maps = whole
    assert maps == expected_maps
    assert [step.index for step in run.steps] == [step.index for step in expected.steps]
    assert fused(run) == fused(expected)
    assert run.skipped == expected.skipped and run.warnings == expected.warnings
    assert np.array_equal(run.trajectory.T_world_camera, expected.trajectory.T_world_camera)
    assert np.array_equal(run.trajectory.timestamps, expected.trajectory.timestamps)


def test_R7_a_death_while_saving_leaves_the_safe_point_before(
    frames, whole, folder, at_every_border, monkeypatch
):
    """At every call that writes: a map, the journal, the state."""
    assert run_until(frames, 5, folder) is None
    kept = folder.path.with_name("kept")
    shutil.copytree(folder.path, kept)
    for name, call in (("append", 1), ("write_state", 1), ("keep_generation", 2)):
        shutil.rmtree(folder.path)
        shutil.copytree(kept, folder.path)
        real, calls = getattr(saver, name), []

        def dying(*arguments, real=real, calls=calls, call=call):
            calls.append(1)
            if len(calls) == call:
                raise Killed
            return real(*arguments)

        with monkeypatch.context() as patch:
            patch.setattr(saver, name, dying)
            assert run_until(frames, 99, folder, resume=True) is None
        (folder.generations[0] / ".x.safetensors.1234.tmp").touch()
        _, maps = run_until(frames, 99, folder, resume=True)
        assert maps == whole[1] and folder.temporaries == () and len(folder.generations) == 1
        assert make_saver(folder, resume=True).resumed is not None


def test_R5_a_full_disk_costs_the_safe_point_and_not_the_run(
    frames, whole, folder, at_every_border, monkeypatch, caplog
):
    def full(*arguments):
        raise FileError("state.json: cannot write: the disk is full")

    assert run_until(frames, 5, folder) is None
    before = folder.state.read_bytes()
    with monkeypatch.context() as patch:
        patch.setattr(saver, "write_state", full)
        _, maps = run_until(frames, 99, folder, resume=True)
    assert maps == whole[1] and folder.state.read_bytes() == before
    assert caplog.text.count("could not be saved on its way") == 1
    assert run_until(frames, 99, folder, resume=True)[1] == whole[1]


def test_a_fresh_run_replaces_a_safe_point_when_it_makes_one_itself(
    frames, whole, folder, at_every_border
):
    assert run_until(frames, 9, folder) is None
    before = folder.state.read_bytes()
    assert run_until(frames, 0, folder) is None  # ended before its first border
    assert folder.state.read_bytes() == before
    assert run_until(frames, 5, folder) is None
    assert json.loads(folder.state.read_text())["done"] < json.loads(before)["done"]
    assert run_until(frames, 99, folder, resume=True)[1] == whole[1]
    assert len(open_scene(folder.path).meshes[0].mesh.faces) > 0  # of a folder without results
    (folder.unfinished / "mine.txt").touch()
    safe_point.remove_safe_point(folder)
    assert [file.name for file in folder.unfinished.iterdir()] == ["mine.txt"]


def test_other_settings_are_refused_by_their_name(frames, folder, at_every_border):
    assert run_until(frames, 5, folder) is None
    config = replace(SMALL, surface=replace(SMALL.surface, voxel_size=0.2))
    for recipe, told in (
        (replace(RECIPE, config=dump_config(config)), "surface.voxel_size is 0.2, and 0.1 in"),
        (
            replace(RECIPE, recording=replace(RECIPE.recording, every=2)),
            "recording.every is 2, and 1",
        ),
        (replace(RECIPE, poses={"tracking": "rgbd"}), "poses.tracking is rgbd, and given"),
        (replace(RECIPE, features="clip:x"), "features is clip:x, and not given in"),
    ):
        with pytest.raises(InputError, match=told):
            make_saver(folder, resume=True, recipe=recipe)


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("{", "a damaged one"),
        ("[]", "a damaged one"),
        ("[" * 5000, "a damaged one"),
        ('{"version": 1}', "'generation' is missing"),
        ('{"version": 2}', "of version 2, this program reads version 1"),
    ],
)
def test_M3_a_damaged_or_newer_state_is_one_sentence(content, told, folder):
    folder.unfinished.mkdir()
    folder.state.write_text(content)
    with pytest.raises(FileError, match=told):
        make_saver(folder, resume=True)
    assert make_saver(folder).resumed is None  # without --resume nobody asks


def test_a_damaged_journal_is_one_sentence(frames, folder, at_every_border):
    assert run_until(frames, 7, folder) is None
    data = folder.journal.read_bytes()
    folder.journal.write_bytes(data[:40] + b"#" + data[41:])
    with pytest.raises(FileError, match=r"steps\.jsonl: a damaged file"):
        make_saver(folder, resume=True)


# --- The command ----------------------------------------------------------------------------------------------------

PROGRAM = """
import os, signal, sys
from taichi_unifusion.results import saver
saver.SHARE = 1e9
place, number = sys.argv.pop(1).split(":")
calls = 0
def dying(real):
    def call(*arguments, **options):
        global calls
        calls += 1
        if calls == int(number):
            os.kill(os.getpid(), signal.SIGKILL)
        return real(*arguments, **options)
    return call
if place == "replace":
    os.replace = dying(os.replace)
from taichi_unifusion.cli.start import main
sys.exit(main())
"""


def command(place: str, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, place, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


def test_c10_R7_kill_9_of_the_command_and_resume(tmp_path, capsys):
    recording = write_folder(tmp_path / "recording", make_frames(12))
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, *WINDOW]
    out, undisturbed = RunFolder(tmp_path / "out"), RunFolder(tmp_path / "undisturbed")
    assert cli.main([*arguments, "--save-every", "0", "--out", str(undisturbed.path)]) == 0
    assert not undisturbed.unfinished.exists()

    arguments += ["--save-every", "1e-9", "--out", str(out.path)]
    killed = command("replace:7", *arguments)  # in the middle of the second safe point
    assert killed.returncode == -signal.SIGKILL and out.temporaries and len(out.generations) == 2
    said = inspect(out.path)
    assert "3 of 12 frames are safe" in said.text and "--resume" in said.text and not said.problems

    resumed = command("none:0", *arguments, "--resume")
    assert resumed.returncode == 0 and "going on after 3 of 12 frames" in resumed.stderr
    for name in ("surface", "color"):
        assert out.map(name).read_bytes() == undisturbed.map(name).read_bytes()
    assert out.mesh.read_bytes() == undisturbed.mesh.read_bytes()
    assert not out.unfinished.exists() and not list(out.path.rglob("*.tmp"))
    assert not inspect(out.path).problems and not out.lock.exists()
    assert read_record(out.record).frames == read_record(undisturbed.record).frames

    capsys.readouterr()
    before = out.record.read_bytes()
    assert cli.main([*arguments, "--resume"]) == 0 and out.record.read_bytes() == before
    assert "holds the whole run already" in capsys.readouterr().err


def test_a_run_that_is_stopped_is_written_and_can_go_on(tmp_path, monkeypatch, capsys):
    """Poses that a tracker found are kept, and not found again."""
    recording = write_folder(tmp_path / "recording", make_frames(8))
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, *WINDOW, "--tracking", "rgbd"]
    out, undisturbed = RunFolder(tmp_path / "out"), RunFolder(tmp_path / "undisturbed")
    assert cli.main([*arguments, "--out", str(undisturbed.path)]) == 0
    arguments += ["--save-every", "1e-9", "--out", str(out.path)]
    monkeypatch.setattr(saver, "SHARE", 1e9)
    with monkeypatch.context() as patch:
        step = Pipeline.step

        def stopping(pipeline, frame):
            if frame.index == 5:
                os.kill(os.getpid(), signal.SIGINT)
            return step(pipeline, frame)

        patch.setattr(Pipeline, "step", stopping)
        assert cli.main(arguments) == 130
    assert "3 frames are safe: the same command with --resume goes on" in capsys.readouterr().err
    assert read_record(out.record).frames.used == 6 and out.mesh.exists()

    def again(*arguments, **options):
        raise AssertionError("frames are tracked a second time")

    monkeypatch.setattr(mapping, "track", again)
    assert cli.main([*arguments, "--resume"]) == 0
    for name in ("surface", "color"):
        assert out.map(name).read_bytes() == undisturbed.map(name).read_bytes()
    for file, same in (
        (out.tracking, undisturbed.tracking),
        (out.trajectory, undisturbed.trajectory),
    ):
        assert file.read_text() == same.read_text()
    assert read_record(out.record).tracking["mode"] == "rgbd" and not out.unfinished.exists()


def test_a_killed_run_in_tiles_leaves_earlier_results_and_goes_on(tmp_path, monkeypatch):
    recording = write_folder(tmp_path / "recording", make_frames(7))
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, *WINDOW, "--map-memory", "1MB"]
    arguments += ["--mesh.formats", "ply", "--save-every", "1e-9", "--out", str(tmp_path / "out")]
    monkeypatch.setattr(saver, "SHARE", 1e9)
    monkeypatch.setattr(working_set, "parse_bytes", lambda *_: 100_000)
    out = RunFolder(tmp_path / "out")
    assert cli.main(arguments) == 0 and not out.working_tiles.exists()
    files = {file: file.read_bytes() for file in out.map_folder.rglob("*") if file.is_file()}
    expected = {name: read_stored(path)[1].tensors for name, path in out.maps.items()}
    assert len(files) > 4
    step = Pipeline.step

    def dying(pipeline, frame):
        if frame.index == 5:
            raise Killed
        return step(pipeline, frame)

    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(Pipeline, "step", dying)
        cli.main(arguments)
    assert all(file.read_bytes() == data for file, data in files.items())
    said = inspect(out.path)
    assert "3 of 7 frames are safe" in said.text and out.working_tiles.exists()
    assert len(safe_point.mesh_of_safe_point(out).faces) > 100

    assert cli.main([*arguments, "--resume"]) == 0
    for name, tensors in expected.items():
        _, found = read_stored(out.maps[name])
        for part, values in tensors.items():
            np.testing.assert_array_equal(found.tensors[part], values)
    assert not out.unfinished.exists() and not out.working_tiles.exists()
    assert not inspect(out.path).problems
