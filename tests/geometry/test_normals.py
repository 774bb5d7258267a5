"""Normals of unit length, also where triangles are very small or none at all."""

from __future__ import annotations

import numpy as np
import pytest

from taichi_unifusion.geometry.triangles import fill_normals, vertex_normals
from taichi_unifusion.maps import meshing


def lengths(normals) -> np.ndarray:
    return np.linalg.norm(normals, axis=1)


def test_N_small_triangles_and_such_without_area_have_unit_normals():
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    far = np.float32([5, 5, 5])
    tiny = far + 1e-4 * square[[0, 1, 2]] @ np.float32([[1, 0, 0], [0, 0, 1], [0, 0, 0]])
    point = np.tile(far + 1, (3, 1))
    vertices = np.concatenate([square, tiny, point, [[2, 2, 2]]]).astype(np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [0, 1, 1], [7, 8, 9], [2, 7, 7]], np.int32)
    normals = vertex_normals(vertices, faces)
    np.testing.assert_allclose(lengths(normals[:10]), 1, atol=1e-6)
    np.testing.assert_allclose(normals[:4], np.tile([0, 0, 1], (4, 1)), atol=1e-6)
    np.testing.assert_allclose(normals[4:7], np.tile([0, -1, 0], (3, 1)), atol=1e-6)
    np.testing.assert_allclose(normals[7], [0, 0, 1], atol=1e-6)  # from the vertex beside it
    assert (normals[10] == 0).all()  # no triangle has it
    assert fill_normals(normals, vertices, faces[:4]) is not None


@pytest.mark.parametrize("turn", [0, 1, 2])
def test_N_a_sum_too_small_for_whole_numbers_is_filled(turn):
    """As in extracted meshes: areas below one step of the sums."""
    vertices = np.float32([[0, 0, 0], [1e-5, 0, 0], [0, 1e-5, 0]])[:, np.roll(range(3), turn)]
    faces = np.array([[0, 1, 2]], np.int32)
    rounded = meshing._unit(np.zeros((3, 3), np.int32))
    assert (rounded == 0).all()
    expected = np.roll([0.0, 0.0, 1.0], turn)
    np.testing.assert_allclose(
        fill_normals(rounded, vertices, faces), np.tile(expected, (3, 1)), atol=1e-6
    )
    kept = np.tile(np.float32([1, 0, 0]), (3, 1))
    assert fill_normals(kept, vertices, faces) is kept
