"""`unifusion evaluate rendering`: a mesh, a colour map and held-out frames -> depth L1, PSNR, SSIM."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from ..datasets import Dataset, known_format, open_dataset
from ..errors import FrameError, InputError
from ..results.tables import format_table
from .color_camera import CHOICES as COLOR_CHOICES
from .color_camera import found_color, given_color
from .options import FORMAT_DEFAULT, ONE_EACH, Device, ScoreOptions, frames_asked, merged_options
from .scores import cell, check_out, percent, show
from .terminal import frame_progress

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from ..evaluation.rendering import RenderingResult
    from ..results.reader import Run
    from ..results.record import ColorRecord
    from ..types import Frame

logger = logging.getLogger(__name__)

FEW_HITS = 0.05  # share of readings that meet the mesh, below which its world is asked about
RUN_DEFAULT, CHOICE_DEFAULT = "(default: the run's recording)", "(default: the run's)"


@dataclass(frozen=True)
class EvaluateRendering:
    """Compare depth and colour, rendered at the frames' poses, with the frames: depth L1, coverage,
    PSNR, SSIM.

    Example: unifusion evaluate rendering results/kitchen

    Of a results folder, with frames that its run did not use: those half-way between the ones that
    it did. --start and --end choose others of these, between its first and its last, or beyond;
    --every N takes every N-th that it did not use. Colour is decoded from its colour map at the points hit.
    """

    reconstruction: Annotated[Positional[Path], arg(metavar="RESULTS|MESH")]
    """Results folder of `unifusion reconstruct`, or a mesh file, whose texture or vertex colours are judged.
    """
    format: Annotated[
        Positional[str | None], arg(metavar="[FORMAT]", help_behavior_hint=RUN_DEFAULT)
    ] = None
    """The kind of recording to compare with."""
    path: Annotated[
        Positional[Path | None], arg(metavar="[PATH]", help_behavior_hint=RUN_DEFAULT)
    ] = None
    """Where it lies."""
    start: Annotated[int | None, arg(metavar="A", help_behavior_hint=CHOICE_DEFAULT)] = None
    """First frame, counted from 0."""
    end: Annotated[int | None, arg(metavar="B", help_behavior_hint=CHOICE_DEFAULT)] = None
    """Frame to stop before."""
    every: Annotated[
        int | None, arg(metavar="N", help_behavior_hint="(default: 1, or see above)")
    ] = None
    """Compare with every N-th frame."""
    all: FlagCreatePairsOff[bool] = False
    """Compare with the frames that the run has used; with --every N let these in."""
    depth_min: Annotated[
        float | None, arg(metavar="M", help_behavior_hint="(default: the run's, else 0.1)")
    ] = None
    """Nearest reading to compare with, in metres."""
    depth_max: Annotated[
        float | None, arg(metavar="M", help_behavior_hint="(default: the run's, else 5)")
    ] = None
    """Farthest reading to compare with, in metres."""
    depth_scale: Annotated[float | None, arg(metavar="S", help_behavior_hint=FORMAT_DEFAULT)] = None
    """Units of the depth images that make a metre."""
    option: Annotated[
        UseAppendAction[tuple[str, ...]], arg(metavar="KEY=VALUE", help_behavior_hint=ONE_EACH)
    ] = ()
    """Another option of the recording's format, as of `unifusion reconstruct`."""
    color_camera: Annotated[
        str | None,
        arg(metavar=COLOR_CHOICES, help_behavior_hint="(default: the run's, else none)"),
    ] = None
    """The colour camera that images are registered with, as of `unifusion reconstruct`."""
    vertex_colors: FlagCreatePairsOff[bool] = False
    """Judge the colours of the mesh's vertices instead of the colour map."""
    device: Device = "auto"
    """Where to compute."""
    scores: Annotated[ScoreOptions, arg(name="")] = field(default_factory=ScoreOptions)


def evaluate_rendering(options: EvaluateRendering) -> int:
    """Mesh, map, frames -> table."""
    check_out(options.scores)
    import numpy as np

    from .. import runtime
    from ..config import Config
    from ..evaluation.rendering import evaluate_rendering as evaluate
    from ..files.mesh_reading import read_textured_mesh
    from ..results.reader import find_run

    run = find_run(options.reconstruction)
    mesh, texture = (run.mesh(), None) if run else read_textured_mesh(options.reconstruction)
    recording, run = _recording(options, run)
    color_record = run.source.color if run else None
    if options.color_camera is not None:
        recording, color_record = found_color(*given_color(recording, options.color_camera))
    for sentence in recording.warnings:
        logger.warning("%s", sentence)
    chosen = choose_frames(options, run, recording)
    limits = run.config().preprocess if run else Config().preprocess
    runtime.init(options.device)
    color, T_run_recording = (
        _color_map(options, run),
        np.linalg.inv(run.T_recording_run()) if run else np.eye(4),
    )
    with frame_progress(len(chosen)) as on_frame:
        result = evaluate(
            mesh,
            _usable(recording, chosen, T_run_recording, on_frame),
            color=color.query if color else None,
            texture=texture,
            depth_min=limits.depth_min if options.depth_min is None else options.depth_min,
            depth_max=limits.depth_max if options.depth_max is None else options.depth_max,
        )
    _warn_of_few_hits(result)
    used = set(run.used if run else ()) & {score.index for score in result.frames}
    about = {
        "metric": "rendering",
        "reconstruction": options.reconstruction,
        "recording": recording.name,
        "used_by_the_run": sorted(used),
        "colour": "map" if color else "texture" if texture else "vertices",
        "images": _images(options, recording, color_record),
    }
    compared = f", {len(used) or 'none'} of which the run has used" if run else ""
    count = len(result.frames)
    colors = (
        f"colour from the {about['colour']}, compared with images {about['images']}"
        if result.psnr_db is not None
        else "no colour was compared"
    )
    return show(
        options.scores,
        about,
        result,
        _table(result),
        f"{'Means over' if count > 1 else 'Of'} {count} frame{'s' * (count > 1)} of {recording.name} "
        f"({_which(chosen)}){compared}; {colors}.",
    )


def _warn_of_few_hits(result: RenderingResult) -> None:
    """Warn where hardly a ray meets the mesh."""
    if result.coverage is not None and result.coverage < FEW_HITS:
        logger.warning(
            "only %s %% of readings meet the mesh: is it in the world of the frames' poses, in metres?",
            percent(result.coverage),
        )


def _images(options: EvaluateRendering, recording: Dataset, color: ColorRecord | None) -> str:
    """How the images that colour is compared with came about."""
    if color is None or color.camera is None:
        return "as the recording registers them" if recording.registered else "as recorded"
    if options.color_camera is not None:
        return f"registered with --color-camera {color.choice}"
    return f"registered with the run's colour camera (--color-camera {color.choice})"


def _which(chosen: Sequence[int]) -> str:
    """The frames by their numbers: "5, 15, 25 ... 295", and how to choose others."""
    few = [str(index) for index in chosen[:3]]
    last = f" ... {chosen[-1]}" if len(chosen) > 4 else ""
    few += [str(chosen[3])] if len(chosen) == 4 else []
    return f"{', '.join(few)}{last}; --start, --end and --every choose others"


def _table(result: RenderingResult) -> str:
    from ..evaluation.rendering import WITHIN

    scores = {
        "depth L1 cm": cell(result.depth_l1_cm),
        "median cm": cell(result.depth_median_cm),
        f"within {100 * WITHIN:g} cm %": percent(result.depth_within),
        "coverage %": percent(result.coverage),
        "PSNR dB": cell(result.psnr_db),
        "SSIM": cell(result.ssim, 3),
    }
    return format_table([[*scores], [*scores.values()]])


def _recording(options: EvaluateRendering, run: Run | None) -> tuple[Dataset, Run | None]:
    """The recording to compare with, and the run as if it were made from it."""
    given = {} if options.depth_scale is None else {"depth_scale": options.depth_scale}
    format = options.format or (run.source.format if run else None)
    if format is None:
        raise InputError(
            "rendering: give the recording to compare the mesh with: unifusion evaluate rendering MESH FORMAT "
            "PATH"
        )
    format = known_format(format, options.path)
    given = merged_options(format, given, options.option)
    if run is None:
        return open_dataset(format, options.path, **given), None
    same = run.source.format == format
    source = replace(
        run.source,
        format=format,
        path=run.source.path if options.format is None else str(options.path or ""),
        reading={**(run.source.reading if same else {}), **given},
        color=run.source.color if same and options.color_camera is None else None,
    )
    run = replace(run, source=source)
    return run.recording, run


def choose_frames(options: EvaluateRendering, run: Run | None, recording: Dataset) -> Sequence[int]:
    """The frames of the recording to compare with: held-out ones, unless `options.all`."""
    start, end, every = options.start, options.end, options.every
    start = (run.source.start if run else 0) if start is None else start
    end = run.source.asked.stop if end is None and run and start < run.source.asked.stop else end
    asked = frames_asked(recording, start, end, 1 if every is None else every)
    if run is None:
        return asked
    if every is None:  # of those that are mapped, or half-way between
        step = run.source.every
        first = run.source.start + (0 if options.all else step // 2)
        kept = [i for i in asked if (i - first) % step == 0]
        if not kept:
            which = "that the run used" if options.all else "half-way between those the run used"
            others = "held-out ones with --every 1" + ", or used ones with --all" * (
                not options.all
            )
            raise InputError(
                f"rendering: no frame {which} is among {asked[0]} to {asked[-1]} of {recording.name}; "
                f"choose {others}"
            )
        asked = kept
    held_out = asked if options.all else [i for i in asked if i not in set(run.used)]
    if not held_out:
        raise InputError(
            "rendering: the run has used every one of these frames; reconstruct with --every 2 or more to hold "
            "some out, choose others with --start, --end, --every, or compare with used ones by --all"
        )
    return held_out


def _usable(
    recording: Dataset,
    chosen: Sequence[int],
    T_run_recording: NDArray,
    on_frame: Callable[[int, int], None],
) -> Iterator[Frame]:
    """The frames that can be read and have a pose, in the run's world; the others are said."""
    for done, index in enumerate(chosen, start=1):
        try:
            frame = recording[index]
            T_run_camera = T_run_recording @ frame.require_pose()
        except FrameError as error:
            logger.warning("frame left out: %s", error)
        else:
            yield replace(frame, T_world_camera=T_run_camera)
        on_frame(done, len(chosen))


def _color_map(options: EvaluateRendering, run: Run | None):
    """The colour map of the run, or None where vertex colours are to be judged."""
    path = run.folder.saved_map("color") if run else None
    if path is None or options.vertex_colors:
        return None
    if not path.exists():
        logger.warning("%s: no such file; colours are those of the mesh's vertices", path)
        return None
    from ..maps import PropertyMap

    return PropertyMap.load(path)
