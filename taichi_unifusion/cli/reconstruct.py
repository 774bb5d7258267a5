"""`unifusion reconstruct`: frames -> maps -> mesh -> results folder."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from ..config import Config
from ..datasets import Dataset
from .interrupts import INTERRUPTED, stop_on_signal
from .recording import RecordingOptions
from .terminal import frame_progress, report
from .tracking import TrackingOptions

if TYPE_CHECKING:
    from ..language import ImageEncoder
    from ..results.run_folder import RunFolder

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class ReconstructOptions(TrackingOptions, RecordingOptions):
    """Turn a recording of RGB-D frames into a coloured mesh.

    Example: unifusion reconstruct 7scenes my/redkitchen --every 10 --out results/kitchen

    Without camera poses: unifusion reconstruct folder my_recording --tracking rgbd --out
    results/mine

    Settings that `unifusion config --help` explains are options here too,

    for example --device cpu, --surface.voxel-size 0.03 or --mesh.resolution 8.
    """

    out: Annotated[Path, arg(metavar="DIR")] = field(kw_only=True)
    """Folder for the results; made where it does not exist."""
    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")] = field(
        default=None, kw_only=True
    )
    """YAML file of settings that differ from the defaults; options given here count more."""
    json: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Print the metrics as JSON instead of tables."""


@dataclass(frozen=True)
class Reconstruct(ReconstructOptions):
    __doc__ = ReconstructOptions.__doc__

    settings: Annotated[Config, arg(name="")] = field(default_factory=Config, kw_only=True)


def reconstruct(options: Reconstruct, encoder: ImageEncoder | None = None) -> int:
    """Frames -> maps -> mesh -> results folder; with an image encoder also a map of its features."""
    frames = options.frames()
    options.check_poses(frames)
    from ..results.writer import prepare_results, remove_temporaries

    folder = prepare_results(options.out)
    with stop_on_signal(clean_up=lambda: remove_temporaries(folder)) as stop:
        return _run_and_write(options, frames, folder, stop, encoder)


def _run_and_write(
    options: Reconstruct,
    frames: Dataset,
    folder: RunFolder,
    stop: Callable[[], bool],
    encoder: ImageEncoder | None,
) -> int:
    from ..pipeline import Pipeline
    from ..results.summary import summarize
    from ..results.writer import write_results

    source, tracking, written = options.source(len(frames)), None, ()
    if options.tracked:
        frames, tracking = options.track(options, options.settings, folder, stop)
        written = folder.tracking_files
    pipeline = Pipeline(options.settings, encoder=encoder)
    with frame_progress(len(frames)) as on_frame:
        run = pipeline.run(frames, strict=options.strict, stop=stop, on_frame=on_frame)
    if not run.steps:
        logger.warning(
            "stopped before the first frame was done; %s",
            f"{' and '.join(file.name for file in written)} hold the poses found until then"
            if written
            else "nothing was written",
        )
        return INTERRUPTED
    done = len(run.steps) + len(run.skipped)
    if done < len(frames):
        logger.warning(
            "%s after %d of %d frames; writing what they gave",
            "stopped" if run.interrupted else "ended early",
            done,
            len(frames),
        )
    results = write_results(folder.path, pipeline, run, source, tracking, written)
    print(
        json.dumps(results.record.to_json(), indent=2)
        if options.json
        else summarize(results.record, results.files, folder.path)
    )
    code = report([error for error in (run.failure, *results.failures) if error])
    return INTERRUPTED if stop() else code
