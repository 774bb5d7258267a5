"""GLB files: laid out as glTF 2.0 demands, what viewers show of them, and read back."""

from __future__ import annotations

import json
import os
import struct

import numpy as np
import pytest
from meshes import scattered
from validators import gltf_validator

from taichi_unifusion.errors import FileError, InputError
from taichi_unifusion.files.glb import write_glb
from taichi_unifusion.files.mesh_reading import read_any_mesh, read_textured_mesh
from taichi_unifusion.files.meshes import write_mesh
from taichi_unifusion.files.texture import Texture
from taichi_unifusion.types import Mesh

COLOR_STEP = 0.5 / 255 + 1e-6  # half a step of 8 bits, and float32 rounding


@pytest.fixture
def mesh() -> Mesh:
    return scattered(color=3)


@pytest.mark.parametrize("name", ["a.glb", "A.GLB"])
def test_glb_keeps_order_colors_and_normals(tmp_path, mesh, name):
    trimesh = pytest.importorskip("trimesh")
    mesh.save(tmp_path / name)
    (geometry,) = trimesh.load(tmp_path / name, process=False).geometry.values()
    assert np.array_equal(geometry.vertices, mesh.vertices) and np.array_equal(
        geometry.faces, mesh.faces
    )
    # trimesh holds float64, GLB float32
    np.testing.assert_allclose(geometry.vertex_normals, mesh.normals, atol=1e-6)
    # linear light, as glTF wants vertex colours: by trimesh's own formula
    np.testing.assert_allclose(
        trimesh.visual.color.linear_to_srgb(geometry.visual.vertex_attributes["color"]),
        mesh.attributes["color"],
        atol=COLOR_STEP,
    )


def test_our_glb_is_read_back_with_the_same_srgb_colors(tmp_path, mesh):
    steps = np.repeat(np.arange(50, dtype=np.float32)[:, None] / 255, 3, axis=1)  # the dark ones
    mesh = mesh.with_attribute("color", steps)
    up = np.eye(4)
    up[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    write_mesh(tmp_path / "a.glb", mesh, T_up_world=up)
    read = read_any_mesh(tmp_path / "a.glb")
    assert np.array_equal(read.vertices, mesh.vertices) and np.array_equal(read.faces, mesh.faces)
    np.testing.assert_allclose(read.normals, mesh.normals, atol=1e-6)
    assert np.array_equal(np.round(255 * read.attributes["color"]), 255 * steps)


def test_glb_of_another_program_is_still_read_by_trimesh(tmp_path, mesh):
    trimesh = pytest.importorskip("trimesh")
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / "a.glb")
    read = read_any_mesh(tmp_path / "a.glb")
    assert np.array_equal(read.vertices, mesh.vertices) and not read.attributes


def test_our_glb_truncated_anywhere_is_an_error(tmp_path, mesh):
    write_mesh(tmp_path / "a.glb", mesh)
    data = (tmp_path / "a.glb").read_bytes()
    for cut in range(0, len(data) - 1, 97):
        (tmp_path / "a.glb").write_bytes(data[:cut])
        with pytest.raises(FileError, match="a.glb"):
            read_any_mesh(tmp_path / "a.glb")


def glb_parts(data: bytes) -> tuple[dict, bytes]:
    """The JSON and the binary chunk of a GLB file, after its frame was found right."""
    magic, version, length, size, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON") and size % 4 == 0
    assert struct.unpack("<I4s", data[20 + size : 28 + size]) == (len(data) - 28 - size, b"BIN\0")
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def test_glb_is_laid_out_as_gltf_demands(tmp_path, mesh):
    write_mesh(tmp_path / "a.glb", Mesh(mesh.vertices, mesh.faces, None, mesh.attributes))
    said, body = glb_parts((tmp_path / "a.glb").read_bytes())
    (primitive,) = said["meshes"][0]["primitives"]
    assert primitive["attributes"].keys() == {"POSITION", "COLOR_0"}
    position = said["accessors"][primitive["attributes"]["POSITION"]]
    for end, values in (("min", mesh.vertices.min(0)), ("max", mesh.vertices.max(0))):
        assert position[end] == values.tolist()
    assert all(view["byteOffset"] % 4 == 0 for view in said["bufferViews"])
    view = said["bufferViews"][position["bufferView"]]
    stored = body[view["byteOffset"] :][: view["byteLength"]]
    assert np.array_equal(np.frombuffer(stored, "<f4").reshape(-1, 3), mesh.vertices)
    assert "matrix" not in said["nodes"][0]  # the world's up is not known


def test_glb_stands_with_y_up_where_up_is_known(tmp_path, mesh):
    # the world's y points down, as a camera's
    up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 2.5], [0, 0, 0, 1]], np.float64)
    write_mesh(tmp_path / "a.glb", mesh, T_up_world=up)
    said, _ = glb_parts((tmp_path / "a.glb").read_bytes())
    T_gltf_world = np.reshape(said["nodes"][0]["matrix"], (4, 4)).T
    np.testing.assert_allclose(T_gltf_world[:3, :3] @ [0, -1, 0], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(T_gltf_world @ [0, 0, 0, 1], [0, 2.5, 0, 1], atol=1e-12)
    assert np.linalg.det(T_gltf_world) == pytest.approx(1)


def test_glb_material_is_matt_and_shows_colors_as_they_are(tmp_path, mesh):
    def material(said: dict) -> tuple[dict, bool]:
        assert said.get("extensionsUsed", []) == list(said["materials"][0].get("extensions", {}))
        return said["materials"][0]["pbrMetallicRoughness"], "extensionsUsed" in said

    matt = {"metallicFactor": 0.0, "roughnessFactor": 1.0}
    for name, shown, lit, unlit in (
        ("colored", mesh, False, True),
        ("lit", mesh, True, False),
        ("plain", Mesh(mesh.vertices, mesh.faces), False, False),
    ):
        with open(tmp_path / f"{name}.glb", "wb") as file:
            write_glb(file, shown, lit=lit)
        said, _ = glb_parts((tmp_path / f"{name}.glb").read_bytes())
        assert material(said) == (matt, unlit), name


@pytest.mark.parametrize("image", ["png", "jpg"])
def test_glb_holds_a_texture(tmp_path, mesh, image):
    cv2 = pytest.importorskip("cv2")
    rng = np.random.default_rng(1)
    texture = Texture(
        rng.random((50, 2)).astype(np.float32),
        np.repeat(rng.integers(0, 256, (5, 6, 3), np.uint8), 8, axis=0).repeat(8, axis=1),
    )
    with open(tmp_path / "a.glb", "wb") as file:
        write_glb(file, mesh, texture, image=image)
    said, body = glb_parts((tmp_path / "a.glb").read_bytes())
    (primitive,) = said["meshes"][0]["primitives"]
    assert primitive["attributes"].keys() == {"POSITION", "NORMAL", "TEXCOORD_0"}
    view = said["bufferViews"][said["images"][0]["bufferView"]]
    stored = body[view["byteOffset"] :][: view["byteLength"]]
    shown = cv2.imdecode(np.frombuffer(stored, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
    assert shown.shape == texture.image.shape
    off = np.abs(shown.astype(int) - texture.image)
    assert off.max() == 0 if image == "png" else off.mean() < 3
    read, found = read_textured_mesh(tmp_path / "a.glb")
    assert "color" not in read.attributes and np.array_equal(read.vertices, mesh.vertices)
    assert np.array_equal(found.coordinates, texture.coordinates)
    assert np.array_equal(found.image, shown)


def test_glb_normals_have_unit_length(tmp_path, mesh):
    normals = 3 * mesh.normals
    normals[:3] = [[0, 0, 0], [np.nan, 0, 0], [1e-9, 0, 0]]
    write_mesh(tmp_path / "a.glb", Mesh(mesh.vertices, mesh.faces, normals))
    read = read_any_mesh(tmp_path / "a.glb").normals
    np.testing.assert_allclose(np.linalg.norm(read, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(read[3:], mesh.normals[3:], atol=1e-6)


@pytest.fixture(scope="module")
def validate():
    return gltf_validator()


@pytest.mark.parametrize("kind", ["colored", "lit", "plain", "upright", "jpg", "png"])
def test_glb_is_valid(tmp_path, mesh, validate, kind):
    texture = Texture(np.ones((50, 2), np.float32), np.zeros((8, 16, 3), np.uint8))
    up = np.eye(4)
    up[:3, :3] = [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]]
    arguments = {
        "colored": (mesh, None, {}),
        "lit": (mesh, None, {"lit": True}),
        "plain": (Mesh(mesh.vertices, mesh.faces), None, {}),
        "upright": (mesh, None, {"T_up_world": up}),
        "jpg": (mesh, texture, {}),
        "png": (mesh, texture, {"image": "png"}),
    }
    shown, image, options = arguments[kind]
    with open(tmp_path / "a.glb", "wb") as file:
        write_glb(file, shown, image, **options)
    assert validate(tmp_path / "a.glb") == []


def test_the_validator_is_asked(tmp_path, mesh, validate):
    write_mesh(tmp_path / "a.glb", mesh)
    data = (tmp_path / "a.glb").read_bytes().replace(b'"VEC3"', b'"VEC9"')
    (tmp_path / "a.glb").write_bytes(data)
    assert validate(tmp_path / "a.glb")


def test_glb_needs_finite_vertices_and_rgb(tmp_path, mesh):
    with pytest.raises(InputError, match="not finite"):
        write_mesh(tmp_path / "a.glb", Mesh(mesh.vertices * np.float32("nan"), mesh.faces))
    with pytest.raises(InputError, match="'color' must be"):
        write_mesh(tmp_path / "a.glb", mesh.with_attribute("color", np.zeros((50, 4))))
    assert os.listdir(tmp_path) == []
