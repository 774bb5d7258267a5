"""`unifusion export`: a results folder -> one file, or a folder, that other programs open."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..errors import InputError, MissingDependency
from ..results.run_folder import RunFolder
from ..results.tables import format_bytes
from .options import OPTIONAL, Device
from .terminal import DONE

if TYPE_CHECKING:
    from ..files.texture import ImageKind, Texture
    from ..results.export_source import ExportSource
    from ..types import Mesh

logger = logging.getLogger(__name__)

SHARE = 0.25  # of the triangles that a textured mesh keeps
# module, package, extra
TEXTURE, SIMPLER = (
    ("xatlas", "xatlas", "texture"),
    (
        "fast_simplification",
        "fast-simplification",
        "texture",
    ),
)
USD, LAS = ("pxr", "usd-core", "usd"), ("laspy", "laspy", "las")


@dataclass(frozen=True)
class Export:
    """Share a reconstruction: a file, or a folder, that other programs open.

    Example: unifusion export results/flat flat.glb

    OUT chooses: .glb, .obj, .usdz, .usdc: a textured mesh of a quarter of the triangles; .html: a page
    with every layer that opens without a network; .ply: the mesh with colours at its vertices, or
    with --points points; .las, .laz: points; a name without a suffix: a folder for game engines.
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """Results folder."""
    out: Annotated[Positional[Path], arg(metavar="OUT")]
    """What to write; its suffix chooses the format."""
    property: Annotated[str, arg(metavar="NAME")] = "color"
    """Show this property instead of colour, as infrared or saliency."""
    vertex_colors: FlagCreatePairsOff[bool] = False
    """Colours at the vertices of the full mesh, no texture."""
    triangles: Annotated[
        float | None, arg(metavar="N", help_behavior_hint="(default: 0.25 with a texture, else 1)")
    ] = None
    """How many triangles to keep: a share up to 1, or a number."""
    texel: Annotated[float, arg(metavar="MM")] = 5.0
    """Edge of a texel on the surface, in millimetres."""
    texture_size: Annotated[int, arg(metavar="N")] = 4096
    """Texels along an edge of the texture at most; texels get wider where more would be needed."""
    image: Annotated[
        Literal["jpg", "png"] | None, arg(help_behavior_hint="(default: png for .obj, else jpg)")
    ] = None
    """File type of the texture; png loses nothing and is several times as large."""
    lit: FlagCreatePairsOff[bool] = False
    """Let viewers light a .glb; by default they show the colours as they were recorded."""
    points: Annotated[int | None, arg(metavar="N", help_behavior_hint=OPTIONAL)] = None
    """Write so many points, evenly over the surface, to a .ply, .las or .laz; by default of .las as
    many as the mesh has vertices.
    """
    device: Device = "auto"
    """Where to compute."""


def export(options: Export) -> int:
    """Results folder -> what OUT says."""
    kind = options.out.suffix.lower()
    if kind not in (*WRITERS, PAGE):
        raise InputError(
            f"{options.out}: exports are written as {', '.join(filter(None, WRITERS))}, {PAGE} or a "
            f"folder, not as '{options.out.suffix}'"
        )
    _check(options, kind)
    from ..files.atomic import check_writable

    check_writable(options.out.parent)
    if kind == PAGE:
        from ..viewer.page import write_page
        from ..viewer.results_scene import open_scene

        print(f"{options.out}: {write_page(open_scene(options.dir), options.out)}")
        return DONE
    from ..results.export_source import read_export_source

    source = read_export_source(RunFolder(options.dir), options.property, options.device)
    files = WRITERS[kind](source, options)
    for file in files:
        print(f"{file}: {format_bytes(file.stat().st_size)}")
    return DONE


def _check(options: Export, kind: str) -> None:
    """Raise for options that do not fit, and for packages that are missing, before any work."""
    with_points = kind in POINTS or options.points is not None
    if kind == PAGE and (options.property != "color" or options.vertex_colors):
        raise InputError(f"{options.out}: a page holds every property, and chooses them itself")
    if options.points is not None and (kind not in (".ply", *POINTS) or options.points < 1):
        raise InputError("--points: needs at least one point, and OUT as .ply, .las or .laz")
    no_mesh = with_points or kind == PAGE
    if options.triangles is not None and (no_mesh or not options.triangles > 0):
        raise InputError("--triangles: must be more than 0, and OUT a mesh")
    if options.out.is_dir() != (kind == "") and options.out.exists():
        kinds = ("file", "folder") if kind == "" else ("folder", "file")
        raise InputError(f"{options.out}: is a {kinds[0]} already, and should be a {kinds[1]}")
    textured = kind in TEXTURED and not options.vertex_colors
    needed = [TEXTURE] * textured + [SIMPLER] * (_share(options, textured) != 1 and not with_points)
    needed += [USD] * (kind in (".usdz", ".usdc")) + [LAS] * (kind in POINTS)
    for module, package, extra in needed:
        if find_spec(module) is None:
            other = ", or use --vertex-colors" if extra == "texture" and textured else ""
            raise MissingDependency(
                f"{options.out}: needs {package}: pip install 'taichi-unifusion[{extra}]'{other}"
            )


def _share(options: Export, textured: bool) -> float:
    return options.triangles or (SHARE if textured else 1.0)


def _surface(source: ExportSource, options: Export) -> tuple[Mesh, Texture | None]:
    """The mesh to write, simplified and with a texture or colours at its vertices as asked for."""
    from ..rendering.simplification import simplify, surface_error

    full = source.mesh
    textured = options.out.suffix.lower() in TEXTURED and not options.vertex_colors
    wanted = _share(options, textured)
    count = round(wanted * len(full.faces)) if wanted <= 1 else int(wanted)
    mesh = full
    if count < len(full.faces):
        logger.info("simplifying %s triangles", f"{len(full.faces):,}")
        mesh = simplify(full, count)
        print(f"{len(mesh.faces):,} of {len(full.faces):,} triangles: {surface_error(mesh, full)}")
    if not textured:
        if mesh is not full:
            mesh = mesh.with_attribute("color", source.colors(mesh.vertices)[0])
        return mesh, None
    from ..rendering.baking import bake

    colors = source.colors
    logger.info("cutting the surface into charts and baking %s", source.name)
    made = bake(mesh, colors, texel_m=options.texel / 1000, max_side=options.texture_size)
    height, width = made.texture.image.shape[:2]
    print(f"texture of {width} x {height} texels, {1000 * made.texel_m:.1f} mm wide")
    return made.mesh, made.texture


def _image(options: Export) -> ImageKind:
    return options.image or ("png" if options.out.suffix.lower() == ".obj" else "jpg")


def _write_ply(source: ExportSource, options: Export) -> list[Path]:
    from ..files.meshes import write_mesh

    mesh = source.sample(options.points) if options.points else _surface(source, options)[0]
    write_mesh(options.out, mesh)
    return [options.out]


def _write_las(source: ExportSource, options: Export) -> list[Path]:
    from ..files.las import write_las
    from ..files.ply import colors_of

    cloud = source.sample(options.points or len(source.mesh.vertices))
    write_las(options.out, cloud.vertices, colors_of(cloud))
    return [options.out]


def _write_glb(source: ExportSource, options: Export) -> list[Path]:
    from ..files.atomic import atomic_write
    from ..files.glb import write_glb

    mesh, texture = _surface(source, options)
    with atomic_write(options.out) as temporary, open(temporary, "wb") as file:
        write_glb(
            file,
            mesh,
            texture,
            T_up_world=source.up.T_up_world,
            lit=options.lit,
            image=_image(options),
        )
    _say_up(source)
    return [options.out]


def _write_obj(source: ExportSource, options: Export) -> list[Path]:
    from ..files.glb import T_GLTF_UP
    from ..files.meshes import write_mesh
    from ..files.obj import write_textured_obj

    mesh, texture = _surface(source, options)
    T_out_world = T_GLTF_UP @ source.up.T_up_world
    _say_up(source)
    if texture is None:
        normals = None if mesh.normals is None else mesh.normals @ T_out_world[:3, :3].T
        write_mesh(options.out, replace(mesh.transformed(T_out_world), normals=normals))
        return [options.out]
    return write_textured_obj(options.out, mesh, texture, T_out_world, _image(options))


def _write_usd(source: ExportSource, options: Export) -> list[Path]:
    from ..files.glb import T_GLTF_UP
    from ..files.usd import write_usd

    mesh, texture = _surface(source, options)
    T_out_world = T_GLTF_UP @ source.up.T_up_world
    _say_up(source)
    return write_usd(options.out, mesh, texture, T_out_world, _image(options))


def _say_up(source: ExportSource) -> None:
    if source.up.how in ("cameras", "guess"):
        logger.info("%s", source.up.sentence)


def _write_engine_folder(source: ExportSource, options: Export) -> list[Path]:
    """A textured GLB, and how to bring it into an engine."""
    from ..files.atomic import check_writable, write_text

    folder = check_writable(options.out)
    glb, readme = folder / f"{folder.resolve().name}.glb", folder / "README.txt"
    _write_glb(source, replace(options, out=glb))
    low, high = (
        end.tolist() for end in (source.mesh.vertices.min(axis=0), source.mesh.vertices.max(axis=0))
    )
    write_text(
        readme,
        ENGINE_README.format(
            file=glb.name,
            material=LIT if options.lit else UNLIT,
            low=" ".join(f"{x:.2f}" for x in low),
            high=" ".join(f"{x:.2f}" for x in high),
            matrix="\n".join(
                "    " + "  ".join(f"{x:9.5f}" for x in row) for row in source.up.T_up_world
            ),
        ),
    )
    return [glb, readme]


UNLIT = """The material is
        unlit (KHR_materials_unlit); `unifusion export --lit` makes one that takes the engine's light."""
LIT = """The material is
        matt and takes the engine's light on top of these."""
ENGINE_README = """{file}: a reconstruction by taichi_unifusion, as glTF 2.0

Units   metres.
Axes    right-handed, +Y up, floor at y = 0 where one was found. Engines turn this to their own
        axes when they import glTF; Unity and Unreal also change to left-handed ones.
Colours in the texture, sRGB, as they were recorded: light and shadow are in them. {material}
Sides   triangles face free space, counter-clockwise; backs are culled, so that one sees into rooms.

Godot   4: copy the folder into the project and drag {file} into a scene.
Unity   with the package com.unity.cloud.gltfast: copy the folder into Assets.
Unreal  5: drag {file} into the Content Browser (plug-in "Interchange glTF", on by default).
Blender File > Import > glTF 2.0.

To robots: the map's own world is what the vertices in the file hold, from {low} to {high};
its one node turns them upright. From the map's world to a z-up frame on the floor:
{matrix}
"""

Writer = Callable[["ExportSource", Export], list[Path]]
WRITERS: dict[str, Writer] = {
    ".glb": _write_glb,
    ".obj": _write_obj,
    ".ply": _write_ply,
    ".usdz": _write_usd,
    ".usdc": _write_usd,
    ".las": _write_las,
    ".laz": _write_las,
    "": _write_engine_folder,
}
PAGE = ".html"
TEXTURED, POINTS = (".glb", ".obj", ".usdz", ".usdc", ""), (".las", ".laz")
