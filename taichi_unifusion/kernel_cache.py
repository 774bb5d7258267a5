"""Where Taichi keeps compiled kernels on disk, made ready before it starts."""

from __future__ import annotations

import logging
import os
import shutil
import sys
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile, gettempdir, mkdtemp

LOCK, LIST = "ticache.lock", "ticache.tcb"  # Taichi's names
STALE_LOCK = 60  # [s] Taichi locks its cache for a second or two

logger = logging.getLogger(__name__)


def open_kernel_cache(folder: str) -> str:
    """The folder, ready for Taichi, or another one where it cannot be used, which is said: Taichi
    would end the process. Raises OSError where no folder can.

    A lock that a killed process left there, under which every start would compile all kernels
    again, is removed; one from the future too, for the clock may have been set back.
    """
    if _can_be_used(Path(folder)):
        lock = Path(folder) / LOCK
        with suppress(OSError):
            if abs(time.time() - lock.stat().st_mtime) > STALE_LOCK:
                lock.unlink()
        return folder
    other = _folder_of_mine()
    logger.warning(
        "compiled kernels cannot be kept in %s, but in %s; TI_OFFLINE_CACHE_FILE_PATH names another "
        "folder",
        folder,
        other,
    )
    return str(other)


def _can_be_used(cache: Path) -> bool:
    """Whether this process can read and write the cache, which is made if need be."""
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with TemporaryFile(dir=cache):
            return all(os.access(file, os.R_OK | os.W_OK) for file in cache.glob("ticache*"))
    except OSError:
        return False


def _folder_of_mine() -> Path:
    """A folder for temporary files that nobody else can have put code into, for kernels are code."""
    folder = Path(gettempdir()) / f"taichi-kernels-of-{os.getuid()}"
    with suppress(OSError):
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if found.st_uid == os.getuid() and found.st_mode == 0o40700 and _can_be_used(folder):
            return folder
    return Path(mkdtemp(prefix="taichi-kernels-"))


def seed_kernel_cache(folder: Path) -> None:
    """Give a folder that is not there yet, or empty, the kernels of the fullest one beside it, or of
    this user's other processes, so that a new worker need not compile what others have.
    """
    if any(folder.glob("*")):
        return
    shared = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "taichi/ticache"
    sources = [each for each in (*folder.parent.glob("*"), shared) if (each / LIST).is_file()]
    fullest = max(sources, key=lambda each: len(list(each.glob("*.tic"))), default=None)
    if fullest is None:
        return
    folder.parent.mkdir(parents=True, exist_ok=True)
    copy = Path(mkdtemp(prefix=".new-", dir=folder.parent))
    try:
        # the list first: what it names is written before it
        for file in (fullest / LIST, *fullest.glob("*.tic")):
            shutil.copy2(file, copy)
        os.replace(copy, folder)
    except OSError:  # a file has just gone, or somebody else was quicker
        shutil.rmtree(copy, ignore_errors=True)


def write_kernels() -> None:
    """Let Taichi write the kernels that this process has compiled, and end: it does so by itself only
    where a process has time to end.
    """
    taichi = sys.modules.get("taichi")
    if taichi is not None:
        taichi.reset()
