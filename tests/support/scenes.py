"""Point clouds of scenes whose distance field is known: points, exact unit normals into free space,
a few attributes.
"""

from __future__ import annotations

from itertools import product

import numpy as np

from taichi_unifusion import PointCloud


def cloud_of(points, normals, **attributes) -> PointCloud:
    """A point cloud of float32 copies."""
    as_floats = {
        name: np.ascontiguousarray(values, np.float32) for name, values in attributes.items()
    }
    return PointCloud(
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(normals, np.float32),
        as_floats,
    )


def sphere(radius: float, spacing: float, center=(0, 0, 0)) -> PointCloud:
    """A sphere seen from outside, points evenly about `spacing` metres apart (a Fibonacci lattice)."""
    count = int(4 * np.pi * radius**2 / spacing**2)
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    normals = np.stack(
        [np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], axis=1
    )
    return cloud_of(radius * normals + center, normals)


def rectangle(center, u, v, spacing: float) -> PointCloud:
    """A flat rectangle with half edges u and v [m] and normal u x v."""
    center, u, v = (np.asarray(a, float) for a in (center, u, v))
    steps = [
        (np.arange(n) + 0.5) / n * 2 - 1
        for n in (int(2 * np.linalg.norm(e) / spacing) for e in (u, v))
    ]
    a, b = (g.reshape(-1, 1) for g in np.meshgrid(*steps, indexing="ij"))
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    return cloud_of(center + a * u + b * v, np.tile(normal, (a.size, 1)))


def box(half: float, spacing: float, center=(0, 0, 0)) -> PointCloud:
    """A cube with half edge `half` seen from outside."""
    faces = []
    for axis, side in product(range(3), (-1, 1)):
        normal, u, v = (np.roll(np.eye(3)[0], axis + k) * half for k in range(3))
        faces.append(rectangle(np.array(center) + side * normal, u, v * side, spacing))
    return joined(*faces)


def rough(seed: int, count: int = 1500, voxel_size: float = 0.05) -> PointCloud:
    """Points scattered about a tilted plane some voxels wide, unit normals up to 30 degrees off,
    random attributes.
    """
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-2.2, 2.2, (count, 2))
    points = np.column_stack([xy, xy @ (0.3, -0.2) + rng.normal(0, 0.2, count) - 0.4]) * voxel_size
    normals = np.array([-0.3, 0.2, 1]) + rng.normal(0, 0.2, (count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return cloud_of(
        points,
        normals,
        one=rng.normal(size=(count, 1)),
        rgb=rng.uniform(size=(count, 3)),
        five=rng.normal(3, 2, size=(count, 5)),
    )


def joined(*clouds: PointCloud) -> PointCloud:
    """All points in the order given; attributes that all clouds have."""
    names = set.intersection(*(set(cloud.attributes) for cloud in clouds))
    return cloud_of(
        np.vstack([cloud.points for cloud in clouds]),
        np.vstack([cloud.normals for cloud in clouds]),
        **{name: np.vstack([cloud.attributes[name] for cloud in clouds]) for name in names},
    )


def taken(cloud: PointCloud, rows) -> PointCloud:
    """Some rows of a cloud, by slice, mask or numbers."""
    return cloud_of(
        cloud.points[rows],
        cloud.normals[rows],
        **{name: a[rows] for name, a in cloud.attributes.items()},
    )


def moved(cloud: PointCloud, offset) -> PointCloud:
    """The cloud shifted by `offset` metres, in float64 until the end."""
    return cloud_of(cloud.points.astype(float) + offset, cloud.normals, **cloud.attributes)


def sphere_distance(points, radius: float, center=(0, 0, 0)):
    return np.linalg.norm(points - np.asarray(center), axis=1) - radius


def box_distance(points, half: float, center=(0, 0, 0)):
    q = np.abs(points - np.asarray(center)) - half
    return np.linalg.norm(np.maximum(q, 0), axis=1) + np.minimum(q.max(axis=1), 0)
