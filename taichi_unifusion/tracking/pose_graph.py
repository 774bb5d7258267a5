"""Pose graph: Gauss-Newton on SE(3) with robust loop edges (Grisetti et al. 2010; Yang et al.
2020).

Needs no library besides SciPy's sparse matrices. Open3D's optimiser is the test's oracle.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from .registration import Registration

ITERATIONS = 60
CONVERGED = 1e-6  # [m, rad] largest change of a pose
LOOP_SCALE = 100.0  # squared Mahalanobis distance at which a loop edge has a quarter of its weight
# that scale starts at the largest squared distance and is divided by this from step to step
ANNEALING = 2.0
ANCHOR = 1e12  # information that holds the first pose
CONTRADICTION = 20.0  # squared Mahalanobis distance that one in 400 right edges exceeds
# [m, rad] smallest standard deviations of an alignment: calibration is no better
FLOOR = np.array([0.003] * 3 + [np.radians(0.15)] * 3)
BLIND = 1e-6  # added to the information, so that its inverse exists where a direction is open


@dataclass(frozen=True, eq=False)
class Edge:
    """A measured pose of node b in node a."""

    a: int
    b: int
    T_a_b: NDArray[np.float64]  # (4, 4)
    information: NDArray[np.float64]  # (6, 6) of a twist on the right of T_a_b
    robust: bool = False  # may be an outlier
    loop: bool = False  # joins keyframes that are not neighbours in time

    @classmethod
    def of(
        cls, a: int, b: int, found: Registration, *, robust: bool = False, loop: bool = False
    ) -> Edge:
        """Node b aligned to node a."""
        # the registration's information is of a twist on the left
        on_right = se3.adjoint(found.T_target_source)
        return cls(
            a,
            b,
            found.T_target_source,
            with_floor(on_right.T @ found.information @ on_right),
            robust,
            loop,
        )

    def contradicts(self, T_world_node: Sequence[NDArray]) -> bool:
        """Whether the present poses do not fit this edge."""
        e = se3.log(
            se3.inverse(self.T_a_b) @ se3.inverse(T_world_node[self.a]) @ T_world_node[self.b]
        )
        return bool(e @ self.information @ e > CONTRADICTION)


@dataclass(frozen=True, eq=False)
class Prior:
    """A measured pose of a node."""

    node: int
    T_world_node: NDArray[np.float64]
    information: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class OptimizedGraph:
    """Poses of all nodes, and the weights that the robust edges ended with."""

    T_world_node: NDArray[np.float64]  # (N, 4, 4)
    weights: NDArray[np.float64]  # (E,) 1 for edges that are not robust
    iterations: int


def optimize(
    T_world_node: Sequence[NDArray], edges: Sequence[Edge], priors: Sequence[Prior] = ()
) -> OptimizedGraph:
    """Poses that fit all edges and priors; without priors the first pose stays as it is.

    Robust edges have Geman-McClure's weight. Its scale begins so wide that all of them count and
    shrinks: drift is corrected before an edge that contradicts the others loses its weight.
    """
    T = np.array(T_world_node, np.float64).reshape(-1, 4, 4)
    stacked = _stack(edges)
    scale, weights, iterations = np.inf, np.ones(len(edges)), 0
    while iterations < ITERATIONS:
        iterations += 1
        residuals = se3.log(se3.inverse(stacked.T_a_b) @ se3.inverse(T[stacked.a]) @ T[stacked.b])
        squared = np.einsum("ei,eij,ej->e", residuals, stacked.information, residuals)
        scale = max(LOOP_SCALE, min(scale / ANNEALING, squared[stacked.robust].max(initial=0.0)))
        weights = np.where(stacked.robust, 1 / (1 + squared / scale) ** 2, 1.0)
        twists = _solve(T, stacked, residuals, weights, priors)
        T = se3.normalized(T @ se3.exp(twists))
        if np.abs(twists).max(initial=0.0) < CONVERGED and scale == LOOP_SCALE:
            break
    return OptimizedGraph(T, weights, iterations)


@dataclass(frozen=True, eq=False)
class _Edges:
    """All edges as arrays."""

    a: NDArray[np.int64]
    b: NDArray[np.int64]
    T_a_b: NDArray[np.float64]  # (E, 4, 4)
    information: NDArray[np.float64]  # (E, 6, 6)
    robust: NDArray[np.bool_]


def _stack(edges: Sequence[Edge]) -> _Edges:
    return _Edges(
        np.array([edge.a for edge in edges], int),
        np.array([edge.b for edge in edges], int),
        np.array([edge.T_a_b for edge in edges], np.float64).reshape(-1, 4, 4),
        np.array([edge.information for edge in edges], np.float64).reshape(-1, 6, 6),
        np.array([edge.robust for edge in edges], bool),
    )


def _solve(
    T: NDArray, edges: _Edges, residuals: NDArray, weights: NDArray, priors: Sequence[Prior]
) -> NDArray[np.float64]:
    """One step: (N, 6) twists on the right of the poses."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.linalg import spsolve

    information = weights[:, None, None] * edges.information
    # of the residual by a's twist; by b's it is the identity
    J = -se3.adjoint(se3.inverse(T[edges.b]) @ T[edges.a])
    J_information = J.swapaxes(1, 2) @ information
    b = np.zeros((len(T), 6))
    np.add.at(b, edges.a, (J_information @ residuals[:, :, None])[..., 0])
    np.add.at(b, edges.b, (information @ residuals[:, :, None])[..., 0])
    nodes = np.array([prior.node for prior in priors] or [0])  # without priors the first pose stays
    anchors = np.array([prior.information for prior in priors] or [ANCHOR * np.eye(6)])
    if priors:
        off = se3.log(se3.inverse(np.array([prior.T_world_node for prior in priors])) @ T[nodes])
        np.add.at(b, nodes, (anchors @ off[:, :, None])[..., 0])
    values = np.concatenate(
        [J_information @ J, J_information, information @ J, information, anchors]
    )
    rows = np.concatenate([edges.a, edges.a, edges.b, edges.b, nodes])[:, None, None]
    columns = np.concatenate([edges.a, edges.b, edges.a, edges.b, nodes])[:, None, None]
    at = [
        np.broadcast_to(6 * rows + np.arange(6)[:, None], values.shape).ravel(),
        np.broadcast_to(6 * columns + np.arange(6), values.shape).ravel(),
    ]
    H = coo_matrix((values.ravel(), tuple(at)), shape=(6 * len(T), 6 * len(T))).tocsc()
    return -spsolve(H, b.ravel()).reshape(-1, 6)


def with_floor(information: NDArray) -> NDArray[np.float64]:
    """Information of an alignment, never better than `FLOOR`."""
    covariance = np.linalg.inv(information + BLIND * np.eye(6)) + np.diag(FLOOR**2)
    return np.asarray(np.linalg.inv(covariance), np.float64)
