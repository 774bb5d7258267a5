"""Files that are packed as a whole by Zstandard, as `ros2 bag record --compression-mode file` does: what is
in them is found only after all that comes before, so they are unpacked into a temporary folder.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from pathlib import Path

from ..errors import DatasetError
from .chunked_bag import zstd

logger = logging.getLogger(__name__)

PACKED = (".zstd", ".zst")
PIECE = 4 << 20  # bytes at a time
MOST_TIMES, MOST_MORE = (
    100,
    64 << 20,
)  # what comes out: so many times the packed bytes, and so many more
SPARED = 256 << 20  # bytes of the disk that stay free


class Scratch:
    """A temporary folder for unpacked files, made when there is one."""

    def __init__(self) -> None:
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def unpacked(self, path: Path) -> tuple[Path, str]:
        """The file itself, or of a packed one what is in it, and what was wrong with it: one that is
        cut off gives what is before the cut. DatasetError where nothing comes out or there is no room.
        """
        if path.suffix.lower() not in PACKED:
            return path, ""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory(prefix="unifusion-")
        file = Path(self._folder.name) / path.with_suffix("").name
        logger.info("unpacking %s into %s", path.name, self._folder.name)
        problem = _unpack(path, file)
        if problem and not file.stat().st_size:
            raise DatasetError(problem)
        return file, problem

    def close(self) -> None:
        """Remove the folder."""
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None


def _unpack(path: Path, file: Path) -> str:
    """Write what is in a packed file; returns what was wrong with it."""
    module, written = zstd(), 0
    most = MOST_TIMES * os.path.getsize(path) + MOST_MORE
    with open(file, "wb") as target:
        try:
            with module.open(path, "rb") as source:
                while piece := source.read(PIECE):
                    written += len(piece)
                    if written > most:
                        return f"{path}: holds more than {MOST_TIMES} times its size; it is taken for damaged"
                    if shutil.disk_usage(file.parent).free < len(piece) + SPARED:
                        raise DatasetError(
                            f"{path}: no room to unpack it in {file.parent}; unpack it with zstd -d, or let TMPDIR "
                            "name a folder on a larger disk"
                        )
                    target.write(piece)
        except (module.ZstdError, EOFError, OSError) as error:
            return f"{path}: damaged or cut off ({error}); what is before that is used"
    return ""
