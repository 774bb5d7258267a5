"""`unifusion merge`: what two runs saw of one place is one map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from mesh_laws import assert_welded
from windows import CONFIG, contents, place_of, seen_from, stepped

from taichi_unifusion import load_map
from taichi_unifusion.cli.main import main
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results.run_folder import RunFolder
from taichi_unifusion.results.writer import write_results

ROUNDING = 1e-6  # of the largest latent: the same windows, added in another order


def frames(place: int) -> list:
    return [seen_from(place_of(n), n + 1, origin=(place, 0, 0)) for n in range(place, place + 4)]


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> list[RunFolder]:
    """Two places, and both; one of them in tiles."""
    folders = []
    for n, limit in ((0, ""), (3, "1MB")):
        folder = RunFolder(tmp_path_factory.mktemp(f"run{n}"))
        pipeline = Pipeline(replace(CONFIG, map_memory=limit), tiles=folder.map_folder)
        assert not write_results(folder.path, pipeline, pipeline.run(frames(n))).failures
        folders.append(folder)
    return folders


def test_two_maps_become_one(runs, tmp_path, capsys):
    out = RunFolder(tmp_path / "both")
    assert main(["merge", *(str(run.path) for run in runs), "--out", str(out.path)]) == 0
    assert "from 2 maps" in capsys.readouterr().out
    expected = stepped(frames(0))
    expected.flush()
    for frame in frames(3):
        expected.step(frame)
    expected.flush()
    for name, each in expected.maps.items():
        a, b = each.voxels(), load_map(out.maps[name]).voxels()
        np.testing.assert_array_equal(a.keys, b.keys)
        np.testing.assert_array_equal(a.weights, b.weights)
        np.testing.assert_allclose(a.latents, b.latents, atol=ROUNDING * np.abs(a.latents).max())
    mesh = read_mesh(out.mesh)
    assert_welded(mesh.vertices, mesh.faces)
    assert sorted(path.name for path in out.map_folder.iterdir()) == ["color", "surface"]
    assert contents(expected)  # what was compared is not empty


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["one"], "at least two"),
        (["one", "two"], "no maps/surface"),
        (["run", "run"], "one of the folders"),
    ],
)
def test_what_cannot_be_merged_is_said(runs, tmp_path, capsys, names, message):
    places = [str(runs[0].path) if name == "run" else str(tmp_path / name) for name in names]
    out = places[0] if "run" in names else str(tmp_path / "out")
    assert main(["merge", *places, "--out", out]) == 2
    assert message in capsys.readouterr().err


def test_maps_of_other_settings_are_not_added_up(runs, tmp_path, capsys):
    other = RunFolder(tmp_path / "other")
    config = replace(CONFIG, surface=replace(CONFIG.surface, noise=0.7))
    pipeline = Pipeline(config)
    write_results(other.path, pipeline, pipeline.run(frames(0)))
    assert main(["merge", str(runs[0].path), str(other.path), "--out", str(tmp_path / "out")]) == 2
    assert "cannot be added up" in capsys.readouterr().err
