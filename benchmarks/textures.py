"""Textured exports: how well frames that were not fused are rendered from a simplified mesh with a
texture, next to decoding the colour map where their rays hit the full mesh.

    python benchmarks/textures.py house-living --data PATH       # PATH holds aws-small-house
    python benchmarks/textures.py house-living --data PATH --texels 3 5 8 --triangles 0.1 0.25 1
    python benchmarks/textures.py synthetic --frames 20
    python benchmarks/textures.py house-living --data PATH --triangles 0.1 --picture docs/textures.jpg

Colours are compared as `unifusion evaluate rendering` does (docs/evaluation.md), the texture as it
comes out of its JPEG. The error is that of the simplified mesh against the full one. CPU seconds
count every thread. The picture shows a frame that was not fused, the texture, and vertex colours on the
same triangles.
"""

from __future__ import annotations

import argparse
import io
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from quality_scenes import DEPTH_RANGE, SCENES
from rich.console import Console
from rich.table import Table

import taichi_unifusion as uf
from taichi_unifusion.evaluation import evaluate_rendering
from taichi_unifusion.evaluation.rendering import render_frame
from taichi_unifusion.files.glb import write_glb
from taichi_unifusion.files.texture import Texture
from taichi_unifusion.rendering.baking import TexturedMesh, bake
from taichi_unifusion.rendering.raycaster import RayCaster
from taichi_unifusion.rendering.simplification import simplify, surface_error

T = TypeVar("T")
SHOWN = (480, 360)  # pixels of each picture
COLUMNS = (
    "what",
    "triangles",
    "PSNR dB",
    "SSIM",
    "depth L1 cm",
    "RMS mm",
    "99 % mm",
    "texture",
    "GLB MB",
    "CPU s",
)


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What `work` gives, and the processor seconds that it took."""
    start = time.process_time()
    made = work()
    return made, time.process_time() - start


def glb_megabytes(mesh: uf.Mesh, texture: Texture | None = None) -> float:
    file = io.BytesIO()
    write_glb(file, mesh, texture)
    return file.tell() / 1e6


def as_shown(textured: TexturedMesh) -> Texture:
    """The texture as viewers decode it."""
    data = np.frombuffer(textured.texture.encoded("jpg"), np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1]
    return replace(textured.texture, image=np.ascontiguousarray(image))


def draw(frame: uf.Frame, shown: Sequence[tuple[uf.Mesh, Texture | None]]) -> np.ndarray:
    """The frame and what its camera sees of some meshes, side by side, (H, W, 3) RGB."""
    images = [frame.color]
    for mesh, texture in shown:
        rendered = render_frame(RayCaster(mesh), frame, texture=texture)
        images.append((255 * rendered.color + 0.5).astype(np.uint8))
    return np.hstack([cv2.resize(image, SHOWN, interpolation=cv2.INTER_AREA) for image in images])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("scene", choices=list(SCENES))
    parser.add_argument("--data", type=Path, default=Path())
    parser.add_argument("--frames", type=int)
    parser.add_argument("--texels", type=float, nargs="+", default=[5.0], metavar="MM")
    parser.add_argument("--triangles", type=float, nargs="+", default=[0.25], metavar="SHARE")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--shown", type=int, default=10, metavar="N", help="which frame to draw")
    options = parser.parse_args()
    config = uf.Config()
    scene = SCENES[options.scene](options.data, options.frames)
    pipeline = uf.Pipeline(config)
    for frame in scene.frames:
        pipeline.step(frame)
    full = pipeline.extract_mesh()
    color = pipeline.properties["color"]
    near, far = DEPTH_RANGE
    table = Table(*COLUMNS, title=f"{scene.name}: {len(scene.frames)} frames fused")

    def add(what: str, mesh: uf.Mesh, rest: tuple[str, ...], **shown) -> None:
        result = evaluate_rendering(
            mesh,
            scene.held_out,
            depth_min=near,
            depth_max=min(far, config.preprocess.depth_max),
            **shown,
        )
        numbers = f"{result.psnr_db:.2f}", f"{result.ssim:.3f}", f"{result.depth_l1_cm:.2f}"
        table.add_row(what, f"{len(mesh.faces):,}", *numbers, *rest)

    size = f"{glb_megabytes(full):.1f}"
    add("decoded at ray hits", full, ("", "", "", size, ""), color=color.query)
    add("vertex colours", full, ("", "", "", size, ""))
    for share in options.triangles:
        mesh, spent = full, 0.0
        if share < 1:
            mesh, spent = timed(lambda share=share: simplify(full, round(share * len(full.faces))))
        error = surface_error(mesh, full)
        said = f"{error.rms_mm:.2f}", f"{error.p99_mm:.1f}"
        colored = mesh.with_attribute("color", color.query(mesh.vertices))
        size = f"{glb_megabytes(colored):.1f}"
        add("vertex colours", colored, (*said, "", size, f"{spent:.1f}"))
        for texel in options.texels:
            textured, baked = timed(
                lambda mesh=mesh, texel=texel: bake(
                    mesh,
                    lambda points: color.query(points, return_valid=True),
                    texel_m=texel / 1000,
                )
            )
            height, width = textured.texture.image.shape[:2]
            sizes = f"{width} x {height}", f"{glb_megabytes(textured.mesh, textured.texture):.1f}"
            add(
                f"texture, {1000 * textured.texel_m:.1f} mm",
                textured.mesh,
                (*said, *sizes, f"{spent + baked:.1f}"),
                texture=as_shown(textured),
            )
            shown = (textured.mesh, as_shown(textured)), (colored, None)
    if options.picture:
        image = draw(scene.held_out[options.shown], shown)
        cv2.imwrite(str(options.picture), image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
    Console(width=140).print(table)


if __name__ == "__main__":
    main()
