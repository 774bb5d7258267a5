"""Up and the viewpoints of pictures: found once, kept in the record, the same before and after."""

from __future__ import annotations

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from meshes import joined, parallelogram

from taichi_unifusion import Mesh, Trajectory
from taichi_unifusion.cli import main as cli
from taichi_unifusion.datasets.synthetic import look_at
from taichi_unifusion.errors import InputError
from taichi_unifusion.files.trajectories import write_trajectory
from taichi_unifusion.geometry.gravity import Up, parse_up
from taichi_unifusion.results.outlook import look_at_mesh, read_outlook, read_up
from taichi_unifusion.results.record import RunRecord, read_record, write_record
from taichi_unifusion.results.run_folder import RunFolder

LEAST = {  # what any record has to say
    "device_name": "CPU",
    "frames": {"used": 2, "skipped": 0, "interrupted": False, "skipped_frames": []},
    "milliseconds": {"frame": {"median": 5, "mean": 6.5}},
    "versions": {"taichi_unifusion": "0.1.0"},
}
TILTED = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])


@pytest.fixture
def folder(tmp_path) -> RunFolder:
    return RunFolder(tmp_path)


def corner() -> tuple[Mesh, Trajectory]:
    """A floor, half a metre below the origin, and two walls in a tilted world, and a camera."""
    inside = joined(
        parallelogram((0, 0, -0.5), (2, 0, 0), (0, 2, 0)),
        parallelogram((0, 0, -0.5), (0, 2, 0), (0, 0, 1.5)),
        parallelogram((0, 0, -0.5), (0, 0, 1.5), (2, 0, 0)),
    )
    mesh = Mesh((inside.vertices @ TILTED.T).astype(np.float32), inside.faces)
    pose = look_at((1.5, 1.5, 0.8), (0.2, 0.1, 0))
    pose[:3] = TILTED @ pose[:3]
    return mesh, Trajectory(np.zeros(1), pose[None])


def test_an_outlook_is_kept_and_read_back(folder):
    mesh, trajectory = corner()
    outlook = look_at_mesh(mesh, trajectory)
    assert outlook.up.how == "floor" and np.allclose(outlook.up.direction, TILTED[:, 2], atol=1e-3)
    write_record(folder.record, outlook.kept_in(RunRecord.from_json(LEAST)))
    T_up_world = np.array(json.loads(folder.record.read_text())["T_up_world"])
    heights = mesh.vertices @ T_up_world[2, :3] + T_up_world[2, 3]
    assert np.isclose(heights.min(), 0, atol=1e-3)  # the floor is at z = 0
    read = read_outlook(folder, mesh)
    assert read.up.how == "floor" and np.allclose(read.up.T_up_world, T_up_world)
    for view, before in zip(read.views, outlook.views, strict=True):
        assert view.camera == before.camera and view.near == before.near
        assert np.array_equal(view.T_world_camera, before.T_world_camera)


def test_another_mesh_is_seen_by_the_same_cameras_and_another_up_moves_them(folder):
    mesh, trajectory = corner()
    before = look_at_mesh(mesh, trajectory)
    write_record(folder.record, before.kept_in(RunRecord.from_json(LEAST)))
    write_trajectory(folder.trajectory, trajectory)
    larger = Mesh(3 * mesh.vertices, mesh.faces, None, mesh.attributes)
    after = read_outlook(folder, larger)
    assert after.up.how == "floor"
    assert np.array_equal(after.views[1].T_world_camera, before.views[1].T_world_camera)
    other = read_outlook(folder, mesh, parse_up("y"))
    assert other.up.how == "given" and np.allclose(other.up.direction, (0, 1, 0))
    assert not np.allclose(other.views[1].T_world_camera, before.views[1].T_world_camera)


@pytest.mark.parametrize("record", [None, "", LEAST, {**LEAST, "T_up_world": [[1]], "up": "floor"}])
def test_folders_that_do_not_say_are_asked_by_their_mesh(folder, record):
    """Those of older versions, and damaged ones."""
    mesh, trajectory = corner()
    write_trajectory(folder.trajectory, trajectory)
    if record is not None:
        folder.record.write_text(record if record == "" else json.dumps(record))
    up = read_up(folder, mesh)
    assert up.how == "floor" and np.allclose(up.direction, TILTED[:, 2], atol=1e-3)
    assert len(read_outlook(folder, mesh).views) == 2


@pytest.mark.parametrize(
    ("text", "direction"),
    [("z", (0, 0, 1)), ("-y", (0, -1, 0)), (" X ", (1, 0, 0)), ("0,-3,4", (0, -0.6, 0.8))],
)
def test_up_as_users_write_it(text, direction):
    up = parse_up(text)
    assert up.how == "given" and np.allclose(up.direction, direction)


@pytest.mark.parametrize("text", ["", "w", "1,2", "0,0,0", "1,2,nan", "--z", "1,2,3,4", "inf,0,0"])
def test_no_direction_is_told(text):
    with pytest.raises(InputError, match="expected an axis as z or -y"):
        parse_up(text)


def test_a_run_keeps_up_and_a_new_mesh_keeps_the_cameras(tmp_path, capsys):
    out = tmp_path / "run"
    options = ["--option", "frames=60", "--option", "width=160", "--option", "height=120"]
    options += ["--every", "20", "--mesh.formats", "ply"]
    assert cli.main(["reconstruct", "synthetic", *options, "--out", str(out)]) == 0
    assert "(the floor's normal)" in capsys.readouterr().out
    record, before = read_record(out / "metrics.json"), cv2.imread(str(out / "preview.png"))
    assert record.up == "floor" and np.array(record.T_up_world)[2, 2] > np.cos(np.radians(1))
    assert cli.main(["mesh", str(out), "--resolution", "3"]) == 0
    again, after = read_record(out / "metrics.json"), cv2.imread(str(out / "preview.png"))
    assert again.views == record.views and again.T_up_world == record.T_up_world
    assert not np.array_equal(before, after)
    changed, moved = (
        np.abs(b.astype(int) - after).mean() for b in (before, np.roll(before, 40, 1))
    )
    assert changed < 0.7 * moved  # what is seen has changed, but not where it is
    assert cli.main(["mesh", str(out), "--resolution", "2", "--up=-z"]) == 0
    turned = read_record(out / "metrics.json")
    assert turned.up == "given" and np.array(turned.T_up_world)[2, 2] == -1
    assert cli.main(["mesh", str(out), "--up=0,0"]) == 2
    assert "expected an axis" in capsys.readouterr().err
    assert cli.main(["info", str(out)]) == 0
    assert "-1.00 (given)" in capsys.readouterr().out


def test_a_given_up_is_unit_length_in_the_record(folder):
    mesh, trajectory = corner()
    kept = look_at_mesh(mesh, trajectory, Up(np.array([0, 0, 1.0]), "given"))
    record = kept.kept_in(RunRecord.from_json(LEAST))
    assert record.up == "given" and record.T_up_world == tuple(map(tuple, np.eye(4).tolist()))
    assert replace(record, views=()) != record
