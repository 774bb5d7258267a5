"""Maps of features: against the float64 twin, and laws that hold for any features."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import reference
import reference_latent as twin
import taichi as ti

from taichi_unifusion import PinholeCamera, PointCloud, load_map
from taichi_unifusion.errors import FrameError, InputError, MapCorrupt
from taichi_unifusion.files.maps import read_map, write_map
from taichi_unifusion.kernels import feature_query
from taichi_unifusion.kernels import features as kernels
from taichi_unifusion.maps import FeatureMap
from taichi_unifusion.types import ImageView

# table of position features, half precision, slopes of 255 levels
TWIN = {"float32": 2e-3, "float16": 2e-3, "int8": 5e-3}
HALF = 1e-3  # rounding of means in half precision, twice
# of the spread of features: what rounding slopes to 8 bits changes in one decoded number, three
# frames
ROUNDED = 0.1
MANY = 0.05  # the same over 120 frames, root mean square
LAG = 0.05  # share of a lasting change that rounding may keep from the map
EXACT = 1e-5  # float32 sums in another order
VOXEL = 0.1
CAMERA = PinholeCamera(24, 18, 22.0, 22.0, 11.5, 8.5)
PUBLISHED_ROWS = 20  # of float32


def facing(angle: float, distance: float) -> np.ndarray:
    """T_world_camera of a camera that looks at the origin from the side of negative z, turned about
    y.
    """
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = T[:3, :3] @ [0, 0, -distance]
    return T


def view(seed: int, channels: int = 20, count: int = 4000, values=None) -> PointCloud:
    """Points on a bent sheet around the origin, in world coordinates, with a feature image that
    sees them.
    """
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-0.45, 0.45, (count, 2))
    points = np.column_stack([xy, 0.3 * xy[:, 0] ** 2]).astype(np.float32)
    if values is None:
        values = rng.standard_normal((CAMERA.height, CAMERA.width, channels)) / np.sqrt(channels)
    T_camera_world = np.linalg.inv(facing(0.2 * seed - 0.3, 1.0 + 0.1 * seed))
    image = ImageView(np.ascontiguousarray(values, np.float32), CAMERA, T_camera_world)
    return PointCloud(points, features={"clip": image})


def made(*clouds: PointCloud, **settings) -> FeatureMap:
    channels = clouds[0].features["clip"].values.shape[2]
    target = FeatureMap("clip", channels, voxel_size=VOXEL, **settings)
    for cloud in clouds:
        target.integrate(cloud)
    return target


def answers(target: FeatureMap, points=None):
    points = view(9).points[::5] if points is None else points
    values, valid = target.query(points, return_valid=True)
    assert valid.mean() > 0.9
    return values[valid]


@pytest.fixture(scope="module")
def clouds():
    return view(0), view(1), view(2)


@pytest.fixture(scope="module")
def target(clouds):
    return made(*clouds)


def test_every_kernel_has_a_twin_of_its_name():
    names = {
        name
        for module in (kernels, feature_query)
        for name, value in vars(module).items()
        if getattr(value, "_is_wrapped_kernel", False)
    }
    assert names and {name for name in names if not hasattr(twin, name)} == set()


@pytest.mark.parametrize("precision", TWIN)
def test_the_map_is_the_regression_over_all_frames(clouds, precision):
    """What is kept as running means, frame by frame, equals one regression of everything that was
    seen, in float64.
    """
    target = made(*clouds, precision=precision)
    encoder = reference.Encoder(rank=8)
    frames = [
        twin.seen_cells(
            cloud.points,
            VOXEL,
            CAMERA.matrix @ cloud.features["clip"].T_camera_cloud[:3],
            cloud.features["clip"].values,
        )
        for cloud in clouds
    ]
    gathered = twin.fuse_features(encoder, frames, minimum=4, margin=1)
    assert len(target) == len(gathered)
    points = (
        np.random.default_rng(3)
        .uniform((-0.45, -0.45, -0.02), (0.45, 0.45, 0.08), (300, 3))
        .astype(np.float32)
    )
    solved = {
        key: twin.solve_rows(*parts, noise=target.settings.noise) for key, parts in gathered.items()
    }
    wanted, known = twin.query_products(encoder, solved, points.astype(float) / VOXEL)
    found, valid = target.query(points, return_valid=True)
    assert known.mean() > 0.9 and (valid == known).all()
    assert np.abs(found - wanted)[known].max() < TWIN[precision]

    texts = np.random.default_rng(4).standard_normal((3, 20)).astype(np.float32)
    texts /= np.linalg.norm(texts, axis=1, keepdims=True)
    scaled = {}
    for key, (f, weights, features) in gathered.items():
        length = np.linalg.norm(weights @ features / weights.sum())
        scaled[key] = (
            twin.solve_rows(f, weights, features @ texts.T, noise=target.settings.noise) / length
        )
    wanted, _ = twin.query_products(encoder, scaled, points.astype(float) / VOXEL)
    lengths = np.linalg.norm(found[known], axis=1).min()
    assert (
        np.abs(target.similarity(points, texts) - wanted)[known].max() < TWIN[precision] / lengths
    )


def random_rows(rng, voxels, slope_rows, channels):
    """Means, slopes and scales as they are kept in 8 bits."""
    slopes = rng.integers(-127, 128, (voxels, slope_rows * channels)).astype(np.int8)
    return (
        rng.standard_normal((voxels, channels)).astype(np.float16),
        slopes,
        rng.uniform(0.001, 0.01, (voxels, slope_rows)).astype(np.float32),
    )


def test_small_kernels_equal_their_twins():
    rng = np.random.default_rng(0)
    rows = random_rows(rng, 7, 3, 20)
    directions = rng.standard_normal((feature_query.DIRECTIONS, 20)).astype(np.float32)
    products = np.empty((7, 4, feature_query.DIRECTIONS), np.float32)
    feature_query.project_rows(7, *rows, directions, products)
    np.testing.assert_allclose(products, twin.project_rows(*rows, directions), atol=1e-4)
    channels = np.empty((7, 4, 6), np.float32)
    feature_query.take_channels(7, *rows, 5, channels)
    np.testing.assert_allclose(channels, twin.take_channels(*rows, 5, 6), rtol=1e-6)
    lengths = np.empty(7, np.float32)
    feature_query.mean_lengths(7, rows[0], lengths)
    np.testing.assert_allclose(lengths, twin.mean_lengths(rows[0]), rtol=1e-5)


def test_voxels_fuse_as_their_twin():
    """Two voxels with other means of f and y: slopes gain what the means moved, and are rounded by
    less than a level.
    """
    rng = np.random.default_rng(1)
    n, q, c = 5, 7, 20
    a, b = random_rows(rng, n, q, c), random_rows(rng, n, q, c)
    moments = rng.uniform(-1, 1, (2, n, q + q * (q + 1) // 2, 1)).astype(np.float32)
    weights = rng.uniform(1, 9, (2, n)).astype(np.float32)
    wanted = [
        twin.fuse_voxels(
            *(
                part
                for k, rows in enumerate((a, b))
                for part in (
                    moments[k, i, :q, 0],
                    *np.split(twin.decoded_rows(*rows)[i], [1])[0],
                    twin.decoded_rows(*rows)[i, 1:],
                    weights[k, i],
                )
            )
        )
        for i in range(n)
    ]
    fused = [array.copy() for array in a]
    fused_moments, fused_weights = moments[0].copy(), weights[0].copy()
    target = FeatureMap("clip", c)
    pools = kernels.FeaturePools(
        means=fused[0],
        slopes=fused[1],
        scales=fused[2],
        moments=fused_moments,
        weights=fused_weights,
    )
    kernels.fuse_voxels(
        target.layout,
        np.arange(3 * n, dtype=np.int32).reshape(n, 3),
        np.arange(n, dtype=np.int32),
        *b,
        moments[1],
        weights[1],
        target._scratch,
        pools,
    )
    ti.sync()
    found = twin.decoded_rows(*fused)
    for i, (mean, slopes) in enumerate(wanted):
        assert np.abs(found[i, 0] - mean).max() < HALF * np.abs(mean).max()
        assert (np.abs(found[i, 1:] - slopes) < 1.001 * fused[2][i][:, None]).all()
        np.testing.assert_allclose(
            np.abs(slopes).max(axis=1) / fused[2][i], kernels.LEVELS, rtol=1e-4
        )
    share = (weights[1] / weights.sum(axis=0))[:, None, None]
    np.testing.assert_allclose(
        fused_moments, moments[0] * (1 - share) + moments[1] * share, atol=1e-5
    )
    np.testing.assert_allclose(fused_weights, weights.sum(axis=0))


def test_rounding_forgets_no_frame():
    """A feature that changes for good after a third of the frames: 8 bits follow as floats do,
    without lag or drift.
    """
    rng = np.random.default_rng(0)
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    fields = [
        np.sin(rng.uniform(0, 0.5, 20) * u[..., None] + rng.uniform(0, 0.5, 20) * v[..., None]) / 4
        for _ in range(2)
    ]
    clouds = [
        view(i % 9, count=600, values=fields[i > 40] + 0.01 * rng.standard_normal((*v.shape, 20)))
        for i in range(120)
    ]
    exact, rounded, first = (
        made(*part, precision=name)
        for part, name in ((clouds, "float32"), (clouds, "int8"), (clouds[:41], "float32"))
    )
    wanted, error = answers(exact), answers(rounded) - answers(exact)
    assert np.sqrt((error**2).mean()) < MANY * wanted.std()
    missing = answers(first) - wanted  # towards what was there at first
    assert abs((error * missing).sum() / (missing**2).sum()) < LAG


def test_a_constant_comes_back_and_a_text_meets_it():
    feature = np.random.default_rng(0).standard_normal(20)
    feature /= np.linalg.norm(feature)
    constant = made(*(view(i, values=np.broadcast_to(feature, (18, 24, 20))) for i in range(2)))
    assert np.abs(answers(constant) - feature).max() < HALF
    points = view(9).points[::5]
    assert np.abs(constant.similarity(points, feature) - 1).max() < 2 * HALF
    # the length of a text does not count
    assert np.abs(constant.similarity(points, -3 * feature) + 1).max() < 2 * HALF


def test_features_lie_where_their_pixels_look():
    """The feature of a pixel is its own place: decoded at a point, it is where the camera sees the
    point.
    """
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    cloud = view(0, values=np.dstack([u, v, np.ones_like(u)]) / 24, count=40_000)
    found = made(cloud, noise=0.05).query(cloud.points)
    P = CAMERA.matrix @ cloud.features["clip"].T_camera_cloud[:3]
    h = cloud.points @ P[:, :3].T + P[:, 3]
    inner = (np.abs(cloud.points[:, :2]) < 0.3).all(axis=1)
    error = 24 * (found[:, :2] - h[:, :2] / h[:, 2:] / 24)[inner]  # [pixels]
    assert np.abs(error.mean(axis=0)).max() < 0.05 and np.sqrt((error**2).mean()) < 0.25


def test_order_does_not_matter_and_maps_merge(clouds, target):
    assert (
        np.abs(answers(made(*clouds[::-1])) - answers(target)).max()
        < ROUNDED * answers(target).std()
    )
    merged = made(*clouds[:2])
    merged.merge(made(clouds[2]))
    assert len(merged) == len(target)
    assert np.abs(answers(merged) - answers(target)).max() < ROUNDED * answers(target).std()


def test_the_same_frames_give_the_same_bits(clouds, target, tmp_path):
    target.save(tmp_path / "a.safetensors")
    made(*clouds).save(tmp_path / "b.safetensors")
    a, b = (read_map(tmp_path / name)[0] for name in ("a.safetensors", "b.safetensors"))
    assert all((a[name] == b[name]).all() for name in a)


def test_a_saved_map_answers_the_same(target, tmp_path):
    target.save(tmp_path / "clip.safetensors")
    loaded = load_map(tmp_path / "clip.safetensors")
    assert isinstance(loaded, FeatureMap) and loaded.settings == target.settings
    assert (answers(loaded) == answers(target)).all()


def test_a_file_with_wrong_rows_is_refused(target, tmp_path):
    target.save(tmp_path / "clip.safetensors")
    tensors, manifest = read_map(tmp_path / "clip.safetensors")
    for name, rows in (
        ("means", tensors["means"][:, 1:]),
        ("slopes", tensors["slopes"].astype(np.float32)),
        ("scales", np.full_like(tensors["scales"], np.nan)),
    ):
        write_map(
            tmp_path / "bad.safetensors", {**tensors, name: np.ascontiguousarray(rows)}, manifest
        )
        with pytest.raises(MapCorrupt, match=name):
            load_map(tmp_path / "bad.safetensors")


def test_a_file_of_an_earlier_version_is_refused(target, tmp_path):
    target.save(tmp_path / "clip.safetensors")
    tensors, manifest = read_map(tmp_path / "clip.safetensors")
    earlier = {
        name: array for name, array in tensors.items() if name not in ("means", "slopes", "scales")
    }
    write_map(
        tmp_path / "old.safetensors",
        {**earlier, "rows": np.zeros((len(target), 8, 20), np.float16)},
        manifest,
    )
    with pytest.raises(MapCorrupt, match="integrate the frames again"):
        load_map(tmp_path / "old.safetensors")


def test_pixels_that_are_not_finite_are_left_out():
    cloud = view(0)
    values = cloud.features["clip"].values
    spoiled = values.copy()
    spoiled[4:9, 5:12, 3] = np.nan
    spoiled[12, 3] = np.inf
    zeroed = spoiled.copy()
    zeroed[~np.isfinite(spoiled).all(axis=2)] = np.nan
    found = made(replace(cloud, features={"clip": replace(cloud.features["clip"], values=spoiled)}))
    same = made(replace(cloud, features={"clip": replace(cloud.features["clip"], values=zeroed)}))
    assert np.isfinite(answers(found)).all() and (answers(found) == answers(same)).all()


def test_unusable_features_leave_the_map_as_it_was(clouds):
    target = made(clouds[0])
    before, image = answers(target), clouds[1].features["clip"]
    for values, error in (
        (np.full_like(image.values, np.nan), FrameError),
        (image.values * 1e9, FrameError),
        (image.values[..., :8], InputError),
    ):
        with pytest.raises(error):
            target.integrate(
                replace(
                    clouds[1],
                    features={"clip": replace(image, values=np.ascontiguousarray(values))},
                )
            )
    with pytest.raises(InputError, match="no feature image"):
        target.integrate(replace(clouds[1], features={}))
    assert (answers(target) == before).all()


@pytest.mark.parametrize(
    "text, message",
    [(np.ones(21), "20 channels"), (np.zeros(20), "zero"), (np.full(20, np.nan), "finite")],
)
def test_texts_that_do_not_fit_are_refused(target, text, message):
    with pytest.raises(InputError, match=message):
        target.similarity(np.zeros((1, 3)), text)


def test_shapes_and_empty_maps(target):
    points, texts = view(9).points[:7], np.eye(20, dtype=np.float32)
    assert target.similarity(points, texts[0]).shape == (7,) and target.similarity(
        points, texts[:1]
    ).shape == (7, 1)
    assert target.similarity(np.zeros((0, 3)), texts).shape == (0, 20)
    values, valid = FeatureMap("clip", 20).similarity(points, texts, return_valid=True)
    assert not valid.any() and (values == 0).all()
    # more texts than are multiplied at once
    many = np.random.default_rng(0).standard_normal((150, 20))
    whole = target.similarity(points, many)
    assert (
        np.abs(whole - np.stack([target.similarity(points, text) for text in many], axis=1)).max()
        < EXACT
    )


def test_uncertainty_is_what_noise_does():
    """Unit features of one direction and white noise: products of the decoded direction with any
    other spread as predicted.
    """
    rng = np.random.default_rng(0)
    direction = np.zeros(64)
    direction[0] = 1
    noisy = direction + rng.standard_normal((3, CAMERA.height, CAMERA.width, 64)) * 0.25
    noisy /= np.linalg.norm(noisy, axis=3, keepdims=True)
    # smooth: the mean alone
    target = made(*(view(i, values=noisy[i]) for i in range(3)), noise=100.0)
    points = view(9).points[::5]
    others = np.eye(64)[1:]
    spread = target.similarity(points, others).std(axis=1)
    # eight voxels are blended, which shrinks it further
    assert 0.4 < np.median(spread / target.uncertainty(points)) < 1.1


@pytest.mark.parametrize("channels", [512, 768])
def test_a_voxel_takes_an_eighth_of_the_published_bytes(channels):
    # leaves of the index as full as on real surfaces
    target = FeatureMap("clip", channels, voxel_size=VOXEL / 3)
    target.integrate(view(0, channels=channels))
    assert (
        len(target) > 500 and target.memory_bytes / len(target) <= PUBLISHED_ROWS * channels * 4 / 8
    )


def test_a_map_grows_beyond_its_first_room():
    """Rows keep their place when the pools are made anew: a voxel size that needs more than the
    first 4,096 of them.
    """
    cloud = view(
        0, channels=4, count=120_000, values=np.broadcast_to([1.0, 2.0, 3.0, 4.0], (18, 24, 4))
    )
    target = FeatureMap("clip", 4, voxel_size=0.01)
    for rows in np.array_split(np.argsort(cloud.points[:, 0]), 4):
        target.integrate(
            PointCloud(np.ascontiguousarray(cloud.points[rows]), features=cloud.features)
        )
    assert len(target) > 5000
    values, valid = target.query(cloud.points[::50], return_valid=True)
    assert np.abs(values[valid] - [1, 2, 3, 4]).max() < 4 * HALF
