"""Maps over many frames: a camera that never moves, and frames that are taken out again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from map_kinds import KINDS, frames, integrated
from tiny_recording import CONFIG, make_frames

from taichi_unifusion import Pipeline


def test_S6_a_camera_that_never_moves_fills_no_memory_after_its_first_window():
    (frame,) = make_frames(1)
    pipeline, sizes = Pipeline(CONFIG), []
    for i in range(60):
        pipeline.step(replace(frame, index=i))
        if i % 20 == 19:
            pipeline.flush()
            grids = [each.grid for each in pipeline.maps.values()]
            sizes.append([(len(g), g.count, g.capacity, g.memory_bytes) for g in grids])
    assert sizes[0] == sizes[1] == sizes[2] and sizes[0][0][0] > 100


def test_R9_a_hundred_clouds_put_in_and_taken_out_leave_what_was_there():
    for make in KINDS.values():
        target = integrated(make(), frames()[:1])
        before, other = target.voxels(), frames()[1]
        for _ in range(50):
            target.integrate(other)
        for _ in range(50):
            target.remove(other)
        after = target.voxels()
        assert np.array_equal(after.keys, before.keys)
        np.testing.assert_allclose(after.weights, before.weights, rtol=1e-5)
        scale = np.abs(before.latents).max()
        assert np.abs(after.latents - before.latents).max() < 1e-3 * scale
        target.remove(frames()[0])
        assert len(target) == 0
