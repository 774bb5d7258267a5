"""Decoding at points and on the grid (Eq. 7, tent blending), against the oracle, on maps with
made-up latents.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference

from taichi_unifusion import runtime
from taichi_unifusion.errors import InputError, RuntimeStateError
from taichi_unifusion.kernels import query as kernels
from taichi_unifusion.kernels.index import INDEX_HALF
from taichi_unifusion.maps import PropertyMap, SurfaceMap
from taichi_unifusion.maps.encoder import NODES
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.maps.meshing import STEPS, grid_basis
from taichi_unifusion.maps.property_map import NEAREST_REACH
from taichi_unifusion.maps.voxel_grid import VoxelGrid

SETTINGS = {"encoder": EncoderSettings(rank=6, anchors=64), "voxel_size": 0.05}
ENCODER = reference.Encoder(6, 64)
INTERPOLATED = reference.Interpolated(ENCODER, NODES)  # at points; test_encoding.py has its error
DECODED = 1e-4  # float32 features (2e-5) times some latents of size 1
# a point on the rim of a doubled voxel keeps this weight per axis, so that its value is defined
TINY_TENT = 1e-6


def write(grid: VoxelGrid, keys, latents, masks) -> None:
    """Give an empty grid these voxels without the kernels that fuse: what is tested here is
    reading.
    """
    grid.next_frame()
    for n, key in enumerate(keys):
        grid.index.slot[tuple(int(k) + INDEX_HALF for k in key)] = n + 1
    for pool, values in (
        (grid["latents"], latents),
        (grid["masks"], masks),
        (grid["keys"], keys),
        (grid["weights"], np.ones(len(keys))),
    ):
        whole = pool.to_numpy()
        whole[: len(keys)] = values
        pool.from_numpy(whole)
    grid.count = len(keys)


def fill(grid: VoxelGrid, seed: int) -> dict[tuple, reference.Voxel]:
    """Give a grid voxels with random latents and sparse support, and return the same as the
    oracle's map.
    """
    rng = np.random.default_rng(seed)
    # holes, both signs, and a lone voxel
    keys = np.unique(np.vstack([rng.integers(-3, 3, (60, 3)), [[8, -8, 8]]]), axis=0)
    latents = rng.normal(size=(len(keys), *grid["latents"].shape[1:])).astype(np.float32)
    masks = np.bitwise_and.reduce(rng.integers(0, 2**32, (3, len(keys), 2), dtype=np.uint32))
    write(grid, keys, latents, masks)
    return {
        tuple(key): reference.Voxel(F.astype(float), 1.0, mask)
        for key, F, mask in zip(keys.tolist(), latents, reference.unpack_masks(masks), strict=True)
    }


def points_about_the_voxels() -> np.ndarray:
    """Random points [m] in and around the voxels of `fill`: some valid from one neighbour only,
    some not at all.
    """
    rng = np.random.default_rng(9)
    lone = [8.5, -7.5, 8.5] + rng.uniform(-4, 4, (100, 3))
    return (np.vstack([rng.uniform(-4.5, 4.5, (400, 3)), lone]) * 0.05).astype(np.float32)


@pytest.fixture(scope="module")
def surface():
    target = SurfaceMap(**SETTINGS)
    return target, fill(target.grid, 1)


def in_voxels(points) -> np.ndarray:
    return (points * np.float32(1 / 0.05)).astype(float)


@pytest.mark.parametrize(
    ("channels", "prior", "blend"),
    [(1, "zero", True), (3, "mean", True), (3, "mean", False), (5, "zero", False)],
)
def test_query_points_equals_its_twin(channels, prior, blend):
    target = PropertyMap("x", channels, prior=prior, blend=blend, **SETTINGS)
    voxels, points = fill(target.grid, channels), points_about_the_voxels()
    values, valid = target.query(points, return_valid=True)
    twin, known = reference.query_points(
        INTERPOLATED,
        voxels,
        in_voxels(points),
        blend=blend,
        centered=prior == "mean",
        reach=NEAREST_REACH,
    )
    np.testing.assert_array_equal(valid, known)
    assert 0.02 < valid.mean() < 0.95
    # there all tents are far above TINY_TENT
    inside = (np.abs(in_voxels(points) % 1 - 0.5) > 1e-3).all(axis=1)
    np.testing.assert_allclose(values[inside], twin[inside], atol=DECODED)
    # the nearest voxel's value, and 0 beyond its reach
    assert values[~valid].any() and not values[~valid].all()
    np.testing.assert_array_equal(values, target.query(points))


def test_sdf_is_in_metres_and_blended(surface):
    target, voxels = surface
    points = points_about_the_voxels()
    values, valid = target.sdf(points)
    twin, known = reference.query_points(INTERPOLATED, voxels, in_voxels(points), blend=True)
    assert values.dtype == np.float32 and valid.dtype == bool and values.shape == (len(points),)
    assert known[valid].all() and not known.all()
    # these voxels hold no surface, mostly: where there is no way to one, the value is the field's
    np.testing.assert_allclose(values[~valid], 0.05 * twin[~valid, 0], atol=0.05 * DECODED)


def test_blending_is_continuous_across_voxels():
    """Over a line through many voxels the blended field makes no jump where all voxels around it
    exist.
    """
    target = PropertyMap("x", 1, prior="zero", **SETTINGS)
    fill(target.grid, 5)
    steps = np.linspace(-0.14, 0.14, 20_001)
    line = np.column_stack([steps, 0.6 * steps, np.full_like(steps, 0.012)])
    values, valid = target.query(line, return_valid=True)
    jumps = np.abs(np.diff(values[:, 0]))[valid[1:] & valid[:-1]]
    # jumps only where the set of known voxels changes
    assert np.median(jumps) > 0 and (jumps > 0.05).mean() < 1e-3


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.zeros((4, 3)), np.array([[np.nan, 0, 0], [np.inf, 0, 0], [1e9, 0, 0]])],
)
def test_any_points_can_be_asked_for(surface, points):
    target, _ = surface
    values, valid = target.sdf(points)
    assert values.shape == valid.shape == (len(points),) and np.isfinite(values).all()
    if not np.isfinite(points).all():
        assert not valid.any()


def test_points_of_another_shape_are_refused(surface):
    with pytest.raises(InputError, match=r"points must be \(N, 3\), got \(4, 2\)"):
        surface[0].sdf(np.zeros((4, 2)))


def test_a_constant_is_decoded_at_voxel_centres_of_neighbours_too():
    """A point exactly on the rim of a lone doubled voxel, in one, two or all axes, still has that
    voxel's value.
    """
    target = PropertyMap("x", 1, prior="mean", **SETTINGS)
    latents = np.zeros((1, 7, 1), np.float32)
    latents[0, 6] = 0.75
    write(target.grid, np.zeros((1, 3), np.int32), latents, np.zeros((1, 2), np.uint32))
    rims = (
        np.array([[0.5, 0.5, -0.5], [0.5, -0.5, -0.5], [-0.5, -0.5, -0.5], [0.2, -0.5, -0.5]])
        * 0.05
    ).astype(np.float32)
    values, valid = target.query(rims, return_valid=True)
    np.testing.assert_allclose(values[valid], 0.75, atol=1e-3)


def other_rows(target, voxels):
    """Rows (S,) as kernels take them, the voxels that take no part, and the row of those that have one."""
    rows, keys = np.full(target.grid.count, kernels.ITSELF, np.int32), list(voxels)
    left_out = keys[:: len(keys) // 9]
    other = dict.fromkeys(keys[1 :: len(keys) // 9], 0) | dict.fromkeys(
        keys[2 :: len(keys) // 9], 1
    )
    rows[target.grid.slots_of(np.array(left_out, np.int32))] = kernels.ABSENT
    rows[target.grid.slots_of(np.array(list(other), np.int32))] = list(other.values())
    return rows, left_out, other


def test_corner_support_equals_its_twin(surface):
    target, voxels = surface
    corners = np.unique((np.array(list(voxels))[:, None] + STEPS).reshape(-1, 3), axis=0).astype(
        np.int32
    )
    rows, left_out, other = other_rows(target, voxels)
    masks = np.array([[0, 1 << 31], [2**32 - 1, 0]], np.uint32)
    cells = reference.unpack_masks(masks).reshape(2, *[4] * 3)
    voxels = {
        key: replace(voxel, mask=cells[other[key]]) if key in other else voxel
        for key, voxel in voxels.items()
        if key not in left_out
    }
    for closing in (1, 9, 27):
        support = np.empty((len(corners), 2), np.uint32)
        index, own = target.grid.index, target.grid["masks"]
        kernels.corner_support(corners, index, own, rows, masks, closing, support)
        twin = [reference.corner_support(voxels, corner, closing).reshape(-1) for corner in corners]
        np.testing.assert_array_equal(reference.unpack_masks(support), twin)
        assert 0.02 < np.mean(twin) < 0.9


@pytest.mark.parametrize("resolution", [1, 3])
def test_sdf_grid_equals_its_twin(surface, resolution):
    target, voxels = surface
    corners = np.unique((np.array(list(voxels))[:, None] + STEPS).reshape(-1, 3), axis=0).astype(
        np.int32
    )
    sdf = np.empty((len(corners), resolution**3), np.float32)
    basis = grid_basis(target.encoder.tables.encoding, resolution)
    rows, left_out, other = other_rows(target, voxels)
    F = np.random.default_rng(3).normal(size=(2, 6, 1)).astype(np.float32)
    latents, index = target.grid["latents"], target.grid.index
    kernels.sdf_grid(6, corners, index, latents, rows, F, *basis, sdf)
    voxels = {
        key: replace(voxel, F=F[other[key]]) if key in other else voxel
        for key, voxel in voxels.items()
        if key not in left_out
    }
    unknown = 0
    for corner, samples in zip(corners, sdf, strict=True):
        twin = reference.sdf_grid(ENCODER, voxels, corner, resolution).reshape(-1)
        defined = reference.tent_sum(voxels, corner, resolution) > 1e-5
        np.testing.assert_allclose(samples[defined], twin[defined], atol=DECODED)
        assert (samples[~defined] == kernels.UNKNOWN).all()
        unknown += (~defined).sum()
    assert 0 < unknown < sdf.size


def test_decoding_needs_the_runtime_of_the_map(surface, monkeypatch):
    target, _ = surface
    monkeypatch.setattr(runtime, "_runtime", runtime.Runtime("cpu", "another one"))
    for use in (lambda: target.sdf(np.zeros((1, 3))), target.extract_mesh):
        with pytest.raises(RuntimeStateError, match="save maps first"):
            use()
