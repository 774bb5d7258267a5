"""Saves a run on its way, so that it can go on after whatever ends its process."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..config import dump_config
from ..errors import UniFusionError
from ..files.atomic import file_error, write_text
from ..pipeline import Pipeline
from ..run_log import RunLog, RunSoFar
from ..tracking import TrackingResult
from ..tracking.keyframes import Keyframes
from .placement import Placement, read_placement, write_placement
from .record import Source
from .run_folder import RunFolder
from .safe_point import (
    VERSION,
    Recipe,
    State,
    append,
    check_same,
    keep_generation,
    lines_of,
    now,
    read_so_far,
    read_state,
    read_tracking,
    remove_safe_point,
    remove_temporaries,
    write_state,
    write_tracking_state,
)
from .safe_windows import keep_windows, save_sums

logger = logging.getLogger(__name__)

SHARE = 0.05  # of a run's time that safe points may take


@dataclass(frozen=True)
class Resumed:
    """A run to go on with: its last safe point."""

    state: State
    so_far: RunSoFar


class RunSaver:
    """Makes a safe point between two windows, every so many seconds (0: never), or seldomer where
    that would take more than SHARE of the time.

        saver = RunSaver(folder, recipe, seconds=60, resume=False)
        pipeline.run(frames, on_border=saver.at_border)

    With `resume`, `resumed` is the run that the folder holds a safe point of, `tracked` what its tracker
    found, and `placed` where it lies in the map that it is added to, where there is such a thing. Raises
    InputError where its settings are others, FileError where it is damaged.
    """

    def __init__(self, folder: RunFolder, recipe: Recipe, seconds: float, *, resume: bool) -> None:
        self.folder, self.recipe, self.seconds = folder, recipe, seconds
        self.generation = self.steps = self.skipped = self.bytes = self.done = 0
        self.resumed: Resumed | None = None
        self.tracked = read_tracking(folder, recipe) if resume else None
        self.placed = read_placement(folder, recipe) if resume else None
        self.fresh = self.tracked is None and self.placed is None
        if resume and (state := read_state(folder)) is not None:
            check_same(recipe, state.recipe)
            self._go_on(Resumed(state, read_so_far(folder, state)))
        self.recording, self.tracking = recipe.recording, None
        self.next, self.failed = now() + seconds, False

    def _go_on(self, resumed: Resumed) -> None:
        self.resumed, self.fresh = resumed, False
        self.generation, self.bytes = resumed.state.generation, resumed.state.journal_bytes
        self.steps, self.skipped = len(resumed.so_far.steps), len(resumed.so_far.skipped)
        self.done = resumed.state.done
        remove_temporaries(self.folder)
        keep_generation(self.folder, self.generation)

    def describe(self, recording: Source, tracking: Mapping[str, Any] | None) -> None:
        """Say what the record of the run will, for whoever goes on."""
        self.recording, self.tracking = recording, tracking

    def save_tracking(self, result: TrackingResult) -> None:
        """Keep what a tracker found of all frames; raises FileError."""
        self._begin()
        write_tracking_state(self.folder, self.recipe, result)

    def save_placement(self, placement: Placement, keyframes: Keyframes) -> None:
        """Keep where a recording lies in the map that it is added to; raises FileError."""
        self._begin()
        write_placement(self.folder, self.recipe, placement, keyframes)

    def save_soon(self) -> None:
        """Make a safe point as soon as a window is fused: the run will write over what it began with."""
        self.next = now()

    def _begin(self) -> None:
        """Remove what another run left, before the first of this one is written."""
        if self.fresh:
            remove_safe_point(self.folder, but=self.folder.new_windows)  # this run writes it
            self.fresh = False
        try:
            self.folder.unfinished.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise file_error("write", self.folder.unfinished, error) from error

    def at_border(self, log: RunLog, pipeline: Pipeline) -> None:
        """Make a safe point if it is time for one; where that fails the run goes on without."""
        if not self.seconds or now() < self.next or not log.steps or log.done == self.done:
            return
        began = now()
        try:
            self.save(log.so_far, pipeline)
        except UniFusionError as error:
            if not self.failed:
                logger.warning("the run could not be saved on its way, and goes on: %s", error)
            self.failed = True
        took = now() - began
        logger.debug("safe point after %d frames, %.2f s", log.done, took)
        self.next = now() + max(self.seconds, took / SHARE)

    def save(self, so_far: RunSoFar, pipeline: Pipeline) -> None:
        """Make a safe point; the one before counts until it is complete. Raises FileError."""
        self._begin()
        folder, generation = self.folder, self.generation + 1
        there = folder.generation(generation)
        try:
            there.mkdir(exist_ok=True)
        except OSError as error:
            raise file_error("write", there, error) from error
        self._save_maps(there, pipeline)
        windows = pipeline.follower and keep_windows(folder, pipeline.follower)
        write_text(folder.config_in(there), dump_config(pipeline.config))
        lines = "".join(f"{line}\n" for line in lines_of(so_far, self.steps, self.skipped))
        size = append(folder.journal, self.bytes, lines)
        state = self._state(so_far, pipeline, generation, size)
        write_state(folder, replace(state, windows=windows))
        self.generation, self.bytes, self.done = generation, size, so_far.done
        self.steps, self.skipped = len(so_far.steps), len(so_far.skipped)
        keep_generation(folder, generation)

    def _save_maps(self, there: Path, pipeline: Pipeline) -> None:
        if pipeline.memory is None:
            for name, each in pipeline.maps.items():
                each.save(self.folder.map_in(there, name))
            save_sums(self.folder, there, pipeline.maps)
            return
        pipeline.memory.save()
        for name, each in pipeline.memory.sets.items():
            path = self.folder.tiles_in(there, name)
            shutil.rmtree(path, ignore_errors=True)  # of a safe point that could not be made
            each.folder.snapshot(path)

    def _state(self, so_far: RunSoFar, pipeline: Pipeline, generation: int, size: int) -> State:
        return State(
            version=VERSION,
            generation=generation,
            recipe=self.recipe,
            recording=self.recording,
            tracking=self.tracking,
            done=so_far.done,
            maps=tuple(pipeline.maps),
            journal_bytes=size,
            borders=pipeline.fusion.borders,
            warnings=so_far.warnings,
            seconds=round(so_far.seconds, 3),
            scale_checked=so_far.scale_checked,
            poses_judged=so_far.poses_judged,
            doubts=so_far.doubts,
            readings=so_far.readings,
        )
