"""The l x l regression of every voxel and its fusion, against the oracle (Eq. 6, 16-19)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import reference
from oracle import assert_equal_maps, encoder_of, in_voxels
from scenes import moved, rough

from taichi_unifusion.device_arrays import Arena
from taichi_unifusion.kernels import fusion
from taichi_unifusion.kernels.gram import TILE
from taichi_unifusion.kernels.layout import Layout
from taichi_unifusion.maps import PropertyMap, SurfaceMap
from taichi_unifusion.maps.binner import patches_of
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.maps.local_lim import CellArrays

SIX_RANKS = {"encoder": EncoderSettings(rank=6, anchors=64), "noise": 0.3, "voxel_size": 0.05}


def surface_twin(settings, *clouds) -> dict:
    return reference.fuse(
        reference.surface_frame(
            encoder_of(settings), in_voxels(cloud, settings), cloud.normals.astype(float), settings
        )
        for cloud in clouds
    )


def property_twin(target: PropertyMap, *clouds) -> dict:
    settings = target.settings
    return reference.fuse(
        reference.property_frame(
            encoder_of(settings),
            in_voxels(cloud, settings),
            cloud.attributes[target.name].astype(float),
            settings,
        )
        for cloud in clouds
    )


@pytest.mark.parametrize(
    ("sampling", "gpis", "margin"),
    [
        ("cells", "samples", 1),
        ("cells", "samples", 2),
        ("cells", "derivatives", 1),
        ("cells", "both", 1),
        ("points", "samples", 1),
        ("points", "derivatives", 1),
        ("points", "both", 1),
    ],
)
def test_surface_regression_equals_the_oracle(sampling, gpis, margin):
    """Two frames through encode_cells or encode_points, claim_slots and fuse; more samples a voxel
    than a tile holds.
    """
    target = SurfaceMap(
        sampling=sampling, gpis=gpis, margin=margin, min_points=5, sample_distance=0.2, **SIX_RANKS
    )
    clouds = rough(0), rough(1, 900)
    for cloud in clouds:
        done = target.integrate(cloud)
    twin = surface_twin(target.settings, *clouds)
    assert_equal_maps(target, twin)
    assert (done.points, done.voxels, done.total_voxels) == (
        900,
        len(surface_twin(target.settings, clouds[1])),
        len(twin),
    )
    assert max(voxel.w for voxel in twin.values()) > 2 * TILE


@pytest.mark.parametrize(
    ("name", "channels", "prior", "sampling", "margin"),
    [
        ("one", 1, "zero", "cells", 1),
        ("rgb", 3, "mean", "cells", 1),
        ("five", 5, "mean", "cells", 2),
        ("rgb", 3, "mean", "points", 1),
    ],
)
def test_property_regression_equals_the_oracle(name, channels, prior, sampling, margin):
    target = PropertyMap(
        name, channels, prior=prior, sampling=sampling, margin=margin, min_points=3, **SIX_RANKS
    )
    clouds = rough(2), rough(3, 900)
    for cloud in clouds:
        target.integrate(cloud)
    assert_equal_maps(target, property_twin(target, *clouds))


def fuse_as_one(target: SurfaceMap | PropertyMap, clouds, ranges: int = 1) -> None:
    """Sum clouds up as frames of one window, encode it in so many ranges of blocks, and fuse it."""
    cells = target.binner.open(CellArrays(target.binner.width))
    for n, cloud in enumerate(clouds):
        patches = patches_of(cloud, "cpu")
        cells = target.binner.touch(cells, patches)
        target.binner.add(cells, patches, [target.carried(patches)], n)
    binned = target.binner.close(cells, Arena())
    local = target.encoder.room(binned)
    ends = np.linspace(0, binned.count, ranges + 1).astype(int)
    for begin, end in pairwise(ends):
        target.encoder.encode_blocks(binned, int(begin), int(end), local)
    target.grid.fuse(local)


def window_of() -> list:
    """Three frames; some voxels are seen by all, and some by one."""
    return [rough(0), moved(rough(1, 900), (0.1, 0.02, 0)), moved(rough(2, 600), (-0.07, 0.3, 0.1))]


def side_by_side(clouds, settings):
    """Positions [voxels] and frame numbers of the points of some clouds."""
    frames = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    return np.vstack([in_voxels(cloud, settings) for cloud in clouds]), frames


@pytest.mark.parametrize("gpis", ["samples", "derivatives", "both"])
def test_a_surface_window_equals_the_oracle(gpis):
    """Noise is a frame's: three frames in one regression have three times that of one, in every
    voxel that all of them saw.
    """
    target = SurfaceMap(gpis=gpis, min_points=5, sample_distance=0.2, **SIX_RANKS)
    clouds, settings, encoder = window_of(), target.settings, encoder_of(target.settings)
    fuse_as_one(target, clouds, ranges=3)
    x, frames = side_by_side(clouds, settings)
    normals = np.vstack([cloud.normals for cloud in clouds]).astype(float)
    twin = reference.surface_frame(encoder, x, normals, settings, frames=frames)
    assert_equal_maps(target, twin)
    # the numbers of frames matter, and differ
    for wrong in (np.zeros(len(x), int), np.arange(len(x)) % 3):
        other = reference.surface_frame(encoder, x, normals, settings, frames=wrong)
        with pytest.raises(AssertionError, match="Not equal to tolerance"):
            assert_equal_maps(target, other)


@pytest.mark.parametrize("margin", [1, 2])
def test_a_property_window_equals_the_oracle(margin):
    target = PropertyMap("rgb", 3, margin=margin, min_points=3, **SIX_RANKS)
    clouds, settings = window_of(), target.settings
    fuse_as_one(target, clouds, ranges=3)
    x, frames = side_by_side(clouds, settings)
    values = np.vstack([cloud.attributes["rgb"] for cloud in clouds]).astype(float)
    twin = reference.property_frame(encoder_of(settings), x, values, settings, frames=frames)
    assert_equal_maps(target, twin)
    other = reference.property_frame(encoder_of(settings), x, values, settings)
    with pytest.raises(AssertionError, match="Not equal to tolerance"):
        assert_equal_maps(target, other)


def test_fuse_equals_its_twin():
    """Eq. 19 into new and old slots; -1 means no slot, whatever the weight says."""
    rng, rows, channels = np.random.default_rng(7), 3, 2
    latents, weights = (
        rng.normal(size=(40, rows, channels)).astype(np.float32),
        rng.integers(1, 50, 40).astype(np.float32),
    )
    masks = rng.integers(0, 2**32, (40, 2), dtype=np.uint32)
    slots = np.where(np.arange(40) % 5 == 0, -1, rng.permutation(60)[:40]).astype(np.int32)
    old = rng.normal(size=(60, rows, channels)).astype(np.float32)
    old_weights = np.where(np.arange(60) % 2, rng.integers(1, 50, 60), 0).astype(np.float32)
    old[old_weights == 0] = 0
    old_masks = rng.integers(0, 2**32, (60, 2), dtype=np.uint32)
    fused, fused_weights, fused_masks = old.copy(), old_weights.copy(), old_masks.copy()
    # another map's columns come first
    beside = np.concatenate([np.full((40, rows, 3), 9, np.float32), latents], axis=2)
    layout = Layout(rows, channels)
    fusion.fuse(
        layout, 3, 40, slots, beside, weights, masks, 1.0, fused, fused_weights, fused_masks
    )

    def voxels(F, w, m, keys):
        return {
            int(k): reference.Voxel(F[n].astype(float), float(w[n]), m[n])
            for n, k in enumerate(keys)
            if k >= 0 and w[n] > 0
        }

    twin = reference.fuse(
        [voxels(old, old_weights, old_masks, range(60)), voxels(latents, weights, masks, slots)]
    )
    for slot in range(60):
        if slot in twin:
            np.testing.assert_allclose(fused[slot], twin[slot].F, atol=1e-6)
            assert fused_weights[slot] == twin[slot].w
            if old_weights[slot] == 0:  # what is loaded into an empty map is the same bit for bit
                assert fused[slot].tobytes() == latents[list(slots).index(slot)].tobytes()
        if slot not in slots:
            assert (
                fused[slot].tobytes() == old[slot].tobytes()
                and fused_weights[slot] == old_weights[slot]
            )
    np.testing.assert_array_equal(
        fused_masks[slots[slots >= 0]], old_masks[slots[slots >= 0]] | masks[slots >= 0]
    )
