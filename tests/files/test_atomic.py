"""Atomic writing: a file is whole or unchanged, and every refusal says why."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from taichi_unifusion.errors import FileError
from taichi_unifusion.files.atomic import atomic_write, check_writable

REPO = Path(__file__).resolve().parents[2]


def run_python(code: str, *arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)],
        cwd=REPO,
        text=True,
        capture_output=True,
        timeout=60,
    )


def test_atomic_write_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    for text in ("first", "second"):
        with atomic_write(path) as temporary:
            assert temporary.parent == tmp_path
            temporary.write_text(text)
            assert not path.exists() or path.read_text() == "first"
        assert path.read_text() == text
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt(), SystemExit(1)])
def test_R3_exception_keeps_the_old_file_and_no_temporary(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(type(error)), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_atomic_write_follows_links_and_spares_what_is_no_file(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with atomic_write(tmp_path / "link.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
    with pytest.raises(FileError, match="not a regular file"), atomic_write(tmp_path):
        pass
    with (
        pytest.raises(FileError, match="folder does not exist"),
        atomic_write(tmp_path / "none" / "a") as temporary,
    ):
        temporary.write_text("x")


@pytest.mark.parametrize("name", ["mesh.ply", "map.safetensors"])
def test_R5_file_size_limit_leaves_the_old_file_and_says_why(tmp_path, name):
    code = """
        import resource, sys
        import numpy as np
        from taichi_unifusion.errors import FileError
        from taichi_unifusion.files.maps import write_map
        from taichi_unifusion.files.meshes import write_mesh
        from taichi_unifusion.types import Mesh

        def write(count):
            if sys.argv[1].endswith("ply"):
                write_mesh(sys.argv[1], Mesh(np.zeros((count, 3), np.float32), np.zeros((0, 3), np.int32)))
            else:
                write_map(sys.argv[1], {"F": np.zeros((count, 3), np.float32)}, {})
        write(100)
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
        try:
            write(100_000)
        except FileError as error:
            print(error)
        """
    result = run_python(code, tmp_path / name)
    assert result.returncode == 0, result.stderr
    assert name in result.stdout and "file-size limit" in result.stdout
    assert os.listdir(tmp_path) == [name]
    assert 1200 < (tmp_path / name).stat().st_size < 50_000  # the first 100 rows


def test_R6_unwritable_folder_is_an_error_and_a_writable_one_is_made(tmp_path):
    assert check_writable(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert os.listdir(tmp_path / "a" / "b") == []
    (tmp_path / "file").write_text("")
    for folder, reason in (
        (tmp_path / "file" / "out", "is a file, not a folder"),
        (tmp_path / "file", "stands in the way"),
    ):
        with pytest.raises(FileError, match=reason):
            check_writable(folder)
    if Path("/proc").is_dir():  # nobody may write there, root included
        with pytest.raises(FileError, match="cannot write results there"):
            check_writable("/proc/results")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_R6_read_only_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(FileError, match="permission is denied"):
        check_writable(tmp_path / "out")


def test_K2_io_needs_no_heavy_package(tmp_path):
    """Also the mesh files that every run writes: a second of import is a second of every run."""
    code = """
        import sys
        import numpy as np
        import taichi_unifusion.files.maps
        from taichi_unifusion import Mesh
        mesh = Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]], np.int32))
        for suffix in ("ply", "glb"):
            mesh.save(sys.argv[1] + "/a." + suffix)
        heavy = ("taichi", "trimesh", "scipy", "open3d", "torch", "cv2")
        print([m for m in heavy if m in sys.modules])
        """
    result = run_python(code, tmp_path)
    assert result.stdout.strip() == "[]", result.stderr
