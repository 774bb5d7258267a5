"""The kernels that let the rays of frames vote, against their twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference
import reference_visibility as twin
from viewpoints import CAMERA, VS, pose

from taichi_unifusion import SurfaceMap
from taichi_unifusion.kernels import visibility as kernels
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.maps.voxel_data import MASKS, WEIGHTS
from taichi_unifusion.maps.voxel_grid import VoxelGrid

ENCODER = EncoderSettings(rank=8, anchors=64)
FLIPPED = 1e-3  # share of cells in which float32 puts a pixel, or a threshold, on the other side
EVIDENCE = 1e-4  # [votes] of float32 weights about 1 and votes about 100


@pytest.fixture(scope="module")
def voxels() -> dict[tuple, reference.Voxel]:
    """Voxels around a camera at the origin, before and behind it and beside its image, with noisy
    planes in them.
    """
    rng, encoder = np.random.default_rng(0), reference.Encoder(ENCODER.rank, ENCODER.anchors)
    features = encoder((twin.CENTERS - 0.5) / 2)
    z = rng.integers(3, 18, (250, 1))
    keys = np.vstack(
        [np.hstack([rng.uniform(-0.6, 0.6, (250, 2)) * z, z]), rng.uniform(-18, 18, (80, 3))]
    ).astype(int)
    found = {}
    for key in sorted(map(tuple, np.unique(keys, axis=0).tolist())):
        normal = rng.normal(size=3)
        plane = (twin.CENTERS - rng.uniform(0.2, 0.8, 3)) @ normal / np.linalg.norm(normal)
        # some of them too flat
        F = np.linalg.lstsq(features, plane[:, None], rcond=None)[0] * rng.choice([0.01, 1, 1, 1])
        F = F.astype(np.float32).astype(float)
        found[key] = reference.Voxel(F, 5.0, rng.uniform(size=64) < 0.5)
    return found


@pytest.fixture(scope="module")
def boards(voxels) -> dict[tuple, reference.Voxel]:
    """The same, most of which have two sides, a few centimetres apart."""
    rng, encoder = np.random.default_rng(3), reference.Encoder(ENCODER.rank, ENCODER.anchors)
    thin = np.linalg.lstsq(encoder((twin.CENTERS - 0.5) / 2), np.full(64, 0.3), rcond=None)[0]
    found = {}
    for key, voxel in voxels.items():
        back = (-voxel.F[:, 0] - thin).astype(np.float16).astype(float)
        both = ((2 * voxel.F[:, 0] + 3 * back) / 5).astype(np.float32).astype(float)[:, None]
        weight = rng.choice([0.0, 3.0, 3.0, 5.0])
        found[key] = reference.Voxel(both, 5.0, voxel.mask, (back, 5.0 - weight, weight))
    return found


@pytest.fixture(scope="module")
def depth() -> np.ndarray:
    """Readings from 0.2 to 1 m in patches, a third of them none; 1 at all borders."""
    rng = np.random.default_rng(1)
    image = np.kron(
        rng.uniform(0.2, 1, (15, 20)) * (rng.uniform(size=(15, 20)) > 0.3), np.ones((8, 8))
    )
    image[[0, -1]] = image[:, [0, -1]] = 1.0
    return image.astype(np.float32)


def pack_masks(masks: np.ndarray) -> np.ndarray:
    """(N, 64) bool -> (N, 2) words, first cell in the highest bit."""
    return np.packbits(masks, axis=1).view(">u4").astype(np.uint32)


def vote(
    voxels: dict, depth: np.ndarray, T: np.ndarray, sign: int, evidence: np.ndarray, slots=None
) -> None:
    """Votes of a view, or of several: depth (H, W) or (K, H, W) and T (4, 4) or (K, 4, 4)."""
    target = SurfaceMap(encoder=ENCODER)
    keys = np.array(list(voxels), np.int32)
    sides = [v.back or (np.zeros(ENCODER.rank), v.w, 0.0) for v in voxels.values()]
    kernels.vote_cells(
        ENCODER.rank,
        slots or (0, len(keys)),
        keys,
        pack_masks(np.array([v.mask for v in voxels.values()])),
        np.array([v.F for v in voxels.values()], np.float32),
        np.array([back for back, *_ in sides], np.float16),
        np.array([weights for _, *weights in sides], np.float32),
        target.cell_gradients.to_numpy(),
        VS,
        depth.reshape(-1, CAMERA.height, CAMERA.width),
        CAMERA.intrinsics,
        np.ascontiguousarray(T.reshape(-1, 4, 4)[:, :3], np.float32),
        sign,
        evidence,
    )


@pytest.mark.parametrize(
    "T",
    [pose((0.003, 0.0017, -0.0021)), pose((0.1, -0.05, 0.02), 0.4, -0.3, 1.0)],
    ids=["straight", "turned"],
)
def test_vote_cells_equals_its_twin(voxels, depth, T):
    """Before and behind the camera, inside and outside the image; the same frame with sign -1 takes
    its votes out.

    The camera is never quite at the origin, where cells fall exactly between pixels.
    """
    evidence = np.zeros((len(voxels), 64), np.int8)
    vote(voxels, depth, T, 1, evidence)
    wanted = np.array(
        list(
            twin.vote_cells(
                reference.Encoder(ENCODER.rank, ENCODER.anchors), voxels, VS, [depth], CAMERA, [T]
            ).values()
        )
    )
    assert min((wanted == v).sum() for v in (-1, 1)) > 100 and (evidence != wanted).mean() < FLIPPED
    vote(voxels, depth, T, -1, evidence)
    assert not evidence.any()


def test_both_sides_of_a_board_are_voted_for(boards, depth):
    """In a cell the nearer of the two surfaces is asked for, as the twin does."""
    T, evidence = pose((0.003, 0.0017, -0.0021)), np.zeros((len(boards), 64), np.int8)
    vote(boards, depth, T, 1, evidence)
    encoder = reference.Encoder(ENCODER.rank, ENCODER.anchors)
    wanted, one = (
        np.array(list(twin.vote_cells(encoder, each, VS, [depth], CAMERA, [T]).values()))
        for each in (boards, {key: replace(v, back=None) for key, v in boards.items()})
    )
    assert (evidence != wanted).mean() < FLIPPED < 0.01 < (one != wanted).mean()


def test_votes_of_several_views_are_those_of_each_and_equal_their_twin(voxels, depth):
    """In one go, or slot by slot; images beyond the last pose are not read."""
    poses = np.array(
        [
            pose((0.003, 0.0017, -0.0021)),
            pose((0.1, -0.05, 0.02), 0.4, -0.3, 1.0),
            pose((-0.2, 0.1, 0.3), -0.9),
            pose((0.05, 0.0, -5.0)),  # sees nothing: all lies behind it
        ]
    )
    images = np.array(
        [depth, depth[::-1], np.roll(depth, 50, axis=1), depth, np.full_like(depth, 9)]
    )
    together, single, ranges = np.zeros((3, len(voxels), 64), np.int8)
    vote(voxels, images, poses, 1, together)
    for T, image in zip(poses, images[:4], strict=True):
        vote(voxels, image, T, 1, single)
    for slots in ((0, 50), (50, 51), (51, 51), (51, len(voxels))):
        vote(voxels, images, poses, 1, ranges, slots)
    np.testing.assert_array_equal(together, single)
    np.testing.assert_array_equal(together, ranges)
    encoder = reference.Encoder(ENCODER.rank, ENCODER.anchors)
    twins = twin.vote_cells(encoder, voxels, VS, images[:4], CAMERA, poses)
    wanted = np.array(list(twins.values()))
    assert (together != wanted).mean() < 3 * FLIPPED and np.abs(wanted).max() > 1
    vote(voxels, images, poses, -1, together)
    assert not together.any()


def test_votes_stay_within_what_a_cell_can_hold(voxels, depth):
    evidence, once = (np.zeros((len(voxels), 64), np.int8) for _ in range(2))
    vote(voxels, depth, np.eye(4), 1, once)
    evidence[:] = 126 * once
    for _ in range(3):
        vote(voxels, depth, np.eye(4), 1, evidence)
    np.testing.assert_array_equal(evidence, 127 * once.astype(int))
    for _ in range(2):
        vote(voxels, depth, np.eye(4), -1, evidence)
    np.testing.assert_array_equal(evidence, 125 * once.astype(int))


def test_a_frame_without_readings_casts_no_vote(voxels, depth):
    evidence = np.zeros((len(voxels), 64), np.int8)
    vote(voxels, np.zeros_like(depth), np.eye(4), 1, evidence)
    assert not evidence.any()


def test_a_reading_at_the_image_border_counts_and_one_pixel_on_does_not():
    """One voxel without support, small in the image, at the last pixels and just outside."""
    for u, seen in ((0, True), (159, True), (-2, False), (161, False)):
        center = np.array([(u - CAMERA.cx) / CAMERA.fx, 0.0, 1.0]) * 50
        key = tuple(np.floor(center / VS).astype(int).tolist())
        evidence = np.zeros((1, 64), np.int8)
        vote(
            {key: reference.Voxel(np.zeros((ENCODER.rank, 1)), 1.0, np.zeros(64, bool))},
            np.full((120, 160), 100, np.float32),
            np.eye(4),
            1,
            evidence,
        )
        assert evidence.all() == evidence.any() == seen, u


def test_add_evidence_equals_its_twin():
    rng = np.random.default_rng(3)
    old, more = (
        rng.integers(-127, 128, (50, 64), dtype=np.int8),
        rng.integers(-127, 128, (30, 64), dtype=np.int8),
    )
    slots, added = rng.permutation(50)[:30].astype(np.int32), old.copy()
    kernels.add_evidence(slots, more, added)
    np.testing.assert_array_equal(added[slots], twin.add_evidence(old[slots], more))
    others = np.setdiff1d(np.arange(50), slots)
    np.testing.assert_array_equal(added[others], old[others])


@pytest.mark.parametrize("sign", [1, -1])
def test_vote_support_equals_its_twin(sign):
    """Voxels that the map does not hold get no vote."""
    rng, grid = np.random.default_rng(5), VoxelGrid([WEIGHTS, MASKS])
    keys = np.unique(rng.integers(-3, 3, (40, 3)), axis=0).astype(np.int32)
    known = np.arange(len(keys)) % 4 > 0
    slots = np.empty(len(keys), np.int32)
    grid.claim(len(keys), keys, known.astype(np.float32), slots)
    support = rng.uniform(size=(len(keys), 64)) < 0.4
    evidence = np.zeros((grid.capacity, 64), np.int8)
    kernels.vote_support(len(keys), keys, pack_masks(support), grid.index, sign, evidence)
    votes = twin.vote_support({tuple(key): mask for key, mask in zip(keys, support, strict=True)})
    for key, slot in zip(keys[known], slots[known], strict=True):
        np.testing.assert_array_equal(evidence[slot], sign * votes[tuple(key)])
    assert np.count_nonzero(evidence) == support[known].sum()


def test_interpolate_evidence_equals_its_twin():
    rng, grid = np.random.default_rng(4), VoxelGrid([WEIGHTS, MASKS])
    keys = np.unique(rng.integers(-2, 2, (40, 3)), axis=0).astype(np.int32)
    slots = np.empty(len(keys), np.int32)
    grid.claim(len(keys), keys, np.ones(len(keys), np.float32), slots)
    masks, evidence = (
        rng.uniform(size=(grid.capacity, 64)) < 0.5,
        rng.integers(-127, 128, (grid.capacity, 64), dtype=np.int8),
    )
    masks[slots[0]] = False
    x, values = rng.uniform(-2.5, 2.5, (2000, 3)), np.empty(2000, np.float32)
    points = (x * VS).astype(np.float32)
    kernels.interpolate_evidence(points, 1 / VS, grid.index, pack_masks(masks), evidence, values)
    by_key = {tuple(key): s for key, s in zip(keys.tolist(), slots, strict=True)}
    wanted = twin.interpolate_evidence(
        {key: evidence[s] for key, s in by_key.items()},
        {key: masks[s] for key, s in by_key.items()},
        points.astype(float) / VS,
    )
    assert 0.2 < (wanted == 1).mean() < 0.9
    assert (np.abs(values - wanted) > EVIDENCE * 127).mean() < FLIPPED
