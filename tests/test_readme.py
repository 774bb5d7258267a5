"""The README's snippet runs as it stands."""

import re
from pathlib import Path

import numpy as np
import pytest

import taichi_unifusion as uf
from taichi_unifusion.files.mesh_reading import read_mesh

README = Path(__file__).parents[1] / "README.md"


def write_seven_scenes(folder: Path, frames: int) -> None:
    cv2 = pytest.importorskip("cv2")
    room = uf.open_dataset("synthetic", frames=12, width=160, height=120)
    K = room[0].camera.matrix
    np.savetxt(folder / "camera-intrinsics.txt", K)
    for n in range(frames):
        frame = room[n]
        cv2.imwrite(str(folder / f"frame-{n:06d}.color.png"), frame.color[..., ::-1])
        cv2.imwrite(
            str(folder / f"frame-{n:06d}.depth.png"), np.round(frame.depth * 1000).astype(np.uint16)
        )
        np.savetxt(folder / f"frame-{n:06d}.pose.txt", frame.T_world_camera)


def test_snippet_makes_a_colored_mesh(tmp_path, monkeypatch):
    (snippet,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.S)
    recording = tmp_path / "recording"
    recording.mkdir()
    write_seven_scenes(recording, 11)
    monkeypatch.chdir(tmp_path)
    exec(compile(snippet, "README.md", "exec"), {"path": recording})
    mesh = read_mesh(tmp_path / "kitchen.ply")
    assert len(mesh.faces) > 1000
    color = mesh.attributes["color"]
    assert color.shape == (len(mesh.vertices), 3) and color.std(axis=0).min() > 0.02, (
        "colours that vary over the room"
    )


def test_readme_is_short_and_names_no_missing_file():
    text = README.read_text()
    assert text.count("\n") < 150
    for target in re.findall(r"\]\((?!http)([^)#]+)\)", text):
        assert (README.parent / target).exists(), f"README links to {target}, which does not exist"
