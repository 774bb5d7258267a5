"""The configuration: what a file may say, what it must not, and that what is printed reads back."""

from __future__ import annotations

import dataclasses
import time
from pathlib import Path

import pytest
import yaml

from taichi_unifusion.config import Config, MeshSettings, dump_config, load_config
from taichi_unifusion.errors import ConfigError, FileError, InputError
from taichi_unifusion.maps.settings import PropertySettings, SurfaceSettings

CONFIGS = sorted((Path(__file__).resolve().parents[1] / "configs").glob("*.yaml"))

CHANGED = Config(
    device="cpu",
    threads=3,
    surface=SurfaceSettings(voxel_size=0.03, gpis="derivatives"),
    color=PropertySettings(prior="zero", blend=False, noise=1e-3),
    mesh=MeshSettings(8, ("obj",)),
)


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "settings.yaml"
    path.write_text(text)
    return path


@pytest.mark.parametrize("config", [Config(), CHANGED], ids=["defaults", "changed"])
def test_what_is_printed_reads_back(tmp_path, config):
    assert load_config(write(tmp_path, dump_config(config))) == config


@pytest.mark.parametrize("text", ["", "# nothing\n", "surface:\n", "{}"])
def test_an_empty_file_or_section_changes_nothing(tmp_path, text):
    assert load_config(write(tmp_path, text), CHANGED) == CHANGED


def test_a_file_changes_what_it_says_and_nothing_else(tmp_path):
    text = "threads: 1\nsurface: {voxel_size: 1}\ncolor:\n  encoder: {rank: 12}\nmesh: {formats: [glb]}\n"
    config = load_config(write(tmp_path, text))
    base = Config()
    assert config == dataclasses.replace(
        base,
        threads=1,
        surface=dataclasses.replace(base.surface, voxel_size=1.0),
        color=dataclasses.replace(
            base.color, encoder=dataclasses.replace(base.color.encoder, rank=12)
        ),
        mesh=dataclasses.replace(base.mesh, formats=("glb",)),
    )
    assert type(config.surface.voxel_size) is float


def test_a_number_with_an_exponent_is_a_number(tmp_path):
    # text to YAML 1.1
    assert load_config(write(tmp_path, "color: {noise: 1e-3}")).color.noise == 1e-3


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("surfce: {}", ["'surfce'", "did you mean 'surface'?", "preprocess"]),
        (
            "surface: {voxel_siz: 1}",
            ["'surface.voxel_siz'", "did you mean 'voxel_size'?", "support_points"],
        ),
        ("color: {encoder: {ranks: 1}}", ["'color.encoder.ranks'", "did you mean 'rank'?"]),
        ("1: 2", ["unknown key '1'"]),
        ("surface: 3", ["surface: expected keys and values, got 3"]),
        ("- surface", ["expected keys and values"]),
        ("surface: {voxel_size: big}", ["surface.voxel_size: expected a number, got 'big'"]),
        ("surface: {voxel_size: [1]}", ["surface.voxel_size: expected a number"]),
        ("surface: {noise: .nan}", ["surface.noise: expected a number"]),
        ("surface: {noise: .inf}", ["surface.noise: expected a number"]),
        ("surface: {min_points: 2.5}", ["surface.min_points: expected a whole number, got 2.5"]),
        ("surface: {min_points: true}", ["surface.min_points: expected a whole number, got True"]),
        ("color: {blend: 1}", ["color.blend: expected true or false, got 1"]),
        ("device: cud", ["device: 'cud' is unknown (did you mean 'cuda'?)", "auto, cuda, cpu"]),
        ("mesh: {formats: ply}", ["mesh.formats: expected a list, got 'ply'"]),
        ("mesh: {formats: [ply, stl]}", ["mesh.formats[1]: 'stl' is unknown", "ply, glb, obj"]),
        ("surface: {voxel_size: -1}", ["in surface: voxel_size", "-1"]),
        ("mesh: {resolution: 99}", ["in mesh: resolution", "99"]),
        ("threads: -1", ["threads: must lie in 0..4096, got -1"]),
    ],
)
def test_I5_what_does_not_fit_is_named_by_its_path(tmp_path, text, told):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError) as raised:
        load_config(path)
    assert str(raised.value).startswith(f"{path}: ")
    for part in told:
        assert part in str(raised.value)


@pytest.mark.parametrize(
    "text",
    [
        "surface: [",
        "a: b: c",
        "threads: 1\nthreads: 2",
        "? [a]\n: 1",
        "x: 2001-99-99",
        "a: \0",
        "[" * 3000,
        "a: !!python/object/apply:os.getcwd []",
        "\xff",
    ],
)
def test_I5_what_is_no_plain_yaml_is_refused(tmp_path, text):
    path = tmp_path / "settings.yaml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(ConfigError, match="not valid YAML"):
        load_config(path)


def test_I5_no_code_runs(tmp_path):
    target = tmp_path / "made"
    path = write(tmp_path, f"threads: !!python/object/apply:os.mkdir ['{target}']")
    with pytest.raises(ConfigError):
        load_config(path)
    assert not target.exists()


def test_I5_a_bomb_of_aliases_gives_one_short_sentence(tmp_path):
    levels = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"] + [
        f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)
    ]
    with pytest.raises(ConfigError) as raised:
        load_config(write(tmp_path, "\n".join(levels) + "\nthreads: *a11\n"))
    assert len(str(raised.value)) < 1000
    with pytest.raises(ConfigError) as raised:
        load_config(write(tmp_path, "device: &a [&b [&c [1, 1, 1], *c, *c], *b, *b, *b]\n"))
    assert len(str(raised.value)) < 1000


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(FileError, match="none.yaml: no such file"):
        load_config(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    "build",
    [lambda: MeshSettings(resolution=0), lambda: MeshSettings(33), lambda: Config(threads=-1)],
)
def test_the_constructors_check_ranges(build):
    with pytest.raises(InputError):
        build()


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.name)
def test_shipped_files_load_and_hold_differences_only(path):
    def differs(values: dict, default: object, at: str = "") -> None:
        for key, value in values.items():
            if isinstance(value, dict):
                differs(value, getattr(default, key), f"{at}{key}.")
            else:
                assert value != getattr(default, key), f"{at}{key} is the default"

    load_config(path)
    differs(yaml.safe_load(path.read_text()), Config())


def test_paper_settings_are_those_published():
    config = load_config(CONFIGS[0].parent / "paper.yaml")
    assert (config.surface.voxel_size, config.surface.sample_distance, config.surface.gpis) == (
        0.05,
        0.1,
        "samples",
    )
    assert (config.color.voxel_size, config.color.prior, config.color.blend) == (
        0.02,
        "zero",
        False,
    )
    assert (config.surface.sampling, config.color.sampling, config.surface.support_points) == (
        "points",
        "points",
        0,
    )
    for settings in (config.surface, config.color):
        assert (settings.noise, settings.encoder.rank, settings.encoder.anchors) == (0.01, 20, 256)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("mesh: {min_area: .nan}", "min_area"),
        ("mesh: {min_area: -5}", "min_area: must lie in 0"),
        ("mesh: {formats: [ply, ply]}", "each once"),
        ("mesh: {formats: []}", "one or more"),
        ("surface: {encoder: {rank: 1000000000}}", "rank"),
        ("surface: {encoder: {anchors: 1000000000}}", "anchors"),
        ("surface: {encoder: {seed: -1}}", "seed"),
        ("surface: {encoder: {length_scale: .nan}}", "length_scale"),
        ("threads: " + "9" * 4000, "threads"),
        ("threads: 99999", "threads: must lie in 0..4096"),
        ("[" * 20_000, "nested values"),
        ("a: &a {b: 1}\nc: {<<: [*a, *a]}", "aliases"),
        ("a: 1\n" * 100_000, "more than the 65536"),
    ],
)
def test_c11_settings_that_cannot_be_are_refused_when_they_are_read(tmp_path, text, told):
    """I5 too: bombs of YAML, sizes, numbers without end."""
    path = tmp_path / "c.yaml"
    path.write_text(text)
    start = time.perf_counter()
    with pytest.raises(ConfigError, match=told):
        load_config(path)
    assert time.perf_counter() - start < 2
