"""Paths of other file systems: commands read and write there as they do here."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import fsspec
import pytest
from tiny_recording import FLAGS, make_frames, write_folder

from taichi_unifusion.cli.main import main
from taichi_unifusion.cli.remote import local_copies, url_of
from taichi_unifusion.errors import FileError, InputError, MissingDependency


@dataclass(frozen=True)
class Inner:
    out: Path
    more: tuple[Path, ...] = ()
    number: int = 3


@dataclass(frozen=True)
class Options:
    inner: Inner
    dir: Path


@pytest.fixture
def there():
    """A file system that lies elsewhere, empty."""
    files = fsspec.filesystem("memory")
    yield files
    files.rm("/", recursive=True)


def test_addresses_are_told_from_paths():
    assert url_of(Path("s3://bucket/a/b")) == "s3://bucket/a/b"
    assert url_of(Path("memory://x")) == "memory://x"
    for path in ("results/a", "/tmp/x", "a:b", "c:/x", "."):
        assert url_of(Path(path)) is None


def test_what_changes_is_written_back_and_indices_come_last(there, monkeypatch):
    there.pipe({"/a/old.txt": b"old", "/a/same.txt": b"same", "/a/deep/index.json": b"{}"})
    written = []
    put = type(there).put_file
    monkeypatch.setattr(
        type(there), "put_file", lambda self, a, b, **_: written.append(b) or put(self, a, b)
    )
    options = Options(Inner(Path("memory://b"), (Path("memory://a"), Path("x"))), Path("y"))
    with local_copies(options) as local:
        assert local.dir == Path("y") and local.inner.more[1] == Path("x")
        a, b = local.inner.more[0], local.inner.out
        assert a.name == "a" and not b.exists() and (a / "old.txt").read_bytes() == b"old"
        (a / "old.txt").unlink()
        (a / "deep" / "index.json").write_text("[1]")
        (a / "deep" / "tile").write_text("1")
        b.mkdir()
        (b / "metrics.json").write_text("new")
    assert written == ["/b/metrics.json", "/a/deep/tile", "/a/deep/index.json"]
    assert set(there.find("/")) == {
        "/a/same.txt",
        "/a/deep/tile",
        "/a/deep/index.json",
        "/b/metrics.json",
    }
    assert there.cat("/a/deep/index.json") == b"[1]" and not a.exists()


def test_what_a_failed_command_left_is_kept_too(there):
    with pytest.raises(FileError), local_copies(Path("memory://c")) as local:
        local.write_text("half")
        raise FileError("the disk is full")
    assert there.cat("/c") == b"half"


@pytest.mark.parametrize("url", ["nowhere://x", "s3://bucket/x"])
def test_an_unknown_file_system_is_said(url, monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(InputError, match="cannot be reached"), local_copies(Path(url)):
        pass


def test_without_fsspec_it_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec.core", None)
    with pytest.raises(MissingDependency, match=r"\[remote\]"), local_copies(Path("memory://x")):
        pass


def test_a_run_writes_elsewhere_and_is_read_from_there(there, tmp_path, capsys):
    recording = write_folder(tmp_path / "recording", make_frames(3))
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, "--mesh.formats", "ply"]
    arguments += ["--map-memory", "100MB", "--mesh.resolution", "1"]
    assert main([*arguments, "--out", "memory://results/kitchen"]) == 0
    assert {"/results/kitchen/metrics.json", "/results/kitchen/maps/surface/index.json"} < set(
        there.find("/results")
    )
    assert not [name for name in there.find("/results") if "unfinished" in name]
    capsys.readouterr()
    assert main(["info", "memory://results/kitchen"]) == 0
    assert "frames  3 used" in capsys.readouterr().out
    assert main(["mesh", "memory://results/kitchen", "--out", "memory://meshes/m.ply"]) == 0
    assert there.cat("/meshes/m.ply").startswith(b"ply")
