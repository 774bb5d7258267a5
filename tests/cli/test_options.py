"""Options of commands: every option of a format is reached, kept and used again; help stays short."""

from __future__ import annotations

import json
import re
import shutil
from itertools import pairwise

import pytest
import yaml
from tiny_recording import FLAGS, make_frames, write_folder

from taichi_unifusion import datasets
from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli import options
from taichi_unifusion.cli.options import RecordingOptions, open_recording, source_of
from taichi_unifusion.config import Config, load_config
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.results import read_run


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A run of every second frame of a shorter and noiseless synthetic recording."""
    out = tmp_path_factory.mktemp("results") / "made"
    chosen = ["--option", "frames=5", "--option", "noise=false", "--every", "2", "--end", "3"]
    assert cli.main(["reconstruct", "synthetic", *chosen, *FLAGS, "--out", str(out)]) == 0
    return out


def test_options_of_a_format_are_kept_in_the_record_and_used_again(made, capsys):
    kept = json.loads((made / "metrics.json").read_text())["recording"]["reading"]
    assert kept == {"frames": 5, "noise": False}
    recording = read_run(made).recording
    assert len(recording) == 5
    assert (recording[1].depth == SyntheticRoom(frames=5, noise=False)[1].depth).all()
    arguments = ["evaluate", "rendering", str(made), "--device", FLAGS[1], "--json"]
    scores = []
    for more in ([], ["--option", "noise=true"]):
        assert cli.main([*arguments, *more]) == 0
        scores.append(json.loads(capsys.readouterr().out))
    assert [frame["index"] for frame in scores[0]["frames"]] == [1, 3]
    # noisy depth is farther from the same mesh
    assert scores[0]["depth_l1_cm"] < scores[1]["depth_l1_cm"]


def test_a_path_is_kept_as_text(tmp_path):
    poses = tmp_path / "poses.txt"
    source = source_of(RecordingOptions("scene", tmp_path, camera_path=poses), 3)
    assert source.reading == {"trajectory": str(poses)} and source.path == str(tmp_path)


def test_the_papers_way_to_read_an_azure_kinect(data):
    folder = data("k4a-infrared")
    file = sorted(folder.glob("*.mkv"))[0]
    depth, color = (
        open_recording(RecordingOptions("k4a", file, end=1, option=option))[0]
        for option in ((), ("align=color",))
    )
    assert color.color is not None and depth.color is not None
    assert color.depth.shape == color.color.shape[:2] != depth.depth.shape


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["--option", "nois=false"], "did you mean 'noise'?); options: frames, width"),
        (["--option", "noise=maybe"], "option 'noise': expected true or false, got 'maybe'"),
        (["--option", "noise"], "option 'noise': give it as NAME=VALUE"),
        (["--option", "seed=1", "--option", "seed=2"], "option 'seed' is given twice"),
        (["--option", "align=color"], "option 'align' is unknown for format 'synthetic'"),
    ],
)
@pytest.mark.parametrize("command", ["reconstruct", "transfer", "understand"])
def test_wrong_options_are_told(command, arguments, told, tmp_path, capsys):
    more = {"transfer": ["--property", "style"], "understand": ["--features", "folder:x"]}
    out = ["--out", str(tmp_path / "out")]
    assert cli.main([command, "synthetic", *arguments, *more.get(command, []), *out]) == 2
    assert told in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_an_option_that_has_a_flag_is_given_once(tmp_path, capsys):
    folder = write_folder(tmp_path / "recording", make_frames(1))
    twice = ["--depth-scale", "1000", "--option", "depth_scale=1000"]
    out = ["--out", str(tmp_path / "out")]
    assert cli.main(["reconstruct", "folder", str(folder), *twice, *out]) == 2
    assert "option 'depth_scale' is given twice, once with --option" in capsys.readouterr().err


@pytest.mark.parametrize("tracking", ["given", "internal"])
def test_a_recording_is_opened_once(tracking, tmp_path, monkeypatch):
    opened = []

    def counted(*arguments, **given):
        opened.append(arguments)
        return datasets.open_dataset(*arguments, **given)

    monkeypatch.setattr(options, "open_dataset", counted)
    arguments = ["reconstruct", "synthetic", "--end", "2", "--tracking", tracking, *FLAGS]
    assert cli.main([*arguments, "--out", str(tmp_path / "out")]) == 0
    assert len(opened) == 1


def test_understand_opens_a_recording_once(tmp_path, monkeypatch, capsys):
    opened = []
    monkeypatch.setattr(options, "open_dataset", lambda *a, **o: opened.append(a) or make_dataset())

    def make_dataset():
        return SyntheticRoom(frames=2)

    features = ["--features", f"folder:{tmp_path / 'none'}"]
    assert cli.main(["understand", "synthetic", *features, "--out", str(tmp_path / "out")]) == 2
    assert len(opened) == 1


@pytest.mark.parametrize("command", ["reconstruct", "transfer", "understand"])
def test_help_does_not_list_the_settings(command, capsys):
    assert cli.main([command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert "--tracking" in shown and "--option KEY=VALUE" in shown
    assert "--surface.voxel-size" not in shown.replace("--surface.voxel-size 0.03", "")
    assert not re.search(r"--(recording|poses|output|settings)\.", shown)


def test_evaluation_takes_a_recording_of_another_format_with_its_options(made, tmp_path, capsys):
    """Options of the run's format are not handed to another one."""
    copy = shutil.copytree(made, tmp_path / "copy")
    folder = write_folder(tmp_path / "recording", make_frames(3))
    arguments = ["evaluate", "rendering", str(copy), "folder", str(folder), "--device", FLAGS[1]]
    assert cli.main([*arguments, "--option", "noise=false"]) == 2
    assert "option 'noise' is unknown for format 'folder'" in capsys.readouterr().err
    assert cli.main([*arguments, "--option", "depth_scale=1000"]) == 0


COMMANDS = [
    ["reconstruct"],
    ["transfer"],
    ["understand"],
    ["query"],
    ["segment"],
    ["view"],
    ["render"],
    ["mesh"],
    ["export"],
    ["info"],
    ["config"],
    *(["evaluate", metric] for metric in ("surface", "trajectory", "rendering", "segmentation")),
]


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_is_whole_sentences_without_empty_defaults(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "90")
    assert cli.main([*command, "--help"]) == 0
    shown = capsys.readouterr().out
    assert "(default: )" not in shown and "(default: False)" not in shown
    rows = [line.strip("│|").rstrip() for line in shown.partition("options")[2].splitlines()]
    width, breaks = max(map(len, rows)), 0
    for row, after in pairwise(rows):
        indent = len(row) - len(row.lstrip())
        if indent > 4 and after[:indent].isspace() and after[indent : indent + 1].strip():
            breaks += 1  # where the next word does not fit any more
            assert len(row) + 1 + len(after.split()[0]) > width - 1, f"{row!r} {after!r}"
    assert breaks > 10 or command != ["config"]


def test_help_lists_first_what_people_need_first(capsys):
    cli.main(["reconstruct", "--help"])
    flags = re.findall(r"^[│| ]? *(--\w[\w-]+)", capsys.readouterr().out, re.MULTILINE)
    assert flags[:4] == ["--detail", "--voxel-size", "--depth-max", "--device"]


def test_short_names_of_settings_are_the_settings(capsys):
    assert cli.main(["config", "--depth-max", "3", "--depth-min=0.2"]) == 0
    values = yaml.safe_load(capsys.readouterr().out)
    assert (values["preprocess"]["depth_max"], values["preprocess"]["depth_min"]) == (3.0, 0.2)


def test_config_explains_every_setting(capsys, tmp_path):
    assert cli.main(["config", "--voxel-size", "0.02"]) == 0
    shown = capsys.readouterr().out
    lines = shown.splitlines()
    for i, line in enumerate(lines):
        if line and not line.lstrip().startswith("#"):
            assert lines[i - 1].lstrip().startswith("#"), line
    file = tmp_path / "all.yaml"
    file.write_text(shown)
    assert load_config(file) == Config(voxel_size=0.02)
