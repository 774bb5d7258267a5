"""Quality against the input frames, and what it took: depth and colour of the map, rendered at the
frames' own poses.

    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10
    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10 --register
    python benchmarks/rendering.py replica PATH --depth-max 10
    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10 --config configs/paper.yaml

The numbers are those of `unifusion evaluate rendering --all`: docs/evaluation.md explains them.
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import time

import numpy as np

import taichi_unifusion as uf
from taichi_unifusion import runtime
from taichi_unifusion.datasets import estimate_color_camera
from taichi_unifusion.evaluation import evaluate_rendering


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("format")
    parser.add_argument("path", nargs="?")
    parser.add_argument("--end", type=int)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--depth-max", type=float, default=5.0)
    parser.add_argument("--resolution", type=int, default=4)
    parser.add_argument("--config")
    parser.add_argument(
        "--register",
        action="store_true",
        help="find the colour camera, and register colour with it",
    )
    options = parser.parse_args()
    live = uf.init()
    config = uf.load_config(options.config) if options.config else uf.Config()
    settings = dataclasses.replace(config.preprocess, depth_max=options.depth_max)
    recording = uf.open_dataset(options.format, options.path)[: options.end]
    if options.register:
        start = time.process_time()
        estimate = estimate_color_camera(recording)
        print(f"colour: {estimate.verdict} ({time.process_time() - start:.1f} s of processor time)")
        if estimate.camera:
            recording = recording.with_color_camera(estimate.camera)
    frames = list(recording[:: options.every])
    surface, color = uf.SurfaceMap(config.surface), uf.PropertyMap("color", 3, config.color)

    def integrate(frame: uf.Frame) -> float:
        start = time.perf_counter()
        cloud = uf.preprocess(frame, settings).transformed(frame.T_world_camera)
        surface.integrate(cloud)
        color.integrate(cloud)
        runtime.synchronize()
        return 1e3 * (time.perf_counter() - start)

    laps = [integrate(frame) for frame in frames]
    start = time.perf_counter()
    mesh = surface.extract_mesh(options.resolution)
    mesh = mesh.with_attribute("color", color.query(mesh.vertices))
    to_mesh = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    result = evaluate_rendering(
        mesh, frames, color=color.query, depth_min=settings.depth_min, depth_max=settings.depth_max
    )
    print(
        f"depth L1 {result.depth_l1_cm:.3f} cm, median {result.depth_median_cm:.3f} cm, "
        f"coverage {result.coverage:.3f}, PSNR {result.psnr_db:.3f} dB, SSIM {result.ssim:.3f}"
    )
    print(
        f"{len(frames)} frames on {live.description}: median {np.median(laps[1:]):.0f} ms a frame, "
        f"first {laps[0]:.0f} ms, mesh in {to_mesh:.2f} s ({len(mesh.faces):,} triangles), "
        f"{surface.memory_bytes / 2**20:.1f} + "
        f"{color.memory_bytes / 2**20:.1f} MB of maps, peak memory {peak:.2f} GB"
    )


if __name__ == "__main__":
    main()
