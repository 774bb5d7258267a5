"""Quality against the input frames, and what it took: depth and colour of the map, rendered at the frames' own poses.

    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10
    python benchmarks/rendering.py replica PATH --depth-max 10
    python benchmarks/rendering.py 7scenes PATH --end 200 --every 10 --config configs/paper.yaml

Depth by casting the pixels' rays at the mesh (Open3D), colour decoded from the colour map at the points they hit, as the paper
does. L1 and PSNR are means over frames, taken where both the reading and the mesh exist; coverage is the share of readings with
a hit.
"""

from __future__ import annotations

import argparse
import dataclasses
import resource
import time

import numpy as np

import taichi_unifusion as uf
from taichi_unifusion import runtime


def cast(scene, frame: uf.Frame):
    """Depth (H, W) [m] of the mesh, inf where missed, and the points hit (H, W, 3)."""
    import open3d as o3d

    camera, T = frame.camera, frame.T_world_camera
    v, u = np.mgrid[:camera.height, :camera.width]
    directions = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1) @ T[:3, :3].T
    rays = np.concatenate([np.broadcast_to(T[:3, 3], directions.shape), directions], -1).astype(np.float32)
    depth = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
    return depth, rays[..., :3] + rays[..., 3:] * depth[..., None]


def evaluate(mesh: uf.Mesh, color: uf.PropertyMap, frames, depth_max: float) -> dict[str, float]:
    """Means over frames: depth L1 mean and median [cm], coverage, colour PSNR [dB]."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.core.Tensor(mesh.vertices), o3d.core.Tensor(mesh.faces.astype(np.uint32)))
    rows = []
    for frame in frames:
        depth, points = cast(scene, frame)
        read = (frame.depth > 0.1) & (frame.depth < depth_max)
        hit = read & np.isfinite(depth)
        error = 100 * np.abs(depth - frame.depth)[hit]
        squared = (np.clip(color.query(points[hit]), 0, 1) - frame.color[hit] / 255.0) ** 2
        rows.append((error.mean(), np.median(error), hit.sum() / read.sum(), -10 * np.log10(squared.mean())))
    return dict(zip(("depth L1 cm", "median cm", "coverage", "PSNR dB"), np.mean(rows, axis=0)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format")
    parser.add_argument("path", nargs="?")
    parser.add_argument("--end", type=int)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--depth-max", type=float, default=5.0)
    parser.add_argument("--resolution", type=int, default=4)
    parser.add_argument("--config")
    options = parser.parse_args()
    live = uf.init()
    config = uf.load_config(options.config) if options.config else uf.Config()
    settings = dataclasses.replace(config.preprocess, depth_max=options.depth_max)
    frames = list(uf.open_dataset(options.format, options.path)[:options.end:options.every])
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
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20  # before Open3D loads
    print(", ".join(f"{name} {value:.3f}" for name, value in evaluate(mesh, color, frames, options.depth_max).items()))
    print(f"{len(frames)} frames on {live.description}: median {np.median(laps[1:]):.0f} ms a frame, first {laps[0]:.0f} ms, "
          f"mesh in {to_mesh:.2f} s ({len(mesh.faces):,} triangles), {surface.memory_bytes / 2**20:.1f} + "
          f"{color.memory_bytes / 2**20:.1f} MB of maps, peak memory {peak:.2f} GB")


if __name__ == "__main__":
    main()
