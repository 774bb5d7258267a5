"""Fusion over frames: the batch regression of all samples, removal of a frame, and voxels that are
given up.
"""

from __future__ import annotations

import numpy as np
import pytest
import reference_fusion as twin
from map_kinds import KINDS, answers, frames, integrated
from oracle import LATENT, assert_equal_maps, encoder_of, in_voxels
from scenes import joined, moved, rough

from taichi_unifusion import PropertyMap, SurfaceMap, load_map
from taichi_unifusion.errors import MapCorrupt, OutOfRange
from taichi_unifusion.files.maps import read_map, write_map
from taichi_unifusion.kernels import fusion
from taichi_unifusion.kernels.layout import Layout
from taichi_unifusion.maps import voxel_grid
from taichi_unifusion.maps.encoding import EncoderSettings

SIX_RANKS = {"encoder": EncoderSettings(rank=6, anchors=64), "noise": 0.3, "voxel_size": 0.05}
# relative to the largest latent: Eq. 19 backwards, where a frame of some times the weight is taken
# out
MEAN_REST = 2e-5
# the same for sums: rounding of sums over all frames, then a solve with noise 0.3
INFORMATION_REST = 2e-4
ORDER = 1e-4  # relative: float32 sums of some thousand samples in another order, then the solve
FUSIONS = ("mean", "information")


@pytest.fixture(params=FUSIONS)
def fused_by(request) -> str:
    return request.param


@pytest.fixture(params=KINDS)
def new(request, fused_by):
    return lambda **settings: KINDS[request.param](fusion=fused_by, **settings)


def assert_close(a, b, tolerance: float, masks: bool = True, sums: bool = True) -> None:
    """Same voxels, weights and support; latents within a share of the largest."""
    x, y = a.voxels(), b.voxels()
    np.testing.assert_array_equal(x.keys, y.keys)
    np.testing.assert_allclose(x.weights, y.weights, rtol=1e-5)
    np.testing.assert_allclose(x.latents, y.latents, atol=tolerance * np.abs(y.latents).max())
    if sums and x.sums is not None:
        np.testing.assert_allclose(x.sums, y.sums, atol=tolerance * np.abs(y.sums).max())
    if masks:
        np.testing.assert_array_equal(x.masks, y.masks)


def rest_of(target) -> float:
    return MEAN_REST if target.settings.fusion == "mean" else INFORMATION_REST


# ---- Against the twins ----


def packed(sums: twin.Sums, size: int) -> np.ndarray:
    """The sums of a voxel in the order of `keep_sums`, padded to `size`."""
    rank = len(sums.G)
    G = np.zeros((size, size))
    G[:rank, :rank] = sums.G
    rows = [np.pad(row, (0, size - rank)) for row in sums.r.T]
    return np.concatenate([G[np.tril_indices(size)], *rows, sums.mean])


@pytest.mark.parametrize("centered", [False, True])
def test_fuse_information_equals_its_twin(centered):
    """Into empty and known slots, with sign 1 and -1, and where nothing is left; -1 means no slot."""
    rng, rank, channels, voxels = np.random.default_rng(2), 6, 2, 12
    layout = Layout(rank, channels, centered, information=True)
    size = layout.size
    assert (size, layout.rows) == (8, 12)

    def sums_of(samples: int) -> twin.Sums:
        P, Y = rng.normal(size=(samples, rank)), rng.normal(size=(samples, channels))
        return twin.keep_sums(P, np.ones(samples), Y, centered)

    old, new = ([sums_of(n) for n in rng.integers(5, 30, voxels)] for _ in range(2))
    slots = np.array([n if n % 4 else -1 for n in range(voxels)], np.int32)
    known = np.arange(voxels) % 3 > 0
    q = layout.sums
    map_sums = np.array([packed(s, size) * k for s, k in zip(old, known, strict=True)], np.float32)
    map_weights = np.array([s.w * k for s, k in zip(old, known, strict=True)], np.float32)
    map_latents, map_masks = (
        np.zeros((voxels, rank + centered, channels), np.float32),
        np.zeros((voxels, 2), np.uint32),
    )
    sums, weights = (
        np.array([packed(s, size) for s in new], np.float32),
        np.array([s.w for s in new], np.float32),
    )
    masks = rng.integers(0, 2**32, (voxels, 2), dtype=np.uint32)
    assert sums.shape == (voxels, q)

    def fuse(sign: float) -> None:
        local = slots, sums[:, :, None], weights, masks
        arrays = map_sums, map_weights, map_masks, map_latents
        fusion.fuse_information(layout, 0, channels, voxels, *local, sign, 0.3, *arrays)

    fuse(1.0)
    for n in range(voxels):
        if slots[n] >= 0:
            F, w = twin.fuse_information([old[n], new[n]], [int(known[n]), 1], 0.3)
            assert map_weights[n] == w and (map_masks[n] == masks[n]).all()
            np.testing.assert_allclose(map_latents[n], F, atol=LATENT * np.abs(F).max())
        else:
            assert (
                not map_latents[n].any()
                and map_weights[n] == old[n].w * known[n]
                and not map_masks[n].any()
            )
    fuse(-1.0)
    for n in np.flatnonzero(slots >= 0):
        assert map_weights[n] == old[n].w * known[n]
        if known[n]:
            F, _ = twin.fuse_information([old[n], new[n], new[n]], [1, 1, -1], 0.3)
            np.testing.assert_allclose(map_latents[n], F, atol=INFORMATION_REST * np.abs(F).max())


def test_fuse_with_sign_minus_one_undoes_it():
    """Eq. 19 backwards; where nothing is left, weight 0."""
    rng, rows, channels = np.random.default_rng(7), 3, 2
    old, new = rng.normal(size=(2, 20, rows, channels)).astype(np.float32)
    weights, more = rng.integers(1, 50, (2, 20)).astype(np.float32)
    weights[:5] = 0
    masks, slots = np.zeros((20, 2), np.uint32), np.arange(20, dtype=np.int32)
    latents, left = old.copy(), weights.copy()
    for sign in (1.0, -1.0):
        fusion.fuse(
            Layout(rows, channels),
            0,
            20,
            slots,
            new,
            more,
            masks,
            sign,
            latents,
            left,
            masks.copy(),
        )
    np.testing.assert_array_equal(left, weights)
    np.testing.assert_allclose(latents[5:], old[5:], atol=3e-5)  # weights differ up to 50-fold
    assert not left[:5].any()


@pytest.mark.parametrize(
    ("sampling", "gpis"),
    [("cells", "samples"), ("cells", "derivatives"), ("cells", "both"), ("points", "samples")],
)
def test_information_fusion_is_one_regression_over_all_frames(sampling, gpis):
    """Surface: every voxel's F from the samples of all frames that encode it."""
    target = SurfaceMap(
        sampling=sampling,
        gpis=gpis,
        fusion="information",
        min_points=5,
        sample_distance=0.2,
        **SIX_RANKS,
    )
    clouds = rough(0), rough(1, 900), moved(rough(2, 600), (0.03, 0, 0.01))
    integrated(target, clouds)
    frames = [
        twin.surface_samples(
            encoder_of(target.settings),
            in_voxels(cloud, target.settings),
            cloud.normals.astype(float),
            target.settings,
        )
        for cloud in clouds
    ]
    assert_equal_maps(target, twin.regress_all(frames, target.settings.noise))


@pytest.mark.parametrize(
    ("prior", "sampling"), [("mean", "cells"), ("zero", "cells"), ("mean", "points")]
)
def test_information_fusion_of_a_property_is_one_regression_over_all_frames(prior, sampling):
    target = PropertyMap(
        "rgb", 3, prior=prior, sampling=sampling, fusion="information", min_points=3, **SIX_RANKS
    )
    clouds = rough(2), rough(3, 900)
    integrated(target, clouds)
    frames = [
        twin.property_samples(
            encoder_of(target.settings),
            in_voxels(cloud, target.settings),
            cloud.attributes["rgb"].astype(float),
            target.settings,
        )
        for cloud in clouds
    ]
    assert_equal_maps(target, twin.regress_all(frames, target.settings.noise))


# ---- Laws ----


def test_one_frame_is_the_same_by_both_fusions():
    for kind in KINDS.values():
        a, b = (integrated(kind(fusion=fused_by), frames()[:1]) for fused_by in FUSIONS)
        assert_close(a, b, ORDER, sums=False)


def test_points_of_two_clouds_in_one_or_in_two_frames_are_the_same_regression():
    """With every point a sample, information fusion does not care in which frame a sample came."""
    settings = {
        "fusion": "information",
        "sampling": "points",
        "min_points": 1,
        "voxel_size": 0.05,
        "noise": 0.3,
    }
    clouds = rough(0, 600), rough(1, 500)
    a, b = (
        integrated(
            PropertyMap("rgb", 3, encoder=EncoderSettings(rank=8, anchors=64), **settings), given
        )
        for given in (clouds, [joined(*clouds)])
    )
    assert_close(a, b, ORDER)


def test_the_order_of_frames_does_not_matter(new):
    a, b, c = frames()
    assert_close(integrated(new(), (c, a, b)), integrated(new(), (a, b, c)), ORDER)


def test_a_removed_frame_leaves_the_map_without_it(new):
    """Latents, weights, voxels; support stays where a voxel stays."""
    a, b, c = frames()
    target, without = integrated(new(), (a, b, c)), integrated(new(), (a, c))
    before, total = len(target), target.integrate(b).voxels
    target.remove(b)
    done = target.remove(b)
    assert (done.points, done.voxels, done.total_voxels) == (len(b), total, len(without))
    assert before > len(without) == len(target)
    assert_close(target, without, rest_of(target), masks=False)
    ours, theirs = target.voxels(), without.voxels()
    assert ((ours.masks & theirs.masks) == theirs.masks).all()
    np.testing.assert_allclose(
        np.frombuffer(answers(target)[0], np.float32),
        np.frombuffer(answers(without)[0], np.float32),
        atol=10 * rest_of(target),
    )
    assert answers(target)[1] == answers(without)[1]


def test_what_is_removed_can_be_integrated_again(new):
    """Voxels given up and seen again are as if seen for the first time; the same with room made for
    more.
    """
    a, b, c = frames()
    target, whole = integrated(new(), (a, b, c)), integrated(new(), (a, b, c))
    for _ in range(2):
        target.remove(b)
        target.integrate(b)
    assert_close(target, whole, rest_of(target))
    target.grid.reserve(target.grid.capacity)
    assert_close(target, whole, rest_of(target))
    assert len(target) == len(whole)


def test_a_map_from_which_all_was_removed_is_empty_and_of_use(new, tmp_path):
    a, b, c = frames()
    target = integrated(new(), (a, b))
    target.remove(a)
    assert target.remove(b).total_voxels == len(target) == 0
    assert answers(target)[2] == 0 and not any(answers(target)[0])
    target.save(tmp_path / "empty")
    empty = load_map(tmp_path / "empty")
    assert len(empty) == 0
    if isinstance(target, SurfaceMap):
        assert len(target.extract_mesh().faces) == len(empty.extract_mesh().faces) == 0
    fresh = integrated(new(), [c])
    for other in (target, empty):
        other.integrate(c)
        assert [array.tobytes() for array in _arrays(other)] == [
            array.tobytes() for array in _arrays(fresh)
        ]
    target.save(tmp_path / "again")
    assert [x.tobytes() for x in _arrays(load_map(tmp_path / "again"))] == [
        x.tobytes() for x in _arrays(fresh)
    ]


def _arrays(target) -> list[np.ndarray]:
    return list(target.voxels().tensors.values())


def test_removing_what_is_not_there_changes_nothing(new):
    a, b, _ = frames()
    target = integrated(new(), [a])
    before = [array.tobytes() for array in _arrays(target)]
    done = target.remove(moved(b, (10, 0, 0)))
    assert (done.voxels, done.total_voxels) == (0, len(target))
    bad = moved(a, (0, 0, 0))
    bad.points[5, 0] = np.inf
    with pytest.raises(OutOfRange):
        target.remove(bad)
    assert [array.tobytes() for array in _arrays(target)] == before


def test_merging_is_integrating_all(new):
    a, b, c = frames()
    merged = integrated(new(), [a])
    merged.merge(integrated(new(), (b, c)))
    assert_close(merged, integrated(new(), (a, b, c)), ORDER)


def test_a_loaded_map_goes_on_as_the_saved_one(new, tmp_path):
    a, b, c = frames()
    target = integrated(new(), (a, b))
    target.save(tmp_path / "map")
    loaded = load_map(tmp_path / "map")
    assert [x.tobytes() for x in _arrays(loaded)] == [x.tobytes() for x in _arrays(target)]
    assert answers(loaded) == answers(target)
    for grown in (target, loaded):
        grown.integrate(c)
        grown.remove(b)
    assert [x.tobytes() for x in _arrays(loaded)] == [x.tobytes() for x in _arrays(target)]
    loaded.save(tmp_path / "again")
    target.save(tmp_path / "map")
    assert (tmp_path / "again").read_bytes() == (tmp_path / "map").read_bytes()


def test_growing_pools_keep_everything(new, monkeypatch):
    whole = integrated(new(), frames())
    monkeypatch.setattr(voxel_grid, "FIRST_CAPACITY", 4)
    small = integrated(new(), frames())
    assert small.grid.capacity > 4 and [x.tobytes() for x in _arrays(small)] == [
        x.tobytes() for x in _arrays(whole)
    ]


def test_sums_are_kept_only_where_they_are_used():
    assert integrated(KINDS["surface"](), frames()[:1]).voxels().sums is None
    kept = integrated(KINDS["property"](fusion="information"), frames()[:1]).voxels()
    assert kept.sums.shape == (len(kept.keys), Layout(8, 3, True).sums) and kept.evidence is None


def test_damaged_sums_are_refused(tmp_path):
    integrated(KINDS["surface"](fusion="information"), frames()[:1]).save(tmp_path / "map")
    tensors, manifest = read_map(tmp_path / "map")
    sums = tensors.pop("sums")
    for damaged, message in (
        (None, "'sums' should be"),
        (sums[:, 1:].copy(), "'sums' should be"),
        (sums.astype(float), "'sums' should be"),
        (sums * np.float32(np.nan), "not finite"),
    ):
        write_map(
            tmp_path / "map", tensors if damaged is None else {**tensors, "sums": damaged}, manifest
        )
        with pytest.raises(MapCorrupt, match=message):
            load_map(tmp_path / "map")
