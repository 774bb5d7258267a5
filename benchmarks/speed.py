"""Time a frame by stage, beside Open3D's TSDF on the same frames in the same run.

    python benchmarks/speed.py 7scenes PATH --end 300 --every 3
    python benchmarks/speed.py synthetic --every 2

Ours: preprocess + surface map + colour map, with the defaults (5 cm and 2.5 cm voxels). Peer:
`VoxelBlockGrid` with colour at 1 cm in blocks of 8, on the CPU. They take turns, ten frames each,
so that a busy machine slows both; medians and their ratio are printed. Frames are loaded before the
clock starts, and between turns all threads come to rest (OpenMP's spin for a while when they have
no work). `--growth` shows instead how the time a frame depends on the size of the map.
"""

from __future__ import annotations

import argparse
import resource
import time

import numpy as np
from rich.console import Console
from rich.table import Table

import taichi_unifusion as uf
from taichi_unifusion import runtime
from taichi_unifusion.preprocessing import PreprocessSettings

TURN, REST = 10, 0.5  # frames, seconds


class Clock:
    """Milliseconds by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, list[float]] = {}

    def run(self, stage: str, work, *args):
        runtime.synchronize()
        start = time.perf_counter()
        result = work(*args)
        runtime.synchronize()
        self.laps.setdefault(stage, []).append(1e3 * (time.perf_counter() - start))
        return result

    def per_frame(self, *stages: str) -> np.ndarray:
        return np.sum([self.laps[stage] for stage in stages], axis=0)


class Ours:
    """Preprocess, surface and colour with the defaults."""

    stages = ("preprocess", "surface", "color")

    def __init__(self, clock: Clock, depth_max: float) -> None:
        self.clock = clock
        self.settings, defaults = PreprocessSettings(depth_max=depth_max), uf.Config()
        self.surface, self.color = (
            uf.SurfaceMap(defaults.surface),
            uf.PropertyMap("color", 3, defaults.color),
        )

    def integrate(self, frame: uf.Frame) -> None:
        cloud = self.clock.run(
            "preprocess",
            lambda: uf.preprocess(frame, self.settings).transformed(frame.T_world_camera),
        )
        self.clock.run("surface", self.surface.integrate, cloud)
        self.clock.run("color", self.color.integrate, cloud)

    def mesh(self) -> uf.Mesh:
        mesh = self.clock.run("mesh", self.surface.extract_mesh, 4)
        return mesh.with_attribute(
            "color", self.clock.run("mesh color", self.color.query, mesh.vertices)
        )


class OpenTsdf:
    """Open3D's VoxelBlockGrid with colour, 1 cm voxels, blocks of 8."""

    def __init__(self, clock: Clock, depth_max: float) -> None:
        import open3d as o3d

        self.o3d, self.clock, self.depth_max = o3d, clock, depth_max
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

    def integrate(self, frame: uf.Frame) -> None:
        geometry, core = self.o3d.t.geometry, self.o3d.core
        depth, color = (
            geometry.Image(frame.depth),
            geometry.Image(frame.color.astype(np.float32) / 255),
        )
        K, T = core.Tensor(frame.camera.matrix), core.Tensor(np.linalg.inv(frame.T_world_camera))

        def step() -> None:
            blocks = self.grid.compute_unique_block_coordinates(depth, K, T, 1.0, self.depth_max)
            self.grid.integrate(blocks, depth, color, K, T, 1.0, self.depth_max)

        self.clock.run("open3d", step)

    def mesh(self):
        return self.clock.run("open3d mesh", self.grid.extract_triangle_mesh)


def growth(frames, depth_max: float) -> None:
    """Time a frame at the 30th and the 300th frame: the same view, revisited while the map grows
    elsewhere.
    """
    clock = Clock()
    ours = Ours(clock, depth_max)
    for n in range(300):
        frame = frames[n % len(frames)]
        shift = np.eye(4)
        # the scene again, beside itself: equal views, a map that grows
        shift[0, 3] = 10.0 * (n // len(frames))
        ours.integrate(
            uf.Frame(frame.depth, frame.camera, frame.color, shift @ frame.T_world_camera)
        )
    total = clock.per_frame(*ours.stages)
    early, late = np.median(total[20:40]), np.median(total[280:300])
    print(
        f"frame 20-39: {early:.1f} ms, frame 280-299: {late:.1f} ms, ratio {late / early:.2f}; "
        f"{len(ours.surface):,} surface voxels, {len(ours.color):,} colour voxels"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("format")
    parser.add_argument("path", nargs="?")
    parser.add_argument("--end", type=int)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--depth-max", type=float, default=5.0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--growth", action="store_true")
    options = parser.parse_args()
    live = uf.init(options.device)
    frames = list(uf.open_dataset(options.format, options.path)[: options.end : options.every])
    if options.growth:
        growth(frames[:20], options.depth_max)
        return
    clock = Clock()
    ours, peer = Ours(clock, options.depth_max), OpenTsdf(clock, options.depth_max)
    for turn in range(0, len(frames), TURN):
        for side in (ours, peer):
            time.sleep(REST)
            for frame in frames[turn : turn + TURN]:
                side.integrate(frame)
    for side in (ours, peer) * 3:
        time.sleep(REST)
        side.mesh()

    table = Table(title=f"{len(frames)} frames of {options.format}, {live.description}")
    for column in ("stage", "median ms", "mean ms", "first ms"):
        table.add_column(column, justify="left" if column == "stage" else "right")
    for stage, laps in clock.laps.items():
        table.add_row(
            stage, *(f"{value:.1f}" for value in (np.median(laps[1:]), np.mean(laps[1:]), laps[0]))
        )
    Console().print(table)
    total = clock.per_frame(*ours.stages)[2:]
    tsdf = np.array(clock.laps["open3d"])[2:]
    print(
        f"ours {np.median(total):.1f} ms a frame, Open3D {np.median(tsdf):.1f} ms a frame, "
        f"ratio {np.median(total) / np.median(tsdf):.2f} (fastest frames {total.min():.1f} and {tsdf.min():.1f}, "
        f"ratio {total.min() / tsdf.min():.2f}); peak memory of both "
        f"{resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GB"
    )


if __name__ == "__main__":
    main()
