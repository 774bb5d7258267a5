"""`unifusion export`: what other programs find in every format, and what is said where that cannot be."""

from __future__ import annotations

import json
import shutil
from importlib import util
from pathlib import Path

import numpy as np
import pytest
from colored_results import make_colored_results
from places import DEVICE
from scipy.spatial import KDTree
from tiny_recording import make_frames
from validators import gltf_validator

from taichi_unifusion import load_map
from taichi_unifusion.cli import export as command
from taichi_unifusion.cli import main as cli
from taichi_unifusion.evaluation import evaluate_rendering
from taichi_unifusion.files.mesh_reading import read_any_mesh, read_mesh, read_textured_mesh

for module in ("xatlas", "fast_simplification"):
    pytest.importorskip(module)

TEXEL = "20"  # mm: voxels of colour are 5 cm here
FEW = ("--texel", "40", "--triangles", "600")  # quick, where colours do not matter
LOST_DB = 0.3  # that a texture on a quarter of the triangles may cost
SAME_COLOR = 1.01 / 255


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    return make_colored_results(tmp_path_factory.mktemp("export")).path


@pytest.fixture(scope="module")
def textured(results, tmp_path_factory) -> Path:
    """A textured GLB with a PNG, which loses nothing."""
    out = tmp_path_factory.mktemp("glb") / "room.glb"
    assert run(results, out, "--texel", TEXEL, "--image", "png") == 0
    return out


def run(results: Path, out: Path, *more: str) -> int:
    return cli.main(["export", str(results), str(out), "--device", DEVICE, *more])


# --- Textured -------------------------------------------------------------------------------------------------------


def test_a_quarter_of_the_triangles_keeps_the_colors(results, textured):
    full, (mesh, texture) = read_mesh(results / "mesh.ply"), read_textured_mesh(textured)
    assert len(mesh.faces) <= 0.27 * len(full.faces)
    color = load_map(results / "maps" / "color.safetensors")
    frames = make_frames(3)
    decoded = evaluate_rendering(full, frames, color=color.query)
    shown = evaluate_rendering(mesh, frames, texture=texture)
    fewer = mesh.with_attribute("color", color.query(mesh.vertices))
    assert shown.psnr_db > decoded.psnr_db - LOST_DB
    assert shown.psnr_db > evaluate_rendering(fewer, frames).psnr_db + LOST_DB


def test_a_textured_glb_is_judged_by_its_texture(results, textured, capsys):
    recording = results.parent / "recording"
    words = ["evaluate", "rendering", str(textured), "folder", str(recording), "--json"]
    assert cli.main([*words, "--device", DEVICE]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["colour"] == "texture" and found["psnr_db"] > 15


def test_a_textured_glb_is_valid_and_keeps_its_normals(textured):
    mesh = read_any_mesh(textured)
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)
    assert gltf_validator()(textured) == []


def test_the_error_and_the_texture_are_said(results, tmp_path, capsys):
    assert (
        run(
            results,
            tmp_path / "a.glb",
            "--triangles",
            "600",
            "--texel",
            "1",
            "--texture-size",
            "256",
        )
        == 0
    )
    said = capsys.readouterr().out.splitlines()
    assert "triangles: " in said[0] and "mm off the full mesh (RMS), 99 % within" in said[0]
    width, height = (int(word) for word in said[1].split()[2:5:2])
    texel = float(said[1].split()[-3])
    assert max(width, height) <= 256 and texel > 2
    assert said[2].startswith(f"{tmp_path / 'a.glb'}: ")


def test_numbers_of_triangles_may_be_given(results, tmp_path):
    assert run(results, tmp_path / "a.ply", "--triangles", "500") == 0
    mesh = read_mesh(tmp_path / "a.ply")
    assert 400 < len(mesh.faces) <= 525
    color = load_map(results / "maps" / "color.safetensors").query(mesh.vertices)
    np.testing.assert_allclose(mesh.attributes["color"], color.clip(0, 1), atol=SAME_COLOR)


# --- The other formats ----------------------------------------------------------------------------------------------


def test_vertex_colors_keep_the_mesh_as_it_is(results, tmp_path):
    full = read_mesh(results / "mesh.ply")
    for name in ("a.glb", "a.ply"):
        assert run(results, tmp_path / name, "--vertex-colors") == 0
        mesh = read_any_mesh(tmp_path / name)
        assert np.array_equal(mesh.vertices, full.vertices)
        np.testing.assert_allclose(mesh.attributes["color"], full.attributes["color"], atol=1e-6)


def test_obj_is_textured_and_upright(results, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    assert run(results, tmp_path / "a.obj", *FEW) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"a.obj", "a.mtl", "a.png"}
    read = trimesh.load(tmp_path / "a.obj", force="mesh", process=False)
    assert read.visual.material.image.size[0] > 64
    full = read_mesh(results / "mesh.ply")  # z is up in the synthetic room
    height = np.ptp(full.vertices[:, 2])
    assert np.ptp(read.vertices[:, 1]) == pytest.approx(height, abs=0.15)  # few triangles


@pytest.mark.parametrize("suffix", [".usdz", ".usdc"])
def test_usd_is_textured(results, tmp_path, suffix):
    usd = pytest.importorskip("pxr.Usd")
    assert run(results, tmp_path / f"a{suffix}", *FEW) == 0
    files = {path.name for path in tmp_path.iterdir()}
    assert files == ({"a.usdz"} if suffix == ".usdz" else {"a.usdc", "a.jpg"})
    stage = usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    assert stage.GetPrimAtPath("/map/surface").GetAttribute("primvars:st").Get()


def test_points_lie_evenly_on_the_surface(results, tmp_path):
    laspy = pytest.importorskip("laspy")
    assert run(results, tmp_path / "a.las", "--points", "3000") == 0
    assert run(results, tmp_path / "a.ply", "--points", "3000") == 0
    read, cloud = laspy.read(tmp_path / "a.las"), read_mesh(tmp_path / "a.ply")
    assert len(read.points) == len(cloud.vertices) == 3000 and len(cloud.faces) == 0
    np.testing.assert_allclose(read.xyz, cloud.vertices, atol=1e-4)
    shown = np.stack([read.red, read.green, read.blue], axis=1) / 65535
    np.testing.assert_allclose(shown, cloud.attributes["color"], atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    color = load_map(results / "maps" / "color.safetensors").query(cloud.vertices)
    np.testing.assert_allclose(cloud.attributes["color"], color.clip(0, 1), atol=SAME_COLOR)
    assert run(results, tmp_path / "b.las") == 0
    full = read_mesh(results / "mesh.ply")
    assert len(laspy.read(tmp_path / "b.las").points) == len(full.vertices)


def test_a_folder_for_engines_says_its_axes(results, tmp_path):
    folder = tmp_path / "room"
    assert run(results, folder, *FEW) == 0
    assert {path.name for path in folder.iterdir()} == {"room.glb", "README.txt"}
    said = (folder / "README.txt").read_text()
    T_up_world = json.loads((results / "metrics.json").read_text())["T_up_world"]
    assert "+Y up" in said and "metres" in said and "unlit" in said
    assert "  ".join(f"{x:9.5f}" for x in T_up_world[2]) in said
    assert run(results, folder, *FEW, "--lit") == 0
    assert "takes the engine's light on top" in (folder / "README.txt").read_text()
    assert gltf_validator()(folder / "room.glb") == []


def test_another_property_is_shown(results, tmp_path):
    assert run(results, tmp_path / "a.glb", *FEW, "--property", "saliency") == 0
    assert run(results, tmp_path / "a.ply", "--property", "saliency") == 0
    shown, full = read_mesh(tmp_path / "a.ply"), read_mesh(results / "mesh.ply")
    assert not np.allclose(shown.attributes["color"], full.attributes["color"], atol=0.1)
    mesh, texture = read_textured_mesh(tmp_path / "a.glb")
    nearest = KDTree(shown.vertices).query(mesh.vertices)[1]
    off = np.abs(texture.at(texture.coordinates) - shown.attributes["color"][nearest])
    assert np.median(off) < 0.05


def test_a_page_holds_every_layer(results, tmp_path, capsys):
    assert run(results, tmp_path / "a.html") == 0
    said, text = capsys.readouterr().out, (tmp_path / "a.html").read_text()
    triangles = len(read_mesh(results / "mesh.ply").faces)
    assert said.startswith(f"{tmp_path / 'a.html'}: {triangles:,} triangles, ")
    assert text.lstrip().lower().startswith("<!doctype html") and "http://" not in text


# --- What cannot be -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("out", "more", "message"),
    [
        ("a.stl", [], "a.stl: exports are written as .glb, .obj, .ply, .usdz"),
        ("a.glb", ["--points", "5"], "--points: needs at least one point, and OUT as .ply"),
        ("a.ply", ["--points", "0"], "--points: needs at least one point"),
        ("a.html", ["--triangles", "0.5"], "--triangles: must be more than 0, and OUT a mesh"),
        ("a.html", ["--property", "saliency"], "a page holds every property"),
        ("a.las", ["--triangles", "0.5"], "--triangles: must be more than 0, and OUT a mesh"),
        ("a.glb", ["--triangles", "-1"], "--triangles: must be more than 0"),
        ("a.glb", ["--texel", "0"], "wider than 0 m"),
        ("a.glb", ["--texture-size", "5"], "16..16384 texels a side"),
        ("a.glb", ["--property", "heat"], "shows no 'heat'; it shows color, saliency"),
        ("there.glb", [], "there.glb: is a folder already, and should be a file"),
        ("taken", [], "taken: is a file already, and should be a folder"),
    ],
)
def test_what_does_not_fit_is_one_sentence(results, tmp_path, capsys, out, more, message):
    (tmp_path / "there.glb").mkdir()
    (tmp_path / "taken").write_text("")
    assert run(results, tmp_path / out, *more) == 2
    error = capsys.readouterr().err.splitlines()
    assert message in error[-1] and error[-1].startswith("unifusion: error: ")
    assert {path.name for path in tmp_path.iterdir()} == {"there.glb", "taken"}


def test_a_folder_without_a_mesh_or_a_map_says_so(results, tmp_path, capsys):
    assert run(tmp_path, tmp_path / "a.glb") == 2
    assert "mesh.ply: no such file; give a results folder" in capsys.readouterr().err
    bare = shutil.copytree(results, tmp_path / "bare")
    (bare / "maps" / "color.safetensors").unlink()
    assert run(bare, tmp_path / "a.glb") == 2
    assert "keep every triangle with --vertex-colors" in capsys.readouterr().err
    assert run(bare, tmp_path / "a.glb", "--vertex-colors") == 0
    assert run(bare, tmp_path / "a.ply", "--points", "100") == 0
    assert "color" in read_mesh(tmp_path / "a.ply").attributes


@pytest.mark.parametrize(
    ("module", "out", "more", "message"),
    [
        (
            "xatlas",
            "a.glb",
            [],
            "needs xatlas: pip install 'taichi-unifusion[texture]', or use --v",
        ),
        ("fast_simplification", "a.ply", ["--triangles", "0.5"], "needs fast-simplification"),
        ("pxr", "a.usdz", [], "needs usd-core: pip install 'taichi-unifusion[usd]'"),
        ("laspy", "a.las", [], "needs laspy: pip install 'taichi-unifusion[las]'"),
    ],
)
def test_a_missing_package_is_named_before_any_work(
    results, tmp_path, monkeypatch, capsys, module, out, more, message
):
    monkeypatch.setattr(
        command, "find_spec", lambda name: None if name == module else util.find_spec(name)
    )
    assert run(results, tmp_path / out, *more) == 2
    assert message in capsys.readouterr().err and not any(tmp_path.iterdir())
