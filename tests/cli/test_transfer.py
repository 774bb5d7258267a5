"""Properties through the pipeline and the command line: maps, meshes, pictures, and what happens
where they are missing.
"""

from __future__ import annotations

import json
import re
import runpy
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from tiny_networks import edge_detector, not_a_number
from tiny_recording import CONFIG, FLAGS, make_frames, write_folder

from taichi_unifusion import Pipeline, PropertyMap
from taichi_unifusion.cli import main as cli
from taichi_unifusion.config import dump_config, load_config
from taichi_unifusion.errors import InputError
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.properties import Look, SurfaceProperty
from taichi_unifusion.rendering.legend import HEIGHT
from taichi_unifusion.results import RunFolder, write_results
from taichi_unifusion.results.ownership import mark_unfinished

CONSTANT = 1e-3  # a constant comes back everywhere where the map is valid, rims included
DECIBELS = 1.0  # by which a property may be reproduced worse than colour, at equal voxel size
EIGHT_BITS = 0.5 / 255 + 1e-6
STALE = ("saliency.obj", "saliency.ply")
ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def frames():
    return make_frames(4)


@pytest.fixture(scope="module")
def recording(frames, tmp_path_factory):
    """Two frames as a folder, with infrared for the second one only."""
    folder = write_folder(tmp_path_factory.mktemp("data") / "recording", frames[:2])
    (folder / "infrared").mkdir()
    cv2.imwrite(str(folder / "infrared" / "1.png"), np.uint16(frames[1].color[..., 0]) * 100)
    return folder


def transfer(recording, out, *properties) -> int:
    chosen = [word for text in properties for word in ("--property", text)]
    return cli.main(["transfer", "folder", str(recording), *FLAGS, *chosen, "--out", str(out)])


@pytest.fixture(scope="module")
def made(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "made"
    out.mkdir()
    for name in STALE:
        (out / name).write_text("of an earlier run")
    mark_unfinished(RunFolder(out), STALE)
    assert (
        transfer(recording, out, "infrared,voxel_size=0.2", "saliency", "style=sketch,name=drawing")
        == 0
    )
    return out


def test_one_pass_gives_a_map_a_mesh_and_a_picture_each(made):
    names = {str(path.relative_to(made)) for path in made.rglob("*") if path.is_file()}
    for name in ("infrared", "saliency", "drawing"):
        assert {f"maps/{name}.safetensors", f"{name}.ply", f"{name}.glb", f"{name}.png"} <= names
    assert {
        "mesh.ply",
        "mesh.glb",
        "preview.png",
        "maps/surface.safetensors",
        "maps/color.safetensors",
    } <= names
    sizes = {
        name: PropertyMap.load(made / "maps" / f"{name}.safetensors").voxel_size
        for name in ("infrared", "saliency", "color")
    }
    assert sizes == {"infrared": 0.2, "saliency": 0.1, "color": 0.05}


def test_meshes_carry_the_values_and_their_colours(made):
    whole = read_mesh(made / "mesh.ply")
    shown = json.loads((made / "metrics.json").read_text())["properties"]
    for name, channels in (("infrared", 1), ("saliency", 1), ("drawing", 3)):
        mesh = read_mesh(made / f"{name}.ply")
        np.testing.assert_array_equal(mesh.attributes[name], whole.attributes[name])
        assert mesh.attributes[name].shape == (len(mesh.vertices), channels) and set(
            mesh.attributes
        ) == {"color", name}
        low, high = shown[name]["range"]
        if channels == 3:
            np.testing.assert_allclose(
                mesh.attributes["color"], np.clip(mesh.attributes[name], 0, 1), atol=EIGHT_BITS
            )
        else:  # the colour map gets lighter with the value
            lightness = cv2.cvtColor(
                mesh.attributes["color"][None].astype(np.float32), cv2.COLOR_RGB2Lab
            )[0, :, 0]
            inside = (mesh.attributes[name][:, 0] > low) & (mesh.attributes[name][:, 0] < high)
            assert np.corrcoef(lightness[inside], mesh.attributes[name][inside, 0])[0, 1] > 0.98
    assert shown["saliency"]["range"] == [0, 1] and shown["infrared"]["colormap"] == "inferno"
    picture = cv2.imread(str(made / "saliency.png"))
    assert picture.shape[0] == cv2.imread(str(made / "preview.png")).shape[0] + HEIGHT


def test_a_frame_that_lacks_a_property_adds_to_the_other_maps(made):
    metrics = json.loads((made / "metrics.json").read_text())
    assert metrics["frames"]["used"] == 2
    frames = {name: shown["frames"] for name, shown in metrics["properties"].items()}
    assert frames == {"infrared": 1, "saliency": 2, "drawing": 2}
    assert (
        len(
            [
                w
                for w in metrics["warnings"]
                if "no infrared image" in w and "add to the other maps only" in w
            ]
        )
        == 1
    )
    assert "infrared image" in metrics["milliseconds"] and metrics["maps"]["infrared"]["voxels"] > 0


def test_the_run_can_be_repeated_from_its_configuration(made):
    config = load_config(made / "config.yaml")
    assert config.properties == ("infrared,voxel_size=0.2", "saliency", "style=sketch,name=drawing")
    assert dump_config(config) == (made / "config.yaml").read_text()


def test_mesh_extracts_properties_again(made, capsys):
    before = read_mesh(made / "saliency.ply")
    (made / "saliency.png").write_bytes(b"of the old mesh")
    assert cli.main(["mesh", str(made), "--resolution", "2", "--device", CONFIG.device]) == 0
    said = capsys.readouterr().out
    for name in ("mesh", "saliency", "infrared", "drawing"):
        assert f"{name}.ply" in said and f"{name}.glb" in said
    after, whole = read_mesh(made / "saliency.ply"), read_mesh(made / "mesh.ply")
    assert 0 < len(after.faces) < 0.5 * len(before.faces) and len(after.faces) == len(whole.faces)
    np.testing.assert_array_equal(after.attributes["saliency"], whole.attributes["saliency"])
    assert set(after.attributes) == {"color", "saliency"}
    assert (made / "saliency.png").read_bytes()[:4] == b"\x89PNG"


def test_an_earlier_run_leaves_no_files_behind(made):
    assert (
        not (made / "saliency.obj").exists()
        and read_mesh(made / "saliency.ply").faces.shape[1] == 3
    )


def test_networks_run_and_a_property_that_no_frame_gives_costs_nothing_else(
    recording, tmp_path, capsys
):
    pytest.importorskip("onnxruntime")
    nothing, edges = not_a_number(tmp_path / "nan.onnx"), edge_detector(tmp_path / "edges.onnx")
    out = tmp_path / "out"
    assert (
        transfer(
            recording, out, f"style=onnx:{nothing}", f"saliency=onnx:{edges},mean=0/0/0,std=1/1/1"
        )
        == 2
    )
    said = capsys.readouterr().err
    assert (
        f"property 'style' is empty: none of 2 frames gave it (first: property 'style', {recording}"
        in said
    )
    assert "gives 100% NaN or infinite values" in said and "Traceback" not in said
    assert (out / "mesh.ply").exists() and not (out / "style.ply").exists()
    values = read_mesh(out / "saliency.ply").attributes["saliency"]
    # a field goes beyond what it was given where the surface ends
    low, high = np.percentile(values, (1, 99))
    assert low > -0.1 and 0.05 < high < 1.1 and values.min() > -0.5 and values.max() < 1.5


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "say what to map, with --property NAME; properties: infrared, saliency"),
        (["--property", "salency"], "property 'salency' is unknown (did you mean 'saliency'?)"),
        (
            ["--property", "saliency", "--property", "saliency"],
            "'saliency' is asked for twice; give one of them another name",
        ),
        (["--property", "saliency=onnx:none.onnx"], "none.onnx: no such file"),
    ],
)
def test_V4_what_cannot_be_mapped_is_said_before_the_first_frame(
    recording, tmp_path, capsys, arguments, told
):
    assert (
        cli.main(
            ["transfer", "folder", str(recording), *FLAGS, *arguments, "--out", str(tmp_path / "o")]
        )
        == 2
    )
    captured = capsys.readouterr()
    assert told in captured.err and "Traceback" not in captured.err


# --- The library ------------------------------------------------------------------------------------------------------

LEVEL = np.float32([0.37, 1.0, 0.02])
HELD_OUT = 2


def warmth(frame):
    """A function of one's own: how much redder than blue a surface is."""
    red, _, blue = np.moveaxis(frame.color / np.float32(255), 2, 0)
    return red - blue


def constant(frame):
    return np.broadcast_to(LEVEL, (*frame.depth.shape, 3))


def half(frame):
    """Every other column unknown."""
    return (
        np.where(np.arange(frame.depth.shape[1]) % 2, np.float32(0.25), np.float32(np.nan))
        + 0 * frame.depth
    )


def fails(frame):
    if frame.index > HELD_OUT:
        raise KeyError("no such thing")
    return frame.depth


OWN = [
    SurfaceProperty("warmth", 1, warmth, Look("diverging", (-1, 1), "red minus blue")),
    SurfaceProperty("constant", 3, constant),
    SurfaceProperty("half", 1, half),
]


@pytest.fixture(scope="module")
def fused(frames):
    """A pipeline with properties by name and of one's own, its run over all frames but one, and
    that frame with its images.
    """
    config = replace(
        CONFIG, properties=("infrared=linear,voxel_size=0.05", "style,voxel_size=0.05")
    )
    seen = [
        frame.with_image("infrared", np.float32(frame.color).mean(axis=2) * 257) for frame in frames
    ]
    pipeline = Pipeline(config, properties=OWN)
    run = pipeline.run([frame for frame in seen if frame.index != HELD_OUT])
    held_out = seen[HELD_OUT]
    for name in ("infrared", "style"):
        held_out = held_out.with_image(name, pipeline.sources[name].image(seen[HELD_OUT]))
    return pipeline, run, held_out


def test_a_function_of_ones_own_becomes_a_map(fused, tmp_path):
    pipeline, run, _ = fused
    results = write_results(tmp_path, pipeline, run)
    assert not results.failures and {"warmth.ply", "warmth.png", "maps/warmth.safetensors"} <= set(
        results.files
    )
    mesh = read_mesh(tmp_path / "mesh.ply")
    red_minus_blue = mesh.attributes["color"][:, :1] - mesh.attributes["color"][:, 2:]
    # in voxels of twice the size
    assert np.corrcoef(mesh.attributes["warmth"][:, 0], red_minus_blue[:, 0])[0, 1] > 0.8


def test_constant_images_come_back_constant(fused):
    """On a furnished room, at random points near the surface: wherever the map says that it is
    valid.
    """
    pipeline, _, _ = fused
    vertices = pipeline.extract_mesh().vertices
    rng = np.random.default_rng(5)
    points = np.repeat(vertices, 3, axis=0) + rng.uniform(-0.3, 0.3, (3 * len(vertices), 3))
    values, valid = pipeline.properties["constant"].query(points, return_valid=True)
    assert 0.2 < valid.mean() < 0.9 and np.abs(values[valid] - LEVEL).max() < CONSTANT


def test_values_that_are_no_numbers_are_left_out(fused):
    """Half of every image unknown: the other half is as if nothing were wrong, and no NaN comes
    out.
    """
    pipeline, _, _ = fused
    values, valid = pipeline.properties["half"].query(
        pipeline.extract_mesh().vertices, return_valid=True
    )
    assert (
        valid.mean() > 0.9
        and np.abs(values[valid] - 0.25).max() < CONSTANT
        and np.isfinite(values).all()
    )


def test_properties_are_reproduced_as_well_as_colour(fused):
    """On a frame that was not mapped, at its own points: infrared-like and style against colour, at
    equal voxel size.
    """
    pipeline, _, frame = fused
    v, u = np.nonzero(frame.depth)
    z, camera, T = frame.depth[v, u], frame.camera, frame.T_world_camera
    points = (
        np.column_stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
        @ T[:3, :3].T
        + T[:3, 3]
    )
    found = {}
    for name, image in (
        ("color", frame.color / 255),
        ("infrared", frame.images["infrared"]),
        ("style", frame.images["style"]),
    ):
        values, valid = pipeline.properties[name].query(points, return_valid=True)
        assert valid.mean() > 0.6
        found[name] = -10 * np.log10(np.square(values[valid] - image[v, u][valid]).mean())
    assert found["color"] > 15
    assert min(found["infrared"], found["style"]) > found["color"] - DECIBELS, found


def test_a_function_that_fails_ends_the_run_and_keeps_what_was_done(frames, monkeypatch):
    pipeline = Pipeline(CONFIG, properties=[SurfaceProperty("own", 1, fails)])
    run = pipeline.run(frames)
    assert len(run.steps) == HELD_OUT + 1 and isinstance(run.failure, InputError)
    assert "synthetic frame 3: its function failed with KeyError" in str(run.failure)


@pytest.mark.parametrize(
    ("app", "files"),
    [
        ("infrared", ["infrared.png"]),
        ("saliency", ["saliency.png"]),
        ("style", ["painting.png", "sketch.png"]),
    ],
)
def test_apps_run(recording, tmp_path, monkeypatch, app, files):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):  # or a window would wait for somebody
        monkeypatch.delenv(name, raising=False)
    runpy.run_path(str(ROOT / "apps" / f"{app}.py"))["main"](
        "folder", str(recording), str(tmp_path / "out")
    )
    assert all((tmp_path / "out" / name).exists() for name in files)


def test_the_page_on_properties_runs(tmp_path, monkeypatch):
    """Its example of a function of one's own, on smaller frames."""
    text = (ROOT / "docs" / "properties.md").read_text()
    (snippet,) = re.findall(r"```python\n(import numpy.*?)```", text, re.S)
    monkeypatch.chdir(tmp_path)
    smaller = snippet.replace(
        '"synthetic", frames=5)', '"synthetic", frames=60, width=160, height=120)[:1]'
    )
    assert smaller != snippet
    exec(compile(smaller, "properties.md", "exec"), {})
    assert (tmp_path / "results" / "warmth" / "warmth.png").exists()
