"""Options that every format takes: how poses are meant, clocks, intrinsics; and files of answers."""

from __future__ import annotations

import numpy as np
import pytest
from dataset_writers import make_samples, write_folder, write_tum

from taichi_unifusion.datasets import open_dataset, parse_options
from taichi_unifusion.datasets.doctor.fix import Fix, read_fix, write_fix
from taichi_unifusion.datasets.pose_readings import FLIP_YZ
from taichi_unifusion.errors import DatasetError, InputError


@pytest.fixture(scope="module")
def samples():
    return make_samples(6)


def test_poses_are_taken_as_the_options_say(tmp_path, samples):
    folder = write_folder(tmp_path / "r", samples)
    for i, sample in enumerate(samples):
        T = np.linalg.inv(sample.T_world_camera @ FLIP_YZ)
        T[:3, 3] *= 100
        np.savetxt(folder / "poses" / f"{i:06d}.txt", T)
    options = parse_options("folder", ["pose_reading=w2c+opengl", "pose_scale=0.01"])
    mended = open_dataset("folder", folder, **options)
    for i, sample in enumerate(samples):
        np.testing.assert_allclose(mended[i].T_world_camera, sample.T_world_camera, atol=1e-9)
        np.testing.assert_allclose(mended.pose_at(i)[1], sample.T_world_camera, atol=1e-9)
    assert mended.without_poses()[0].T_world_camera is None
    assert len(mended[2:4]) == 2 and mended[2:4][0].index == 2


def test_intrinsics_are_given_where_the_recording_has_none_or_wrong_ones(tmp_path, samples):
    folder = write_folder(tmp_path / "r", samples)
    text = (folder / "camera.yaml").read_text().replace("cx: 7.5", "cx: 75")
    (folder / "camera.yaml").write_text(text)
    with pytest.raises(DatasetError, match="another resolution"):
        open_dataset("folder", folder)
    for value in ("15,14,7.5,5.5", [15, 14, 7.5, 5.5], (15.0, 14.0, 7.5, 5.5)):
        camera = open_dataset("folder", folder, intrinsics=value)[0].camera
        assert (camera.size, camera.intrinsics) == ((16, 12), (15, 14, 7.5, 5.5))
    rendered = open_dataset("synthetic", frames=2, width=32, height=24, intrinsics="20,20,15,11")
    assert rendered[0].camera.fx == 20
    tum = open_dataset("tum", write_tum(tmp_path / "tum", samples), intrinsics="15,14,7.5,5.5")
    assert not tum.warnings and tum[0].camera.fx == 15


def test_a_clock_offset_moves_poses_in_time(tmp_path, samples):
    folder = write_tum(tmp_path / "tum", samples)
    step = samples[1].timestamp - samples[0].timestamp
    moved = open_dataset("tum", folder, intrinsics="15,14,7.5,5.5", clock_offset=step)
    for i in range(len(samples) - 1):
        np.testing.assert_allclose(
            moved[i].T_world_camera, samples[i + 1].T_world_camera, atol=1e-5
        )
    with pytest.raises(DatasetError, match="no pose at its time stamp plus the clock offset"):
        moved[len(samples) - 1]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("pose_reading=opengll", "did you mean 'opengl'"),
        ("pose_scale=-1", "positive"),
        ("pose_scale=x", "expected a number"),
        ("clock_offset=1e9", "within 3600 s"),
        ("intrinsics=1,2,3", "numbers with / between them"),
    ],
)
def test_wrong_ones_are_said(text, told):
    with pytest.raises(InputError, match=told):
        parse_options("folder", [text])


def test_a_file_of_answers_comes_back_and_another_file_is_refused(tmp_path):
    file = tmp_path / "fix.yaml"
    fix = Fix({"pose_reading": "w2c", "depth_scale": 5000.0}, {"preprocess": {"depth_max": 8.0}})
    write_fix(file, fix)
    assert read_fix(file) == fix
    write_fix(file, Fix())
    assert read_fix(file) == Fix()
    file.write_text("device: cpu\n")
    with pytest.raises(InputError, match="sections recording and settings"):
        read_fix(file)
