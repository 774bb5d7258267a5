"""P4, P5 and A: poses that are meant in another way are found out by depth that disagrees, right
ones are left alone.
"""

import re
from dataclasses import replace

import numpy as np
import pytest
from tiny_recording import CONFIG

import taichi_unifusion as uf
from taichi_unifusion.datasets.plausibility import guess_depth_scale
from taichi_unifusion.datasets.pose_convention import (
    FLIP_YZ,
    guess_pose_convention,
    has_moved,
    judge_poses,
)
from taichi_unifusion.datasets.pose_fit import EarlyPairs
from taichi_unifusion.datasets.pose_readings import NAMES, describe, read_as
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.errors import InputError
from taichi_unifusion.geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion


@pytest.fixture(scope="module")
def pair():
    room = uf.open_dataset("synthetic", frames=60, width=160, height=120)
    return room[3], room[6]


def posed(pair, change):
    return [replace(frame, T_world_camera=change(frame.T_world_camera)) for frame in pair]


def test_right_poses_are_left_alone(pair):
    assert has_moved(*pair) and guess_pose_convention(*pair) == (True, None)


@pytest.mark.parametrize(
    "change, words",
    [
        (np.linalg.inv, "on .*% if they are world-to-camera matrices: invert them"),
        (lambda T: T @ FLIP_YZ, "OpenGL's axes .*multiply"),
        (lambda T: np.linalg.inv(T @ FLIP_YZ), "world-to-camera matrices with OpenGL's axes"),
    ],
    ids=["P4", "P5", "P4 and P5"],
)
def test_P4_P5_other_conventions_are_named(pair, change, words):
    decided, sentence = guess_pose_convention(*posed(pair, change))
    assert decided
    assert re.search(words, sentence), sentence


def test_frames_that_share_nothing_decide_nothing(pair):
    away = np.eye(4)
    away[:3, 3] = 50
    a, b = pair
    assert guess_pose_convention(a, replace(b, T_world_camera=away @ b.T_world_camera)) == (
        False,
        None,
    )


def test_a_camera_that_stands_still_decides_nothing(pair):
    assert not has_moved(pair[0], pair[0])


def test_P4_a_run_says_it_once(pair, caplog):
    room = uf.open_dataset("synthetic", frames=60, width=160, height=120)
    frames = posed([room[i] for i in (3, 5, 7, 9)], np.linalg.inv)
    result = uf.Pipeline(CONFIG).run(frames)
    assert len(result.steps) == 4
    assert sum("world-to-camera" in sentence for sentence in result.warnings) == 1


@pytest.fixture(scope="module")
def walk():
    return list(SyntheticRoom(frames=60, width=160, height=120)[:14:2])


def w_first(T):
    """What becomes of a pose whose quaternion was written w x y z and read x y z w."""
    x, y, z, w = rotation_to_quaternion(T[None, :3, :3])[0]
    changed = T.copy()
    changed[:3, :3] = quaternion_to_rotation(np.array([[w, x, y, z]]))[0]
    return changed


def longer(factor):
    def change(T):
        changed = T.copy()
        changed[:3, 3] *= factor
        return changed

    return change


def transposed(T):
    changed = T.copy()
    changed[:3, :3] = T[:3, :3].T
    return changed


def body(T):
    """Poses of a robot's body: x forward, y left, z up."""
    R = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # body axes in the camera's
    changed = T.copy()
    changed[:3, :3] = T[:3, :3] @ R
    return changed


def judged(frames):
    early = EarlyPairs()
    for frame in frames:
        early.add(frame)
    return judge_poses(early.take())


@pytest.mark.parametrize(
    ("change", "reading", "scale"),
    [
        (w_first, "w-first", 1),
        (lambda T: w_first(np.linalg.inv(T)), "w-first+w2c", 1),
        (lambda T: np.linalg.inv(T @ FLIP_YZ), "w2c+opengl", 1),
        (transposed, "transposed", 1),
        (body, "body", 1),
        (longer(0.37), "c2w", 1 / 0.37),
        (longer(2.0), "c2w", 0.5),
        (longer(100), "c2w", 0.01),
        (longer(1000), "c2w", 0.001),
        (lambda T: longer(100)(T @ FLIP_YZ), "opengl", 0.01),
    ],
    ids=[
        "wxyz",
        "wxyz-w2c",
        "w2c-opengl",
        "transposed",
        "body",
        "x0.37",
        "x2",
        "cm",
        "mm",
        "cm-opengl",
    ],
)
def test_A_a_wrong_reading_is_recognised_and_named(walk, change, reading, scale):
    verdict = judged(posed(walk, change))
    assert (verdict.kind, verdict.reading) == ("other reading", reading)
    assert verdict.scale == pytest.approx(scale, rel=0.05)
    assert verdict.best.share >= 0.85
    assert f"{verdict.given.share:.0%}" in verdict.sentence and verdict.options in verdict.sentence
    # and the option mends it
    T = read_as(verdict.reading, np.stack([change(frame.T_world_camera) for frame in walk]))
    T[:, :3, 3] *= verdict.scale
    mended = [replace(f, T_world_camera=each) for f, each in zip(walk, T, strict=True)]
    assert judged(mended).kind == "fits"


def test_A_poses_of_other_frames_are_said_to_fit_nothing(walk):
    order = [3, 0, 5, 1, 6, 2, 4]
    shuffled = [
        replace(frame, T_world_camera=walk[i].T_world_camera)
        for frame, i in zip(walk, order, strict=True)
    ]
    verdict = judged(shuffled)
    assert verdict.kind == "does not fit"
    assert f"{verdict.given.share:.0%}" in verdict.sentence and "usual causes" in verdict.sentence


@pytest.mark.parametrize("missing", [0.0, 0.5, 0.8])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_A_right_poses_stay_silent_with_noise_and_holes(walk, missing, noise):
    rng = np.random.default_rng(3)
    frames = []
    for frame in walk:
        depth = frame.depth * (1 + rng.normal(0, noise, frame.depth.shape))
        depth[rng.random(depth.shape) < missing] = 0
        frames.append(replace(frame, depth=depth.astype(np.float32)))
    assert judged(frames).sentence is None


def test_A_a_run_says_it_once_and_its_result_repeats_it(walk):
    result = uf.Pipeline(CONFIG).run(posed(walk, lambda T: longer(0.37)(w_first(T))))
    assert len(result.doubts) == 1
    assert result.warnings.count(result.doubts[0]) == 1
    assert "w x y z" in result.doubts[0] and "--pose-scale" in result.doubts[0]
    assert uf.Pipeline(CONFIG).run(walk).doubts == ()


def test_E_what_is_beyond_every_map_is_no_reading(walk):
    room = SyntheticRoom(frames=60, width=160, height=120, noise=False)
    for nothing in (1e10, 65504.0, 65.535, 1000.0, np.inf, np.nan):
        frames = []
        for i in range(0, 10, 2):
            depth = room[i].depth.copy()
            depth[depth > 2.4] = nothing
            frames.append(replace(room[i], depth=depth))
            assert guess_depth_scale(depth, 1.0) is None
        assert judged(frames).sentence is None, nothing
    assert uf.Pipeline(CONFIG).run(frames).warnings == ()


def test_readings_are_named_and_a_wrong_one_is_answered():
    T = np.stack([uf.open_dataset("synthetic", frames=4)[0].T_world_camera] * 2)
    for name in NAMES:
        assert np.isfinite(read_as(name, T)).all()
        assert describe(name) or name == "c2w"
    np.testing.assert_allclose(read_as("w-first", np.stack([w_first(T[0])])), T[:1], atol=1e-12)
    with pytest.raises(InputError, match="did you mean 'opengl'"):
        read_as("w2c+openg", T)
    with pytest.raises(InputError, match="one word of each group"):
        read_as("opengl+w2c", T)
