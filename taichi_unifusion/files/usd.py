"""A mesh as USD: `.usdc`, or packed with its texture as `.usdz`, which phones open; by usd-core."""

from __future__ import annotations

import tempfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, MissingDependency
from .atomic import atomic_write
from .glb import unit_normals
from .ply import Triangles, colors_of
from .srgb import LINEAR_OF_BYTE
from .texture import ImageKind, Texture

ROOT, SURFACE, MATERIAL = "/map", "/map/surface", "/map/material"


def write_usd(
    path: Path,
    mesh: Triangles,
    texture: Texture | None,
    T_out_world: NDArray,
    image: ImageKind,
) -> list[Path]:
    """Write `mesh` with its texture or its colours at the vertices, as linear light, and give the
    paths of what was written; the image lies beside a `.usdc`, within a `.usdz`.

    `T_out_world` (4, 4), rigid, is kept as the transform of the mesh's parent; y is up, units are
    metres. Raises FileError where a file cannot be written, MissingDependency without usd-core.
    """
    pxr = _pxr(path)
    packed = path.suffix.lower() == ".usdz"
    with tempfile.TemporaryDirectory() as folder:
        # names within a package need not be the user's
        stage = Path(folder) / (f"{path.stem}.usdc" if not packed else "map.usdc")
        picture = stage.with_suffix(f".{image}")
        if texture is not None:
            picture.write_bytes(texture.encoded(image))
        _write_stage(pxr, stage, mesh, texture, T_out_world, picture.name)
        made = {path: stage}
        if packed:
            made[path] = stage.with_suffix(".usdz")
            if not pxr.UsdUtils.CreateNewUsdzPackage(str(stage), str(made[path])):
                raise FileError(f"{path}: USD could not be packed")
        elif texture is not None:
            made[path.with_suffix(f".{image}")] = picture
        for target, source in made.items():
            with atomic_write(target) as temporary:
                temporary.write_bytes(source.read_bytes())
    return list(made)


def _pxr(path: Path) -> Any:
    """The modules of usd-core, whose members have no types."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdUtils, Vt
    except ImportError:
        raise MissingDependency(
            f"{path}: USD is written by usd-core: pip install 'taichi-unifusion[usd]'"
        ) from None
    return SimpleNamespace(
        Gf=Gf, Sdf=Sdf, Usd=Usd, UsdGeom=UsdGeom, UsdShade=UsdShade, UsdUtils=UsdUtils, Vt=Vt
    )


def _write_stage(
    pxr: Any,
    file: Path,
    mesh: Triangles,
    texture: Texture | None,
    T_out_world: NDArray,
    picture: str,
) -> None:
    UsdGeom, Vt = pxr.UsdGeom, pxr.Vt
    stage = pxr.Usd.Stage.CreateNew(str(file))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    root = UsdGeom.Xform.Define(stage, ROOT)
    # USD's vectors are rows
    root.AddTransformOp().Set(pxr.Gf.Matrix4d(T_out_world.T.tolist()))
    stage.SetDefaultPrim(root.GetPrim())
    surface = UsdGeom.Mesh.Define(stage, SURFACE)

    def rows(values: NDArray, kind: Any) -> Any:
        return kind.FromNumpy(np.ascontiguousarray(values, np.float32))

    surface.CreatePointsAttr(rows(mesh.vertices, Vt.Vec3fArray))
    surface.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(mesh.faces), 3, np.int32)))
    surface.CreateFaceVertexIndicesAttr(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces, np.int32).reshape(-1))
    )
    surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    ends = np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)])
    surface.CreateExtentAttr(rows(ends, Vt.Vec3fArray))
    if mesh.normals is not None:
        surface.CreateNormalsAttr(rows(unit_normals(mesh.normals), Vt.Vec3fArray))
        surface.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    colors = colors_of(mesh)
    if texture is not None:
        coordinates = texture.coordinates * (1, -1) + (0, 1)  # USD's run up
        places = UsdGeom.PrimvarsAPI(surface).CreatePrimvar(
            "st", pxr.Sdf.ValueTypeNames.TexCoord2fArray, UsdGeom.Tokens.vertex
        )
        places.Set(rows(coordinates, Vt.Vec2fArray))
        _bind_texture(pxr, stage, surface, picture)
    elif colors is not None:
        shown = surface.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        shown.Set(rows(LINEAR_OF_BYTE[colors], Vt.Vec3fArray))
    stage.GetRootLayer().Save()


def _bind_texture(pxr: Any, stage: Any, surface: Any, picture: str) -> None:
    """A matt material whose colour is read from the picture at the primvar `st`."""
    UsdShade, types = pxr.UsdShade, pxr.Sdf.ValueTypeNames
    material = UsdShade.Material.Define(stage, MATERIAL)

    def shader(name: str, kind: str, **inputs: tuple[Any, Any]) -> Any:
        made = UsdShade.Shader.Define(stage, f"{MATERIAL}/{name}")
        made.CreateIdAttr(kind)
        for key, (type_name, value) in inputs.items():
            made.CreateInput(key, type_name).Set(value)
        return made

    matt = shader(
        "matt", "UsdPreviewSurface", roughness=(types.Float, 1.0), metallic=(types.Float, 0.0)
    )
    place = shader("place", "UsdPrimvarReader_float2", varname=(types.String, "st"))
    image = shader(
        "image",
        "UsdUVTexture",
        file=(types.Asset, pxr.Sdf.AssetPath(picture)),
        sourceColorSpace=(types.Token, "sRGB"),
        wrapS=(types.Token, "clamp"),
        wrapT=(types.Token, "clamp"),
    )
    image.CreateInput("st", types.Float2).ConnectToSource(
        place.CreateOutput("result", types.Float2)
    )
    matt.CreateInput("diffuseColor", types.Color3f).ConnectToSource(
        image.CreateOutput("rgb", types.Float3)
    )
    material.CreateSurfaceOutput().ConnectToSource(matt.CreateOutput("surface", types.Token))
    UsdShade.MaterialBindingAPI.Apply(surface.GetPrim()).Bind(material)
