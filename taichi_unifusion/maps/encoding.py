"""Position encoding f_posi: the Matern-7/2 kernel on the unit cube as an l-dimensional feature
(Sec. III-B).

Computed once, in float64 NumPy, from a fixed seed. Encoder coordinates `t` lie in [-0.5, 0.5]^3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, check_range, check_types, strict

MAX_ANCHORS = 1024
# of the largest eigenvalue of the anchors' kernel matrix: what is smaller is rounding
LEAST_EIGENVALUE = 1e-13


@strict
@dataclass(frozen=True)
class EncoderSettings:
    """What defines f_posi; maps fuse and merge only where these agree."""

    rank: int = 20
    """l: number of eigenpairs kept, the length of a latent."""
    anchors: int = 256
    """Number of random anchor points of the Nystrom approximation."""
    length_scale: float = 0.4753
    """rho of the Matern-7/2 kernel, in encoder coordinates (the doubled voxel has side 1)."""
    seed: int = 0
    """Seed of the anchors."""

    def __post_init__(self) -> None:
        check_types(self)
        check_range("encoder: rank", self.rank, 1, MAX_ANCHORS)
        check_range("encoder: anchors", self.anchors, 1, MAX_ANCHORS)
        check_range("encoder: length_scale", self.length_scale, 0.01, 100)
        check_range("encoder: seed", self.seed, 0, 2**63 - 1)
        if self.rank > self.anchors:
            raise InputError(
                f"encoder: rank must lie in 1..anchors, got rank {self.rank} and {self.anchors} anchors"
            )


def matern72(distance: NDArray, length_scale: float) -> NDArray[np.float64]:
    """k(d) of Eq. 13 with sigma = 1."""
    s = np.sqrt(7.0) * np.asarray(distance, dtype=np.float64) / length_scale
    return (1 + s + 0.4 * s**2 + s**3 / 15) * np.exp(-s)


def _matern72_slope_over_distance(distance: NDArray, length_scale: float) -> NDArray[np.float64]:
    """k'(d) / d, finite at d = 0: -(7 / rho^2) (1/5 + s/5 + s^2/15) e^-s."""
    s = np.sqrt(7.0) * distance / length_scale
    return -(7.0 / length_scale**2) * (0.2 + 0.2 * s + s**2 / 15) * np.exp(-s)


@dataclass(frozen=True)
class PositionEncoding:
    """f_posi(t) = Lambda^-1/2 U^T k(t, anchors), Eq. 9-11."""

    settings: EncoderSettings

    @cached_property
    def anchors(self) -> NDArray[np.float64]:
        """(A, 3) uniform samples of the cube."""
        return np.random.default_rng(self.settings.seed).uniform(
            -0.5, 0.5, (self.settings.anchors, 3)
        )

    @cached_property
    def projection(self) -> NDArray[np.float64]:
        """(A, l): U Lambda^-1/2 of the anchors' kernel matrix, largest eigenvalues first."""
        distance = np.linalg.norm(self.anchors[:, None] - self.anchors[None], axis=2)
        values, vectors = np.linalg.eigh(matern72(distance, self.settings.length_scale))
        values, vectors = (
            values[::-1][: self.settings.rank],
            vectors[:, ::-1][:, : self.settings.rank],
        )
        if values[-1] < LEAST_EIGENVALUE * values[0]:
            raise InputError(
                f"encoder: of {self.settings.anchors} anchors with length_scale "
                f"{self.settings.length_scale:g}, fewer than {self.settings.rank} eigenpairs are more "
                "than rounding: use a smaller rank or a smaller length_scale"
            )
        largest = vectors[np.abs(vectors).argmax(axis=0), np.arange(self.settings.rank)]
        # eigenvectors of the same sign on every machine
        return vectors * np.sign(largest) / np.sqrt(values)

    def check(self) -> None:
        """Raise InputError where the settings have fewer eigenpairs than the rank asks for."""
        _ = self.projection

    def __call__(self, t: NDArray) -> NDArray[np.float64]:
        """f_posi: (N, 3) encoder coordinates -> (N, l)."""
        distance = np.linalg.norm(np.asarray(t, np.float64)[:, None] - self.anchors[None], axis=2)
        return matern72(distance, self.settings.length_scale) @ self.projection

    def gradient(self, t: NDArray) -> NDArray[np.float64]:
        """d f_posi / d t_i of Eq. 14: (N, 3) -> (N, 3, l)."""
        offset = np.asarray(t, np.float64)[:, None] - self.anchors[None]
        slope = _matern72_slope_over_distance(
            np.linalg.norm(offset, axis=2), self.settings.length_scale
        )
        return np.einsum("na,nad,al->ndl", slope, offset, self.projection)

    def nodes(self, count: int) -> NDArray[np.float64]:
        """(count^3, 3) centres of a count^3 grid of cells that fills the cube, x slowest."""
        axis = (np.arange(count) + 0.5) / count - 0.5
        return np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)

    def lattice(self, count: int) -> NDArray[np.float32]:
        """(count^3, l): f_posi on a count^3 lattice that spans the cube, faces included, x slowest.

        In float32 and a row at a time, since the first query waits for it.
        """
        scale = np.sqrt(7.0) / self.settings.length_scale
        axis = np.linspace(-0.5, 0.5, count)[:, None]
        # (count, A) each: squares of the scaled offsets from the anchors
        x, y, z = np.square(scale * (axis - self.anchors.T[:, None])).astype(np.float32)
        projection = self.projection.astype(np.float32)
        rows = []
        for i, j in product(range(count), repeat=2):
            s = np.sqrt(x[i] + y[j] + z)
            rows.append((1 + s * (1 + s * (0.4 + s / 15))) * np.exp(-s) @ projection)
        return np.concatenate(rows)

    def kernel_error(self, samples: int = 2000, seed: int = 1) -> float:
        """Mean |K - K^| over random points of the cube (Fig. 13)."""
        t = np.random.default_rng(seed).uniform(-0.5, 0.5, (samples, 3))
        exact = matern72(np.linalg.norm(t[:, None] - t[None], axis=2), self.settings.length_scale)
        features = self(t)
        return float(np.abs(exact - features @ features.T).mean())


@lru_cache(maxsize=8)
def position_encoding(settings: EncoderSettings) -> PositionEncoding:
    """The encoding for these settings, computed once a process."""
    return PositionEncoding(settings)
