"""Textures of OBJ files as people have them: options before the name, other computers' paths, and
pictures that are not there.
"""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from taichi_unifusion.errors import DatasetError
from taichi_unifusion.rendering.textured_scene import load_scene

pytest.importorskip("trimesh")
Image = pytest.importorskip("PIL.Image")

OBJ = "mtllib {}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl a\nf 1/1 2/2 3/3\n"
RED = (200, 30, 10)


def scene(folder, texture: str, mtl: str = "a.mtl"):
    """A triangle whose material names `texture`; tex.png is there, in red."""
    Image.fromarray(np.full((4, 4, 3), RED, np.uint8)).save(folder / "tex.png")
    (folder / "a.obj").write_text(OBJ.format(mtl))
    (folder / "a.mtl").write_text(f"newmtl a\nKd 1 1 1\nmap_Kd {texture}\n")
    return load_scene(folder / "a.obj")


@pytest.mark.parametrize(
    "texture",
    [
        "tex.png",
        "-s 1 1 1 tex.png",
        "-blendu on -o 0 0 -mm 0 1 -clamp off tex.png",
        '"tex.png"',
        r"C:\models\chair\tex.png",
        "TEX.PNG",
        "textures/tex.png",
        "\t-s 1.0 1.0\ttex.png ",
    ],
)
def test_M_a_texture_is_found_behind_options_and_strange_paths(tmp_path, texture):
    read = scene(tmp_path, texture)
    assert not read.warnings
    assert (read.textures[0] == RED).all()


def test_M_a_texture_with_blanks_in_its_name_and_in_another_folder(tmp_path):
    (tmp_path / "obj").mkdir()
    Image.fromarray(np.full((4, 4, 3), RED, np.uint8)).save(tmp_path / "my tex.png")
    read = scene(tmp_path / "obj", "-s 1 1 1 ../my tex.png")
    assert not read.warnings and (read.textures[0] == RED).all()


@pytest.mark.parametrize(
    ("texture", "mtl", "told"),
    [
        ("gone.png", "a.mtl", "a.mtl: its texture gone.png is not there"),
        ("-s 1 1 1 gone.png", "a.mtl", "its texture gone.png is not there"),
        ("a.obj", "a.mtl", "its texture .*a.obj cannot be read"),
        ("tex.png", "gone.mtl", "a.obj: its material file gone.mtl is not there"),
        ("-s 2 2 1 tex.png", "a.mtl", "'-s 2 2 1' of texture tex.png is left out"),
    ],
)
def test_M_what_is_missing_is_said_once_with_its_name(tmp_path, texture, mtl, told):
    read = scene(tmp_path, texture, mtl)
    assert len(read.warnings) == 1
    assert re.search(told, read.warnings[0])


def test_M_several_material_files(tmp_path):
    (tmp_path / "b.mtl").write_text("newmtl b\nKd 0 1 0\n")
    for line in ("b.mtl a.mtl", "b.mtl\nmtllib a.mtl"):
        read = scene(tmp_path, "tex.png", line)
        assert not read.warnings and (read.textures[0] == RED).all()


def test_M_a_picture_missing_from_a_gltf_is_said(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    scene(tmp_path, "tex.png")
    trimesh.load_scene(tmp_path / "a.obj").export(tmp_path / "a.gltf")
    content = json.loads((tmp_path / "a.gltf").read_text())
    content["images"] = [{"uri": "gone.png"}]
    (tmp_path / "a.gltf").write_text(json.dumps(content))
    (told,) = load_scene(tmp_path / "a.gltf").warnings
    assert "a.gltf: its file gone.png is not there" in told


def test_an_obj_without_materials_and_a_missing_one(tmp_path):
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    assert not load_scene(tmp_path / "a.obj").warnings
    with pytest.raises((DatasetError, OSError)):
        load_scene(tmp_path / "gone.obj")
