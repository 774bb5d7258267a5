"""`unifusion evaluate surface`: two meshes -> accuracy, completeness, F1."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..errors import InputError
from ..results.tables import format_table
from .options import Device, ScoreOptions
from .scores import cell, check_out, percent, show

if TYPE_CHECKING:
    from ..evaluation.surface import SurfaceResult
    from ..results.reader import Run
    from ..types import Mesh

EVERYTHING = "Judged is everything, seen or not."
NO_TRUTH = "surface: give the true mesh too: unifusion evaluate surface MESH TRUTH"


@dataclass(frozen=True)
class EvaluateSurface:
    """Compare a reconstructed surface with the true one: accuracy, completeness, F1, Chamfer
    distance.

    Example: unifusion evaluate surface results/demo

    Of a results folder, only what its frames could tell is judged; of a mesh file, everything.
    """

    reconstruction: Annotated[Positional[Path], arg(metavar="RESULTS|MESH")]
    """Results folder of `unifusion reconstruct`, or a mesh file."""
    ground_truth: Annotated[
        Positional[Path | None],
        arg(
            metavar="[TRUTH]",
            help_behavior_hint="(default: the recording's own, where it has one: synthetic, scene)",
        ),
    ] = None
    """The true mesh: a file in the same frame of reference, in metres."""
    seen_by: Annotated[
        Path | None, arg(metavar="RESULTS", help_behavior_hint="(default: RESULTS itself)")
    ] = None
    """Results folder whose frames decide what is judged."""
    whole: FlagCreatePairsOff[bool] = False
    """Judge everything, seen or not."""
    thresholds: Annotated[tuple[float, ...], arg(metavar="M")] = (0.025, 0.01)
    """Distances, in metres, within which a point is right."""
    samples: Annotated[int, arg(metavar="N")] = 100_000
    """Points drawn from each mesh."""
    seed: Annotated[int, arg(metavar="N")] = 0
    """Of the drawing."""
    to: Literal["surface", "samples"] = "surface"
    """Measure to the other mesh's surface, or, as published, to its samples: too coarse where these
    lie far apart.
    """
    device: Device = "auto"
    """Where to compute."""
    scores: Annotated[ScoreOptions, arg(name="")] = field(default_factory=ScoreOptions)


def evaluate_surface(options: EvaluateSurface) -> int:
    """Meshes -> table."""
    if options.whole and options.seen_by:
        raise InputError("surface: --whole and --seen-by exclude each other")
    check_out(options.scores)
    from .. import runtime
    from ..evaluation.surface import evaluate_surface as evaluate
    from ..files.mesh_reading import read_any_mesh
    from ..results.reader import find_run, read_run

    run = find_run(options.reconstruction)
    judge = run if options.seen_by is None else read_run(options.seen_by)
    if options.ground_truth is None and judge is None:
        raise InputError(NO_TRUTH)
    runtime.init(options.device)
    mesh = (
        run.mesh().transformed(run.T_recording_run())
        if run
        else read_any_mesh(options.reconstruction)
    )
    views = judge.views() if judge and not options.whole else None
    truth = read_any_mesh(options.ground_truth) if options.ground_truth else _own_truth(judge)
    result = evaluate(
        mesh,
        truth,
        views=views,
        thresholds=options.thresholds,
        samples=options.samples,
        seed=options.seed,
        distance_to=options.to,
    )
    about = {
        "metric": "surface",
        "reconstruction": options.reconstruction,
        "ground_truth": options.ground_truth or "the recording's",
        "seen_by": judge.folder.path if judge and views else None,
        "distance_to": options.to,
        "samples": options.samples,
        "seed": options.seed,
    }
    judged = _judged(result, len(views.T_world_camera)) if views else EVERYTHING
    return show(options.scores, about, result, *_tables(result), judged)


def _tables(result: SurfaceResult) -> tuple[str, str]:
    shares = [["within cm", "precision %", "recall %", "F1 %"]]
    shares += [
        [f"{100 * s.threshold:g}", percent(s.precision), percent(s.recall), percent(s.f1)]
        for s in result.scores
    ]
    means = [
        ["mean distance", "cm"],
        ["reconstruction to truth (accuracy)", cell(result.accuracy_cm)],
        ["truth to reconstruction (completeness)", cell(result.completeness_cm)],
        ["mean of both (Chamfer)", cell(result.chamfer_cm)],
    ]
    return format_table(shares), format_table(means)


def _judged(result: SurfaceResult, frames: int) -> str:
    """What share of both surfaces was judged."""
    return (
        f"Judged is what {frames} frames could tell: {percent(1 - result.ground_truth_unseen)} % of the "
        f"true surface, {percent(1 - result.reconstruction_unseen)} % of the reconstruction; --whole "
        "judges all."
    )


def _own_truth(run: Run | None) -> Mesh:
    """The mesh that the recording of a run was rendered from."""
    if run is None:
        raise InputError(NO_TRUTH)
    recording = run.recording
    ground_truth_mesh = getattr(recording, "ground_truth_mesh", None)
    if ground_truth_mesh is None:
        raise InputError(
            f"surface: a recording of format '{run.source.format}' holds no true surface; give one: "
            "unifusion evaluate surface RESULTS TRUTH"
        )
    return ground_truth_mesh()
