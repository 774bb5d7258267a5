"""Reading and atomic writing of files, and why the file system refuses."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..errors import FileError, UniFusionError

_REASONS = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another folder",
    errno.EFBIG: "the file would pass the file-size limit of this process; raise it with ulimit -f",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.EACCES: "permission is denied; choose another folder or ask for access",
    errno.EPERM: "permission is denied; choose another folder or ask for access",
    errno.ENOENT: "the folder does not exist; create it first",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EEXIST: "a file of that name stands in the way",
    errno.EISDIR: "this is a folder, not a file",
    errno.ENAMETOOLONG: "the name is too long",
}


def file_error(verb: str, path: str | os.PathLike[str], error: OSError) -> FileError:
    """The FileError that says what could not be done where, and why."""
    reason = _REASONS.get(error.errno or 0) or error.strerror or str(error) or type(error).__name__
    return FileError(f"{path}: cannot {verb}: {reason}")


def check_name(path: str | os.PathLike[str]) -> None:
    """Raise FileError for a name that no file can have."""
    if "\0" in os.fspath(path):
        raise FileError(f"{os.fspath(path)[:200]!r}: a file's name cannot hold a zero byte")


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """The whole content of a file; raises FileError where it is missing or cannot be read."""
    path = Path(path)
    check_name(path)
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except OSError as error:
        raise file_error("read", path, error) from error


def check_writable(folder: str | os.PathLike[str]) -> Path:
    """Create `folder` where needed and write a test file in it; raises FileError that says why it
    cannot hold results.
    """
    folder = Path(folder)
    check_name(folder)
    probe = folder / f".{secrets.token_hex(4)}.tmp"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"test")
    except OSError as error:
        raise file_error("write results there", folder, error) from error
    finally:
        with suppress(OSError):
            probe.unlink()
    return folder


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Give a temporary path in the folder of `path`; what was written there replaces `path` when
    the block ends well.

    On any exception, Ctrl-C included, the temporary file is removed and an older file at `path`
    stays as it was. An OSError of the block (disk full, no permission) becomes a FileError that
    names `path` and the reason. A link keeps pointing where it does, and what it points to is
    replaced; one that another user made is refused.
    """
    path = _followed(Path(path))
    if path.exists() and not path.is_file():
        raise FileError(f"{path}: cannot write: this is not a regular file; choose another name")
    temporary = path.with_name(f".{path.name[:200]}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, path)
        with suppress(OSError):  # the file is in place; some file systems cannot sync a folder
            _flush_to_disk(path.parent)
    except UniFusionError:
        raise
    except OSError as error:
        raise file_error("write", path, error) from error
    finally:
        # already renamed on success; never made if the folder does not exist
        with suppress(OSError):
            temporary.unlink()


def _followed(path: Path) -> Path:
    """Where a path leads; raises FileError where a link of another user says so: whoever may write
    into a folder could choose which of our files is lost.
    """
    if path.is_symlink() and path.lstat().st_uid not in (os.geteuid(), 0):
        raise FileError(f"{path}: cannot write: this is a link of another user; remove it first")
    check_name(path)
    return Path(os.path.realpath(path))


def link_or_copy(file: Path, other: Path) -> None:
    """Let `other` be the same file, which nobody changes, or a copy where the disk has no links;
    raises OSError.
    """
    try:
        os.link(file, other)
    except FileExistsError:
        raise
    except OSError:
        shutil.copyfile(file, other)


def write_text(path: str | os.PathLike[str], text: str) -> None:
    """Write a text file atomically; raises FileError."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _flush_to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
