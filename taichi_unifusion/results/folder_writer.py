"""Writes files into a run's folder so that one that fails does not cost the others."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

from ..errors import FileError, InputError, UniFusionError
from ..files.tiles import INDEX, TileFolder
from .ownership import mark_unfinished, owned_files
from .run_folder import RunFolder

logger = logging.getLogger(__name__)

T = TypeVar("T")


@dataclass
class FolderWriter:
    """Writes files into a folder; one that fails is remembered, and the others are still written."""

    folder: RunFolder
    written: list[Path] = field(default_factory=list)
    failures: list[Exception] = field(default_factory=list)
    # names of files that runs wrote, this one's too, kept in a mark; None: nothing is marked
    marked: set[str] | None = None

    @classmethod
    def marking(cls, folder: RunFolder, written: Sequence[Path] = ()) -> FolderWriter:
        """A writer that marks the folder as unfinished, from now until a record is written.

        `written` are files of this run that are there already.
        """
        owned = {*owned_files(folder), *map(folder.relative, written)}
        writer = cls(folder, list(written), marked=owned)
        writer.attempt(f"{folder.record}: could not be marked", writer.mark)
        return writer

    def mark(self) -> None:
        """Keep in the mark what there is by now."""
        mark_unfinished(self.folder, self.marked or ())

    @property
    def of_others(self) -> tuple[str, ...]:
        """Files that earlier runs wrote, and this one did not write anew."""
        names = sorted({*(self.marked or ())} - {*self.files, self.folder.record.name})
        return tuple(name for name in names if (self.folder.path / name).exists())

    @property
    def files(self) -> list[str]:
        """What was written, relative to the folder."""
        return [self.folder.relative(file) for file in self.written]

    def write(self, file: Path, write: Callable[[Path], object]) -> None:
        """Call `write` with the path of a file in the folder."""

        def action() -> bool:
            write(file)
            return True

        name = self.folder.relative(file)
        if self.marked is not None and name not in self.marked:
            self.marked.add(name)
            with suppress(UniFusionError):  # said when the first mark could not be made
                self.mark()
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
        mix; one that no run wrote stays.
        """
        if self.folder.relative(file) not in (self.marked or owned_files(self.folder)):
            return
        gone = [file]
        if file.name == INDEX:
            tiles = self.attempt(f"{file}: could not be read", lambda: TileFolder.open(file.parent))
            gone = [] if tiles is None else tiles.files
        for each in gone:
            self.attempt(
                f"{each}: could not be removed", lambda each=each: each.unlink(missing_ok=True)
            )
        if file.name == INDEX:
            with suppress(OSError):  # it holds something else
                file.parent.rmdir()
