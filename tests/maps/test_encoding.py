"""f_posi against Eq. 4-14, and its kernels against their twins."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from encoding_kernels import encode_gradients, encode_positions, interpolate_positions
from scipy.special import gamma, kv

from taichi_unifusion.errors import InputError
from taichi_unifusion.maps.encoder import NODES, SPACES, between_centers
from taichi_unifusion.maps.encoding import (
    EncoderSettings,
    PositionEncoding,
    matern72,
    position_encoding,
)
from taichi_unifusion.maps.settings import PropertySettings, SurfaceSettings

# what 256 anchors and 20 eigenpairs reach on 2000 random points; other samples differ by 3 %
KERNEL_ERROR = 0.0058 * 1.03
EXACT = 1e-9  # float64 formulas written twice; the smallest kept eigenvalue is about 0.8
SINGLE = 2e-5  # float32: sums over 256 anchors of products whose terms cancel to some 1 %
# Trilinear interpolation over cells of side h errs by at most h^2 / 8 times the sum of the three
# second derivatives, which go with 1 / rho^2: the largest of 20 features, on random points 1.5e-3.
INTERPOLATION = 2e-3
SMALL = EncoderSettings(rank=7, anchors=50, length_scale=0.3, seed=4)
SETTINGS = [EncoderSettings(), SMALL]


def oracle(settings: EncoderSettings) -> reference.Encoder:
    return reference.Encoder(settings.rank, settings.anchors, settings.length_scale, settings.seed)


@pytest.fixture(scope="module")
def t() -> np.ndarray:
    """Encoder coordinates: random ones, the cube's corners, its centre, and an anchor, where the
    distance is zero.
    """
    corners = reference.CORNERS - 0.5
    return np.vstack(
        [
            np.random.default_rng(3).uniform(-0.5, 0.5, (300, 3)),
            corners,
            np.zeros((1, 3)),
            PositionEncoding(EncoderSettings()).anchors[:1],
        ]
    )


def test_matern72_is_the_general_matern_kernel():
    d, nu, rho = np.linspace(1e-3, 2, 200), 3.5, 0.4753
    s = np.sqrt(2 * nu) * d / rho
    # Eq. 12
    np.testing.assert_allclose(
        matern72(d, rho), 2 ** (1 - nu) / gamma(nu) * s**nu * kv(nu, s), rtol=1e-10
    )
    assert matern72(0.0, rho) == 1


@pytest.mark.parametrize("settings", SETTINGS, ids=["default", "small"])
def test_encoding_equals_the_oracle(settings, t):
    encoding = PositionEncoding(settings)
    np.testing.assert_allclose(encoding(t), oracle(settings)(t), atol=EXACT)
    # the twin takes differences
    np.testing.assert_allclose(encoding.gradient(t), oracle(settings).gradient(t), atol=1e-7)


def test_features_of_the_anchors_are_the_leading_part_of_their_kernel_matrix():
    encoding = position_encoding(EncoderSettings())
    values, vectors = np.linalg.eigh(
        reference.kernel_matrix(encoding.anchors, encoding.anchors, 0.4753)
    )
    leading = (vectors[:, -20:] * values[-20:]) @ vectors[:, -20:].T
    features = encoding(encoding.anchors)
    np.testing.assert_allclose(features @ features.T, leading, atol=1e-10)


def test_kernel_error_is_small_and_falls_with_rank_and_anchors():
    assert PositionEncoding(EncoderSettings()).kernel_error() <= KERNEL_ERROR
    by_rank = [
        PositionEncoding(EncoderSettings(rank=rank)).kernel_error() for rank in (5, 10, 20, 40, 80)
    ]
    assert all(after < 0.7 * before for before, after in zip(by_rank, by_rank[1:], strict=False)), (
        by_rank
    )
    by_anchors = [
        np.mean(
            [
                PositionEncoding(EncoderSettings(anchors=anchors, seed=s)).kernel_error(500)
                for s in range(3)
            ]
        )
        for anchors in (20, 64, 256)
    ]
    assert all(after < before for before, after in zip(by_anchors, by_anchors[1:], strict=False)), (
        by_anchors
    )


def test_kernel_error_measures_the_kernel():
    settings, t = EncoderSettings(), np.random.default_rng(1).uniform(-0.5, 0.5, (400, 3))
    features = oracle(settings)(t)
    error = np.abs(
        reference.kernel_matrix(t, t, settings.length_scale) - features @ features.T
    ).mean()
    assert PositionEncoding(settings).kernel_error(400) == pytest.approx(error, rel=1e-6)


def test_encoding_is_deterministic_and_seeded():
    first, again, other = (PositionEncoding(EncoderSettings(seed=seed)) for seed in (0, 0, 1))
    assert (
        first.anchors.tobytes() == again.anchors.tobytes()
        and first.projection.tobytes() == again.projection.tobytes()
    )
    assert not np.allclose(first.anchors, other.anchors)
    assert position_encoding(EncoderSettings()) is position_encoding(EncoderSettings())


def test_nodes_are_cell_centres_x_slowest():
    nodes = PositionEncoding(SMALL).nodes(4).reshape(4, 4, 4, 3)
    np.testing.assert_allclose(nodes[3, 0, 1], [0.375, -0.375, -0.125])


@pytest.mark.parametrize("wrong", [{"rank": 0}, {"rank": 257}, {"length_scale": 0.0}])
def test_settings_that_make_no_encoder_are_refused(wrong):
    with pytest.raises(InputError, match="encoder: "):
        EncoderSettings(**wrong)


def test_decoupled_regression_approaches_the_exact_process():
    """Eq. 5 and 6 against Eq. 3: with more eigenpairs the latent predicts what the full Gaussian
    process does.
    """
    rng = np.random.default_rng(5)
    X, X_new = rng.uniform(-0.5, 0.5, (80, 3)), rng.uniform(-0.4, 0.4, (50, 3))
    Y = np.sin(4 * X[:, :1]) + X[:, 1:2] ** 2
    exact = reference.gpr(X, Y, X_new, 0.1, 0.4753)
    errors = []
    for rank in (5, 20, 80, 250):
        encoder = PositionEncoding(EncoderSettings(rank=rank))
        errors.append(
            np.abs(encoder(X_new) @ reference.regress_dual(encoder(X), Y, 0.1) - exact).mean()
        )
    assert (
        errors[0] > errors[1] > errors[2] > errors[3] and errors[1] < 0.03 and errors[3] < 1e-3
    ), errors


def test_primal_form_equals_dual_form():
    """Eq. 6 as printed (n x n) and as solved here (l x l), with repeated rows as weights, and with
    derivatives (Eq. 16-17).
    """
    rng = np.random.default_rng(6)
    encoder = PositionEncoding(EncoderSettings())
    t, counts = rng.uniform(-0.5, 0.5, (40, 3)), rng.integers(1, 6, 40)
    P, Y = encoder(t), rng.normal(size=(40, 3))
    for noise in (0.01, 1.0):
        dual = reference.regress_dual(
            np.repeat(P, counts, axis=0), np.repeat(Y, counts, axis=0), noise
        )
        np.testing.assert_allclose(reference.regress(P, counts, Y, noise), dual, atol=1e-9)
        gradient = np.moveaxis(encoder.gradient(t), 1, 0)
        stacked, targets = (
            np.vstack([P, *(0.5 * gradient)]),
            np.vstack([np.zeros((40, 1)), *Y.T[:, :, None]]),
        )
        np.testing.assert_allclose(
            reference.encode_voxel(
                oracle(encoder.settings),
                t,
                np.ones(40),
                np.zeros((40, 1)),
                Y,
                noise,
                centered=False,
            ),
            reference.regress_dual(stacked, targets, noise),
            atol=1e-7,
        )


def parameters(encoding: PositionEncoding) -> tuple[np.ndarray, np.ndarray, float]:
    """Anchors, projection and scale as the kernels take them."""
    scale = np.sqrt(7) / encoding.settings.length_scale
    return (
        np.ascontiguousarray(encoding.anchors.T * scale, np.float32),
        np.ascontiguousarray(encoding.projection.T, np.float32),
        scale,
    )


@pytest.mark.parametrize("settings", SETTINGS, ids=["default", "small"])
def test_encode_positions_equals_its_twin(settings, t):
    features = np.empty((len(t), settings.rank), np.float32)
    encode_positions(
        settings.rank, t.astype(np.float32), *parameters(PositionEncoding(settings)), features
    )
    np.testing.assert_allclose(
        features, reference.encode_positions(oracle(settings), t.astype(np.float32)), atol=SINGLE
    )


@pytest.mark.parametrize("settings", SETTINGS, ids=["default", "small"])
def test_interpolate_positions_equals_its_twin_and_nearly_the_encoding(settings, t):
    encoder = reference.Interpolated(oracle(settings), NODES)
    lattice = PositionEncoding(settings).lattice(NODES)
    np.testing.assert_allclose(
        lattice, encoder.lattice.values.reshape(len(lattice), -1), atol=SINGLE
    )
    t, features = t.astype(np.float32), np.empty((len(t), settings.rank), np.float32)
    interpolate_positions(settings.rank, t, lattice, NODES, features)
    np.testing.assert_allclose(features, reference.interpolate_positions(encoder, t), atol=SINGLE)
    bound = INTERPOLATION * (0.4753 / settings.length_scale) ** 2
    np.testing.assert_allclose(features, oracle(settings)(t), atol=bound)
    on_nodes = t[300:309]  # corners and centre
    np.testing.assert_allclose(features[300:309], oracle(settings)(on_nodes), atol=SINGLE)


def test_encode_gradients_equals_its_twin(t):
    gradients = np.empty((len(t), 3, SMALL.rank), np.float32)
    encode_gradients(
        SMALL.rank, t.astype(np.float32), *parameters(PositionEncoding(SMALL)), gradients
    )
    twin = reference.encode_gradients(oracle(SMALL), t.astype(np.float32).astype(float))
    np.testing.assert_allclose(gradients, twin, atol=SINGLE * np.abs(twin).max())


def test_between_centers_is_f_posi_of_all_eight_voxels_at_the_same_place():
    """Eighths of one lattice, in the order of the corners; zeros fill up the size."""
    settings = EncoderSettings(rank=6, anchors=64)
    between = between_centers(PositionEncoding(settings).lattice(NODES))
    u = np.stack(np.meshgrid(*[np.linspace(0, 1, SPACES + 1)] * 3, indexing="ij"), axis=-1)
    for o, step in enumerate(reference.CORNERS):
        wanted = oracle(settings)((u.reshape(-1, 3) - step) / 2)
        np.testing.assert_allclose(between[:, o, :6], wanted, atol=SINGLE)
    assert between.shape == ((SPACES + 1) ** 3, 8, 8) and not between[..., 6:].any()


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"anchors": 100_000}, "anchors: must lie in 1..1024"),
        ({"seed": -1}, "seed: must lie in 0"),
        ({"length_scale": 1e-300}, "length_scale: must lie in 0.01..100"),
        ({"length_scale": float("nan")}, "length_scale.*got nan"),
        ({"rank": 20, "anchors": 10}, "rank must lie in 1..anchors"),
        ({"rank": "8"}, "rank: expected a whole number"),
    ],
)
def test_c11_settings_out_of_range_are_refused_when_they_are_made(values, word):
    with pytest.raises(InputError, match=word):
        EncoderSettings(**values)


def test_c11_a_map_of_a_rank_that_compiles_for_minutes_is_refused():
    for settings in (SurfaceSettings, PropertySettings):
        with pytest.raises(InputError, match="rank: must lie in 1..64, got 200"):
            settings(encoder=EncoderSettings(rank=200))
        assert settings(encoder=EncoderSettings(rank=64)).encoder.rank == 64


def test_c11_more_eigenpairs_than_a_wide_kernel_has_are_refused():
    with pytest.raises(InputError, match="smaller rank or a smaller length_scale"):
        PositionEncoding(EncoderSettings(rank=64, length_scale=100.0)).check()
    assert np.isfinite(PositionEncoding(EncoderSettings(rank=64)).projection).all()
