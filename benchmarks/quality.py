"""Quality of the maps against exact ground truth, held-out frames and Open3D's TSDF, all in one
run.

    python benchmarks/quality.py --data ../shared/data --out results/quality
    python benchmarks/quality.py --scenes synthetic --methods ours tsdf-1cm            needs no data
    python benchmarks/quality.py --scenes kitchen --methods ours mine.yaml tsdf-1cm    ours under another configuration

Prints a table, and one of depth and colour in those readings alone where the surface of every method is
hit; writes quality.json and, for every scene, pictures of held-out frames and of the worst regions. Surface
metrics compare 100,000 points each way, cropped to what the cameras saw; depth and colour are those of
held-out frames between the fused ones. Needs the extra open3d for the TSDF.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from quality_methods import METHODS, Reconstruction, method
from quality_pictures import REGIONS, compare, overview_frames, write_overview, write_worst
from quality_scenes import DEPTH_RANGE, SCENES, Scene
from quality_shared import SHARED_COLUMNS, render_held_out, score_shared

import taichi_unifusion as uf
from taichi_unifusion.errors import UniFusionError
from taichi_unifusion.evaluation import Viewpoints, evaluate_rendering, evaluate_surface
from taichi_unifusion.evaluation.rendering import FrameScore
from taichi_unifusion.files.atomic import check_writable
from taichi_unifusion.types import Frame

DATA = Path(
    os.environ.get("UNIFUSION_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")
)
COLUMNS = {  # title -> (where in a row's numbers, format)
    "Accuracy %": ("precision_2.5cm", ".1%"),
    "Completeness %": ("recall_2.5cm", ".1%"),
    "F1 2.5 cm": ("f1_2.5cm", ".1%"),
    "F1 1 cm": ("f1_1cm", ".1%"),
    "Depth L1 cm": ("depth_l1_cm", ".2f"),
    "median cm": ("depth_median_cm", ".2f"),
    "coverage": ("coverage", ".3f"),
    "PSNR dB": ("psnr_db", ".2f"),
    "SSIM": ("ssim", ".3f"),
    "map MB": ("map_mb", ".1f"),
    "of it surface": ("surface_mb", ".1f"),
    "lean MB": ("lean_mb", ".1f"),
    "of it surface ": ("lean_surface_mb", ".1f"),
    "ms a frame": ("cpu_ms", ".0f"),
}


def measure(
    reconstruction: Reconstruction, scene: Scene
) -> tuple[dict[str, float | None], tuple[FrameScore, ...]]:
    """All numbers of one row of the table, and the scores of the held-out frames."""
    near, far = scene.nearest, DEPTH_RANGE[1]
    numbers = {
        "map_mb": reconstruction.surface_mb + reconstruction.color_mb,
        "surface_mb": reconstruction.surface_mb,
        "color_mb": reconstruction.color_mb,
        "lean_mb": reconstruction.lean_mb,
        "lean_surface_mb": reconstruction.lean_surface_mb,
        "cpu_ms": reconstruction.cpu_ms,
        "wall_ms": reconstruction.wall_ms,
        "mesh_s": reconstruction.mesh_s,
        "triangles": len(reconstruction.mesh.faces),
    }
    rendering = evaluate_rendering(
        reconstruction.mesh,
        scene.held_out,
        color=reconstruction.color,
        depth_min=near,
        depth_max=far,
    )
    numbers.update({name: value for name, value in asdict(rendering).items() if name != "frames"})
    if scene.ground_truth is not None:
        views = Viewpoints(scene.frames[0].camera, scene.T_world_camera, near, far)
        surface = evaluate_surface(reconstruction.mesh, scene.ground_truth, views=views)
        numbers.update({name: value for name, value in asdict(surface).items() if name != "scores"})
        for score in surface.scores:
            at = f"{100 * score.threshold:g}cm"
            numbers.update(
                {
                    f"precision_{at}": score.precision,
                    f"recall_{at}": score.recall,
                    f"f1_{at}": score.f1,
                }
            )
    return numbers, rendering.frames


def worst_frames(scene: Scene, scores: Sequence[FrameScore]) -> list[Frame]:
    """The held-out frames with the smallest share of readings that a surface comes near to."""
    shares = [1.0 if score.depth_within is None else score.depth_within for score in scores]
    return [scene.held_out[i] for i in sorted(range(len(shares)), key=shares.__getitem__)[:REGIONS]]


def table(
    results: dict[str, dict[str, dict]], columns: Mapping[str, tuple[str, str]] = COLUMNS
) -> str:
    """Markdown, one block of rows a scene."""
    rows = [["scene", "method", *columns]]
    for scene, methods in results.items():
        for name, row in methods.items():
            values = [row["numbers"].get(key) for key, _ in columns.values()]
            rows.append(
                [
                    scene,
                    name,
                    *(
                        "-" if value is None else format(value, style).rstrip("%")
                        for value, (_, style) in zip(values, columns.values(), strict=True)
                    ),
                ]
            )
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    lines = [
        "| "
        + " | ".join(
            cell.ljust(width) if k < 2 else cell.rjust(width)
            for k, (cell, width) in enumerate(zip(row, widths, strict=True))
        )
        + " |"
        for row in rows
    ]
    rule = (
        "|"
        + "|".join(
            "-" * (width + 2) if k < 2 else "-" * (width + 1) + ":"
            for k, width in enumerate(widths)
        )
        + "|"
    )
    return "\n".join([lines[0], rule, *lines[1:]])


def write_results(folder: Path, results: dict[str, dict[str, dict]]) -> None:
    """Every number and setting so far."""
    (folder / "quality.json").write_text(json.dumps(results, indent=1, default=str))


def run(options: argparse.Namespace) -> dict[str, dict[str, dict]]:
    """Every method on every scene; what is done is written at once, so that a long run loses
    nothing.
    """
    results: dict[str, dict[str, dict]] = {}
    for scene_name in options.scenes:
        scene = SCENES[scene_name](options.data, options.frames)
        print(
            f"{scene_name}: {len(scene.frames)} frames fused, {len(scene.held_out)} held out",
            flush=True,
        )
        rows, pictures, rendered = results.setdefault(scene_name, {}), {}, {}
        for name in options.methods:
            reconstruction = method(name)(scene.frames, scene.nearest)
            label = Path(name).stem if name not in METHODS else name
            numbers, scores = measure(reconstruction, scene)
            rows[label] = {"numbers": numbers, "settings": reconstruction.settings}
            print(table({scene_name: {label: rows[label]}}).splitlines()[2], flush=True)
            if len(options.methods) > 1:
                rendered[label] = render_held_out(reconstruction, scene)
            if options.out:
                worst = compare(reconstruction, worst_frames(scene, scores))
                write_worst(options.out / f"worst-{scene_name}-{label}.jpg", worst)
                pictures[label] = compare(reconstruction, overview_frames(scene))
                write_results(options.out, results)
            del reconstruction
            gc.collect()  # maps give their memory back before the next are made
        for label, numbers in score_shared(rendered, scene.held_out, scene.nearest).items():
            rows[label]["numbers"].update(numbers)
        if options.out:
            write_results(options.out, results)
        if pictures:
            write_overview(options.out / f"{scene_name}.jpg", pictures)
    return results


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--scenes",
        nargs="+",
        default=list(SCENES),
        choices=list(SCENES),
        metavar="SCENE",
        help=", ".join(SCENES),
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        default=list(METHODS),
        metavar="METHOD",
        help=f"{', '.join(METHODS)}, tsdf-1cm-t8-w3 (truncation, weight) or FILE.yaml",
    )
    parser.add_argument(
        "--frames",
        type=int,
        help="about how many frames to fuse (default: every 5th of the house, 30, 60)",
    )
    parser.add_argument(
        "--data", type=Path, default=DATA, help=f"folder of the recordings (default: {DATA})"
    )
    parser.add_argument("--threads", type=int, help="CPU threads of Taichi (default: all)")
    parser.add_argument("--out", type=Path, help="folder for quality.json and the pictures")
    options = parser.parse_args()
    try:
        for name in options.methods:
            method(name)
        if options.out:
            check_writable(options.out)
        uf.init(threads=options.threads)
        results = run(options)
        print(table(results))
        if len(options.methods) > 1:
            print(
                "\nWhere the surface of every method is hit:\n\n" + table(results, SHARED_COLUMNS)
            )
    except UniFusionError as error:
        raise SystemExit(f"quality: {error}") from None
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
