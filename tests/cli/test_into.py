"""`unifusion reconstruct --into`: a recording of another day, in a world of its own, joins a map."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from killing import killed_at
from scipy.spatial import cKDTree

from taichi_unifusion.cli import live, viewing
from taichi_unifusion.cli.main import main
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.tiles import TileFolder
from taichi_unifusion.files.trajectories import read_trajectory
from taichi_unifusion.geometry import se3
from taichi_unifusion.maps.stored import read_stored
from taichi_unifusion.maps.window_store import WindowStore
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results import read_record, saver
from taichi_unifusion.results.folder_writer import FolderWriter
from taichi_unifusion.results.reader import CAMERA
from taichi_unifusion.results.run_folder import RunFolder
from taichi_unifusion.tracking.keyframe_file import read_keyframes
from taichi_unifusion.viewer.live import ChangedChunks
from taichi_unifusion.viewer.null import NullViewer

ROOM = ["synthetic", "--option", "frames=120", "--option", "width=240", "--option", "height=180"]
SMALL = ["--voxel-size", "0.1", "--window", "4", "--device", "cpu", "--color-camera", "none"]
SMALL += ["--mesh.resolution", "2", "--mesh.formats", "ply"]
OFF = 0.002, 0.1  # [m, degrees] of a camera that found its place; 0.3 mm and 0.01 degrees are usual
SECOND, THIRD = {"start": 8, "end": 16}, {"start": 12, "end": 20}
APART = 0.002  # [m] between surfaces, in the mean


def reconstruct(*words: str, start: int = 0, end: int) -> int:
    return main(["reconstruct", *ROOM, "--start", str(start), "--end", str(end), *words])


@pytest.fixture(scope="module")
def monday(tmp_path_factory):
    """The map of the first frames, with its windows."""
    folder = tmp_path_factory.mktemp("monday") / "results"
    assert reconstruct(*SMALL, "--keep-windows", "--out", str(folder), end=14) == 0
    return folder


@pytest.fixture(scope="module")
def both(monday, tmp_path_factory):
    """With frames of a second recording, whose world begins at its first camera."""
    folder = tmp_path_factory.mktemp("both") / "results"
    words = ["--tracking", "rgbd", "--into", str(monday), "--out", str(folder)]
    assert reconstruct(*words, start=8, end=24) == 0
    return folder


@pytest.fixture(scope="module")
def of_both(tmp_path_factory):
    """The map of all frames at their true poses; those from 8 to 13 are in both recordings."""
    folder = tmp_path_factory.mktemp("all") / "results"
    assert reconstruct(*SMALL, "--out", str(folder), end=24) == 0
    return folder


@pytest.fixture(scope="module")
def tuesday(tmp_path_factory):
    """The second recording by itself, in its own world."""
    folder = tmp_path_factory.mktemp("tuesday") / "results"
    words = [*SMALL, "--tracking", "rgbd", "--tracking-passes", "1", "--out", str(folder)]
    assert reconstruct(*words, start=8, end=24) == 0
    return folder


def test_the_camera_finds_its_place(both):
    found = read_trajectory(both / "trajectory.txt").T_world_camera
    truth = SyntheticRoom(frames=120).T_world_camera[8:24]
    off = np.array([se3.distance(a, b) for a, b in zip(found, truth, strict=True)])
    assert off[:, 0].max() < OFF[0] and np.degrees(off[:, 1].max()) < OFF[1]
    tracked = read_trajectory(both / "tracking.txt").T_world_camera
    np.testing.assert_allclose(tracked, found, atol=1e-6)


def assert_same_surface(folder, other):
    """All but some rims, which other rays cut."""
    ours, theirs = (cKDTree(read_mesh(f / "mesh.ply").vertices) for f in (folder, other))
    for a, b in ((ours, theirs), (theirs, ours)):
        distance = a.query(b.data)[0]
        assert np.median(distance) < APART and np.mean(distance < 0.02) > 0.97


def test_the_map_is_that_of_both_recordings(both, of_both):
    assert_same_surface(both, of_both)


def test_what_a_map_was_made_from_is_kept(both, monday):
    before, after = RunFolder(monday), RunFolder(both)
    source = json.loads(after.record.read_text())["recording"]
    assert [each["start"] for each in source["before"]] == [0] and source["start"] == 8
    first, all_ = WindowStore.open(before.windows), WindowStore.open(after.windows)
    assert len(all_) == len(first) + 4
    places = [place for kept in all_.windows for place in kept.frames]
    assert places == list(range(14)) + list(range(14 + 8, 14 + 24))
    ours = read_keyframes(after.keyframes)
    assert len(ours) > len(read_keyframes(before.keyframes)) > 2


def test_two_results_become_one_in_the_world_of_the_first(
    monday, tuesday, of_both, tmp_path, capsys
):
    out = tmp_path / "merged"
    words = ["merge", str(monday), str(tuesday), "--align", "--resolution", "2", "--out", str(out)]
    assert main(words) == 0
    assert "views were recognised" in capsys.readouterr().out
    assert_same_surface(out, of_both)
    record = json.loads((out / "metrics.json").read_text())
    assert record["recording"]["start"] == 0 and record["recording"]["before"][0]["start"] == 8
    assert len(WindowStore.open(out / "windows.log")) == 4 + 4
    assert main(["info", str(out)]) == 0
    assert len(read_keyframes(out / "keyframes.log")) > len(
        read_keyframes(monday / "keyframes.log")
    )


def test_what_came_from_a_camera_is_brought_together_by_its_own_keyframes(
    monday, tmp_path, monkeypatch, capsys
):
    """Nobody can open its recording again: those of the tracker are kept."""
    seen, out = tmp_path / "live", tmp_path / "merged"
    with monkeypatch.context() as patch:
        patch.setattr(live, "source_of", lambda *_: None)
        words = [*SMALL, "--tracking", "rgbd", "--live", "--live-speed", "0.1"]
        assert reconstruct(*words, "--out", str(seen), **SECOND) == 0
    assert read_record(seen / "metrics.json").recording is None
    poses = read_trajectory(seen / "tracking.txt").T_world_camera
    kept = read_keyframes(seen / "keyframes.log")
    for T in kept.T_world_keyframe:
        assert min(se3.distance(T, each)[0] for each in poses) < 1e-6
    words = ["merge", str(monday), str(seen), "--align", "--resolution", "2", "--out", str(out)]
    assert main(words) == 0
    assert "views were recognised" in capsys.readouterr().out
    assert [each.format for each in read_record(out / "metrics.json").recording.before] == [CAMERA]
    both = ["--into", str(seen), "--out", str(tmp_path / "both")]
    assert reconstruct(*both, **SECOND) == 0  # a map from a camera is added to, too


def test_worlds_that_are_not_the_same_are_not_added_up(monday, tuesday, tmp_path, capsys):
    out = str(tmp_path / "merged")
    assert main(["merge", str(monday), str(tuesday), "--out", out]) == 2
    assert "--align" in capsys.readouterr().err


def test_a_map_is_added_to_in_place_again_and_again(tmp_path, capsys):
    """Without keyframes: they are taken from the recording that is still there."""
    folder = tmp_path / "results"
    assert reconstruct(*SMALL, "--out", str(folder), end=6) == 0
    voxels = []
    for start in (3, 7):
        assert reconstruct("--into", str(folder), start=start, end=start + 6) == 0
        record = json.loads((folder / "metrics.json").read_text())
        voxels.append(record["maps"]["surface"]["voxels"])
        assert "added    to" in capsys.readouterr().out
    assert voxels[1] > voxels[0] and len(record["recording"]["before"]) == 2
    assert record["tracking"]["joined"]["recognised"] >= 2
    T = np.array(record["tracking"]["joined"]["T_map_recording"])
    assert se3.distance(np.eye(4), T)[0] < OFF[0]  # the same world
    assert (folder / "keyframes.log").exists() and not (folder / "windows.log").exists()
    t = folder / "trajectory.txt"
    assert main(["repose", str(folder), "--trajectory", str(t)]) == 2  # no windows


def test_a_recording_of_another_place_leaves_the_map_as_it_is(monday, capsys):
    before = {file.name: file.read_bytes() for file in monday.iterdir() if file.is_file()}
    assert reconstruct("--tracking", "rgbd", "--into", str(monday), start=70, end=76) == 2
    assert "does not find its place" in capsys.readouterr().err
    assert before == {file.name: file.read_bytes() for file in monday.iterdir() if file.is_file()}


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--voxel-size", "0.2"], "'voxel_size' is another one"),
        (["--live"], "--live"),
        (["--workers", "2"], "--workers"),
    ],
)
def test_what_does_not_go_with_it_is_said(monday, capsys, words, message):
    assert reconstruct("--into", str(monday), *words, end=8) == 2
    assert message in capsys.readouterr().err


def test_a_folder_without_results_is_named(tmp_path, capsys):
    assert reconstruct("--into", str(tmp_path / "none"), end=8) == 2
    assert "config.yaml" in capsys.readouterr().err


# --- Runs that are ended, and maps in tiles -------------------------------------------------------------------------


def killed(patch, owner, name: str, call: int, *words: str, **frames: int) -> None:
    """A run that dies when a function is called for the so manieth time."""
    with killed_at(patch, owner, name, call):
        reconstruct(*words, **frames)


def voxels(folder: Path) -> dict[str, dict[str, bytes]]:
    """All that the maps of a folder hold, in one order, wherever they lie."""
    found = {}
    for name, path in RunFolder(folder).maps.items():
        tensors = read_stored(path)[1].tensors
        order = np.lexsort(tensors["keys"].T)
        found[name] = {each: values[order].tobytes() for each, values in tensors.items()}
    return found


@pytest.fixture(scope="module")
def grown(monday, tmp_path_factory):
    """The map of Monday with frames at given poses, of which no windows are kept."""
    folder = tmp_path_factory.mktemp("grown") / "results"
    assert reconstruct("--into", str(monday), "--forget", "--out", str(folder), **SECOND) == 0
    return folder


def test_a_run_that_is_ended_goes_on_in_the_folder_of_the_map(
    monday, grown, tmp_path, monkeypatch, capsys
):
    """Ended after its safe point, and then while it writes over the map that it began with."""
    folder = tmp_path / "results"
    shutil.copytree(monday, folder)
    words = ["--into", str(folder), "--forget"]
    killed(monkeypatch, Pipeline, "step", 7, *words, **SECOND)
    assert read_record(folder / "metrics.json").frames.used == 14  # as it was
    words.append("--resume")
    killed(monkeypatch, FolderWriter, "write", 3, *words, **SECOND)
    assert "going on after 4 of 8 frames" in capsys.readouterr().err
    assert reconstruct(*words, **SECOND) == 0
    assert voxels(folder) == voxels(grown)
    ours, theirs = (json.loads((f / "metrics.json").read_text()) for f in (folder, grown))
    assert len(ours["recording"]["before"]) == len(theirs["recording"]["before"]) == 1
    assert len(read_keyframes(folder / "keyframes.log")) == len(
        read_keyframes(grown / "keyframes.log")
    )
    assert not RunFolder(folder).unfinished.exists() and not RunFolder(folder).temporaries
    capsys.readouterr()
    assert reconstruct(*words, **SECOND) == 0
    assert "holds the whole run already" in capsys.readouterr().err


def test_windows_of_both_recordings_survive_what_ends_a_run(monday, tmp_path, monkeypatch):
    """While a safe point is made, while frames are fused, and while results are written."""
    folder, whole = tmp_path / "results", tmp_path / "whole"
    assert reconstruct("--into", str(monday), "--out", str(whole), **SECOND) == 0
    shutil.copytree(monday, folder)
    monkeypatch.setattr(saver, "SHARE", 1e9)  # safe points at every border
    words = ["--into", str(folder), "--save-every", "1e-9"]
    killed(monkeypatch, saver, "write_state", 1, *words, **SECOND)
    words.append("--resume")
    killed(monkeypatch, Pipeline, "step", 7, *words, **SECOND)
    assert read_record(folder / "metrics.json").frames.used == 14  # as it was
    killed(monkeypatch, FolderWriter, "write", 3, *words, **SECOND)
    assert reconstruct(*words, **SECOND) == 0
    assert voxels(folder) == voxels(whole)
    ours, theirs = (WindowStore.open(each / "windows.log").windows for each in (folder, whole))
    assert [kept.frames for kept in ours] == [kept.frames for kept in theirs]
    assert [kept.record.checksum for kept in ours] == [kept.record.checksum for kept in theirs]
    assert all(np.array_equal(a.place, b.place) for a, b in zip(ours, theirs, strict=True))
    assert not RunFolder(folder).unfinished.exists() and not RunFolder(folder).temporaries
    assert main(["info", str(folder)]) == 0


def test_maps_in_tiles_are_added_to(monday, grown, tmp_path, monkeypatch):
    """A map in one file grows into tiles, and these go on, also after the run was ended."""
    tiled, again = tmp_path / "tiled", tmp_path / "again"
    words = ["--into", str(monday), "--map-memory", "1GB", "--out", str(tiled)]
    assert reconstruct(*words, **SECOND) == 0
    assert TileFolder.is_one(RunFolder(tiled).maps["surface"]) and voxels(tiled) == voxels(grown)
    assert reconstruct("--into", str(tiled), "--out", str(again), **THIRD) == 0
    words = ["--into", str(tiled)]
    killed(monkeypatch, Pipeline, "step", 7, *words, **THIRD)
    assert reconstruct(*words, "--resume", **THIRD) == 0
    assert voxels(tiled) == voxels(again) != voxels(grown)
    assert main(["info", str(tiled)]) == 0


def test_who_watches_sees_the_map_that_is_added_to(monday, tmp_path, monkeypatch):
    shown: dict = {}

    class Looking(NullViewer):
        def on_step(self, frame, step, pipeline):
            if not shown:
                shown.update(ChangedChunks().take(pipeline, frame, 10_000))

    monkeypatch.setattr(viewing, "open_watcher", lambda *_: Looking())
    words = ["--into", str(monday), "--out", str(tmp_path / "results")]
    assert reconstruct(*words, **SECOND) == 0
    seen = np.concatenate([mesh.vertices for mesh in shown.values() if len(mesh.faces)])
    before = read_mesh(monday / "mesh.ply").vertices
    assert np.quantile(cKDTree(seen).query(before)[0], 0.9) < 0.1
