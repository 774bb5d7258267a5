"""Slow float64 twins of the votes of frames: evidence for the surface in every cell, and against
it.

A map is a dict from voxel index to `reference.Voxel`, evidence one from voxel index to (64,) votes.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from reference import CELLS, CORNERS, cell_number
from reference_sides import part_sides

# (64, 3) of cells, voxels from the voxel's corner
CENTERS = (np.array(list(product(range(CELLS), repeat=3))) + 0.5) / CELLS


def read_behind(p, depth, camera):
    """How far behind p [m, camera] the reading of its pixel lies, None where there is no reading."""
    if p[2] <= 0:
        return None
    u, v = (
        int(np.floor(x + 0.5))
        for x in (camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy)
    )
    if not (0 <= u < camera.width and 0 <= v < camera.height) or depth[v, u] <= 0:
        return None
    return float(depth[v, u]) - p[2]


def seen_beside(p, slack, depth, camera):
    """Whether any of the 3x3 pixels around that of p reads its depth; never on the border of the
    image.
    """
    u, v = (
        int(np.floor(x + 0.5))
        for x in (camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy)
    )
    if not (1 <= u < camera.width - 1 and 1 <= v < camera.height - 1):
        return False
    readings = depth[v - 1 : v + 2, u - 1 : u + 2]
    return bool(((readings > 0) & (np.abs(readings - p[2]) < slack)).any())


def vote_of_free_cell(p, voxel_size, depth, camera):
    """-1 where a ray passes a cell in which nothing was seen."""
    behind = read_behind(p, depth, camera)
    return -1 if behind is not None and behind > 0.5 * voxel_size + 0.003 * p[2] ** 2 else 0


def vote_of_surface(p, normal, voxel_size, depth, camera):
    """1 where the reading lies on a point of the surface [m, camera], -1 where it lies behind, and
    not at a grazing angle.
    """
    behind = read_behind(p, depth, camera)
    cosine = max(abs(normal @ p) / np.linalg.norm(p), 0.02)
    slack = 0.5 * voxel_size + 0.003 * p[2] ** 2 + p[2] / camera.fx * np.tan(np.arccos(cosine))
    if behind is None:
        return int(p[2] > 0 and seen_beside(p, slack, depth, camera))
    if behind > slack:
        return -1 if cosine > 0.1 else 0
    return 1 if behind > -slack else 0


def vote_cells(encoder, voxels, voxel_size, depths, camera, poses):
    """Voxel -> (64,) votes of some views, taken from poses T_camera_world: the sum of what each of
    them votes.
    """
    views = [
        votes_of_view(encoder, voxels, voxel_size, depth, camera, T)
        for depth, T in zip(depths, poses, strict=True)
    ]
    return {key: sum(view[key] for view in views) for key in voxels}


def votes_of_view(encoder, voxels, voxel_size, depth, camera, T_camera_world):
    """Voxel -> (64,) votes of one view."""
    t = (CENTERS - 0.5) / 2
    f, slopes = encoder(t), 0.5 * encoder.gradient(t)  # t moves by half a voxel a voxel
    R, origin = T_camera_world[:3, :3], T_camera_world[:3, 3]
    votes = {}
    for key, voxel in voxels.items():
        votes[key] = np.zeros(CELLS**3, int)
        for cell, center in enumerate(CENTERS):
            if not voxel.mask[cell]:
                p = R @ ((key + center) * voxel_size) + origin
                votes[key][cell] = vote_of_free_cell(p, voxel_size, depth, camera)
                continue
            near = nearest_surface(f[cell], slopes[cell], fields_of(encoder, voxel))
            if near is not None:
                distance, normal = near
                p = R @ ((key + center - distance * normal) * voxel_size) + origin
                votes[key][cell] = vote_of_surface(p, R @ normal, voxel_size, depth, camera)
    return votes


def fields_of(encoder, voxel):
    """The latents (l,) of a voxel's fields: one, or one a side."""
    if voxel.back is None:
        return [voxel.F[:, 0]]
    two, front = part_sides(encoder, voxel.F[:, 0], *voxel.back)
    return [front, voxel.back[0]] if two else [front]


def nearest_surface(f, slopes, fields):
    """Signed distance from a cell's centre to the nearest surface of some fields, and the normal
    there; None where there is none.
    """
    found = []
    for F in fields:
        slope = slopes @ F
        steep = np.linalg.norm(slope)
        distance = f @ F / max(steep, 1e-6)
        if steep > 0.2 and abs(distance) < 0.45:
            found.append((distance, slope / steep))
    return min(found, key=lambda each: abs(each[0]), default=None)


def vote_support(support):
    """Voxel -> (64,) votes of a frame that has no rays: one for every cell that it supports."""
    return {key: mask.astype(int) for key, mask in support.items()}


def add_evidence(evidence, more):
    """Sums of votes, as far as a cell can hold them."""
    return np.clip(evidence.astype(int) + more, -127, 127)


def interpolate_evidence(evidence, masks, x):
    """(N,) tent-weighted mean over the eight nearest cells that have support or were seen through,
    1 where none is; x [voxels].
    """
    values = np.zeros(len(x))
    for n, point in enumerate(x * CELLS - 0.5):
        corner, total, weight = np.floor(point).astype(int), 0.0, 0.0
        for at in corner + CORNERS:
            key, cell = tuple((at // CELLS).tolist()), cell_number(at)
            if key in evidence and (masks[key][cell] or evidence[key][cell] < 0):
                tent = np.prod(1 - np.abs(point - at))
                total, weight = total + tent * evidence[key][cell], weight + tent
        values[n] = total / weight if weight > 1e-6 else 1.0
    return values
