"""Slow float64 NumPy twins of the method (Eq. 3-19) and of the kernels, written from the paper and
for reading only.

A twin has the name of the kernel that it mirrors; the kernels' scratch and launch arguments have no
place here. A map is a dict from voxel index to `Voxel`; positions are in voxel units unless a
comment says metres.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from scipy.interpolate import RegularGridInterpolator

CELLS = 4  # support and averaging cells per voxel edge
LEAST_SHARE = 1e-3  # of normals that count
UNKNOWN = 1e9  # signed distance where no voxel reaches
CORNERS = np.array(list(product((0, 1), repeat=3)))
# corners around each face
FACE_CYCLES = ((0, 1, 3, 2), (4, 5, 7, 6), (0, 1, 5, 4), (2, 3, 7, 6), (0, 2, 6, 4), (1, 3, 7, 5))


# ---- Kernel and position encoding: Eq. 9-15 ----


def matern72(distance, length_scale):
    """Eq. 13 with sigma = 1."""
    s = np.sqrt(7) * distance / length_scale
    return (1 + s + 2 / 5 * s**2 + s**3 / 15) * np.exp(-s)


def kernel_matrix(a, b, length_scale):
    """k(a, b) for every pair of rows."""
    return matern72(np.linalg.norm(a[:, None] - b[None], axis=2), length_scale)


@dataclass(frozen=True)
class Encoder:
    """f_posi by Nystrom: eigenpairs of the anchors' kernel matrix, each sign such that the largest
    entry is positive.
    """

    rank: int = 20
    anchors: int = 256
    length_scale: float = 0.4753
    seed: int = 0

    @cached_property
    def points(self):
        return np.random.default_rng(self.seed).uniform(-0.5, 0.5, (self.anchors, 3))

    @cached_property
    def eigenpairs(self):
        values, vectors = np.linalg.eigh(kernel_matrix(self.points, self.points, self.length_scale))
        top = np.argsort(values)[::-1][: self.rank]
        vectors = vectors[:, top]
        for i in range(self.rank):
            if vectors[np.abs(vectors[:, i]).argmax(), i] < 0:
                vectors[:, i] *= -1
        return values[top], vectors

    def __call__(self, t):
        """Eq. 10 and 11: diag(sqrt(mu)) k(t, anchors) U with mu = 1 / lambda."""
        values, vectors = self.eigenpairs
        return kernel_matrix(t, self.points, self.length_scale) @ vectors * np.sqrt(1 / values)

    def gradient(self, t, h=1e-5):
        """Eq. 14 by central differences, good to about 1e-9: (N, 3, l)."""
        return np.stack([(self(t + h * e) - self(t - h * e)) / (2 * h) for e in np.eye(3)], axis=1)


@dataclass(frozen=True)
class Interpolated:
    """f_posi as decoding reads it: trilinear between nodes^3 values, the cube's faces included."""

    encoder: Encoder
    nodes: int

    @property
    def rank(self):
        return self.encoder.rank

    @cached_property
    def lattice(self):
        axis = np.linspace(-0.5, 0.5, self.nodes)
        t = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
        values = np.stack([self.encoder(plane.reshape(-1, 3)) for plane in t])
        return RegularGridInterpolator([axis] * 3, values.reshape(*t.shape[:3], -1))

    def __call__(self, t):
        return self.lattice(np.clip(t, -0.5, 0.5))


def interpolate_positions(encoder, t):
    return encoder(t)


def encode_positions(encoder, t):
    return encoder(t)


def encode_gradients(encoder, t):
    return encoder.gradient(t)


# ---- Regression: Eq. 3, 6, 16-18 ----


def gpr(X, Y, X_new, noise, length_scale):
    """Eq. 3: the exact Gaussian process."""
    K = kernel_matrix(X, X, length_scale) + noise * np.eye(len(X))
    return kernel_matrix(X, X_new, length_scale).T @ np.linalg.solve(K, Y)


def regress_dual(P, Y, noise):
    """Eq. 6, an n x n solve."""
    return P.T @ np.linalg.solve(P @ P.T + noise * np.eye(len(P)), Y)


def regress(P, W, Y, noise):
    """Eq. 6 as an l x l solve, row i of P and Y counting W[i] times."""
    return np.linalg.solve(
        P.T @ (W[:, None] * P) + noise * np.eye(P.shape[1]), P.T @ (W[:, None] * Y)
    )


def encode_voxel(encoder, t, counts, targets, normals, noise, centered):
    """F of one voxel; with `normals` Eq. 16-17, with `centered` the mean target is taken off and
    kept as a last row.
    """
    P, W, Y = encoder(t), counts, targets
    mean = (W @ Y / W.sum())[None] if centered else np.zeros((1, Y.shape[1]))
    P, W, Y = with_slopes(encoder, t, P, W, Y - mean, normals)
    F = regress(P, W, Y, noise)
    return np.vstack([F, mean]) if centered else F


def with_slopes(encoder, t, P, W, Y, normals):
    """The rows of a regression, and those of the slopes at the same points (Eq. 16): `normals`
    (N, 3), or (N, 4) with the share of each weight that they count for; None: there are none.
    """
    if normals is None:
        return P, W, Y
    gradient = 0.5 * encoder.gradient(t)  # by voxel units, as t moves by half a voxel a voxel
    share = normals[:, 3] if normals.shape[1] == 4 else np.ones(len(normals))
    return (
        np.vstack([P, *np.moveaxis(gradient, 1, 0)]),
        np.concatenate([W, *[W * share] * 3]),
        np.vstack([Y, *normals.T[:3, :, None]]),
    )


def shared_normals(means):
    """Mean vectors (N, 3) of normals of which some are 0, as unit normals and their share (N, 4)."""
    share = np.linalg.norm(means, axis=1, keepdims=True)
    return np.hstack(
        [means / np.where(share > LEAST_SHARE, share, 1), share * (share > LEAST_SHARE)]
    )


# ---- Voxels, cells, surfels ----


@dataclass
class Voxel:
    F: np.ndarray  # (l [+ 1], c)
    w: float
    mask: np.ndarray  # (64,) support
    # F (l,) of what shows its back, and w of fronts and backs
    back: tuple[np.ndarray, float, float] | None = None


def rows_by(keys):
    """Distinct rows of an integer array -> their row numbers, sorted by key."""
    groups = defaultdict(list)
    for n, key in enumerate(map(tuple, np.asarray(keys).tolist())):
        groups[key].append(n)
    return {key: np.array(groups[key]) for key in sorted(groups)}


def touch_points(x):
    """Voxels that hold a point."""
    return set(rows_by(np.floor(x).astype(int)))


def frames_in(x, frames):
    """Voxel -> the frames, by number, that have a point in it."""
    return {key: set(frames[n].tolist()) for key, n in rows_by(np.floor(x).astype(int)).items()}


def block_of_points(x):
    """Voxel of each point."""
    return np.floor(x).astype(int)


def cell_number(cell):
    """0..63 within its voxel of lattice cells (N, 3), x slowest."""
    i, j, k = np.moveaxis(np.asarray(cell) % CELLS, -1, 0)
    return (i * CELLS + j) * CELLS + k


def bin_points(x, values, counts=None):
    """Lattice cell -> (count, mean value, mean position) of points that stand for `counts` pixels
    each, or for one.
    """
    counts = np.ones(len(x), int) if counts is None else counts
    return {
        cell: (
            counts[n].sum(),
            np.average(values[n], axis=0, weights=counts[n]),
            np.average(x[n], axis=0, weights=counts[n]),
        )
        for cell, n in rows_by(np.floor(x * CELLS).astype(int)).items()
        if counts[n].any()
    }


def surfels(x, normals, counts=None):
    """(count, mean point, unit mean normal) for every cell whose normals do not cancel."""
    for count, normal, point in bin_points(x, normals, counts).values():
        if np.linalg.norm(normal) > 0.1:
            yield count, point, normal / np.linalg.norm(normal)


def touch_surfel_samples(x, normals, offsets):
    """Voxels that hold a point or a sample beside a surfel."""
    beside = [point + a * normal for _, point, normal in surfels(x, normals) for a in offsets]
    return touch_points(x) | touch_points(np.array(beside))


def surfel_sample_frames(x, normals, offsets, frames):
    """Voxel -> the frames that have a point in it, or in a voxel whose surfels sample it; of voxels
    with samples.
    """
    seen, found = frames_in(x, frames), defaultdict(set)
    for _, point, normal in surfels(x, normals):
        own = tuple(np.floor(point).astype(int).tolist())
        for a in offsets:
            found[tuple(np.floor(point + a * normal).astype(int).tolist())] |= seen[own]
    return dict(found)


def bin_surfel_samples(x, normals, offsets, counts=None):
    """Lattice cell -> (count, mean signed distance of its centre to the planes of the surfels that
    sample it, mean normal, which only samples on the surface have).
    """
    sums = defaultdict(lambda: np.zeros(5))
    for count, point, normal in surfels(x, normals, counts):
        for a in offsets:
            cell = np.floor((point + a * normal) * CELLS).astype(int)
            distance = normal @ ((cell + 0.5) / CELLS - point)
            sums[tuple(cell.tolist())] += count * np.array([1, distance, *normal * (a == 0)])
    return {cell: (s[0], s[1:2] / s[0], s[2:] / s[0]) for cell, s in sums.items()}


def mark_cells(counts, minimum):
    """Voxel -> cells (64,) with `minimum` of the counts by lattice cell or half the mean of its
    occupied cells; 0 marks all.
    """
    in_cells = defaultdict(lambda: np.zeros(CELLS**3))
    for cell, count in counts.items():
        in_cells[tuple(c // CELLS for c in cell)][cell_number(cell)] = count
    masks = {key: (n >= minimum) | (n >= 0.5 * n[n > 0].mean()) for key, n in in_cells.items()}
    return defaultdict(lambda: np.zeros(CELLS**3, bool), masks)


def compact_cells(counts, sums):
    """(M, 1 + c) for every occupied cell in order: root of its count, mean values times that; from
    (B, 64) and (B, 64, c).
    """
    rows = [
        [np.sqrt(counts[b, cell]), *(sums[b, cell] / np.sqrt(counts[b, cell]))]
        for b, cell in product(*map(range, counts.shape))
        if counts[b, cell]
    ]
    return np.array(rows)


def unpack_masks(masks):
    """(N, 2) words, first cell in the highest bit -> (N, 64) bool."""
    return np.unpackbits(np.ascontiguousarray(masks).astype(">u4").view(np.uint8), axis=1).astype(
        bool
    )


# ---- Local maps of a frame, and their fusion ----


def encode_points(
    encoder, samples, targets, *, normals=None, noise, minimum, centered=False, encode=encode_voxel
):
    """Voxel -> (F, w) from single samples, for every voxel whose doubled box holds at least
    `minimum` of them.
    """
    local = {}
    for key in rows_by((np.floor(samples - 0.5).astype(int)[:, None] + CORNERS).reshape(-1, 3)):
        t = (samples - key - 0.5) / 2
        inside = np.abs(t).max(axis=1) <= 0.5
        if inside.sum() >= minimum:
            local[key] = (
                encode(
                    encoder,
                    t[inside],
                    np.ones(inside.sum()),
                    targets[inside],
                    None if normals is None else normals[inside],
                    noise,
                    centered,
                ),
                inside.sum(),
            )
    return local


def encode_cells(
    encoder,
    cells,
    *,
    derivatives=False,
    noise,
    minimum,
    margin,
    centered=False,
    encode=encode_voxel,
    frames=None,
):
    """The same from cell averages (count, mean targets, mean normals), which lie at the cell
    centres.

    `frames`: voxel -> the frames that saw it. Noise is a frame's: as many frames as saw any voxel
    whose cells count add as much of it.
    """
    lattice = np.array(list(cells))
    counts = np.array([cell[0] for cell in cells.values()], float)
    targets, slopes = (np.array([cell[i] for cell in cells.values()], float) for i in (1, 2))
    if derivatives == "some":
        slopes = shared_normals(slopes)
    local = {}
    for key, own in rows_by(lattice // CELLS).items():
        if counts[own].sum() >= minimum:
            offset = lattice - CELLS * np.array(key)
            near = ((offset >= -margin) & (offset < CELLS + margin)).all(axis=1)
            t = ((offset[near] + 0.5) / CELLS - 0.5) / 2
            beside = map(tuple, (lattice[near] // CELLS).tolist())
            seen = set().union(*(frames[voxel] for voxel in beside)) if frames else {0}
            local[key] = (
                encode(
                    encoder,
                    t,
                    counts[near],
                    targets[near],
                    slopes[near] if derivatives else None,
                    noise * len(seen),
                    centered,
                ),
                counts[near].sum(),
            )
    return local


def surface_frame(encoder, x, normals, settings, encode=encode_voxel, frames=None):
    """Local surface LIM of a frame: sample-based (Sec. IV-B.2) or derivative-based (IV-B.1) GPIS;
    or of a window, where `frames` are the numbers of the points' frames.
    """
    derivatives = {"samples": False, "derivatives": True, "both": "some"}[settings.gpis]
    beside = settings.sample_distance
    steps = [0.0] if settings.gpis == "derivatives" else [-beside, 0.0, beside]
    options = {"noise": settings.noise, "minimum": settings.min_points, "encode": encode}
    if settings.sampling == "cells":
        cells = bin_surfel_samples(x, normals, steps)
        if frames is not None:
            options["frames"] = surfel_sample_frames(x, normals, steps, frames)
        local = encode_cells(
            encoder, cells, derivatives=derivatives, margin=settings.margin, **options
        )
        counts = {cell: value[0] for cell, value in cells.items()}
    else:
        samples = np.vstack([x + a * normals for a in steps])
        targets = np.repeat(steps, len(x))[:, None]
        on_surface = np.repeat(np.equal(steps, 0), len(x))[:, None]
        slopes = np.tile(normals, (len(steps), 1)) * on_surface if derivatives else None
        slopes = shared_normals(slopes) if derivatives == "some" else slopes
        local = encode_points(encoder, samples, targets, normals=slopes, **options)
        counts = {
            cell: len(n) for cell, n in rows_by(np.floor(samples * CELLS).astype(int)).items()
        }
    masks = mark_cells(counts, settings.support_points)
    return {key: Voxel(F, w, masks[key]) for key, (F, w) in local.items()}


def property_frame(encoder, x, values, settings, encode=encode_voxel, frames=None):
    """Local property LIM of a frame (Eq. 18), or of a window as in `surface_frame`."""
    options = {
        "noise": settings.noise,
        "minimum": settings.min_points,
        "centered": settings.prior == "mean",
        "encode": encode,
    }
    cells = bin_points(x, values)
    if settings.sampling == "cells":
        seen = None if frames is None else frames_in(x, frames)
        local = encode_cells(encoder, cells, margin=settings.margin, frames=seen, **options)
    else:
        local = encode_points(encoder, x, values, **options)
    masks = mark_cells({cell: value[0] for cell, value in cells.items()}, 1)
    return {key: Voxel(F, w, masks[key]) for key, (F, w) in local.items()}


def fuse(frames):
    """Eq. 19 over local maps, one after the other."""
    fused = {}
    for frame in frames:
        for key, new in frame.items():
            old = fused.get(key, Voxel(np.zeros_like(new.F), 0.0, np.zeros_like(new.mask)))
            fused[key] = Voxel(
                (old.F * old.w + new.F * new.w) / (old.w + new.w),
                old.w + new.w,
                old.mask | new.mask,
            )
    return fused


# ---- Decoding: Eq. 7 ----


def find_neighbors(keys):
    """(B, 27) row of each neighbour of every key, -1 where there is none."""
    rows = {tuple(key): n for n, key in enumerate(np.asarray(keys).tolist())}
    steps = list(product((-1, 0, 1), repeat=3))
    return np.array(
        [[rows.get(tuple((key + step).tolist()), -1) for step in steps] for key in np.asarray(keys)]
    )


def decode(encoder, voxel, t, centered):
    """f_dec(t, F), plus the prior mean."""
    value = (encoder(t[None]) @ voxel.F[: encoder.rank])[0]
    return value + voxel.F[encoder.rank] if centered else value


def nearest_voxel(voxels, point, reach):
    """Key of the voxel with the nearest centre among those up to `reach` voxels away along every
    axis, or None.
    """
    home = np.floor(point).astype(int)
    near = [key for key in voxels if np.abs(np.array(key) - home).max() <= reach]
    return min(near, key=lambda key: np.linalg.norm(point - np.array(key) - 0.5), default=None)


def query_points(encoder, voxels, x, *, blend, centered=False, reach=0):
    """Values (N, c) and validity (N,): tent-blended over the doubled voxels that contain a point,
    or from its own voxel only.

    Elsewhere the value is that of the nearest voxel within `reach` (0: none), at the nearest point
    of its doubled box.
    """
    channels = next(iter(voxels.values())).F.shape[1]
    values, valid = np.zeros((len(x), channels)), np.zeros(len(x), bool)
    for n, point in enumerate(x):
        corner = np.floor(point - 0.5) if blend else np.floor(point)
        total, weight = np.zeros(channels), 0.0
        for key in (corner + CORNERS if blend else corner[None]).astype(int):
            voxel = voxels.get(tuple(key.tolist()))
            if voxel is not None:
                t = (point - key - 0.5) / 2
                tent = np.prod(1 - np.abs(2 * t)) if blend else 1.0
                total += tent * decode(encoder, voxel, t, centered)
                weight += tent
        if weight > 0:
            values[n], valid[n] = total / weight, True
        elif reach and (key := nearest_voxel(voxels, point, reach)):
            values[n] = decode(
                encoder,
                voxels[key],
                np.clip((point - np.array(key) - 0.5) / 2, -0.5, 0.5),
                centered,
            )
    return values, valid


def sdf_grid(encoder, voxels, corner, resolution):
    """(R, R, R) signed distance at the samples of the cube that spans the centres of the eight
    voxels around a corner.
    """
    axes = [np.arange(resolution) / resolution - 0.5] * 3
    samples = corner + np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    values, valid = query_points(encoder, voxels, samples, blend=True)
    return np.where(valid, values[:, 0], UNKNOWN).reshape([resolution] * 3)


def tent_sum(voxels, corner, resolution):
    """(R^3,) sum of the tent weights of the voxels that exist, at the same samples: 0 where none
    reaches.
    """
    u = np.stack(
        np.meshgrid(*[np.arange(resolution) / resolution] * 3, indexing="ij"), axis=-1
    ).reshape(-1, 3)
    there = (step for step in CORNERS if tuple((corner - 1 + step).tolist()) in voxels)
    return sum((np.prod(1 - np.abs(u - step), axis=1) for step in there), np.zeros(len(u)))


def corner_support(voxels, corner, closing):
    """(4, 4, 4) cells of that cube that are supported or have `closing` supported ones among their
    26 neighbours.
    """
    supported = {
        tuple((CELLS * np.array(key) + np.unravel_index(n, [CELLS] * 3)).tolist())
        for key, voxel in voxels.items()
        for n in np.flatnonzero(voxel.mask)
    }
    first = CELLS * np.array(corner) - CELLS // 2
    near = [step for step in product((-1, 0, 1), repeat=3) if any(step)]
    return np.array(
        [
            tuple((first + at).tolist()) in supported
            or sum(tuple((first + at + step).tolist()) in supported for step in near) >= closing
            for at in product(range(CELLS), repeat=3)
        ]
    ).reshape([CELLS] * 3)


# ---- Marching cubes ----


def classify_cells(field, support, resolution):
    """Case (bit per corner behind the surface, x slowest) of every cell of a field (R+1)^3; 0 where
    unknown or unsupported.
    """
    cases = np.zeros([resolution] * 3, int)
    for ijk in product(range(resolution), repeat=3):
        corners = [field[tuple(np.add(ijk, step))] for step in CORNERS]
        cell = tuple(int((i + 0.5) / resolution * CELLS) for i in ijk)
        if support[cell] and max(corners) < UNKNOWN / 2:
            cases[ijk] = sum(1 << o for o, value in enumerate(corners) if value < 0)
    return cases


def crossed_edges(cases):
    """Edges (lower sample, axis) of the cells whose ends lie on different sides, for cases (R, R,
    R).
    """
    edges = set()
    for ijk in product(*map(range, cases.shape)):
        for o, d in product(range(8), range(3)):
            upper = o | 4 >> d
            if upper != o and (cases[ijk] >> o & 1) != (cases[ijk] >> upper & 1):
                edges.add((*np.add(ijk, CORNERS[o]).tolist(), d))
    return edges


def place_vertex(field, edge, resolution, corner, voxel_size):
    """Where the field is zero on an edge, linearly [m]."""
    low = np.array(edge[:3])
    step = np.eye(3, dtype=int)[edge[3]]
    a, b = field[tuple(low)], field[tuple(low + step)]
    return (corner - 0.5 + (low + step * a / (a - b)) / resolution) * voxel_size


def emit_mesh(field, cases, resolution, corner, voxel_size, triangles_of, edge_table):
    """The vertices (V, 3), and the corners of all triangles (T, 9): those of each cell's case, on
    the cell's own edges.

    `triangles_of(case)` gives edges of a cell, three a triangle.
    """
    place = {
        edge: place_vertex(field, edge, resolution, corner, voxel_size)
        for edge in crossed_edges(cases)
    }
    corners = []
    for cell in np.argwhere(cases):
        for triangle in triangles_of(cases[tuple(cell)]):
            edges = [
                (*(cell + edge_table[e, :3]).tolist(), int(edge_table[e, 3])) for e in triangle
            ]
            corners.append(np.concatenate([place[edge] for edge in edges]))
    return np.array(list(place.values())), np.array(corners)


def face_segments(case):
    """Number of segments in which the surface of a case meets the cell's faces: half the crossings
    of the faces' borders.
    """
    return (
        sum(
            (case >> cycle[k] & 1) != (case >> cycle[(k + 1) % 4] & 1)
            for cycle in FACE_CYCLES
            for k in range(4)
        )
        // 2
    )


def sum_normals(vertices, faces):
    """(V, 3) area-weighted sums of face normals."""
    sums = np.zeros_like(vertices)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    for k in range(3):
        np.add.at(sums, faces[:, k], np.cross(b - a, c - a))
    return sums


# ---- Images ----


def clip_depth(depth, low, high):
    with np.errstate(invalid="ignore"):
        return np.where(
            np.isfinite(depth) & (depth >= np.float32(low)) & (depth <= np.float32(high)),
            depth,
            np.float32(0),
        )


def drop_flying_pixels(depth, jump, support):
    """Inverse depth (H, W), 0 where fewer than `support` of the 8 neighbours belong to the same
    surface; borders have none.
    """
    height, width = depth.shape
    inverse = np.zeros(depth.shape)
    for v, u in zip(*np.nonzero(depth), strict=True):
        close = 0
        if 0 < v < height - 1 and 0 < u < width - 1:
            patch = depth[v - 1 : v + 2, u - 1 : u + 2]
            close = int((np.abs(patch - depth[v, u]) <= np.float32(jump) * depth[v, u]).sum()) - 1
        if close >= support:
            inverse[v, u] = 1 / float(depth[v, u])
    return inverse


def slope_along(inverse, v, u, along, step, radius, jump):
    """Mean slope of 1/z along `along` (dv, du), from pairs of pixels `step` before and after those
    of a line across it through (v, u), where both belong with that pixel; and how many pairs.
    """
    along, across, at = np.array(along), np.array(along[::-1]), np.array([v, u])
    q, slopes = inverse[v, u], []
    for i in range(-radius, radius + 1):
        ahead = inverse[tuple(at + i * across + step * along)]
        behind = inverse[tuple(at + i * across - step * along)]
        if max(abs(ahead - q), abs(behind - q)) < jump * q:
            slopes.append((ahead - behind) / (2 * step))
    return (np.mean(slopes) if slopes else 0.0), len(slopes)


def inverse_depth_slope(inverse, v, u, radius, jump):
    """Slopes of 1/z by u and v and whether they are known: from pairs on opposite edges of the
    window, or, where there is none, from at least four pairs of direct neighbours.
    """
    height, width = inverse.shape
    if not (radius <= v < height - radius and radius <= u < width - radius):
        return 0.0, 0.0, False
    slopes, known = [], True
    for along in ((0, 1), (1, 0)):
        slope, pairs = slope_along(inverse, v, u, along, radius, radius, jump)
        if pairs == 0:
            slope, pairs = slope_along(inverse, v, u, along, 1, radius, jump)
            known = known and pairs >= 4
        slopes.append(slope)
    return *slopes, known


def normal_towards_camera(q, slopes, v, u, fx, fy, cx, cy, cos_max_angle):
    """Normal of the plane 1/z = a u + b v + c, which is q at (v, u); None where it is seen at too
    grazing an angle.
    """
    ray = np.array([(u - cx) / fx, (v - cy) / fy, 1])
    # plane . x = 1
    plane = np.array(
        [slopes[0] * fx, slopes[1] * fy, q - slopes[0] * (u - cx) - slopes[1] * (v - cy)]
    )
    plane /= np.linalg.norm(plane)
    return -plane if plane @ ray / np.linalg.norm(ray) >= cos_max_angle else None


def estimate_normals(inverse, fx, fy, cx, cy, radius, jump, cos_max_angle):
    """(H, W, 3) normals of the planes 1/z = a u + b v + c, towards the camera; quads of pixels on
    one surface share slopes.
    """
    height, width = inverse.shape
    normals = np.zeros((height, width, 3))
    for top, left in product(range(0, height, 2), range(0, width, 2)):
        fitted_at, known = 0, False
        for v, u in product(range(top, min(top + 2, height)), range(left, min(left + 2, width))):
            q = inverse[v, u]
            if q == 0:
                continue
            if not known or abs(q - fitted_at) > 0.5 * jump * q:
                slope_u, slope_v, known = inverse_depth_slope(inverse, v, u, radius, jump)
                fitted_at = q
            if known:
                normal = normal_towards_camera(
                    q, (slope_u, slope_v), v, u, fx, fy, cx, cy, cos_max_angle
                )
                if normal is not None:
                    normals[v, u] = normal
    return normals


def transform(points, T):
    return points @ T[:3, :3].T + T[:3, 3]


def join_parts(faces, count):
    """(count,) the first vertex of the connected part of every vertex."""
    part = list(range(count))
    for _ in range(count):
        before = part.copy()
        for face in faces:
            lowest = min(part[v] for v in face)
            for v in face:
                part[v] = lowest
        if part == before:
            return np.array(part)
