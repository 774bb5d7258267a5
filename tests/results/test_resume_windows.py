"""Runs that keep their windows, in one pass or at given poses, go on after whatever ended them."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from killing import killed_at
from tiny_recording import CONFIG, FLAGS, make_frames

from taichi_unifusion.cli.main import main
from taichi_unifusion.errors import FileError
from taichi_unifusion.geometry.se3 import exp
from taichi_unifusion.maps import follower, load_map
from taichi_unifusion.maps.window_store import WindowStore
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results import RunFolder, safe_windows, saver
from taichi_unifusion.results.folder_writer import FolderWriter
from taichi_unifusion.results.record import read_record
from taichi_unifusion.results.safe_point import mesh_of_safe_point, read_state

ROOM = ["--option", "frames=60", "--option", "width=160", "--option", "height=120", "--end", "11"]
SMALL = [*FLAGS, "--window", "3", "--mesh.resolution", "2", "--mesh.formats", "ply"]
ONE_PASS = ["--tracking", "rgbd", "--tracking-passes", "1"]
KEPT = ["--keep-windows"]


def reconstruct(out: Path, *words: str) -> int:
    return main(["reconstruct", "synthetic", *ROOM, *SMALL, "--out", str(out), *words])


def killed(monkeypatch, owner, name: str, call: int, out: Path, *words: str) -> None:
    """A run that dies when a function is called for the so manieth time."""
    with killed_at(monkeypatch, owner, name, call):
        reconstruct(out, "--save-every", "1e-9", *words)


@pytest.fixture(autouse=True)
def often(monkeypatch):
    """Safe points at every border, and windows that move when a pose changes at all."""
    monkeypatch.setattr(saver, "SHARE", 1e9)
    monkeypatch.setattr(follower, "LEAST_MOVE", 1e-5)


@pytest.fixture(scope="module", params=[ONE_PASS, KEPT], ids=["one pass", "given poses"])
def whole(request, tmp_path_factory):
    """The words of a run, and where it was never disturbed."""
    out = tmp_path_factory.mktemp("whole") / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(follower, "LEAST_MOVE", 1e-5)
        assert reconstruct(out, "--save-every", "0", *request.param) == 0
    return request.param, RunFolder(out)


def check_same(ours: RunFolder, theirs: RunFolder) -> None:
    for name, path in theirs.maps.items():
        assert ours.map(name).read_bytes() == path.read_bytes()
    for one, other in ((ours.mesh, theirs.mesh), (ours.trajectory, theirs.trajectory)):
        assert one.read_bytes() == other.read_bytes()
    if theirs.tracking.exists():
        assert ours.tracking.read_text() == theirs.tracking.read_text()
    assert not ours.unfinished.exists() and not list(ours.path.rglob("*.tmp"))
    assert main(["info", str(ours.path)]) == 0


def check_same_windows(ours: RunFolder, theirs: RunFolder) -> None:
    """The same windows at the same places, to the bit."""
    one, other = (WindowStore.open(each.windows) for each in (ours, theirs))
    assert [kept.frames for kept in one.windows] == [kept.frames for kept in other.windows]
    for a, b in zip(one.windows, other.windows, strict=True):
        assert np.array_equal(a.place, b.place) and a.record.checksum == b.record.checksum


def test_R7_a_run_that_keeps_windows_goes_on_after_every_death(
    whole, tmp_path, monkeypatch, capsys
):
    """While frames are fused, while a safe point is made, and while results are written."""
    words, undisturbed = whole
    out = RunFolder(tmp_path / "results")
    killed(monkeypatch, Pipeline, "step", 6, out.path, *words)
    state = read_state(out)
    assert state.done == 3 and out.safe_windows.stat().st_size >= state.windows.bytes > 1e4
    assert len(mesh_of_safe_point(out).faces) > 100  # of windows that wait, too
    capsys.readouterr()
    assert main(["info", str(out.path)]) == 0
    said = capsys.readouterr().out
    waits = words == ONE_PASS
    assert "3 of 11 frames are safe" in said
    assert ("waiting 1 window" in said, state.windows.waiting) == (waits, waits)
    assert ("Matern" in said) != waits  # no row of a map that nothing was fused into
    with out.safe_windows.open("ab") as file:
        file.write(b"half of a window")
    killed(monkeypatch, saver, "write_state", 2, out.path, *words, "--resume")
    assert "going on after 3 of 11 frames" in capsys.readouterr().err
    killed(monkeypatch, FolderWriter, "write", 2, out.path, *words, "--resume")
    assert out.windows.exists() and not out.safe_windows.exists()
    assert reconstruct(out.path, *words, "--resume", "--save-every", "1e-9") == 0
    check_same(out, undisturbed)
    check_same_windows(out, undisturbed)
    if words == ONE_PASS:  # else nothing moves
        tracking = read_record(out.record).tracking
        assert tracking["passes"] == 1 and tracking["following"]["moved"] > 0
    capsys.readouterr()
    assert reconstruct(out.path, *words, "--resume") == 0
    assert "holds the whole run already" in capsys.readouterr().err


def test_windows_that_are_forgotten_are_safe_meanwhile(tmp_path, monkeypatch):
    words, out, other = [*ONE_PASS, "--forget"], RunFolder(tmp_path / "a"), tmp_path / "b"
    killed(monkeypatch, Pipeline, "step", 8, out.path, *words)
    assert out.safe_windows.exists()
    assert reconstruct(out.path, *words, "--resume") == 0
    assert not out.windows.exists() and not out.keyframes.exists()
    assert reconstruct(other, *words) == 0
    check_same(out, RunFolder(other))


def test_what_belongs_to_another_run_or_is_cut_off_is_said(tmp_path, monkeypatch, capsys):
    out = RunFolder(tmp_path / "results")
    killed(monkeypatch, Pipeline, "step", 6, out.path, *KEPT)
    capsys.readouterr()
    assert reconstruct(out.path, "--resume") == 2
    assert "poses.windows is not given, and kept in the run" in capsys.readouterr().err
    shutil.copytree(out.path, tmp_path / "cut")
    cut = RunFolder(tmp_path / "cut")
    cut.lock.unlink(missing_ok=True)
    cut.safe_windows.write_bytes(cut.safe_windows.read_bytes()[:1000])
    assert reconstruct(cut.path, *KEPT, "--resume") == 2
    assert "windows.log: damaged (it is cut off)" in capsys.readouterr().err
    sums = out.sums_in(out.generation(read_state(out).generation), "surface")
    monkeypatch.setattr(safe_windows, "_as_counts", lambda rows: rows[:-1])
    assert sums.exists() and reconstruct(out.path, *KEPT, "--resume") == 2
    assert "surface.sums: damaged" in capsys.readouterr().err


def test_maps_go_on_with_their_exact_sums(tmp_path):
    """What is taken out of a map that was read again leaves it as if it had never been there."""
    frames, elsewhere = make_frames(6), exp(np.array([0.03, -0.02, 0.01, 0.02, 0.0, 0.01]))
    config = replace(CONFIG, window=3)

    def moved(pipeline: Pipeline) -> dict[str, dict[str, bytes]]:
        pipeline.follower.move_to({0: elsewhere, 1: None})
        pipeline.follower.finish()
        every = pipeline.maps.items()
        return {n: {k: v.tobytes() for k, v in m.voxels().tensors.items()} for n, m in every}

    first = Pipeline(config, keep=WindowStore(tmp_path / "windows.log"))
    for frame in frames:
        first.step(frame)
    first.flush()
    folder = RunFolder(tmp_path)
    folder.unfinished.mkdir()
    for name, each in first.maps.items():
        each.save(folder.map_in(tmp_path, name))
    safe_windows.save_sums(folder, tmp_path, first.maps)
    then = safe_windows.keep_windows(RunFolder(tmp_path), first.follower)
    maps = {name: load_map(folder.map_in(tmp_path, name)) for name in first.maps}
    safe_windows.restore_sums(folder, tmp_path, maps)
    shutil.copy(tmp_path / "unfinished" / "windows.log", tmp_path / "then.log")
    expected = moved(first)
    shutil.copy(tmp_path / "then.log", tmp_path / "unfinished" / "windows.log")
    again = Pipeline(config, keep=safe_windows.windows_then(folder, then), maps=maps)
    assert moved(again) == expected


def test_a_folder_without_its_windows_is_one_sentence(tmp_path):
    then = safe_windows.StoredWindows(bytes=100, first=0, settled=True)
    with pytest.raises(FileError, match="windows"):
        safe_windows.windows_then(RunFolder(tmp_path), then)
