"""The doctor on synthetic frames spoiled in every way: the right cause, and no other; nothing on
sound ones. `benchmarks/doctor.py` does the same on real recordings.
"""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny_recording import write_folder

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "benchmarks"))

import doctor as bench
import doctor_spoilings as spoilings

from taichi_unifusion.cli import main as cli
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.doctor import CAUSES, Fix, examine
from taichi_unifusion.datasets.doctor.color import find_shift
from taichi_unifusion.datasets.doctor.evidence import Change, Evidence
from taichi_unifusion.datasets.doctor.order import misfits
from taichi_unifusion.datasets.doctor.sampling import take_sample
from taichi_unifusion.datasets.pose_readings import FLIP_YZ
from taichi_unifusion.datasets.synthetic import SyntheticRoom

# a steady walk: poses of a moment later fit nearly as well
NOT_SEEN = {"clock 0.2 s late", "clock 0.3 s early"}


@pytest.fixture(scope="module")
def frames():
    return list(SyntheticRoom(frames=100, width=160, height=120)[:12])


def test_sound_frames_are_sound(frames):
    diagnosis = bench.examined(frames)
    assert diagnosis.sound and diagnosis.findings == () and diagnosis.fix == Fix()
    assert "160x120" in diagnosis.facts["depth"] and "12" in diagnosis.facts["frames"]


@pytest.mark.parametrize("title", [title for title in spoilings.SPOILINGS if title not in NOT_SEEN])
def test_the_right_cause_is_named_and_no_other(frames, title):
    spoiling = spoilings.SPOILINGS[title]
    diagnosis = bench.examined(spoiling.change(frames), spoiling.depth_scale)
    named = {finding.cause for finding in diagnosis.findings}
    assert named == {spoiling.cause}, [finding.sentence for finding in diagnosis.findings]
    assert named <= set(CAUSES)


def test_answers_mend_what_they_were_given_for(frames, tmp_path, capsys):
    spoiled = spoilings.by_pose(lambda T: np.linalg.inv(T @ FLIP_YZ))(spoilings.longer(100)(frames))
    folder = write_folder(tmp_path / "r", spoiled)
    fix = tmp_path / "fix.yaml"
    assert cli.main(["check", "folder", str(folder), "--fix", str(fix)]) == 2
    out = capsys.readouterr().out
    assert "OpenGL" in out and "--pose-reading w2c+opengl --pose-scale 0.01" in out
    assert yaml.safe_load(fix.read_text())["recording"] == {
        "pose_reading": "w2c+opengl",
        "pose_scale": 0.01,
    }
    options = ["--pose-reading", "w2c+opengl", "--pose-scale", "0.01"]
    assert cli.main(["check", "folder", str(folder), *options, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sound"] is True


def test_a_recording_that_cannot_be_opened_is_a_finding(frames, tmp_path, capsys):
    folder = write_folder(tmp_path / "r", frames[:4])
    (folder / "camera.yaml").unlink()
    assert cli.main(["check", "folder", str(folder)]) == 2
    assert "camera.yaml: no such file" in capsys.readouterr().out


@pytest.mark.parametrize("name", list(bench.ON_DISK))
def test_odd_time_stamps_are_said(frames, name):
    assert bench.on_disk(name, frames) == {bench.ON_DISK[name]}


def test_frames_that_cannot_be_read_are_counted(frames, tmp_path):
    folder = write_folder(tmp_path / "r", frames[:5])
    (folder / "depth" / "3.png").write_bytes(b"nothing")
    diagnosis = examine(open_dataset("folder", folder))
    assert [f.cause for f in diagnosis.findings] == ["unreadable"]
    assert "1 of 5 frames" in diagnosis.findings[0].sentence


def test_how_far_colour_is_off(frames):
    for right, down in ((16, 0), (-20, 12)):
        found = find_shift(spoilings.beside(right, down)(frames))
        # half of it in images 320 pixels wide; textures pull by a few pixels
        np.testing.assert_allclose(found, (right / 2, down / 2), atol=4)
    grey = [replace(f, color=np.full_like(f.color, 90)) for f in frames]
    assert find_shift(grey) is None


def smaller(frames, factor: float):
    """The same scene as a model of it: depth and ways shorter by a factor."""
    return spoilings.longer(factor)(spoilings.deeper(factor)(frames))


def test_a_unit_of_depth_is_found_in_a_scene_as_near_as_a_table(frames):
    """Five times as deep, it looks like a room."""
    near = smaller(frames, 0.15)
    assert bench.examined(near).sound
    (found,) = bench.examined(spoilings.deeper(5)(near), depth_scale=200.0).findings
    assert found.cause == "depth-scale" and found.fix.recording == {"depth_scale": 1000.0}


def test_where_both_units_are_usual_both_are_said(frames):
    (found,) = bench.examined(spoilings.deeper(0.2)(frames), depth_scale=5000.0).findings
    assert {found.cause, *found.rivals} == {"depth-scale", "pose-scale"}
    assert "--depth-scale 1000" in found.advice and "--pose-scale" in found.advice


def test_a_jump_of_exposure_to_white_is_found_and_a_slow_change_is_none(frames):
    bright = [replace(f, color=(155 + f.color // 3).astype(np.uint8)) for f in frames]
    jump = spoilings.SPOILINGS["jump of exposure"].change(bright)
    assert bench.causes(bench.examined(jump)) == {"exposure"}
    slow = [
        replace(f, color=(f.color * (0.7 + 0.3 * i / len(frames))).astype(np.uint8))
        for i, f in enumerate(frames)
    ]
    assert bench.examined(slow).sound


@pytest.mark.parametrize("factor", [0.75, 1.25])
def test_intrinsics_of_a_resolution_not_far_away_are_found_where_frames_move(frames, factor):
    """The principal point lies no farther off than a camera's own may, but with the focal length it tells."""
    (found,) = bench.examined(spoilings.resized(factor)(frames)).findings
    assert found.cause == "intrinsics"
    right = frames[0].camera.intrinsics
    np.testing.assert_allclose(found.fix.recording["intrinsics"], right, rtol=0.02)


def test_edges_that_agree_best_where_the_search_ends_tell_nothing():
    """Textures of this stretch, whose colour fits, agree the better the farther colour is moved."""
    room = SyntheticRoom(frames=200, width=320, height=240, seed=9)
    assert find_shift(room[40:60:2]) is None


def test_frames_are_not_out_of_place_where_the_named_change_mends_them(frames):
    """What poses in another unit say of one frame is chance; pictures in each other's place stay so."""

    def misfit(spoiled, change: Change) -> bool:
        sample = take_sample(bench.InMemory(spoiled))
        pairs, _ = sample.pose_pairs()
        return misfits(Evidence(sample, pairs, []), change, [3, 9])

    inches = spoilings.longer(39.37)(frames)
    assert misfit(inches, Change()) and not misfit(inches, Change(scale=1 / 39.37))
    assert misfit(spoilings.exchanged(frames), Change()) and not misfit(frames, Change())
