"""Writes files into a run's folder so that one that fails does not cost the others."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from ..errors import FileError, InputError
from .run_folder import RunFolder

logger = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass
class FolderWriter:
    """Writes files into a folder; one that fails is remembered, and the others are still written."""

    folder: RunFolder
    written: list[Path] = field(default_factory=list)
    failures: list[Exception] = field(default_factory=list)

    @property
    def files(self) -> list[str]:
        """What was written, relative to the folder."""
        return [self.folder.relative(file) for file in self.written]

    def write(self, file: Path, write: Callable[[Path], object]) -> None:
        """Call `write` with the path of a file in the folder."""

        def action() -> bool:
            write(file)
            return True

        if self.attempt(f"{file}: could not be written", action):
            self.written.append(file)

    def attempt(self, what: str, action: Callable[[], T]) -> T | None:
        """The result of `action`, or None where it failed."""
        try:
            return action()
        except (FileError, InputError) as error:  # their messages name the file
            self.failures.append(error)
        except Exception as error:  # no error may cost the other files
            logger.debug("%s", what, exc_info=True)
            self.failures.append(
                FileError(f"{what} ({type(error).__name__}: {' '.join(str(error).split())[:200]})")
            )
        return None

    def remove(self, file: Path) -> None:
        """Remove a file of an earlier run that this run does not replace, so that results do not
        mix.
        """
        self.attempt(f"{file}: could not be removed", lambda: file.unlink(missing_ok=True))
