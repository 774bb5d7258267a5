"""Boards thinner than a voxel get both of their faces, also from saved, merged and moved maps."""

from __future__ import annotations

import numpy as np
import pytest
from mesh_laws import assert_welded, triangles
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.datasets.synthetic import Scene, SyntheticRoom, look_at
from taichi_unifusion.maps import SurfaceMap, load_map
from taichi_unifusion.maps.meshing import mesh_blocks
from taichi_unifusion.rendering.primitives import box
from taichi_unifusion.rendering.raycaster import RayCaster
from taichi_unifusion.rendering.room import furnished_room
from taichi_unifusion.types import Mesh, PinholeCamera

VIEWS = 10


class Board(SyntheticRoom):
    """A board of a metre that stands in an empty room, seen from all around."""

    def __init__(self, thickness: float) -> None:
        super().__init__(frames=VIEWS, width=240, height=180)
        self.T_world_camera = np.stack(
            [
                look_at((1.4 * np.cos(a), 1.4 * np.sin(a), 1.1 + 0.3 * np.sin(2 * a)), (0, 0, 1))
                for a in (np.arange(VIEWS) + 0.5) * 2 * np.pi / VIEWS
            ]
        )
        room, y = furnished_room()[0], thickness / 2
        # takes the place of the furnished room, which is made when it is first needed
        self.__dict__["_scene"] = Scene((room, box(room.material, (-0.5, -y, 0.5), (0.5, y, 1.5))))


@pytest.fixture(scope="module")
def board_map():
    uf.init(DEVICE)
    made = {}

    def make(thickness: float, **settings) -> SurfaceMap:
        key = thickness, *settings.items()
        if key not in made:
            surface = uf.maps.SurfaceSettings(voxel_size=0.05, **settings)
            pipeline = uf.Pipeline(uf.Config(device=DEVICE, surface=surface))
            for frame in Board(thickness):
                pipeline.step(frame)
            made[key] = pipeline.surface
        return made[key]

    return make


def within(mesh: Mesh, thickness: float, tolerance: float = 0.005) -> tuple[float, float]:
    """The share of a face that is met within a tolerance of where it is, from either side; 3 cm along
    its rim left out.
    """
    camera = PinholeCamera(95, 95, 100.0, 100.0, 47.0, 47.0)  # sees the face from a metre
    shares = []
    for side in (1, -1):
        eye = np.array([0.0, side * (1 + thickness / 2), 1.0])
        depth = RayCaster(mesh).cast(camera, look_at(eye, (0, 0, 1))).depth
        shares.append(float((np.abs(depth - 1) < tolerance).mean()))
    return shares[0], shares[1]


@pytest.mark.parametrize("thickness", [0.01, 0.02, 0.03])
def test_F_both_faces_of_a_board_are_where_they_are(board_map, thickness):
    mesh = board_map(thickness).extract_mesh(4)
    assert_welded(mesh.vertices, mesh.faces)
    assert min(within(mesh, thickness)) > 0.9
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-4)


def test_blocks_with_a_board_together_are_the_whole_mesh(board_map):
    """Also where a border of blocks goes through the board: what lies beyond counts."""
    surface = board_map(0.02)
    mesh, blocks = surface.extract_mesh(2), mesh_blocks(surface.grid.voxel_keys())
    alone = [surface.extract_mesh(2, blocks=block[None]) for block in blocks]
    on_board = [each for each in alone if len(each.part(lies_on_board(each))[0].faces)]
    assert len(on_board) >= 4
    rows = np.concatenate([triangles(each) for each in alone])
    np.testing.assert_array_equal(rows[np.lexsort(rows.T[::-1])], triangles(mesh))


def lies_on_board(mesh: Mesh) -> np.ndarray:
    """Which faces (F,) lie within the board's outline."""
    x, y, z = mesh.vertices[mesh.faces[:, 0]].T
    return (np.abs(x) < 0.5) & (np.abs(y) < 0.05) & (np.abs(z - 1) < 0.5)


def test_one_field_a_voxel_cannot_hold_both(board_map):
    assert max(within(board_map(0.02, two_sides=False).extract_mesh(4), 0.02)) < 0.3


def test_a_saved_map_and_the_sum_of_two_have_both_faces_too(board_map, tmp_path):
    whole = board_map(0.02)
    whole.save(tmp_path / "board.safetensors")
    loaded = load_map(tmp_path / "board.safetensors")
    meshes = [each.extract_mesh(2) for each in (whole, loaded)]
    np.testing.assert_array_equal(meshes[0].faces, meshes[1].faces)
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    parts = []
    for side in (1, -1):
        pipeline = uf.Pipeline(uf.Config(device=DEVICE, voxel_size=0.05))
        for frame in Board(0.02):
            if side * frame.T_world_camera[1, 3] > 0:
                pipeline.step(frame)
        parts.append(pipeline.surface)
    assert min(within(parts[0].extract_mesh(4), 0.02)) < 0.1
    parts[0].merge(parts[1])
    assert min(within(parts[0].extract_mesh(4), 0.02)) > 0.9


def test_a_room_has_one_sheet(board_map):
    pipeline = uf.Pipeline(uf.Config(device=DEVICE, voxel_size=0.05))
    for frame in SyntheticRoom(frames=8, width=160, height=120):
        pipeline.step(frame)
    pipeline.surface.flush()
    sheets = pipeline.surface._sheets(pipeline.surface.grid.used_slots())
    assert [sheet.near for sheet in sheets] == [None]
