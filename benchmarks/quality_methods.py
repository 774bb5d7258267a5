"""Reconstructions to compare: ours under a configuration, and the TSDF of Open3D's VoxelBlockGrid
with colour.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from quality_scenes import DEPTH_RANGE

from taichi_unifusion import Config, Pipeline, load_config
from taichi_unifusion.errors import InputError, MissingDependency
from taichi_unifusion.types import Frame, Mesh

PAPER = Path(__file__).resolve().parents[1] / "configs" / "paper.yaml"
TRUNCATION, MIN_WEIGHT = 6.0, 1.0  # of the TSDF: in voxels, and frames that must have seen a voxel
BLOCK = 8  # voxels along a TSDF block: the smallest that VoxelBlockGrid can be made, at some loss of speed
# Open3D's pixel u spans [u, u + 1), ours is centred at u: what it is given as the principal point
HALF_PIXEL = 0.5
TSDF_BYTES = {"tsdf": 4, "weight": 4, "color": 12}  # a voxel, as float32
LEAN_BYTES = {"surface": 4 + 2, "color": 6}  # a voxel, with 16-bit weights and colours


@dataclass(frozen=True)
class Reconstruction:
    """A mesh with colour, and what it took."""

    mesh: Mesh
    # decodes colour at points; None: the mesh's vertex colours
    color: Callable[[NDArray], NDArray] | None
    surface_mb: float  # of the map
    color_mb: float
    lean_mb: float  # both, as small as the method can store them...
    lean_surface_mb: float  # ...and of that the surface
    cpu_ms: float  # of all threads, a frame: median
    wall_ms: float  # a frame: median
    mesh_s: float  # wall time of the extraction
    settings: dict  # what was used


@dataclass
class Stopwatch:
    """CPU and wall milliseconds of every lap."""

    laps: list[tuple[float, float]]

    @contextmanager
    def lap(self) -> Iterator[None]:
        cpu, wall = time.process_time(), time.perf_counter()
        yield
        self.laps.append((1e3 * (time.process_time() - cpu), 1e3 * (time.perf_counter() - wall)))

    def median(self) -> tuple[float, float]:
        """CPU and wall of a typical lap; the first two compile and allocate."""
        return tuple(float(x) for x in np.median(self.laps[2:] or self.laps, axis=0))


def ours(config: Config, frames: Sequence[Frame], near: float = DEPTH_RANGE[0]) -> Reconstruction:
    """The pipeline under a configuration, on readings from `near` [m]."""
    far = DEPTH_RANGE[1]
    config = replace(config, preprocess=replace(config.preprocess, depth_min=near, depth_max=far))
    pipeline, watch = Pipeline(config), Stopwatch([])
    for frame in frames:
        with watch.lap():
            pipeline.step(frame)  # waits for the device
    start = time.perf_counter()
    mesh = pipeline.extract_mesh()
    mesh_s = time.perf_counter() - start
    surface, color = (
        pipeline.surface.memory_bytes / 2**20,
        pipeline.properties["color"].memory_bytes / 2**20,
    )
    return Reconstruction(
        mesh,
        pipeline.properties["color"].query,
        surface,
        color,
        surface + color,
        surface,
        *watch.median(),
        mesh_s,
        asdict(config),
    )


def tsdf(
    frames: Sequence[Frame],
    near: float = DEPTH_RANGE[0],
    *,
    voxel_size: float,
    truncation: float = TRUNCATION,
    min_weight: float = MIN_WEIGHT,
) -> Reconstruction:
    """Open3D's VoxelBlockGrid on the raw depth from `near` [m], float32."""
    try:
        import open3d as o3d
        from open3d.core import Device, Tensor, float32
    except ImportError:
        raise MissingDependency("the TSDF needs Open3D: pip install '.[open3d]'") from None

    cpu, far = Device("CPU:0"), DEPTH_RANGE[1]
    grid = o3d.t.geometry.VoxelBlockGrid(
        tuple(TSDF_BYTES), (float32,) * 3, ((1,), (1,), (3,)), voxel_size, BLOCK, 64_000, cpu
    )
    matrix = frames[0].camera.matrix.copy()
    matrix[:2, 2] += HALF_PIXEL
    K, watch = Tensor(matrix), Stopwatch([])
    for frame in frames:
        depth = o3d.t.geometry.Image(
            Tensor(np.where(frame.depth < near, 0, frame.depth).astype(np.float32))
        )
        color = o3d.t.geometry.Image(Tensor(frame.color.astype(np.float32) / 255))
        T_camera_world = Tensor(np.linalg.inv(frame.T_world_camera))
        with watch.lap():
            blocks = grid.compute_unique_block_coordinates(
                depth, K, T_camera_world, 1.0, far, truncation
            )
            grid.integrate(blocks, depth, color, K, K, T_camera_world, 1.0, far, truncation)
    start = time.perf_counter()
    extracted = grid.extract_triangle_mesh(min_weight)
    mesh = Mesh(
        extracted.vertex.positions.numpy(),
        extracted.triangle.indices.numpy().astype(np.int32),
        attributes={"color": extracted.vertex.colors.numpy()},
    )
    mesh_s = time.perf_counter() - start
    voxels = grid.hashmap().size() * BLOCK**3 / 2**20
    surface = voxels * (TSDF_BYTES["tsdf"] + TSDF_BYTES["weight"])
    return Reconstruction(
        mesh,
        None,
        surface,
        voxels * TSDF_BYTES["color"],
        voxels * sum(LEAN_BYTES.values()),
        voxels * LEAN_BYTES["surface"],
        *watch.median(),
        mesh_s,
        {
            "voxel_size": voxel_size,
            "truncation_voxels": truncation,
            "min_weight": min_weight,
            "block": BLOCK,
        },
    )


# frames and their nearest reading [m] -> a reconstruction
Method = Callable[[Sequence[Frame], float], Reconstruction]


def _finer() -> Config:
    config = Config()
    return replace(config, surface=replace(config.surface, voxel_size=0.04))


METHODS: dict[str, Method] = {
    "ours": partial(ours, Config()),
    "ours-4cm": partial(ours, _finer()),
    "paper": partial(ours, load_config(PAPER)),
    "tsdf-1cm": partial(tsdf, voxel_size=0.01),
    "tsdf-2cm": partial(tsdf, voxel_size=0.02),
    "tsdf-0.5cm": partial(tsdf, voxel_size=0.005),
    "tsdf-0.3cm": partial(tsdf, voxel_size=0.003),
}


def method(name: str) -> Method:
    """A method of METHODS, ours under the YAML file of that name, or a TSDF such as tsdf-1cm-t8-w3:
    truncation, weight.
    """
    if name in METHODS:
        return METHODS[name]
    if match := re.fullmatch(r"tsdf-([\d.]+)cm-t([\d.]+)-w([\d.]+)", name):
        centimetres, truncation, min_weight = map(float, match.groups())
        return partial(
            tsdf, voxel_size=centimetres / 100, truncation=truncation, min_weight=min_weight
        )
    if Path(name).suffix in (".yaml", ".yml"):
        return partial(ours, load_config(name))
    raise InputError(
        f"method '{name}' is unknown; there are {', '.join(METHODS)}, tsdf-1cm-t8-w3 (truncation in voxels, "
        "weight threshold) and configurations FILE.yaml"
    )
