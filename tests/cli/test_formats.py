"""`unifusion formats`, and the format that is found by the files."""

from __future__ import annotations

import json

import pytest
from phone_writers import views, write_polycam
from tiny_recording import FLAGS

from taichi_unifusion.cli import main as cli
from taichi_unifusion.datasets import FORMATS


def test_all_are_listed(capsys):
    assert cli.main(["formats"]) == 0
    out = capsys.readouterr().out
    assert all(f"\n{format} " in f"\n{out}" for format in FORMATS)
    assert max(map(len, out.splitlines())) <= 100


def test_one_is_explained(capsys):
    assert cli.main(["formats", "polycam"]) == 0
    out = capsys.readouterr().out
    for said in ("corrected_cameras/", "Known by: keyframes/", "min_confidence", "(default: 1)"):
        assert said in out
    assert cli.main(["formats", "polycan"]) == 2
    assert "did you mean 'polycam'" in capsys.readouterr().err


def test_auto_says_how_it_knew_and_keeps_what_it_found(tmp_path, capsys):
    path = write_polycam(tmp_path / "scan", views(count=2))
    out = tmp_path / "out"
    assert cli.main(["reconstruct", "auto", str(path), *FLAGS, "--out", str(out)]) == 0
    assert capsys.readouterr().err.count("format polycam: found cameras/T.json and depth/") == 1
    record = json.loads((out / "metrics.json").read_text())
    assert record["recording"]["format"] == "polycam"
    assert record["up"] == "recording"
    assert record["T_up_world"][2][:3] == pytest.approx([0, 1, 0])
