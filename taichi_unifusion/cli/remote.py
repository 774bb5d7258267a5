"""Paths of other file systems in commands, as s3://bucket/results or memory://results: what is there is
copied here first, and what the command changed is copied back when it has ended.
"""

from __future__ import annotations

import dataclasses
import logging
import re
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Any

from ..errors import FileError, InputError, MissingDependency
from ..files.tiles import INDEX
from ..results.run_folder import RunFolder

logger = logging.getLogger(__name__)

URL = re.compile(r"([a-z][a-z0-9+.-]+):/+([^/].*)")  # pathlib leaves one slash of two
LACKING = "{}: paths of other file systems need fsspec: pip install 'taichi-unifusion[remote]'"

Stamp = tuple[int, int, int]  # what tells that a file was changed


@dataclass
class RemoteCopy:
    """A file or folder elsewhere, and its copy here."""

    url: str
    files: Any  # fsspec.AbstractFileSystem
    root: str
    local: Path
    before: dict[str, Stamp] = field(default_factory=dict)

    def download(self) -> None:
        """Copy everything here; nothing where there is nothing. Raises FileError."""
        with _named(self.url, "read"):
            if self.files.isfile(self.root):
                self.files.get_file(self.root, str(self.local))
            elif self.files.exists(self.root):
                for key in self.files.find(self.root):
                    name = PurePosixPath(key).relative_to(self.root)
                    if ".." in name.parts:
                        raise InputError(f"{self.url}: holds a file of the name {name}")
                    (self.local / name).parent.mkdir(parents=True, exist_ok=True)
                    self.files.get_file(key, str(self.local / name))
        self.before = _stamps(self.local)

    def upload(self) -> None:
        """Copy back what is new or changed, what names other files after them, and then remove what is
        gone. Raises FileError.
        """
        after = _stamps(self.local)
        changed = [name for name, stamp in after.items() if self.before.get(name) != stamp]
        gone = self.before.keys() - after.keys()
        with _named(self.url, "write"):
            for name in sorted(changed, key=_turn):
                key = f"{self.root}/{name}" if name else self.root
                self.files.makedirs(str(PurePosixPath(key).parent), exist_ok=True)
                self.files.put_file(str(self.local / name), key)
            for name in sorted(gone):
                self.files.rm_file(f"{self.root}/{name}")
        if changed or gone:
            logger.info("%s: %d files written, %d removed", self.url, len(changed), len(gone))


@contextmanager
def local_copies(options: Any) -> Iterator[Any]:
    """The options of a command with a local copy in the place of every path that lies elsewhere; what
    the block changes is copied back, also where it fails.

    Raises MissingDependency without fsspec, InputError for an unknown file system, FileError where a
    copy fails.
    """
    with tempfile.TemporaryDirectory(prefix="unifusion-") as folder:
        copies: dict[str, RemoteCopy] = {}

        def local(path: Path) -> Path:
            if (url := url_of(path)) is None:
                return path
            if url not in copies:
                there = Path(folder) / str(len(copies)) / PurePosixPath(url).name
                there.parent.mkdir()
                copies[url] = RemoteCopy(url, *_opened(url), there)
                copies[url].download()
            return copies[url].local

        try:
            yield _replaced(options, local)
        finally:
            for each in copies.values():
                each.upload()


def url_of(path: Path) -> str | None:
    """The address that a path stands for; None for one of this machine."""
    found = URL.fullmatch(str(path))
    return None if found is None else f"{found[1]}://{found[2]}"


def _opened(url: str) -> tuple[Any, str]:
    """The file system of an address, and the path there."""
    try:
        from fsspec.core import url_to_fs
    except ImportError:
        raise MissingDependency(LACKING.format(url)) from None
    try:
        files, root = url_to_fs(url)
    except (ImportError, ValueError) as error:
        raise InputError(f"{url}: cannot be reached ({error})") from None
    return files, root.rstrip("/")


def _replaced(value: Any, local: Callable[[Path], Path]) -> Any:
    """A value, of whatever depth, with other paths."""
    if isinstance(value, Path):
        return local(value)
    if isinstance(value, tuple):
        found = tuple(_replaced(each, local) for each in value)
        return value if found == value else found
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return value
    old = {each.name: getattr(value, each.name) for each in dataclasses.fields(value)}
    new = {name: _replaced(each, local) for name, each in old.items()}
    changed = {name: each for name, each in new.items() if each is not old[name]}
    return dataclasses.replace(value, **changed) if changed else value


def _stamps(path: Path) -> dict[str, Stamp]:
    """What is known of all files in a folder, by name, or of the file itself, by no name."""
    found = [path] if path.is_file() else [each for each in path.rglob("*") if each.is_file()]
    stats = {file.relative_to(path).as_posix(): file.stat() for file in found}
    return {
        "" if name == "." else name: (stat.st_ino, stat.st_size, stat.st_mtime_ns)
        for name, stat in stats.items()
    }


def _turn(name: str) -> tuple[int, str]:
    """Where a file comes in the order of writing."""
    last = (INDEX, RunFolder(Path()).record.name)
    file = PurePosixPath(name).name
    return (1 + last.index(file) if file in last else 0, name)


@contextmanager
def _named(url: str, verb: str) -> Iterator[None]:
    """Errors of a file system as FileError with the address."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{url}: cannot {verb}: {error}") from error
