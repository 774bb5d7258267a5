"""Meshes whose geometry is known by hand, and cameras that look at them."""

from __future__ import annotations

import numpy as np

from taichi_unifusion import Mesh, PinholeCamera

CAMERA = PinholeCamera(64, 48, 40.0, 40.0, 31.5, 23.5)  # sees 1.6 x 1.2 m at 1 m


def mesh_of(vertices, faces, color=None) -> Mesh:
    mesh = Mesh(
        np.array(vertices, np.float32).reshape(-1, 3), np.array(faces, np.int32).reshape(-1, 3)
    )
    return (
        mesh
        if color is None
        else mesh.with_attribute("color", np.tile(np.float32(color), (len(mesh.vertices), 1)))
    )


def scattered(**channels: int) -> Mesh:
    """16 triangles without a common vertex, two vertices without any, random unit normals, and so
    many random channels of each attribute.
    """
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Mesh(
        rng.normal(size=(50, 3)).astype(np.float32),
        rng.permutation(50)[:48].reshape(16, 3).astype(np.int32),
        normals.astype(np.float32),
        {name: rng.random((50, c)).astype(np.float32) for name, c in channels.items()},
    )


def rectangle(low, high, z: float, color=None, steps: int = 1) -> Mesh:
    """2 steps^2 triangles that fill low..high, (x, y) each, at height z."""
    x, y = (np.linspace(a, b, steps + 1) for a, b in zip(low, high, strict=True))
    vertices = np.stack(
        [
            *(g.ravel() for g in np.meshgrid(x, y, indexing="ij")),
            np.full((steps + 1) ** 2, float(z)),
        ],
        axis=1,
    )
    index = np.arange((steps + 1) ** 2).reshape(steps + 1, steps + 1)
    p, q, r, t = (
        index[:-1, :-1].ravel(),
        index[1:, :-1].ravel(),
        index[1:, 1:].ravel(),
        index[:-1, 1:].ravel(),
    )
    return mesh_of(
        vertices, np.concatenate([np.stack([p, q, r], axis=1), np.stack([p, r, t], axis=1)]), color
    )


def parallelogram(corner, a, b, steps: int = 12) -> Mesh:
    """2 steps^2 triangles of the parallelogram with edges a and b, facing a x b."""
    flat = rectangle((0, 0), (1, 1), 0, steps=steps)
    s, t = flat.vertices[:, :1], flat.vertices[:, 1:2]
    return mesh_of(np.array(corner) + s * np.array(a, float) + t * np.array(b, float), flat.faces)


def box(low, high) -> Mesh:
    """The twelve triangles of an axis-aligned box."""
    corners = [[(low, high)[k >> d & 1][d] for d in range(3)] for k in range(8)]
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    return mesh_of(corners, [f for a, b, c, d in quads for f in ((a, b, c), (a, c, d))])


def joined(*meshes: Mesh) -> Mesh:
    """All triangles; attributes that all have."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    whole = mesh_of(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)]),
    )
    for name in set.intersection(*(set(mesh.attributes) for mesh in meshes)):
        whole = whole.with_attribute(
            name, np.concatenate([mesh.attributes[name] for mesh in meshes])
        )
    return whole


def moved(mesh: Mesh, T) -> Mesh:
    """The mesh under the 4x4 transform T."""
    T = np.asarray(T, float)
    return mesh_of(mesh.vertices @ T[:3, :3].T + T[:3, 3], mesh.faces)


def random_soup(count: int, seed: int, size: float = 0.5, slivers: bool = True) -> Mesh:
    """Triangles scattered over a cube of 2 m, up to about `size` metres; every seventh of them may
    have no area.
    """
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1, 1, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3)) * rng.uniform(
        0.01, 1, (count, 1, 1)
    )
    if slivers:
        corners[::7, 2] = 0.5 * (corners[::7, 0] + corners[::7, 1])
    return mesh_of(corners, np.arange(3 * count))


def random_rigid(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = q * np.sign(np.linalg.det(q)), rng.uniform(-2, 2, 3)
    return T


def at(x: float, y: float, z: float) -> np.ndarray:
    """T_world_camera of a camera at (x, y, z) that looks along +z, x to the right."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def open3d_scene(mesh: Mesh):
    """The mesh as Open3D's ray casting takes it."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor(np.ascontiguousarray(mesh.vertices)),
        o3d.core.Tensor(mesh.faces.astype(np.uint32)),
    )
    return scene
