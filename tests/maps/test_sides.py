"""A board thinner than a voxel is noticed, and said with what to do; a room is not."""

from __future__ import annotations

import numpy as np
import pytest
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.datasets.synthetic import Scene, SyntheticRoom, look_at
from taichi_unifusion.maps.sides import Sides, count_sides
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


def test_sides_are_counted_where_both_fields_have_a_clear_slope():
    up, steep = np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.6, 0.8])
    before = np.array([up, up, up, 0.1 * up])
    after = np.array([-up, steep, 0.2 * -up, -up])
    assert count_sides(before, after) == Sides(2, 1)
    assert count_sides(np.zeros((0, 3)), np.zeros((0, 3))) == Sides(0, 0)
    assert Sides(2, 1) + Sides(3, 0) == Sides(5, 1)
