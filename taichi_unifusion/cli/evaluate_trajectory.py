"""`unifusion evaluate trajectory`: estimated and true poses -> ATE, RPE."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..errors import FileError, InputError
from ..results.tables import format_table
from .options import ScoreOptions
from .scores import cell, check_out, show

if TYPE_CHECKING:
    from ..evaluation.trajectory import TrajectoryResult
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
    """File of true poses, or a results folder that has them."""
    tracked: FlagCreatePairsOff[bool] = False
    """Judge every pose that the run tracked (tracking.txt), not only those of the frames it mapped."""
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

    estimate, truth, frames = _read(options)
    result = evaluate(
        estimate,
        truth,
        max_difference=options.max_difference,
        rpe_delta=options.rpe_delta,
        rpe_unit=options.rpe_unit,
    )
    apart = None
    if frames is not None and result.rpe_unit == "frames":
        apart = _frames_apart(estimate, truth, frames, options)
    per = _per(result, apart)
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
    if left := _tracked_but_not_mapped(options, len(estimate)):
        notes += f"\n{left}"
    about = {
        "metric": "trajectory",
        "estimate": options.estimate,
        "ground_truth": options.ground_truth or "the recording's",
        "rpe_frames_of_the_recording": apart,
    }
    return show(options.scores, about, result, format_table(rows), notes)


def _per(result: TrajectoryResult, apart: tuple[int, int] | None) -> str:
    """The length of the motions of RPE: in frames of the recording where these are known."""
    if apart is not None:
        low, high = apart
        return f"{low} frame{'s' * (low != 1)}" if low == high else f"{low} to {high} frames"
    unit = {"frames": "poses"}.get(result.rpe_unit, result.rpe_unit)
    return f"{result.rpe_delta:g} {unit if result.rpe_delta != 1 else unit[:-1]}"


def _frames_apart(
    estimate: Trajectory, truth: Trajectory, frames: Sequence[int], options: EvaluateTrajectory
) -> tuple[int, int] | None:
    """The fewest and the most frames of the recording from one pose of a motion of RPE to the other;
    None where there is no motion, or time does not go on.
    """
    import numpy as np

    from ..evaluation.trajectory import match

    if not all((np.diff(each.timestamps) > 0).all() for each in (estimate, truth)):
        return None
    matched = np.array(frames)[match(estimate, truth, options.max_difference)[:, 0]]
    delta = int(options.rpe_delta)
    apart = matched[delta:] - matched[:-delta]
    return (int(apart.min()), int(apart.max())) if len(apart) else None


def _tracked_but_not_mapped(options: EvaluateTrajectory, judged: int) -> str:
    """What to say where a run found more poses than are judged."""
    from ..files.trajectories import read_trajectory
    from ..results.reader import find_run

    run = find_run(options.estimate)
    if options.tracked or run is None or not run.folder.tracked_poses.exists():
        return ""
    found = len(read_trajectory(run.folder.tracked_poses))
    if found <= judged:
        return ""
    return (
        f"Judged are the poses of the {judged} frames that were mapped; --tracked judges all {found} that "
        "were tracked."
    )


def _read(
    options: EvaluateTrajectory,
) -> tuple[Trajectory, Trajectory, Sequence[int] | None]:
    """Estimated and true poses, and of a results folder the frames of the former."""
    from ..files.trajectories import read_trajectory
    from ..results.reader import find_run

    run, truth = find_run(options.estimate), options.ground_truth
    if run is None and options.tracked:
        raise InputError(
            f"trajectory: --tracked is for a results folder, {options.estimate} is a file"
        )
    if run is None and truth is None:
        raise InputError(
            "trajectory: give the true poses too: unifusion evaluate trajectory FILE TRUTH, or a results "
            "folder, whose recording may have them"
        )
    if run is None:
        estimate, frames = read_trajectory(options.estimate), None
    else:
        estimate, frames = (
            run.tracked_trajectory() if options.tracked else (run.trajectory(), run.used)
        )
    if truth is not None:
        return estimate, read_trajectory(_truth_file(truth)), frames
    assert run is not None
    return estimate, run.true_trajectory(estimate, frames), frames


def _truth_file(truth: Path) -> Path:
    """The file of true poses; raises FileError for a folder that is no results folder."""
    if not truth.is_dir():
        return truth
    from ..results.run_folder import RunFolder

    file = RunFolder(truth).trajectory
    if not file.exists():
        raise FileError(
            f"{truth}: is a folder without {file.name}; the truth is a file of poses or a results folder. "
            "Poses of a recording are the truth for the results made from it: unifusion evaluate "
            "trajectory RESULTS, with --tracked for all frames"
        )
    return file
