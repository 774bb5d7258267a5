"""Quality against the input frames, and what it took: depth and colour of the map, rendered at the
frames' own poses.

    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10
    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10 --register
    python benchmarks/rendering.py replica PATH --depth-max 10
    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10 --config configs/paper.yaml

The maps are those of `unifusion reconstruct`, fused in windows unless the configuration says
otherwise, and the numbers those of `unifusion evaluate rendering --all`: docs/evaluation.md explains
them.
"""

from __future__ import annotations

import argparse
import resource
import time
from dataclasses import replace

import taichi_unifusion as uf
from taichi_unifusion.datasets import estimate_color_camera
from taichi_unifusion.evaluation import evaluate_rendering


def _megabytes(pipeline: uf.Pipeline) -> str:
    return " + ".join(f"{each.memory_bytes / 2**20:.1f}" for each in pipeline.maps.values())


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
    settings = replace(config.preprocess, depth_max=options.depth_max)
    pipeline = uf.Pipeline(replace(config, preprocess=settings))
    recording = uf.open_dataset(options.format, options.path)[: options.end]
    if options.register:
        start = time.process_time()
        estimate = estimate_color_camera(recording)
        print(f"colour: {estimate.verdict} ({time.process_time() - start:.1f} s of processor time)")
        if estimate.camera:
            recording = recording.with_color_camera(estimate.camera)
    frames = recording[:: options.every]
    start = time.perf_counter()
    run = pipeline.run(frames)
    mapped = time.perf_counter() - start
    start = time.perf_counter()
    mesh = pipeline.extract_mesh(options.resolution)
    to_mesh = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    result = evaluate_rendering(
        mesh,
        frames,
        color=pipeline.properties["color"].query,
        depth_min=settings.depth_min,
        depth_max=settings.depth_max,
    )
    print(
        f"depth L1 {result.depth_l1_cm:.3f} cm, median {result.depth_median_cm:.3f} cm, "
        f"coverage {result.coverage:.3f}, PSNR {result.psnr_db:.3f} dB, SSIM {result.ssim:.3f}"
    )
    print(
        f"{len(run.steps)} frames on {live.description} in {mapped:.1f} s, kernels compiled in them, mesh "
        f"in {to_mesh:.2f} s ({len(mesh.faces):,} triangles), {_megabytes(pipeline)} MB of maps, peak "
        f"memory {peak:.2f} GB"
    )


if __name__ == "__main__":
    main()
