"""Textured OBJ, USD and LAS: what other programs' readers find in them."""

from __future__ import annotations

import os

import numpy as np
import pytest

from taichi_unifusion.errors import FileError
from taichi_unifusion.files.las import write_las
from taichi_unifusion.files.obj import write_textured_obj
from taichi_unifusion.files.texture import Texture
from taichi_unifusion.files.usd import write_usd
from taichi_unifusion.types import Mesh

T_OUT_WORLD = np.array([[1, 0, 0, 0.5], [0, 0, 1, 0], [0, -1, 0, -2], [0, 0, 0, 1]], np.float64)


@pytest.fixture
def quad() -> Mesh:
    corners = np.array([[0, 0, 1], [2, 0, 1], [2, 1, 1], [0, 1, 1]], np.float32)
    return Mesh(
        corners,
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
        np.tile(np.float32([0, 0, 1]), (4, 1)),
        {"color": np.float32([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.5, 0.5]])},
    )


@pytest.fixture
def texture() -> Texture:
    image = np.zeros((8, 16, 3), np.uint8)
    image[:4] = [200, 40, 10]  # its upper half
    return Texture(np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32), image)


@pytest.mark.parametrize("image", ["png", "jpg"])
def test_obj_with_material_and_image(tmp_path, quad, texture, image):
    trimesh = pytest.importorskip("trimesh")
    written = write_textured_obj(tmp_path / "a.obj", quad, texture, T_OUT_WORLD, image)
    assert sorted(os.listdir(tmp_path)) == sorted(path.name for path in written)
    assert {path.suffix for path in written} == {".obj", ".mtl", f".{image}"}
    read = trimesh.load(tmp_path / "a.obj", process=False, force="mesh")
    moved = quad.vertices @ T_OUT_WORLD[:3, :3].T + T_OUT_WORLD[:3, 3]
    np.testing.assert_allclose(read.vertices, moved, atol=1e-5)
    assert np.array_equal(read.faces, quad.faces)
    np.testing.assert_allclose(read.vertex_normals, np.tile([0, 1, 0], (4, 1)), atol=1e-4)
    np.testing.assert_allclose(read.visual.uv, texture.coordinates * (1, -1) + (0, 1), atol=1e-6)
    shown = np.asarray(read.visual.material.image.convert("RGB"), int)
    assert np.abs(shown[:3] - [200, 40, 10]).max() < 12 and shown[-2:].max() < 12


def stage_of(path):
    usd = pytest.importorskip("pxr.Usd")
    return usd.Stage.Open(str(path))


@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_usd_holds_the_surface_upright_and_in_metres(tmp_path, quad, suffix):
    pytest.importorskip("pxr")
    from pxr import UsdGeom

    path = tmp_path / f"a{suffix}"
    assert write_usd(path, quad, None, T_OUT_WORLD, "jpg") == [path]
    stage = stage_of(path)
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/map/surface"))
    points = np.array(surface.GetPointsAttr().Get())
    assert np.array_equal(points, quad.vertices)
    T = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(surface.GetPrim())).T
    np.testing.assert_allclose(T, T_OUT_WORLD)
    assert (
        np.array(surface.GetFaceVertexIndicesAttr().Get()).tolist() == quad.faces.ravel().tolist()
    )
    assert surface.GetSubdivisionSchemeAttr().Get() == "none"
    color = np.array(surface.GetDisplayColorPrimvar().Get())
    # linear light: sRGB 0.5, to 8 bits 128 / 255, is 0.2158
    np.testing.assert_allclose(color, [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.2158605] * 3], atol=1e-6)


@pytest.mark.parametrize("image", ["png", "jpg"])
def test_usdz_is_one_compliant_file_with_its_texture(tmp_path, quad, texture, image):
    pytest.importorskip("pxr")
    from pxr import UsdGeom, UsdShade, UsdValidation

    path = tmp_path / "with a space.usdz"
    assert write_usd(path, quad, texture, T_OUT_WORLD, image) == [path]
    assert os.listdir(tmp_path) == [path.name]
    stage = stage_of(path)
    every = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(every).Validate(stage)
    assert len(every) > 10 and [error.GetErrorAsString() for error in found] == []
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/map/surface"))
    places = np.array(UsdGeom.PrimvarsAPI(surface).GetPrimvar("st").Get())
    np.testing.assert_allclose(places, texture.coordinates * (1, -1) + (0, 1), atol=1e-6)
    material, _ = UsdShade.MaterialBindingAPI(surface.GetPrim()).ComputeBoundMaterial()
    assert material.GetPath() == "/map/material"


def test_usdc_has_its_texture_beside_it(tmp_path, quad, texture):
    pytest.importorskip("pxr")
    from pxr import UsdShade

    path = tmp_path / "flat.usdc"
    written = write_usd(path, quad, texture, T_OUT_WORLD, "png")
    assert written == [path, tmp_path / "flat.png"] and len(os.listdir(tmp_path)) == 2
    stage = stage_of(path)
    image = UsdShade.Shader(stage.GetPrimAtPath("/map/material/image"))
    assert os.path.samefile(image.GetInput("file").Get().resolvedPath, tmp_path / "flat.png")


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("colored", [True, False])
def test_las_holds_points_to_a_tenth_of_a_millimetre(tmp_path, suffix, colored):
    laspy = pytest.importorskip("laspy")
    rng = np.random.default_rng(0)
    points = rng.normal(size=(500, 3)) * [30, 40, 2] + [5000, -900, 3]
    colors = rng.integers(0, 256, (500, 3), np.uint8) if colored else None
    path = tmp_path / f"a{suffix}"
    write_las(path, points, colors)
    read = laspy.read(path)
    np.testing.assert_allclose(read.xyz, points, atol=0.51e-4)
    assert read.header.version == laspy.header.Version(1, 2)
    if colored:
        shown = np.stack([read.red, read.green, read.blue], axis=1)
        assert np.array_equal(shown // 257, colors) and shown.max() > 60_000


def test_a_folder_that_is_not_there_is_said(tmp_path, quad, texture):
    pytest.importorskip("pxr")
    pytest.importorskip("laspy")
    for write in (
        lambda folder: write_textured_obj(folder / "a.obj", quad, texture, T_OUT_WORLD, "png"),
        lambda folder: write_usd(folder / "a.usdz", quad, texture, T_OUT_WORLD, "png"),
        lambda folder: write_las(folder / "a.las", quad.vertices, None),
    ):
        with pytest.raises(FileError, match="nowhere.*the folder does not exist"):
            write(tmp_path / "nowhere")
