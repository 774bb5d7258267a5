"""Frames in windows: their order, what is refused, room for them, and the work they leave."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from places import DEVICE
from reference import unpack_masks
from windows import (
    CONFIG,
    RUNS,
    SINGLE,
    assert_close,
    contents,
    empty,
    seen_from,
    stepped,
    turned,
    walk,
    windows,
)

from taichi_unifusion import preprocess
from taichi_unifusion.device_arrays import Arena
from taichi_unifusion.errors import CapacityError, OutOfRange
from taichi_unifusion.kernels import ti
from taichi_unifusion.maps import PropertyMap, SurfaceMap, local_lim, voxel_grid, window
from taichi_unifusion.maps.pool import Pool
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.run_log import EmptyFrame

ORDER = 1e-5  # relative: Eq. 19 in float32, windows in another order
VOTES = 0.05  # share of cells with surface that are seen in one order, and seen through in another
WEIGHT = 1e-6  # relative: a cell's count is the square of its root, in float32


@pytest.fixture(scope="module")
def frames():
    """Neighbours, all of which fit into one window."""
    return walk(8)


@pytest.fixture(scope="module")
def fused(frames):
    """What two windows of four frames give."""
    return contents(stepped(frames))


# ---- Order ----


@pytest.mark.parametrize("order", [(3, 1, 0, 2), (1, 3, 2, 0)])
def test_the_order_of_frames_in_a_window_does_not_matter(frames, fused, order):
    """To the bit: sums are whole numbers."""
    mixed = [frames[n] for n in (*order, *(4 + n for n in reversed(order)))]
    assert contents(stepped(mixed)) == fused


def test_the_order_of_windows_matters_to_rounding_only(frames, fused):
    """But votes are cast on the surface as it is by then: the first window's on its own, and not in
    voxels that the other one brings. So counts differ, and what they say of the surface hardly.
    """
    there, back = stepped(frames), stepped([*frames[4:], *frames[:4]])
    for name in there.maps:
        assert_close(there.maps[name], back.maps[name], ORDER)
    a, b = there.surface.voxels(), back.surface.voxels()
    supported = unpack_masks(a.masks)
    evidence, other = (each.evidence.astype(int)[supported] for each in (a, b))
    assert ((evidence > 0) != (other > 0)).mean() < VOTES
    assert np.abs(evidence).max() == np.abs(other).max() == len(frames)


def test_another_process_with_one_thread_writes_the_same_bytes_and_goes_on_from_files(
    frames, tmp_path
):
    """Saved in mid-window, and loaded by a process that goes on: as if it had been this one."""
    pipeline = stepped(frames[:6])
    for name, each in pipeline.maps.items():
        each.save(tmp_path / f"half {name}")
    for frame in frames[6:]:
        pipeline.step(frame)
    script = (
        f"import sys; sys.path[:0] = {sys.path!r}\n"
        f"import taichi_unifusion as uf; uf.init({DEVICE!r}, threads=1)\n"
        "from windows import *\n"
        "all_of_it, resumed = stepped(walk(6)), Pipeline(CONFIG)\n"
        "for name, each in all_of_it.maps.items():\n"
        f"    each.save({str(tmp_path)!r} + f'/one thread {{name}}')\n"
        f"    resumed.maps[name].merge(uf.load_map({str(tmp_path)!r} + f'/half {{name}}'))\n"
        "for frame in walk(8)[6:]:\n"
        "    resumed.step(frame)\n"
        "for name, each in resumed.maps.items():\n"
        f"    each.save({str(tmp_path)!r} + f'/resumed {{name}}')\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=300)
    for name, each in pipeline.maps.items():
        each.save(tmp_path / f"here {name}")
        files = {kind: (tmp_path / f"{kind} {name}").read_bytes() for kind in
                 ("half", "one thread", "here", "resumed")}  # fmt: skip
        assert files["half"] == files["one thread"] and files["here"] == files["resumed"]


# ---- Against single frames ----


@pytest.mark.parametrize("gpis", ["samples", "derivatives", "both"])
def test_a_window_of_one_frame_is_integrating_its_cloud(gpis):
    frames = [seen_from(turned(n), n) for n in range(3)]
    config = replace(SINGLE, surface=replace(SINGLE.surface, gpis=gpis))
    pipeline = stepped(frames, config)
    surface, color = SurfaceMap(config.surface), PropertyMap("color", 3, config.color)
    for frame in frames:
        cloud = preprocess(frame, config.preprocess).transformed(frame.T_world_camera)
        surface.integrate(cloud)
        color.integrate(cloud)
    assert_close(pipeline.surface, surface, RUNS)
    assert_close(pipeline.maps["color"], color, RUNS)
    np.testing.assert_array_equal(pipeline.surface.voxels().evidence, surface.voxels().evidence)
    assert len(surface) > 200


def part_of(frame, columns: slice):
    depth = np.zeros_like(frame.depth)
    depth[:, columns] = frame.depth[:, columns]
    return replace(frame, depth=depth)


def test_frames_that_do_not_overlap_are_the_same_in_one_window_to_the_bit():
    """Noise is that of the frames that saw a voxel, not of all in its window."""
    whole = walk(1)[0]
    apart = [
        replace(part_of(whole, columns), index=n + 1)
        for n, columns in enumerate((slice(0, 18), slice(45, 64)))
    ]
    assert windows(apart) == [1, 2]
    together, alone = contents(stepped(apart)), contents(stepped(apart, SINGLE))
    assert together == alone
    again = [*apart, replace(apart[0], index=3)]  # overlaps: now a window is not the same
    assert contents(stepped(again)) != contents(stepped(again, SINGLE))


def test_frames_that_see_the_same_twice_have_twice_its_noise(frames):
    """A window of a frame and its copies is that frame, with their weight."""
    every = {"min_points": 1}  # a voxel with too few points of one frame has enough in three
    config = replace(
        CONFIG,
        surface=replace(CONFIG.surface, **every),
        color=replace(CONFIG.color, **every),
    )
    once, thrice = stepped(frames[:1], config), stepped([frames[0]] * 3, config)
    for name in once.maps:
        one, three = (each.maps[name].voxels() for each in (once, thrice))
        np.testing.assert_allclose(three.weights, 3 * one.weights, rtol=WEIGHT)
        scale = np.abs(one.latents).max()
        np.testing.assert_allclose(three.latents, one.latents, atol=ORDER * scale)


# ---- What is refused ----


def refuse(pipeline: Pipeline, frame, error: type[Exception]) -> None:
    before = {name: len(each.grid) for name, each in pipeline.maps.items()}
    with pytest.raises(error):
        pipeline.step(frame)
    assert {name: len(each.grid) for name, each in pipeline.maps.items()} == before


def test_a_frame_without_depth_in_mid_window_leaves_no_trace(frames, fused):
    pipeline = stepped(frames[:2])
    refuse(pipeline, empty(frames[2]), EmptyFrame)
    for frame in frames[2:]:
        pipeline.step(frame)
    assert contents(pipeline) == fused


def test_a_frame_beyond_the_range_of_one_map_in_mid_window_leaves_no_trace():
    """The colours' voxels are finer and end nearer: the surface's were touched by then."""
    config = replace(CONFIG, color=replace(CONFIG.color, voxel_size=0.05))
    # the wall in front stands 6 cm before the border at 8191 voxels, or behind it
    border = 8191 * 0.05 - 1.5
    frames = [
        seen_from(turned(n), n + 1, origin=(border + beyond, 0, 0))
        for n, beyond in enumerate((-0.1, -0.1, 0.1, -0.1, -0.1))
    ]
    pipeline = stepped(frames[:2], config)
    refuse(pipeline, frames[2], OutOfRange)
    assert len(pipeline.fusion.window) == 2
    for frame in frames[3:]:
        pipeline.step(frame)
    assert contents(pipeline) == contents(stepped([*frames[:2], *frames[3:]], config))


def test_a_frame_that_is_far_off_ends_the_window_and_is_refused(frames):
    pipeline, T = stepped(frames[:2]), frames[2].T_world_camera.copy()
    T[0, 3] = 1e6
    refuse(pipeline, replace(frames[2], T_world_camera=T), OutOfRange)
    assert pipeline.fusion.window is None
    for frame in frames[3:6]:
        pipeline.step(frame)
    others = stepped(frames[:2])
    others.flush()
    for frame in frames[3:6]:
        others.step(frame)
    assert contents(pipeline) == contents(others)


def test_a_frame_too_many_in_mid_window_leaves_no_trace(frames, fused, monkeypatch):
    pipeline = stepped(frames[:2])
    with monkeypatch.context() as patched:
        patched.setattr(voxel_grid, "SPARSE_LIMIT", 1)
        refuse(pipeline, frames[2], CapacityError)
        assert len(pipeline.fusion.window) == 2
    for frame in frames[2:]:
        pipeline.step(frame)
    assert contents(pipeline) == fused


def test_what_was_summed_up_before_a_limit_can_be_read_after_it(frames, monkeypatch):
    """What a window holds has its room, whatever comes after."""
    whole = contents(stepped(frames[:6]))
    pipeline = stepped(frames[:6])
    with monkeypatch.context() as patched:
        patched.setattr(voxel_grid, "SPARSE_POOL", 1)
        refuse(pipeline, frames[6], CapacityError)
    assert contents(pipeline) == whole and len(pipeline.extract_mesh(2).faces) > 100


# ---- Room, and slices ----


def test_cells_that_grow_change_nothing(frames, fused, monkeypatch):
    """What a frame had no room for is added in a second round, before the next one comes."""
    monkeypatch.setattr(local_lim, "FIRST_BLOCKS", 20)
    monkeypatch.setattr(window, "WINDOW_BYTES", 1)
    pipeline = stepped(frames[:2])
    arrays = [each.cells.arrays for each in pipeline.fusion.window.parts.values()]
    assert all(20 < each.room < 2000 for each in arrays)
    with monkeypatch.context() as patched:
        patched.setattr(voxel_grid, "SPARSE_LIMIT", 1)
        refuse(pipeline, frames[2], CapacityError)
    for frame in frames[2:]:
        pipeline.step(frame)
    assert contents(pipeline) == fused


def test_no_frame_waits_for_more_than_its_share_and_all_is_fused_before_the_next_window_is_full(
    frames, monkeypatch
):
    pipeline = Pipeline(CONFIG)
    counts = []
    for n, frame in enumerate([*frames, *walk(12)[8:]]):
        waiting = len(pipeline.fusion.pieces)
        pipeline.step(frame)
        left = len(pipeline.fusion.pieces)
        if n % 4 == 3:  # this frame filled a window
            assert waiting == 0
            share = -(-left // 3)  # of what its three successors do
        else:
            done = waiting - left
            counts.append(done)
            assert waiting == 0 or 0 < done <= share
        if n % 4 == 2:
            assert left == 0
    assert max(counts) < sum(counts) / 5


def test_a_map_grows_before_a_frame_has_to_wait_and_not_all_of_it_in_one(frames, monkeypatch):
    """Pools that are too small for the second window grow by pieces of the first one; the map is that
    of pools that had room from the start.
    """
    fused = contents(stepped(frames))
    monkeypatch.setattr(voxel_grid, "FIRST_CAPACITY", 3400)
    done, grown, reserve = [], [], Pool.reserve

    def recorded(pool: Pool, rows: int, used: int) -> None:
        if rows > pool.capacity:
            grown.append((len(done), pool.field.name))
        reserve(pool, rows, used)

    monkeypatch.setattr(Pool, "reserve", recorded)
    pipeline = Pipeline(CONFIG)
    for frame in frames:
        pipeline.step(frame)
        done.append(frame)
    assert contents(pipeline) == fused
    fields = ["keys", *(field.name for field in pipeline.surface.grid.fields)]
    assert [name for _, name in grown] == fields[::-1]  # the keys last: they say how many
    by_frame = [sum(at == n for at, _ in grown) for n in (4, 5, 6)]
    assert sum(by_frame) == len(fields) and max(by_frame) <= len(fields) // 3 + 1


def test_an_arena_makes_more_room_before_it_is_asked_for():
    arena = Arena()
    first = arena.borrow("averages", ti.f32, (90, 4))
    arena.grow_ahead()
    second = arena.borrow("averages", ti.f32, (120, 4))
    assert (first.shape, second.shape) == ((90, 4), (180, 4))
    arena.grow_ahead()  # two thirds are in use: enough
    assert arena.borrow("averages", ti.f32, (180, 4)) is second
    arena.grow_ahead()
    assert arena.borrow("averages", ti.f32, (1, 4)).shape == (360, 4)
