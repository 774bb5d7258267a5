"""One process at a time writes into a results folder."""

from __future__ import annotations

import fcntl
import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from ..errors import FileError
from ..files.atomic import check_writable, file_error
from .run_folder import RunFolder


@dataclass(frozen=True)
class Holder:
    """Who writes into a folder."""

    pid: int
    host: str
    since: str

    @classmethod
    def this(cls) -> Holder:
        return cls(os.getpid(), socket.gethostname(), time.strftime("%Y-%m-%d %H:%M:%S"))

    @classmethod
    def read(cls, path: Path) -> Holder | None:
        """Who wrote a lock file; None where it says nothing that makes sense."""
        try:
            values = json.loads(path.read_bytes()[:4096])
            return cls(int(values["pid"]), str(values["host"])[:80], str(values["since"])[:40])
        except (OSError, ValueError, KeyError, TypeError, RecursionError):
            return None

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host!r} since {self.since}"


@contextmanager
def lock_folder(folder: RunFolder, *, shared: bool = False) -> Iterator[None]:
    """Hold a folder while the block runs; several may hold it `shared`, to add answers.

    Raises FileError where another process holds it. The lock of a process that was killed does not
    count: the system took it from it. That of another machine does, for nobody here can tell
    whether that process lives.
    """
    check_writable(folder.path)
    path = folder.lock
    descriptor = _take(path, fcntl.LOCK_SH if shared else fcntl.LOCK_EX)
    try:
        if not shared:
            text = json.dumps(asdict(Holder.this())).encode()
            os.truncate(descriptor, 0)
            os.pwrite(descriptor, text, 0)
        yield
    finally:
        with suppress(OSError):  # another one may still share it
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()
        os.close(descriptor)


def who_writes(folder: RunFolder) -> Holder | None:
    """Who writes into a folder now, as far as this machine can tell."""
    try:
        descriptor = os.open(folder.lock, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return Holder.read(folder.lock)
    finally:
        os.close(descriptor)
    holder = Holder.read(folder.lock)
    return holder if holder is not None and holder.host != socket.gethostname() else None


def _take(path: Path, kind: int) -> int:
    """The open and locked file."""
    while True:
        try:
            flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
            descriptor = os.open(path, flags, 0o666)
        except OSError as error:
            raise file_error("lock", path, error) from error
        locks = True
        try:
            fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
        except BlockingIOError:
            holder = Holder.read(path)
            os.close(descriptor)
            raise FileError(
                f"{path.parent}: is in use by {holder or 'another process'}; wait until that has ended, or choose "
                "another folder"
            ) from None
        except OSError:  # a file system without locks: what the file says has to do
            locks = False
        if _is_still(path, descriptor):
            break
        os.close(descriptor)  # who held it has removed it meanwhile
    holder = Holder.read(path)
    if holder is not None and _may_live(holder, locks):
        os.close(descriptor)
        raise FileError(
            f"{path.parent}: is in use by {holder}, as {path.name} says; if that has ended, delete {path}"
        )
    return descriptor


def _is_still(path: Path, descriptor: int) -> bool:
    """Whether an open file is the one that the path names."""
    try:
        return os.path.samestat(os.stat(path), os.fstat(descriptor))
    except FileNotFoundError:
        return False


def _may_live(holder: Holder, locks: bool) -> bool:
    """Whether the holder named by a file that could be locked may still write."""
    if holder.host != socket.gethostname():
        return True
    return not locks and holder.pid != os.getpid() and Path(f"/proc/{holder.pid}").exists()
