"""Depth that is wrong by its place in the image, found from views that overlap.

A reading z at a pixel stands for a depth z (1 + b(u, v)), where b is a polynomial of second degree
without a constant, which no alignment could tell. Two keyframes see one surface at different pixels; what
is left of their distance after the alignment says something of b. One linear equation a pixel, six unknown
for the pose of every pair, which are eliminated, and five for all of them.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..types import Frame, PinholeCamera
from .pyramid import SurfelImage, SurfelPyramid
from .registration import GATES, MAX_ANGLE

TERMS = 5
LEVEL = 1  # of the pyramid that is compared
STEP = 2  # [px] there, between pixels that are compared
NOISE = 0.0015  # [1/m] standard deviation of a reading at 1 m; grows with the distance squared
LEAST_PAIRS = 60  # before anything is believed
LEAST_AMOUNT = 0.004  # share of the depth, root mean square over the image, worth correcting
SAME = 0.4  # share of it by which halves of the pairs may differ
WEIGHT = np.eye(TERMS) / 0.01**2  # of coefficients: by their deviation before anything is seen
MOST_PAIRS = 150  # that are looked at
INDEPENDENT = 200.0  # measurements that one pair counts as
GRID = 12  # points along an image's side, by which amounts are judged


def terms(camera: PinholeCamera, u: NDArray, v: NDArray) -> NDArray[np.float64]:
    """The terms (..., TERMS) of b at pixels; x is in [-1, 1] across the image, y has its scale."""
    half = camera.width / 2
    x = (np.asarray(u, np.float64) - (camera.width - 1) / 2) / half
    y = (np.asarray(v, np.float64) - (camera.height - 1) / 2) / half
    x, y = np.broadcast_arrays(x, y)
    flat = (camera.height / camera.width) ** 2 / 3
    return np.stack([x, y, x * x - 1 / 3, x * y, y * y - flat], axis=-1)


def factors(camera: PinholeCamera, bias: NDArray[np.float64]) -> NDArray[np.float32]:
    """(H, W) by which readings of a camera are multiplied."""
    v, u = np.mgrid[: camera.height, : camera.width]
    return (1 + terms(camera, u, v) @ bias).astype(np.float32)


def corrected(frame: Frame, bias: NDArray[np.float64]) -> Frame:
    """A frame as it should have been read."""
    return replace(frame, depth=frame.depth * factors(frame.camera, bias))


def amount(camera: PinholeCamera, bias: NDArray[np.float64]) -> float:
    """Root mean square of b over the image, without its mean, which is the unknown scale."""
    middles = (np.arange(GRID) + 0.5) / GRID
    u, v = middles * camera.width - 0.5, middles[:, None] * camera.height - 0.5
    return float(np.std(terms(camera, u, v) @ bias))


@dataclass
class DepthBias:
    """What pairs of keyframes say of b, and what is corrected already."""

    camera: PinholeCamera | None = None
    known: NDArray[np.float64] = field(default_factory=lambda: np.zeros(TERMS))  # corrected
    pairs: int = 0
    H: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, TERMS, TERMS)))  # of halves
    b: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, TERMS)))

    def add(self, source: SurfelPyramid, target: SurfelPyramid, T_target_source: NDArray) -> None:
        """Take in a pair that was aligned."""
        level = min(LEVEL, len(source.levels) - 1, len(target.levels) - 1)
        if (
            found := _equations(source.levels[level], target.levels[level], T_target_source)
        ) is None:
            return
        self.camera = source.levels[level].camera
        half = self.pairs % 2
        self.H[half] += found[0]
        self.b[half] += found[1]
        self.pairs += 1

    @property
    def looking(self) -> bool:
        """Whether pairs may still say something new."""
        return self.pairs < MOST_PAIRS and not self.known.any()

    @property
    def likeliest(self) -> NDArray[np.float64]:
        """What is still to be corrected, by all pairs."""
        return np.linalg.solve(self.H.sum(axis=0) + WEIGHT, self.b.sum(axis=0))

    def largest(self, bias: NDArray[np.float64]) -> float:
        """The largest share of itself by which depth is corrected, beside a common scale."""
        assert self.camera is not None
        factor = factors(self.camera, bias)
        return float(np.abs(factor / factor.mean() - 1).max())

    def surely(self) -> NDArray[np.float64] | None:
        """What is to be corrected; None where that is little, or not sure."""
        if self.known.any() or self.pairs < LEAST_PAIRS or self.camera is None:
            return None
        halves = [np.linalg.solve(H + WEIGHT, b) for H, b in zip(self.H, self.b, strict=True)]
        whole = self.likeliest
        size = amount(self.camera, whole)
        apart = amount(self.camera, halves[0] - halves[1])
        return whole if size > LEAST_AMOUNT and apart < SAME * size else None

    def correct(self, more: NDArray[np.float64]) -> None:
        """Note that so much more is corrected from now on; what pairs said of it is used up."""
        self.known, self.pairs = self.known + more, 0
        self.H, self.b = np.zeros_like(self.H), np.zeros_like(self.b)

    def corrected(self, frame: Frame) -> Frame:
        """A frame as it should have been read."""
        return corrected(frame, self.known) if self.known.any() else frame


def _equations(
    source: SurfelImage, target: SurfelImage, T_target_source: NDArray
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """The normal equations of b from one pair, its pose eliminated."""
    v, u, z, n_source = _surfels(source, STEP)
    R, t = T_target_source[:3, :3], T_target_source[:3, 3]
    arm = (source.camera.rays(u, v) * z[:, None]) @ R.T  # moves with the reading
    points = arm + t
    at, seen = _pixels(target.camera, points)
    v_all, u_all, z_all, n_all = _surfels(target, 1)
    table = np.full((target.camera.height, target.camera.width), -1)
    table[v_all, u_all] = np.arange(len(z_all))
    met = np.full(len(points), -1)
    met[seen] = table[at[seen, 1], at[seen, 0]]
    rows, other = np.nonzero(met >= 0)[0], met[met >= 0]
    if len(rows) < 50:
        return None
    there = target.camera.rays(u_all[other], v_all[other]) * z_all[other, None]
    n, points, arm = n_all[other], points[rows], arm[rows]
    r = np.einsum("ij,ij->i", n, points - there)
    near = np.abs(r) < 2 * GATES[LEVEL]
    near &= np.einsum("ij,ij->i", n, n_source[rows] @ R.T) > np.cos(np.radians(MAX_ANGLE))
    phi_source = terms(source.camera, u[rows], v[rows])
    phi_target = terms(target.camera, u_all[other], v_all[other])
    J = np.hstack(
        [
            n,
            np.cross(points, n),
            np.einsum("ij,ij->i", n, arm)[:, None] * phi_source
            - np.einsum("ij,ij->i", n, there)[:, None] * phi_target,
        ]
    )[near]
    r = r[near]
    if len(r) < 50:
        return None
    sigma = NOISE * np.maximum(z[rows][near], 0.5) ** 2
    spread = max(1.0, 1.5 * float(np.median(np.abs(r / sigma))))
    weight = 1 / sigma**2 / (1 + (r / (2 * spread * sigma)) ** 2)
    weight *= INDEPENDENT / len(r)
    H, g = (J * weight[:, None]).T @ J, (J * weight[:, None]).T @ r
    damped = H[:6, :6] + 1e-9 * np.trace(H[:6, :6]) * np.eye(6)
    pose = np.linalg.solve(damped, np.column_stack([H[:6, 6:], g[:6]]))
    return H[6:, 6:] - H[6:, :6] @ pose[:, :-1], -(g[6:] - H[6:, :6] @ pose[:, -1])


def _surfels(
    image: SurfelImage, step: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Rows, columns, depths and normals of the surfels that are not left out."""
    from ..kernels import registration as kernels

    values = image.read(step, kernels.NORMAL + 3)
    v, u = np.nonzero(values[..., kernels.DEPTH] > 0)
    chosen = values[v, u].astype(np.float64)
    return (
        v * step,
        u * step,
        chosen[:, kernels.DEPTH],
        chosen[:, kernels.NORMAL : kernels.NORMAL + 3],
    )


def _pixels(
    camera: PinholeCamera, points: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The pixels (N, 2) u, v that points in front of a camera fall in, and which are in its image."""
    z = np.maximum(points[:, 2], 1e-3)
    K = camera.matrix
    uv = points[:, :2] / z[:, None] * [K[0, 0], K[1, 1]] + [K[0, 2], K[1, 2]]
    inside = (uv > -0.5) & (uv < np.array(camera.size) - 0.5)
    at = np.rint(np.where(inside, uv, 0)).astype(np.int64)
    at = np.clip(at, 0, np.array(camera.size) - 1)
    return at, (points[:, 2] > 0.05) & inside.all(axis=1)
