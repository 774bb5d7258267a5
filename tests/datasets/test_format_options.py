"""The options of every format: known by name, type and sentence, and readable from text."""

from __future__ import annotations

from pathlib import Path

import pytest

from taichi_unifusion.cli import main as cli
from taichi_unifusion.datasets import (
    FORMATS,
    SENTENCES,
    format_options,
    open_dataset,
    parse_options,
)
from taichi_unifusion.errors import DatasetError, InputError


def test_every_option_has_a_sentence_and_no_sentence_is_left():
    options = {name for format in FORMATS for name in format_options(format)}
    assert options == set(SENTENCES)


@pytest.mark.parametrize(
    ("format", "texts", "options"),
    [
        ("k4a", ["align=color", "depth_scale=1e3"], {"align": "color", "depth_scale": 1000.0}),
        (
            "synthetic",
            ["frames=3", "noise=false", "seed=7"],
            {"frames": 3, "noise": False, "seed": 7},
        ),
        (
            "scene",
            ["trajectory=walk.txt", "noise=true"],
            {"trajectory": Path("walk.txt"), "noise": True},
        ),
        (
            "tum",
            ["max_difference=0.05", "drop_alpha=true"],
            {"max_difference": 0.05, "drop_alpha": True},
        ),
        ("folder", [], {}),
    ],
)
def test_options_from_text(format, texts, options):
    assert parse_options(format, texts) == options


def test_colour_may_be_written_so():
    assert parse_options("rosbag", ["colour_topic=none"]) == {"color_topic": "none"}
    with pytest.raises(InputError, match="given twice"):
        parse_options("rosbag", ["colour_topic=a", "color_topic=b"])
    assert cli.main(["check", "synthetic", "--end", "2", "--colour-camera=none"]) == 0


def test_options_from_text_open_a_recording():
    recording = open_dataset("synthetic", **parse_options("synthetic", ["frames=2", "width=32"]))
    assert len(recording) == 2


@pytest.mark.parametrize(
    ("format", "texts", "told"),
    [
        ("k4a", ["align=colour"], "option 'align': 'colour' is unknown .did you mean 'color'"),
        ("k4a", ["align"], "option 'align': give it as NAME=VALUE"),
        ("k4a", ["align=color", "align=depth"], "option 'align' is given twice"),
        ("tum", ["camera=640"], "option 'camera' cannot be given as text"),
        ("scene", ["classes=x"], "option 'classes' cannot be given as text"),
        (
            "synthetic",
            ["frame=2"],
            "'frame' is unknown for format 'synthetic' .did you mean 'frames'",
        ),
        ("synthetic", ["frames=2.5"], "option 'frames': expected a whole number, got '2.5'"),
        ("synthetic", ["noise=no"], "option 'noise': expected true or false, got 'no'"),
        ("tumm", [], "format 'tumm' is unknown .did you mean 'tum'"),
    ],
)
def test_options_that_do_not_fit_are_said(format, texts, told):
    with pytest.raises((InputError, DatasetError), match=told):
        parse_options(format, texts)
