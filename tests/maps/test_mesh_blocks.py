"""A mesh in blocks: all of them together are the whole mesh, and what did not change need not be
extracted again.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_kinds import SMALL
from mesh_laws import triangles
from scenes import sphere
from windows import CONFIG, stepped, walk

from taichi_unifusion import Mesh, SurfaceMap
from taichi_unifusion.errors import InputError
from taichi_unifusion.maps.changes import GROWTH, MeshedSurface, changed_blocks
from taichi_unifusion.maps.encoding import EncoderSettings
from taichi_unifusion.maps.meshing import MESH_BLOCK, mesh_blocks
from taichi_unifusion.maps.voxel_data import VoxelData

SAME_NORMAL = 1e-6  # whole numbers are summed; what is left is the division


def random_surface(span: int = 20) -> SurfaceMap:
    """Latents, support and votes at random, over several blocks on either side of the origin."""
    target = SurfaceMap(encoder=EncoderSettings(rank=6, anchors=64), two_sides=False)
    rng = np.random.default_rng(5)
    keys = np.unique(rng.integers(-span, span, (3000, 3)), axis=0).astype(np.int32)
    fields = {
        "latents": rng.normal(size=(len(keys), 6, 1)).astype(np.float32),
        "weights": np.ones(len(keys), np.float32),
        "masks": rng.integers(0, 2**32, (len(keys), 2), dtype=np.uint32),
        "evidence": rng.integers(-3, 6, (len(keys), 64)).astype(np.int8),
    }
    target.grid.add(VoxelData(keys, fields))
    return target


def normals_by_place(mesh: Mesh) -> dict[bytes, np.ndarray]:
    return {
        vertex.tobytes(): normal for vertex, normal in zip(mesh.vertices, mesh.normals, strict=True)
    }


def joined(meshes: list[Mesh]) -> np.ndarray:
    rows = np.concatenate([triangles(mesh) for mesh in meshes])
    return rows[np.lexsort(rows.T[::-1])]


@pytest.mark.parametrize("resolution", [2, 3, 4])
def test_blocks_together_are_the_whole_mesh(resolution):
    target = random_surface()
    whole = target.extract_mesh(resolution)
    blocks = mesh_blocks(target.grid.voxel_keys())
    assert len(blocks) >= 27
    alone = [target.extract_mesh(resolution, blocks=block[None]) for block in blocks]
    np.testing.assert_array_equal(joined(alone), triangles(whole))
    normals = normals_by_place(whole)
    for mesh in alone:
        for place, normal in normals_by_place(mesh).items():
            np.testing.assert_allclose(normal, normals[place], atol=SAME_NORMAL)
    seams = sum(len(mesh.vertices) for mesh in alone) - len(whole.vertices)
    assert seams > 100  # vertices that two blocks share
    several = target.extract_mesh(resolution, blocks=blocks[3:9])
    np.testing.assert_array_equal(triangles(several), joined(alone[3:9]))


def test_a_block_without_surface_is_an_empty_mesh():
    mesh = random_surface().extract_mesh(2, blocks=np.array([[50, 0, 0]], np.int32))
    assert mesh.vertices.shape == mesh.faces.shape == mesh.normals.shape == (0, 3)


def test_small_parts_cannot_be_told_from_blocks():
    with pytest.raises(InputError, match="min_area needs the whole mesh"):
        random_surface().extract_mesh(2, 0.1, blocks=np.zeros((1, 3), np.int32))


def test_what_did_not_change_stays_as_it_was():
    """A second sphere beside the first: the blocks of the first one, kept, and the changed ones are
    the whole.
    """
    target = SurfaceMap(carve=False, **SMALL)
    target.integrate(sphere(0.3, 0.01, (0, 0, 0)))
    before, state = changed_blocks(target, MeshedSurface.nothing())
    kept = {tuple(block): target.extract_mesh(2, blocks=block[None]) for block in before}
    nothing, same = changed_blocks(target, state)
    assert nothing.shape == (0, 3) and (same.weights == state.weights).all()
    target.integrate(sphere(0.3, 0.01, (3, 0, 0)))
    changed, _ = changed_blocks(target, state)
    assert 0 < len(changed) < len({*map(tuple, changed), *kept})
    for block in changed:
        kept[tuple(block)] = target.extract_mesh(2, blocks=block[None])
    np.testing.assert_array_equal(joined(list(kept.values())), triangles(target.extract_mesh(2)))


def test_a_voxel_counts_again_when_its_weight_has_grown_by_a_quarter():
    target = SurfaceMap(carve=False, **SMALL)
    cloud, state = sphere(0.3, 0.01, (0, 0, 0)), MeshedSurface.nothing()
    meshed = []
    for _ in range(9):
        target.integrate(cloud)
        _, state = changed_blocks(target, state)
        meshed.append(state.weights[0])
    assert GROWTH == 0.25
    np.testing.assert_array_equal(np.array(meshed) / meshed[0], [1, 2, 3, 4, 4, 6, 6, 8, 8])


def test_frames_that_wait_are_left_out_and_go_on_waiting():
    config = replace(CONFIG, surface=replace(CONFIG.surface, carve=True))
    pipeline = stepped(walk(2 * CONFIG.window - 1), config)  # the first window is fused by now
    waiting = len(pipeline.fusion.window)
    blocks, _ = changed_blocks(pipeline.surface, MeshedSurface.nothing())
    meshes = [pipeline.extract_mesh(2, blocks=block[None], flush=False) for block in blocks]
    assert len(pipeline.fusion.window) == waiting == 3 and pipeline.surface.waiting is not None
    colored = [mesh for mesh in meshes if len(mesh.vertices)]
    assert all("color" in mesh.attributes for mesh in colored)
    assert 0 < len(joined(colored)) != len(pipeline.extract_mesh(2).faces)
    assert pipeline.surface.waiting is None


def test_the_blocks_of_a_voxel_reach_into_the_next_one_at_a_border():
    inside = mesh_blocks(np.array([[5, 5, 5]], np.int32))
    np.testing.assert_array_equal(inside, [[0, 0, 0]])
    border = mesh_blocks(np.array([[MESH_BLOCK - 1, 5, 0]], np.int32))
    np.testing.assert_array_equal(border, [[0, 0, -1], [0, 0, 0], [1, 0, -1], [1, 0, 0]])
