"""A board thinner than a voxel is noticed, and said with what to do; a room is not."""

from __future__ import annotations

import numpy as np
import pytest
import reference_visibility as twin
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.datasets.synthetic import Scene, SyntheticRoom, look_at
from taichi_unifusion.kernels import sides as kernels
from taichi_unifusion.maps.sides import Sides
from taichi_unifusion.maps.voxel_data import MASKS, WEIGHTS
from taichi_unifusion.maps.voxel_grid import VoxelGrid
from taichi_unifusion.rendering.primitives import box
from taichi_unifusion.rendering.room import furnished_room


class Board(SyntheticRoom):
    """A board that stands in an empty room, seen from all around."""

    def __init__(self, thickness: float) -> None:
        super().__init__(frames=8, width=160, height=120)
        self.T_world_camera = np.stack(
            [
                look_at((1.4 * np.cos(a), 1.4 * np.sin(a), 1.1), (0, 0, 1))
                for a in np.arange(8) * np.pi / 4
            ]
        )
        room = furnished_room()[0]
        y = thickness / 2
        # takes the place of the furnished room, which is made when it is first needed
        self.__dict__["_scene"] = Scene((room, box(room.material, (-0.5, -y, 0.5), (0.5, y, 1.5))))


@pytest.fixture(scope="module")
def warned():
    uf.init(DEVICE)

    def run(frames) -> list[str]:
        result = uf.Pipeline(uf.Config(device=DEVICE, voxel_size=0.05)).run(frames)
        return [warning for warning in result.warnings if "faces the other way" in warning]

    return run


def test_a_thin_board_is_said_with_what_to_do(warned):
    (sentence,) = warned(Board(0.02))
    assert "voxels of 5 cm" in sentence and "--detail fine or --voxel-size 0.02" in sentence


def test_a_thick_board_and_a_furnished_room_are_not(warned):
    assert warned(Board(0.3)) == []
    assert warned(SyntheticRoom(frames=8, width=160, height=120)) == []


def test_sides_add_up():
    assert Sides(2, 1) + Sides(3, 0) == Sides(5, 1)


def test_count_sides_equals_its_twin():
    """Voxels that the map does not hold, or that were not encoded, are not looked at."""
    rng, grid, rank = np.random.default_rng(0), VoxelGrid([WEIGHTS, MASKS]), 8
    slopes = rng.normal(size=(9, 3, rank)).astype(np.float32)
    keys = np.unique(rng.integers(-9, 9, (900, 3)), axis=0).astype(np.int32)
    known, weights = np.arange(len(keys)) % 4 > 0, np.arange(len(keys)) % 5 % 3 + 0.0
    slots = np.empty(len(keys), np.int32)
    grid.claim(len(keys), keys, known.astype(np.float32), slots)
    latents = rng.normal(size=(grid.capacity, rank, 1)).astype(np.float32)
    turned = rng.choice([-1.0, 0.0, 0.02, 1.0], len(keys))[:, None, None]
    encoded = (latents[slots] * turned + 0.1 * rng.normal(size=(len(keys), rank, 1))) * 0.2
    encoded, counts = encoded.astype(np.float32), np.array([10, 20], np.int32)
    kernels.count_sides(
        rank,
        len(keys),
        keys,
        weights.astype(np.float32),
        encoded,
        grid.index,
        0.2 * latents,
        slopes,
        counts,
    )
    looked_at = known & (weights > 0)
    wanted = twin.count_sides(0.2 * latents[slots[looked_at]], encoded[looked_at], slopes)
    assert 0 < wanted[1] < wanted[0] < looked_at.sum()
    np.testing.assert_array_equal(counts, np.array([10, 20]) + wanted)
