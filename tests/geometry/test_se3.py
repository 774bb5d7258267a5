"""The laws of rigid motions, of one and of many at once."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.geometry import se3

EXACT = 1e-9


def twists(seed: int, count: int = 20, turn: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(count, 6)) * np.repeat([1.0, turn], 3)


A, B, C = (se3.exp(twists(seed)) for seed in (10, 11, 12))
XI = twists(13, turn=0.5)
ONE = np.broadcast_to(np.eye(4), A.shape)
LAWS = {
    "inverse on the right": (A @ se3.inverse(A), ONE),
    "inverse on the left": (se3.inverse(A) @ A, ONE),
    "inverse of an inverse": (se3.inverse(se3.inverse(A)), A),
    "inverse of a product": (se3.inverse(A @ B), se3.inverse(B) @ se3.inverse(A)),
    "products of three": ((A @ B) @ C, A @ (B @ C)),
    "nothing moves nothing": (se3.exp(0 * XI), ONE),
    "the opposite twist": (se3.exp(-XI), se3.inverse(se3.exp(XI))),
    "twists along one axis add": (se3.exp(0.3 * XI) @ se3.exp(0.7 * XI), se3.exp(XI)),
    "adjoint of a product": (se3.adjoint(A @ B), se3.adjoint(A) @ se3.adjoint(B)),
    "adjoint of an inverse": (se3.adjoint(se3.inverse(A)), np.linalg.inv(se3.adjoint(A))),
    "rigid is normal": (se3.normalized(A), A),
    "one as many": (np.array([se3.log(T) for T in A]), se3.log(A)),
}


@pytest.mark.parametrize("law", LAWS)
def test_laws(law):
    np.testing.assert_allclose(*LAWS[law], atol=EXACT)


def test_distance_is_the_same_from_both_sides():
    for T_a, T_b in zip(A, B, strict=True):
        assert se3.distance(T_a, T_b) == pytest.approx(se3.distance(T_b, T_a))
        assert se3.distance(C[0] @ T_a, C[0] @ T_b) == pytest.approx(se3.distance(T_a, T_b))


@pytest.mark.parametrize("turn", [0.0, 1e-9, 1e-5, 0.3, 1.0])
def test_log_undoes_exp(turn):
    xi = twists(0, turn=turn)
    np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-8)
    np.testing.assert_allclose(np.linalg.det(se3.exp(xi)[:, :3, :3]), 1, atol=EXACT)


def test_exp_is_the_matrix_exponential():
    from scipy.linalg import expm

    for xi in twists(1, 5):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = se3.hat(xi[3:]), xi[:3]
        np.testing.assert_allclose(se3.exp(xi), expm(generator), atol=EXACT)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, -1, 0), (0.6, 0, -0.8), (-0.48, 0.6, 0.64)])
def test_half_a_turn_has_a_logarithm(axis):
    T = se3.exp(np.array([0.1, 0.2, 0.3, *(np.pi * np.array(axis))]))
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-7)


def test_inverse_and_adjoint():
    T, xi = se3.exp(twists(2)), twists(3)
    np.testing.assert_allclose(T @ se3.inverse(T), np.broadcast_to(np.eye(4), T.shape), atol=EXACT)
    carried = (se3.adjoint(T) @ xi[:, :, None])[..., 0]
    np.testing.assert_allclose(T @ se3.exp(xi) @ se3.inverse(T), se3.exp(carried), atol=1e-8)


def test_products_stay_rigid_when_normalized():
    T, step = np.eye(4), se3.exp(np.array([0.1, 0, 0, 0.3, 0.2, 0.1]))
    for _ in range(1000):
        T = se3.normalized(T @ step)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=EXACT)
