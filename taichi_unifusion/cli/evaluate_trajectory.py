"""`unifusion evaluate trajectory`: estimated and true poses -> ATE, RPE."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import Positional, arg

from ..errors import InputError
from ..results.tables import format_table
from .options import ScoreOptions
from .scores import cell, check_out, show

if TYPE_CHECKING:
    from ..types import Trajectory


SAME = 1e-3  # [cm] what rounding in files makes of equal poses, and more


@dataclass(frozen=True)
class EvaluateTrajectory:
    """Compare estimated camera poses with true ones: ATE after alignment, RPE.

    Example: unifusion evaluate trajectory results/desk rgbd_dataset_freiburg1_desk/groundtruth.txt

    Files hold lines 'timestamp tx ty tz qx qy qz qw', camera to world, as TUM's benchmark has them.
    """

    estimate: Annotated[Positional[Path], arg(metavar="RESULTS|FILE")]
    """Results folder of `unifusion reconstruct`, or a file of poses."""
    ground_truth: Annotated[
        Positional[Path | None],
        arg(
            metavar="[TRUTH]",
            help_behavior_hint="(default: the poses in the recording that RESULTS was made from)",
        ),
    ] = None
    """File of true poses."""
    max_difference: Annotated[float, arg(metavar="SECONDS")] = 0.02
    """How far time stamps of an estimated and a true pose may be apart."""
    rpe_delta: Annotated[float, arg(metavar="N")] = 1.0
    """Length of the motions whose error is RPE."""
    rpe_unit: Literal["frames", "metres"] = "frames"
    """What that length counts: matched poses, or metres of the true path."""
    scores: Annotated[ScoreOptions, arg(name="")] = field(default_factory=ScoreOptions)


def evaluate_trajectory(options: EvaluateTrajectory) -> int:
    """Poses -> table."""
    check_out(options.scores)
    from ..evaluation.trajectory import evaluate_trajectory as evaluate

    estimate, truth = _read(options)
    result = evaluate(
        estimate,
        truth,
        max_difference=options.max_difference,
        rpe_delta=options.rpe_delta,
        rpe_unit=options.rpe_unit,
    )
    per = (
        f"{result.rpe_delta:g} {result.rpe_unit if result.rpe_delta != 1 else result.rpe_unit[:-1]}"
    )
    rows = [["error", "rmse", "mean", "median", "max"]]
    for name, errors in (
        ("ATE, aligned [cm]", result.ate_cm),
        ("ATE, aligned and scaled [cm]", result.ate_sim3_cm),
        ("ATE, as it is [cm]", result.ate_unaligned_cm),
        (f"RPE, translation over {per} [cm]", result.rpe_translation_cm),
        (f"RPE, rotation over {per} [deg]", result.rpe_rotation_deg),
    ):
        rows.append(
            [
                name,
                *(cell(getattr(errors, column) if errors else None, 3) for column in rows[0][1:]),
            ]
        )
    notes = (
        f"{result.matches} of {result.estimated_poses} estimated poses were matched with "
        f"{result.true_poses} true ones."
    )
    if result.scale is not None:
        notes += f" Scale: {result.scale:.4f}."
    if not result.unique:
        notes += "\nThe positions lie on a line or in one point: ATE is right, but the alignment is one of many."
    unaligned = result.ate_unaligned_cm
    if options.ground_truth is None and unaligned is not None and unaligned.max < SAME:
        notes += (
            "\nThe run took the recording's poses as they are, so they are compared with themselves; "
            "--tracking rgbd finds poses of its own."
        )
    about = {
        "metric": "trajectory",
        "estimate": options.estimate,
        "ground_truth": options.ground_truth or "the recording's",
    }
    return show(options.scores, about, result, format_table(rows), notes)


def _read(options: EvaluateTrajectory) -> tuple[Trajectory, Trajectory]:
    from ..files.trajectories import read_trajectory
    from ..results.reader import find_run
    from ..results.run_folder import RunFolder

    run, truth = find_run(options.estimate), options.ground_truth
    if truth is not None:
        estimate = run.trajectory() if run else read_trajectory(options.estimate)
        return estimate, read_trajectory(RunFolder(truth).trajectory if truth.is_dir() else truth)
    if run is None:
        raise InputError(
            "trajectory: give the true poses too: unifusion evaluate trajectory FILE TRUTH"
        )
    return run.trajectory(), run.true_trajectory()
