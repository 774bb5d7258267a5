"""What docs/python.md shows runs as it stands, block after block."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from places import DEVICE, ROOT

import taichi_unifusion as uf
from taichi_unifusion.files.mesh_reading import read_mesh


def test_the_page_on_python_runs(tmp_path, monkeypatch, capsys):
    uf.init(DEVICE)
    page = (ROOT / "docs" / "python.md").read_text()
    monkeypatch.chdir(tmp_path)
    names: dict = {"__name__": "python"}
    for block in re.findall(r"```python\n(.*?)```", page, re.S):
        exec(compile(block, "python.md", "exec"), names)
    out, err = capsys.readouterr()
    assert "6 came" in out and "nowhere: no such file" in err and names["code"] == 2
    assert len(read_mesh(tmp_path / "room.ply").faces) == len(names["mesh"].faces) > 10_000
    assert np.median(np.abs(names["distance"] - 0.02)[names["known"]]) < 0.005  # 2 cm in front
    assert names["known"].mean() > 0.9 and names["seen"].mean() > 0.9
    assert len(names["again"]) == len(names["surface"]) and len(names["half"].faces) > 0
    assert 0.2 < np.median(names["values"]) < 0.6 and len(names["by_hand"]) > 100
    assert len(names["mapped"].surface) == len(names["surface"])
    assert (
        Path(tmp_path / "results" / "room" / "mesh.ply")
        in Path("results/room").absolute().iterdir()
    )
