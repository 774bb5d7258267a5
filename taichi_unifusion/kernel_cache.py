"""Where Taichi keeps compiled kernels on disk, made ready before it starts."""

from __future__ import annotations

import logging
import os
import time
from contextlib import suppress
from pathlib import Path
from tempfile import TemporaryFile, gettempdir, mkdtemp

STALE_LOCK = 60  # [s] Taichi locks its cache for a second or two

logger = logging.getLogger(__name__)


def open_kernel_cache(folder: str) -> str:
    """The folder, ready for Taichi, or another one where it cannot be used, which is said: Taichi
    would end the process. Raises OSError where no folder can.

    A lock that a killed process left there, under which every start would compile all kernels
    again, is removed; one from the future too, for the clock may have been set back.
    """
    if _can_be_used(Path(folder)):
        lock = Path(folder) / "ticache.lock"
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
