"""Where windows of frames end: by themselves, and because a map is read or changed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from windows import CAMERA, CONFIG, SINGLE, contents, seen_from, stepped, walk, windows, with_value

from taichi_unifusion import PinholeCamera, load_map, preprocess
from taichi_unifusion.config import Config
from taichi_unifusion.maps import SurfaceMap, window
from taichi_unifusion.maps.window import FARTHEST_MOVE, GAP, LARGEST_TURN


@pytest.fixture(scope="module")
def frames():
    """Neighbours, all of which fit into one window."""
    return walk(8)


def two(first, second, config: Config = CONFIG) -> int:
    """How many frames are in the window after both."""
    return windows([first, second], config)[-1]


def test_a_window_ends_with_so_many_frames(frames):
    assert windows(frames) == [1, 2, 3, 0, 1, 2, 3, 0]
    assert windows(frames[:3], SINGLE) == [0, 0, 0]
    assert windows(frames[:3], replace(CONFIG, window=2)) == [1, 0, 1]


def test_a_frame_that_fills_a_window_by_itself_is_fused_alone(frames, monkeypatch):
    """The first frame too, for which kernels are compiled ahead."""
    alone = contents(stepped(frames[:2], SINGLE))
    monkeypatch.setattr(window, "ROOM", 0)  # a large image of something far
    assert windows(frames[:2]) == [0, 0]
    assert contents(stepped(frames[:2])) == alone


def moved_by(frame, metres: float = 0.0, degrees: float = 0.0):
    a = np.radians(degrees)
    T = np.eye(4)
    T[:3, :3] = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    T[0, 3] = metres
    return seen_from(frame.T_world_camera @ T, frame.index + 1)


@pytest.mark.parametrize(
    ("step", "count"),
    [
        ({"metres": FARTHEST_MOVE - 0.01}, 2),
        ({"metres": FARTHEST_MOVE + 0.01}, 1),
        ({"degrees": LARGEST_TURN - 0.1}, 2),
        ({"degrees": LARGEST_TURN + 0.1}, 1),
    ],
)
def test_a_window_ends_where_the_camera_has_moved_or_turned(frames, step, count):
    """From its first frame, not from the one before."""
    assert two(frames[0], moved_by(frames[0], **step)) == count
    third = [frames[0], frames[1], moved_by(frames[0], **step)]
    assert windows(third)[-1] == (3 if count == 2 else 1)


def test_a_window_ends_at_a_gap_in_the_recording(frames):
    numbered = [replace(frame, index=10 * n + 5) for n, frame in enumerate(frames[:3])]
    after, gap = (replace(frames[3], index=25 + 10 * GAP + more) for more in (0, 1))
    every_frame = replace(CONFIG, window=8)
    assert windows([*numbered, after], every_frame) == [1, 2, 3, 4]
    assert windows([*numbered, gap], every_frame) == [1, 2, 3, 1]


def test_a_window_ends_where_another_camera_takes_over(frames):
    other = PinholeCamera(64, 48, 66.0, 66.0, 31.5, 23.5)
    smaller = PinholeCamera(48, 36, 41.25, 41.25, 23.5, 17.5)
    for camera in (other, smaller):
        taken = [frames[0], frames[1], *walk(4, camera=camera)[2:]]
        assert windows(taken) == [1, 2, 1, 2]
        assert contents(stepped(taken)) == contents(stepped(taken))  # and back, from the pool
    assert camera != CAMERA


def test_a_window_ends_where_frames_carry_something_else(frames):
    plain, other = frames[:2]
    assert two(plain, replace(other, color=None)) == 1
    assert two(plain, with_value(other)) == 1
    assert two(with_value(plain), with_value(other)) == 2
    # an image in which not all values are numbers leaves out points
    assert two(with_value(plain), with_value(other, holes=True)) == 1
    assert two(with_value(plain, holes=True), with_value(other, holes=True)) == 2


# ---- Reading ----


PROBES = np.array([[1.5, 0.1, 0.1], [1.4, 0.0, 0.2]])
READINGS = {
    "len": lambda p, path: len(p.surface),
    "memory": lambda p, path: p.surface.memory_bytes,
    "voxels": lambda p, path: p.surface.voxels(),
    "sdf": lambda p, path: p.surface.sdf(PROBES),
    "mesh": lambda p, path: p.surface.extract_mesh(2),
    "coloured mesh": lambda p, path: p.extract_mesh(2),
    "query": lambda p, path: p.maps["color"].query(PROBES),
    "save": lambda p, path: p.maps["color"].save(path),
    "merge": lambda p, path: p.surface.merge(SurfaceMap(CONFIG.surface)),
    "be merged": lambda p, path: SurfaceMap(CONFIG.surface).merge(p.surface),
    "flush": lambda p, path: p.flush(),
    "flush a map": lambda p, path: p.surface.flush(),
}


@pytest.mark.parametrize("reading", READINGS)
def test_reading_in_mid_window_fuses_what_waits_first(frames, tmp_path, reading):
    """And the next frame begins another window: as where one was fused there by name."""
    pipeline, flushed = stepped(frames[:2]), stepped(frames[:2])
    assert {each.waiting for each in pipeline.maps.values()} == {pipeline.fusion}
    READINGS[reading](pipeline, tmp_path / "map")
    assert [each.waiting for each in pipeline.maps.values()] == [None, None]
    assert pipeline.fusion.window is None and not pipeline.fusion.pieces
    flushed.flush()
    assert len(pipeline.surface.grid) == len(flushed.surface.grid) > 0
    for each in (pipeline, flushed):
        each.step(frames[2])
    assert contents(pipeline) == contents(flushed)


@pytest.mark.parametrize("change", ["integrate", "remove"])
def test_changing_a_map_in_mid_window_fuses_what_waits_first(frames, change):
    cloud = preprocess(frames[5], CONFIG.preprocess).transformed(frames[5].T_world_camera)
    pipeline, flushed = stepped(frames[:2]), stepped(frames[:2])
    flushed.flush()
    for each in (pipeline, flushed):
        for target in each.maps.values():
            getattr(target, change)(cloud)
        each.step(frames[2])
    assert contents(pipeline) == contents(flushed)


def test_a_map_saved_in_mid_window_holds_all_frames(frames, tmp_path):
    pipeline = stepped(frames[:6])
    pipeline.surface.save(tmp_path / "map")
    assert len(load_map(tmp_path / "map")) == len(pipeline.surface.grid)
    whole = stepped(frames[:6])
    whole.flush()
    assert load_map(tmp_path / "map").voxels().weights.sum() == whole.surface.voxels().weights.sum()
