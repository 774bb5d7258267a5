"""The paper's ablations (Fig. 11-13): how the surface is encoded, voxel size, eigenpairs and
anchors.

    python benchmarks/ablation.py --out docs                        on the synthetic room: needs no data
    python benchmarks/ablation.py --only voxel-size --scene house-living --data ../shared/data --out results/ablation

Prints tables and writes pictures: ablation-encoding.jpg (Fig. 11), ablation-voxel-size.jpg (Fig.
12), ablation-kernel.png (Fig. 13). Needs matplotlib.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from quality import DATA
from quality_methods import PAPER
from quality_scenes import DEPTH_RANGE, SCENES, Scene

import taichi_unifusion as uf
from taichi_unifusion.evaluation import Viewpoints, evaluate_rendering, evaluate_surface
from taichi_unifusion.maps.encoding import EncoderSettings, PositionEncoding
from taichi_unifusion.rendering.drawing import Viewpoint, render_mesh
from taichi_unifusion.types import Mesh

VOXEL_SIZES = (0.02, 0.03, 0.05, 0.07, 0.10)  # [m]
EIGENPAIRS = (2, 5, 8, 12, 16, 20, 25, 30, 40, 60)
ANCHORS = (20, 32, 64, 128, 256, 512, 1024)
SEEDS = 5  # anchors are random: means and ranges over so many draws
KEPT = (20, 256)  # the paper's choice of eigenpairs and anchors
CELL = 0.0125  # [m] of marching cubes, whatever the voxel, so that voxels alone differ
HEAD = (
    "| variant | Accuracy % | Completeness % | F1 2.5 cm | F1 1 cm | Depth L1 cm | median cm | coverage "
    "| map MB | CPU ms |"
)


def reconstruct(config: uf.Config, scene: Scene) -> tuple[Mesh, float, float]:
    """Surface under a configuration, megabytes of its map, median CPU milliseconds a frame."""
    near, far = DEPTH_RANGE
    settings = replace(config.preprocess, depth_min=near, depth_max=far)
    surface, laps = uf.SurfaceMap(config.surface), []
    for frame in scene.frames:
        start = time.process_time()
        surface.integrate(uf.preprocess(frame, settings).transformed(frame.T_world_camera))
        uf.runtime.synchronize()
        laps.append(1e3 * (time.process_time() - start))
    mesh = surface.extract_mesh(
        max(1, round(config.surface.voxel_size / CELL)), config.mesh.min_area
    )
    return mesh, surface.memory_bytes / 2**20, float(np.median(laps[2:] or laps))


def row(name: str, mesh: Mesh, megabytes: float, milliseconds: float, scene: Scene) -> str:
    """One line of a table."""
    near, far = DEPTH_RANGE
    seen = evaluate_rendering(mesh, scene.held_out, depth_min=near, depth_max=far)
    shares = ["-"] * 4
    if scene.ground_truth is not None:
        views = Viewpoints(scene.frames[0].camera, scene.T_world_camera, near, far)
        surface = evaluate_surface(mesh, scene.ground_truth, views=views)
        wide, strict = surface.scores
        shares = [f"{100 * x:.1f}" for x in (wide.precision, wide.recall, wide.f1, strict.f1)]
    return (
        f"| {name} | {' | '.join(shares)} | {seen.depth_l1_cm:.2f} | {seen.depth_median_cm:.2f} "
        f"| {seen.coverage:.3f} | {megabytes:.1f} | {milliseconds:.0f} |"
    )


def compare(variants: dict[str, uf.Config], scene: Scene, picture: Path, columns: int) -> None:
    """A table of variants, and a picture of each, shaded without colour, from a held-out camera."""
    print(HEAD + "\n|---|" + "---:|" * (HEAD.count("|") - 2), flush=True)
    panels = []
    for name, config in variants.items():
        mesh, *cost = reconstruct(config, scene)
        print(row(name, mesh, *cost, scene), flush=True)
        panels.append(shaded(mesh, scene, name))
    write_panels(picture, panels, columns)


def shaded(mesh: Mesh, scene: Scene, title: str) -> NDArray[np.uint8]:
    """The mesh without its colour from a held-out camera, BGR."""
    frame = scene.held_out[len(scene.held_out) // 3]
    camera = frame.camera.resized(480, 480 * frame.camera.height // frame.camera.width)
    image = render_mesh(replace(mesh, attributes={}), Viewpoint(camera, frame.T_world_camera))[
        ..., ::-1
    ].copy()
    return cv2.putText(
        image, title, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (160, 40, 0), 2, cv2.LINE_AA
    )


def write_panels(path: Path, panels: Sequence[NDArray[np.uint8]], columns: int) -> None:
    """Pictures of one size, side by side in rows."""
    blank = [np.full_like(panels[0], 255)] * (-len(panels) % columns)
    cells = [*panels, *blank]
    sheet = np.vstack([np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)])
    cv2.imwrite(str(path), sheet, [cv2.IMWRITE_JPEG_QUALITY, 80])


def encoding(scene: Scene, out: Path) -> None:
    """Fig. 11: samples beside the surface against normals as derivatives, as published and under
    our defaults.
    """
    variants = {}
    for name, config in (("published", uf.load_config(PAPER)), ("ours", uf.Config())):
        for gpis in ("samples", "derivatives", "both"):
            variants[f"{name}: {gpis}"] = replace(
                config, surface=replace(config.surface, gpis=gpis)
            )
    compare(variants, scene, out / "ablation-encoding.jpg", 2)


def voxel_size(scene: Scene, out: Path) -> None:
    """Fig. 12: the surface at several voxel sizes, under our defaults."""
    default = uf.Config()
    variants = {
        f"{100 * size:g} cm": replace(default, surface=replace(default.surface, voxel_size=size))
        for size in VOXEL_SIZES
    }
    compare(variants, scene, out / "ablation-voxel-size.jpg", 3)


def kernel(scene: Scene | None, out: Path) -> None:
    """Fig. 13: mean |K - K^| of 2000 random points against eigenpairs l and anchors."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise SystemExit("ablation: the plot needs matplotlib: pip install matplotlib") from None

    figure = Figure(figsize=(8, 3), layout="constrained")
    rank, anchors = KEPT
    studies = (
        (
            "eigenpairs l",
            EIGENPAIRS,
            rank,
            lambda n, seed: EncoderSettings(rank=n, anchors=anchors, seed=seed),
        ),
        (
            "anchors",
            ANCHORS,
            anchors,
            lambda n, seed: EncoderSettings(rank=rank, anchors=n, seed=seed),
        ),
    )
    for axes, (what, values, kept, settings) in zip(figure.subplots(1, 2), studies, strict=True):
        rows = []
        for n in values:  # minutes in all
            print(f"{what} {n}, {SEEDS} seeds", file=sys.stderr, flush=True)
            rows.append([PositionEncoding(settings(n, s)).kernel_error() for s in range(SEEDS)])
        errors = np.array(rows)
        print(f"| {what} | " + " | ".join(map(str, values)) + " |\n|---|" + "---:|" * len(values))
        print(
            "| mean error | " + " | ".join(f"{e:.4f}" for e in errors.mean(axis=1)) + " |\n",
            flush=True,
        )
        axes.fill_between(values, errors.min(axis=1), errors.max(axis=1), alpha=0.25)
        axes.plot(values, errors.mean(axis=1), marker="o", markersize=3)
        axes.axvline(kept, color="grey", linestyle=":", linewidth=1)
        axes.set(
            xlabel=what,
            ylabel="mean |K - K^|",
            yscale="log",
            xscale="log" if what == "anchors" else "linear",
        )
        axes.grid(alpha=0.3, which="both")
    figure.savefig(out / "ablation-kernel.png", dpi=110)


STUDIES = {"encoding": encoding, "voxel-size": voxel_size, "kernel": kernel}


def run(
    studies: Sequence[str], scene_name: str, data: Path | None, frames: int | None, out: Path
) -> None:
    """Some of STUDIES on a scene, which the kernel's alone does not need."""
    uf.init()
    scene = SCENES[scene_name](data, frames) if set(studies) - {"kernel"} else None
    for name in studies:
        print(f"\n{name} ({STUDIES[name].__doc__.partition(':')[0]})\n", flush=True)
        STUDIES[name](scene, out)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--only",
        nargs="+",
        default=list(STUDIES),
        choices=list(STUDIES),
        metavar="STUDY",
        help=", ".join(STUDIES),
    )
    parser.add_argument(
        "--scene",
        default="synthetic",
        choices=list(SCENES),
        metavar="SCENE",
        help=", ".join(SCENES),
    )
    parser.add_argument("--frames", type=int, help="about how many frames to fuse")
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the recordings")
    parser.add_argument("--threads", type=int, help="CPU threads of Taichi (default: all)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    uf.init(threads=options.threads)
    run(options.only, options.scene, options.data, options.frames, options.out)


if __name__ == "__main__":
    main()
