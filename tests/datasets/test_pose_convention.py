"""P4 and P5: poses that are meant in another way are found out by depth that disagrees."""

import re
from dataclasses import replace

import numpy as np
import pytest

import taichi_unifusion as uf
from taichi_unifusion.datasets.pose_convention import FLIP_YZ, guess_pose_convention, has_moved


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
    result = uf.Pipeline().run(frames)
    assert len(result.steps) == 4
    assert sum("world-to-camera" in sentence for sentence in result.warnings) == 1
