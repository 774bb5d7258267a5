"""The kernels that keep the sides of boards apart, against their twins."""

from __future__ import annotations

import numpy as np
import pytest
import reference
import reference_sides as twin
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.kernels import sides as kernels

RANK, ANCHORS, VOXELS = 6, 32, 300
ENCODER = reference.Encoder(RANK, ANCHORS)
HALF = 2e-3  # of what float16 holds


@pytest.fixture(scope="module", autouse=True)
def taichi():
    uf.init(DEVICE)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(4)


def test_weigh_sides_equals_its_twin(rng):
    lean, F = rng.normal(size=RANK), rng.normal(size=(VOXELS, RANK))
    weights, found = rng.uniform(1, 9, VOXELS), np.full((VOXELS, 2), 7, np.float32)
    single = (a.astype(np.float32) for a in (lean, F[:, :, None], weights))
    kernels.weigh_sides(VOXELS, *single, found)
    wanted = twin.weigh_sides(lean, F, weights)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    assert 50 < (wanted[:, 1] > 0).sum() < VOXELS - 50


@pytest.mark.parametrize("exact", [False, True])
def test_fuse_sides_equals_its_twin(rng, exact):
    """Fronts and backs, some without a voxel; what is taken out leaves what was there, or nothing."""
    F = rng.integers(-500, 500, (3, VOXELS, RANK)) / 256
    w = rng.integers(0, 3, (3, VOXELS, 2)).astype(np.float32)
    slots = rng.permutation(VOXELS).astype(np.int32)
    slots[::9] = -1
    totals, backs = np.zeros((VOXELS, 1 + RANK)), np.zeros((VOXELS, RANK), np.float16)
    weights, steps = np.zeros((VOXELS, 2), np.float32), [(0, 1), (1, 1), (2, 1), (1, -1)]
    for part, sign in steps:
        local = F[part].astype(np.float32)[:, :, None], w[part], sign
        kernels.fuse_sides(RANK, exact, VOXELS, slots, *local, totals, backs, weights)
    for n in np.flatnonzero(slots >= 0):
        parts = [(F[part, n], w[part, n], sign) for part, sign in steps]
        mean, both = twin.fuse_sides(parts)
        np.testing.assert_allclose(backs[slots[n]], mean, atol=3 * HALF)
        assert weights[slots[n]].tolist() == both
    unused = np.setdiff1d(np.arange(VOXELS), slots)
    assert not backs[unused].any() and not weights[unused].any()
    assert (totals[:, 0] == weights[:, 1]).all() if exact else not totals.any()


def test_note_support_equals_its_twin(rng):
    cells = rng.uniform(size=(2, VOXELS, 64)) < 0.3
    masks, slots = np.zeros((VOXELS, 2), np.uint32), np.arange(VOXELS, dtype=np.int32)
    slots[::7] = -1
    for each in cells:
        kernels.note_support(
            VOXELS, slots, np.packbits(each, axis=1).view(">u4").astype(np.uint32), masks
        )
    wanted = twin.note_support(cells)
    wanted[slots < 0] = False
    np.testing.assert_array_equal(reference.unpack_masks(masks), wanted)


def test_find_sides_equals_its_twin(rng):
    """Fronts and backs that face away from each other, or do not, or of which there is one alone."""
    slopes, features = twin.mean_slopes(ENCODER), np.zeros((65, 4, RANK), np.float32)
    features[64, 1:] = slopes
    backs = rng.normal(size=(VOXELS, RANK)).astype(np.float16).astype(float)
    turned = np.where(rng.uniform(size=(VOXELS, 1)) < 0.5, -1.0, 1.0)
    fronts = turned * backs + 0.3 * rng.normal(size=(VOXELS, RANK))
    back_weights = rng.choice([0.0, 2.0, 4.0, 6.0], VOXELS)
    weights = np.column_stack([6 - back_weights, back_weights])
    F = (fronts * weights[:, :1] + backs * weights[:, 1:]) / 6
    slots = rng.permutation(VOXELS)[VOXELS // 8 :].astype(np.int32)
    two, found = np.zeros(len(slots), np.uint8), np.empty((len(slots), RANK), np.float32)
    mean, latents = np.empty((len(slots), 6), np.float32), F.astype(np.float32)[:, :, None]
    what = latents, backs.astype(np.float16), weights.astype(np.float32)
    kernels.find_sides(RANK, features, slots, *what, two, found, mean)
    backs = backs[slots]
    wanted, latent = twin.find_sides(ENCODER, F[slots], backs, weights[slots])
    assert 40 < wanted.sum() < len(slots) - 40
    assert (two != wanted).sum() <= 1  # float32 at a threshold
    same = two == wanted
    np.testing.assert_allclose(found[same], latent[same], atol=1e-4)
    np.testing.assert_allclose(mean[:, :3], found @ slopes.T, atol=1e-4)
    np.testing.assert_allclose(mean[two > 0, 3:], (backs @ slopes.T)[two > 0], atol=1e-4)
