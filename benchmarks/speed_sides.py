"""What `speed.py` compares: our pipeline, its maps by hand, and Open3D's TSDF, each on the same
frames; and the clock that times them.
"""

from __future__ import annotations

import os
import time
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion import runtime
from taichi_unifusion.errors import MissingDependency


@dataclass(frozen=True)
class Times:
    """Milliseconds of one side: column 0 by the clock on the wall, column 1 of all processors."""

    frames: NDArray[np.float64]  # (N, 2)
    finish: NDArray[np.float64]  # (2,) what was still to do after the last frame
    mesh: NDArray[np.float64]  # (2,)

    @property
    def mean(self) -> NDArray[np.float64]:
        """(2,) a frame, with its share of what was left to do at the end."""
        return (self.frames.sum(axis=0) + self.finish) / len(self.frames)

    @property
    def worst(self) -> NDArray[np.float64]:
        """(2,) the worst frame, as a multiple of the mean."""
        return self.frames.max(axis=0) / self.mean


def timed(work, *arguments) -> NDArray[np.float64]:
    """(2,) milliseconds that the work takes, the device's included: wall, all processors."""
    runtime.synchronize()
    start = time.perf_counter(), time.process_time()
    work(*arguments)
    runtime.synchronize()
    return 1e3 * (np.array([time.perf_counter(), time.process_time()]) - start)


class Side(ABC):
    """Something that fuses frames."""

    name: str

    def prepare(self, frame: uf.Frame) -> Any:
        """A frame with pose and colour, as `step` takes it; not timed."""
        return frame

    @abstractmethod
    def step(self, prepared: Any) -> None:
        """Fuse a frame."""

    @abstractmethod
    def finish(self) -> None:
        """Do what is still to be done of the frames given so far."""

    @abstractmethod
    def mesh(self) -> Any:
        """The mesh of all frames, with colour."""


class Ours(Side):
    """Surface and colour through `Pipeline.step`."""

    name = "Pipeline.step"

    def __init__(self, config: uf.Config) -> None:
        self.pipeline = uf.Pipeline(config)

    def step(self, prepared: uf.Frame) -> None:
        self.pipeline.step(prepared)

    def finish(self) -> None:
        # a pipeline that fuses every frame at once has nothing to flush
        self.pipeline.flush()

    def mesh(self) -> uf.Mesh:
        return self.pipeline.extract_mesh()


class ByHand(Side):
    """The same maps, given one cloud after the other."""

    name = "map.integrate(cloud)"

    def __init__(self, config: uf.Config) -> None:
        self.config = config
        self.surface = uf.SurfaceMap(config.surface)
        self.color = uf.PropertyMap("color", 3, config.color)

    def step(self, prepared: uf.Frame) -> None:
        cloud = uf.preprocess(prepared, self.config.preprocess)
        cloud = cloud.transformed(prepared.T_world_camera)
        self.surface.integrate(cloud)
        self.color.integrate(cloud)

    def finish(self) -> None:
        """Nothing: every cloud is fused at once."""

    def mesh(self) -> uf.Mesh:
        mesh = self.surface.extract_mesh(self.config.mesh.resolution, self.config.mesh.min_area)
        return mesh.with_attribute("color", self.color.query(mesh.vertices))


class OpenTsdf(Side):
    """Open3D's VoxelBlockGrid with colour on the CPU, 1 cm voxels, blocks of 8."""

    name = "Open3D TSDF"

    def __init__(self, config: uf.Config) -> None:
        # threads that wait without spinning, so that waiting is not counted as work
        os.environ.setdefault("OMP_WAIT_POLICY", "passive")
        try:
            import open3d as o3d
        except ImportError as error:
            raise MissingDependency("Open3D: run pip install '.[open3d]'") from error
        self.o3d, self.depth_max = o3d, config.preprocess.depth_max
        core = o3d.core
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color"),
            (core.float32, core.float32, core.float32),
            ((1,), (1,), (3,)),
            0.01,
            8,
            50000,
            core.Device("CPU:0"),
        )

    def prepare(self, frame: uf.Frame) -> tuple:
        geometry, core = self.o3d.t.geometry, self.o3d.core
        depth = geometry.Image(frame.depth)
        color = geometry.Image(frame.color.astype(np.float32) / 255)
        K, T = core.Tensor(frame.camera.matrix), core.Tensor(np.linalg.inv(frame.T_world_camera))
        return depth, color, K, T

    def step(self, prepared: tuple) -> None:
        depth, color, K, T = prepared
        blocks = self.grid.compute_unique_block_coordinates(depth, K, T, 1.0, self.depth_max)
        self.grid.integrate(blocks, depth, color, K, T, 1.0, self.depth_max)

    def finish(self) -> None:
        """Nothing: every frame is fused at once."""

    def mesh(self) -> Any:
        return self.grid.extract_triangle_mesh()
