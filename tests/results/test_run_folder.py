"""The folder of a run: one place knows the names of its files."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import taichi_unifusion
from taichi_unifusion.results import RunFolder

PACKAGE = Path(taichi_unifusion.__file__).parent
OWNER = PACKAGE / "results" / "run_folder.py"
NAMES = re.compile(
    r"\b(metrics\.json|config\.yaml|trajectory\.txt|tracking\.(csv|txt)|mesh\.(ply|glb|obj)|preview\.png"
    r"|query\.json|query-\S*\.|segmentation\.(json|ply|png)|maps/)|\.safetensors$"
)
SHOWN = ("metavar", "help", "help_behavior_hint")  # what --help says of a folder is no path
# these name their own kinds of files
FORMATS = ("files/maps.py", "files/tiles.py", "datasets/open3d_system.py")


def texts(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and value of every text in a program but docstrings and what --help shows."""
    skipped = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.keyword) and node.arg in SHOWN:
            skipped |= {id(inside) for inside in ast.walk(node.value)}
    for node in ast.walk(tree):
        if (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and id(node) not in skipped
        ):
            yield node.lineno, node.value


def test_no_other_file_names_the_files_of_a_run():
    found = [
        f"{file.relative_to(PACKAGE)}:{line}: {text!r}"
        for file in sorted(PACKAGE.rglob("*.py"))
        if file != OWNER and str(file.relative_to(PACKAGE)) not in FORMATS
        for line, text in texts(ast.parse(file.read_text(encoding="utf-8")))
        if NAMES.search(text)
    ]
    assert found == []


def test_every_name_stands_once():
    named = [text for _, text in texts(ast.parse(OWNER.read_text(encoding="utf-8")))]
    files = [text for text in named if NAMES.search(text)]
    assert len(files) >= 8 and len(files) == len(set(files))


def test_paths_are_those_that_users_know():
    folder = RunFolder(Path("results"))
    known = {
        "metrics.json": folder.record,
        "config.yaml": folder.config,
        "trajectory.txt": folder.trajectory,
        "tracking.csv": folder.tracking,
        "tracking.txt": folder.tracked_poses,
        "maps/color.safetensors": folder.map("color"),
        "mesh.ply": folder.mesh,
        "mesh.glb": folder.mesh_file("glb"),
        "preview.png": folder.preview,
        "style.obj": folder.property_mesh("style", "obj"),
        "style.png": folder.property_picture("style"),
        "query-sofa.ply": folder.answer_mesh("sofa"),
        "query-sofa.png": folder.answer_picture("sofa"),
        "query.json": folder.answers,
        "segmentation.ply": folder.segmentation_mesh,
        "segmentation.png": folder.segmentation_picture,
        "segmentation.json": folder.segmentation,
    }
    assert {name: folder.relative(path) for name, path in known.items()} == {n: n for n in known}


def test_a_folder_lists_what_is_there(tmp_path):
    folder = RunFolder(tmp_path)
    assert folder.maps == {} and folder.asked == folder.temporaries == ()
    folder.map_folder.mkdir()
    for file in (folder.map("surface"), folder.map("color"), folder.mesh, tmp_path / "photo.png"):
        file.touch()
    asked = {folder.answers, folder.answer_mesh("a"), folder.answer_picture("b")}
    asked.add(folder.segmentation_mesh)
    left = {tmp_path / ".mesh.ply.1234.tmp", folder.map_folder / ".x.tmp"}
    for file in asked | left:
        file.touch()
    assert folder.maps == {name: folder.map(name) for name in ("color", "surface")}
    assert set(folder.asked) == asked and set(folder.temporaries) == left
