"""A map while it grows: which chunks of its mesh a viewer needs anew, at a bounded share of the run's
time. Looking changes nothing: frames that wait to be fused are left to wait.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..maps.changes import MeshedSurface, changed_blocks
from ..maps.meshing import MESH_BLOCK
from ..pipeline import Pipeline
from ..types import Frame, Mesh

INTERVAL = 1.0  # [s] between two updates
SHARE = 0.1  # of the time of a run that watching may take
RESOLUTION = 2  # cells a voxel of what is shown while it grows
BACK, ABOVE = 0.8, 0.5  # [m] from where one looks at first, behind and above the camera
LEVEL = np.cos(np.radians(40))  # of the camera's up to an axis of the world, which then is up
LEAST_BLOCKS = 16  # of an update: what every update costs is spread over them

Block = tuple[int, int, int]


@dataclass
class Pace:
    """When to look again, so that looking takes at most SHARE of the time."""

    due: float = field(default_factory=time.perf_counter)
    seconds_per_block: float = 0.0
    compiling: bool = True

    def ready(self) -> bool:
        """Whether it is time to look."""
        return time.perf_counter() >= self.due

    def blocks(self) -> int:
        """How many blocks fit into the share of one interval; where these are too few, the interval
        gets longer.
        """
        if not self.seconds_per_block:
            return LEAST_BLOCKS
        return max(LEAST_BLOCKS, int(SHARE * INTERVAL / self.seconds_per_block))

    def took(self, seconds: float, blocks: int) -> None:
        """Note what an update of so many blocks took. The first one compiles kernels, which every
        mesh needs once, and tells nothing about the next.
        """
        pause = INTERVAL if self.compiling else max(INTERVAL, seconds / SHARE - seconds)
        if blocks and not self.compiling:
            self.seconds_per_block = seconds / blocks
        self.compiling = self.compiling and not blocks
        self.due = time.perf_counter() + pause


@dataclass
class ChangedChunks:
    """The chunks of a growing mesh that have changed: first those that were never taken, so that the
    map grows, and of these the nearest to the camera.
    """

    resolution: int = RESOLUTION
    before: MeshedSurface = field(default_factory=MeshedSurface.nothing)
    waiting: dict[Block, None] = field(default_factory=dict)  # in order of their change
    taken: set[Block] = field(default_factory=set)

    def take(self, pipeline: Pipeline, frame: Frame, count: int) -> Mapping[Block, Mesh]:
        """At most `count` chunks that have changed since they were taken, by block; one that is
        empty now has no triangles.
        """
        changed, self.before = changed_blocks(pipeline.surface, self.before)
        self.waiting.update(dict.fromkeys(_tuples(changed)))
        if not self.waiting:
            return {}
        blocks = np.array(list(self.waiting), np.int32)
        edge = MESH_BLOCK * pipeline.surface.voxel_size
        eye = frame.require_pose()[:3, 3]
        again = [block in self.taken for block in self.waiting]
        distance = np.linalg.norm((blocks + 0.5) * edge - eye, axis=1)
        chosen = blocks[np.lexsort((distance, again))[:count]]
        for block in _tuples(chosen):
            del self.waiting[block]
        self.taken.update(_tuples(chosen))
        mesh = pipeline.extract_mesh(self.resolution, blocks=chosen, flush=False)
        return split_blocks(mesh, chosen, pipeline.surface.voxel_size)


def upright(up: NDArray) -> NDArray[np.float64]:
    """The axis of the world that is nearest to a camera's up, if any is near."""
    axis = np.abs(up).argmax()
    level = np.sign(up[axis]) * np.eye(3)[axis]
    return level if float(up @ level) > LEVEL else up


def split_blocks(mesh: Mesh, blocks: NDArray[np.int32], voxel_size: float) -> Mapping[Block, Mesh]:
    """A mesh that was extracted in `blocks` (M, 3), block by block.

    Cube k of the mesh spans the voxels' centres k - 1 to k; a block is MESH_BLOCK^3 cubes.
    """
    centers = mesh.vertices[mesh.faces].mean(axis=1)
    owner = np.floor(np.floor(centers / voxel_size + 0.5) / MESH_BLOCK).astype(np.int64)
    return {
        block: mesh.part((owner == np.array(block)).all(axis=1))[0] for block in _tuples(blocks)
    }


def _tuples(blocks: NDArray[np.int32]) -> list[Block]:
    return [(int(i), int(j), int(k)) for i, j, k in blocks]
