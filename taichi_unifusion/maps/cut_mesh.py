"""Meshes cut along the zero line of a value at their vertices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry.triangles import used_vertices

SNAP = 1e-4  # of an edge: a cut this near to a vertex goes through it


def cut_mesh(
    vertices: NDArray[np.float32], faces: NDArray[np.int32], values: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.intp]]:
    """The part of a mesh where `values` (V,), linear on every triangle, are not negative, and the
    face that each of its own comes from; triangles on the border are cut.
    """
    inside = values >= 0
    a, b, c = (inside.view(np.uint8).take(faces[:, k]) for k in range(3))
    corners = a + b + c  # that stay
    if (corners == 3).all():
        return vertices, faces, np.arange(len(faces))
    crossed = np.flatnonzero((corners > 0) & (corners < 3))
    one_in = corners[crossed] == 1
    odd_in = _odd_first(faces[crossed[one_in]], inside)  # the first stays
    odd_out = _odd_first(faces[crossed[~one_in]], ~inside)  # the first goes
    first = np.concatenate([odd_in[:, 0], odd_in[:, 0], odd_out[:, 0], odd_out[:, 0]])
    other = np.concatenate([odd_in[:, 1], odd_in[:, 2], odd_out[:, 1], odd_out[:, 2]])
    low, high = np.minimum(first, other), np.maximum(first, other)
    # an edge is cut once, also between two triangles
    cut, at = np.unique(low * np.int64(len(vertices)) + high, return_inverse=True)
    a, b = cut // len(vertices), cut % len(vertices)
    share = values[a] / (values[a] - values[b])
    on_edges = vertices[a] + share[:, None] * (vertices[b] - vertices[a])
    number = np.where(
        share < SNAP, a, np.where(share > 1 - SNAP, b, len(vertices) + np.arange(len(cut)))
    )
    i, j, p, q = np.split(
        number[at.reshape(-1)], np.cumsum([len(odd_in), len(odd_in), len(odd_out)])
    )
    pieces = np.concatenate(
        [
            np.stack([odd_in[:, 0], i, j], axis=1),
            np.stack([p, odd_out[:, 1], odd_out[:, 2]], axis=1),
            np.stack([p, odd_out[:, 2], q], axis=1),
        ]
    )
    # what a cut through a corner makes of a triangle
    proper = (pieces != pieces[:, [2, 0, 1]]).all(axis=1)
    whole, out = np.flatnonzero(corners == 3), crossed[~one_in]
    source = np.concatenate([whole, np.concatenate([crossed[one_in], out, out])[proper]])
    vertices, faces = without_unused(
        np.concatenate([vertices, on_edges]).astype(np.float32, copy=False),
        np.concatenate([faces.take(whole, axis=0), pieces[proper].astype(np.int32)]),
    )
    return vertices, faces, source


def _odd_first(faces: NDArray[np.int32], odd: NDArray[np.bool_]) -> NDArray[np.int32]:
    """Faces turned, without changing their orientation, so that their one corner that is `odd`
    comes first.
    """
    first = np.argmax(odd[faces], axis=1)[:, None]
    return np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)


def without_unused(
    vertices: NDArray[np.float32], faces: NDArray[np.int32]
) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """A mesh without the vertices that no face has."""
    rows, faces = used_vertices(faces)
    return vertices.take(rows, axis=0), faces
