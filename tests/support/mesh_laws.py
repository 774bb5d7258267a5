"""What every extracted mesh must be, and its area and volume."""

from __future__ import annotations

import numpy as np


def assert_welded(vertices, faces) -> None:
    """No unreferenced vertices, none twice, no face with two equal corners."""
    assert faces.min() == 0 and len(np.unique(faces)) == len(vertices) == faces.max() + 1
    assert (
        (faces[:, 0] != faces[:, 1]).all()
        and (faces[:, 1] != faces[:, 2]).all()
        and (faces[:, 2] != faces[:, 0]).all()
    )


def assert_closed(vertices, faces) -> None:
    """Every edge is used exactly once in either direction: a closed, oriented manifold."""
    assert_welded(vertices, faces)
    directed = np.vstack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = set(map(tuple, directed.tolist()))
    assert len(edges) == len(directed) and all((b, a) in edges for a, b in edges)


def area_and_volume(vertices, faces) -> tuple[float, float]:
    a, b, c = (vertices[faces[:, k]].astype(float) for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2, np.einsum(
        "ni,ni->", a, np.cross(b, c)
    ) / 6


def triangles(mesh) -> np.ndarray:
    """The corners of every face (F, 9), each from its lowest corner on, in order."""
    corners = mesh.vertices[mesh.faces]  # (F, 3, 3)
    lowest = np.lexsort(np.moveaxis(corners, 2, 0)[::-1], axis=-1)[:, :1]
    turned = np.take_along_axis(corners, ((lowest + np.arange(3)) % 3)[..., None], axis=1)
    rows = turned.reshape(-1, 9)
    return rows[np.lexsort(rows.T[::-1])]
