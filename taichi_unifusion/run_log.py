"""What a run did, frame by frame, as values; and the log that collects them while it runs."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from . import runtime
from .datasets.file_recording import Recording
from .datasets.loading import index_in_recording, recording_of
from .datasets.plausibility import guess_depth_scale, is_reading
from .datasets.pose_convention import judge_poses
from .datasets.pose_fit import EarlyPairs
from .errors import (
    DatasetError,
    FrameError,
    OutOfRange,
    PoseError,
    SizeMismatch,
    UniFusionError,
    check_kind,
)
from .maps import Integration
from .preprocessing import FARTHEST, PreprocessSettings
from .types import Frame, Trajectory

logger = logging.getLogger(__name__)

MOST_OUTSIDE = 0.05  # of the readings may lie outside depth_min..depth_max unsaid
SPARSE = 4  # one pixel of so many each way stands for all


class EmptyFrame(FrameError):
    """No depth reading of a frame can be used."""


SKIP_REASONS: dict[type[UniFusionError], str] = {  # the first class that fits names the kind
    PoseError: "no usable pose",
    SizeMismatch: "image sizes differ",
    EmptyFrame: "no usable depth",
    FrameError: "unreadable image",
    OutOfRange: "outside the range of the map",
}


@dataclass
class StageClock:
    """Milliseconds by stage; with `synchronize`, the device's work is included."""

    synchronize: bool = True
    milliseconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        if self.synchronize:
            runtime.synchronize()
        spent = 1e3 * (time.perf_counter() - start)
        self.milliseconds[name] = self.milliseconds.get(name, 0.0) + spent


@dataclass(frozen=True)
class StepResult:
    """What one frame did."""

    index: int  # place in its recording
    name: str
    points: int  # after preprocessing
    integrations: Mapping[str, Integration]  # by map
    milliseconds: Mapping[str, float]  # by stage
    # property, color and features among them -> why the frame does not give it
    lacking: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class SkippedFrame:
    """A frame that was not used, and why."""

    index: int  # place in its recording
    reason: str  # its kind, one of SKIP_REASONS
    message: str


@dataclass(frozen=True)
class RunResult:
    """What a run did; the maps are the pipeline's."""

    steps: tuple[StepResult, ...]
    skipped: tuple[SkippedFrame, ...]
    trajectory: Trajectory  # of the frames used
    warnings: tuple[str, ...]
    seconds: float
    interrupted: bool = False  # asked to stop before the last frame
    failure: Exception | None = None  # what else ended the run before the last frame
    # sentences on what makes the whole result doubtful; they are among the warnings too
    doubts: tuple[str, ...] = ()


@dataclass(frozen=True)
class RunSoFar:
    """A run up to a border of its windows, from where it can go on in another process."""

    done: int  # frames of the sequence that were tried
    steps: tuple[StepResult, ...]
    skipped: tuple[SkippedFrame, ...]
    timestamps: tuple[float | None, ...]  # of the steps
    T_world_camera: tuple[NDArray[np.float64], ...]  # of the steps
    warnings: tuple[str, ...]
    seconds: float
    scale_checked: bool
    poses_judged: bool
    doubts: tuple[str, ...]
    readings: tuple[int, ...]


class RunLog:
    """Collects a RunResult while frames are processed; warns at once of the first of every kind of
    trouble.
    """

    def __init__(
        self,
        sequence: Sequence[Frame],
        settings: PreprocessSettings | None = None,
        before: RunSoFar | None = None,
    ) -> None:
        self.sequence, self.name = sequence, getattr(sequence, "name", "sequence")
        self.settings = settings or PreprocessSettings()
        self.readings = np.zeros(3, np.int64)  # nearer than is used, farther, all; of some pixels
        self.started = time.perf_counter()
        self.steps: list[StepResult] = []
        self.skipped: list[SkippedFrame] = []
        self.reasons: Counter[str] = Counter()
        self.poses: list[tuple[float | None, np.ndarray]] = []  # time stamp, T_world_camera
        self.warnings: list[str] = []
        self.scale_checked = False
        self.early = EarlyPairs()  # frames whose poses are checked against their depth
        self.doubts: list[str] = []  # said again at the end
        self.done = 0  # frames tried
        if before is not None:
            self._go_on(before)
        for sentence in getattr(sequence, "warnings", ()):
            if sentence not in self.warnings:
                self.warn(sentence)

    def _go_on(self, before: RunSoFar) -> None:
        self.started -= before.seconds
        self.done, self.warnings = before.done, list(before.warnings)
        self.steps, self.skipped = list(before.steps), list(before.skipped)
        self.reasons.update(frame.reason for frame in before.skipped)
        self.poses = list(zip(before.timestamps, before.T_world_camera, strict=True))
        self.scale_checked = before.scale_checked
        self.readings, self.doubts = np.array(before.readings, np.int64), list(before.doubts)
        if before.poses_judged:
            self.early.take()

    @property
    def so_far(self) -> RunSoFar:
        """What there is by now, to be kept."""
        return RunSoFar(
            self.done,
            tuple(self.steps),
            tuple(self.skipped),
            tuple(stamp for stamp, _ in self.poses),
            tuple(T for _, T in self.poses),
            tuple(self.warnings),
            time.perf_counter() - self.started,
            self.scale_checked,
            self.early.kept is None,
            tuple(self.doubts),
            tuple(self.readings.tolist()),
        )

    def warn(self, sentence: str) -> None:
        self.warnings.append(sentence)
        logger.warning("%s", sentence)

    def check_depth_scale(self, frame: Frame) -> None:
        """Warn if the first frame with readings looks as if the depth scale were wrong; raises
        InputError for what is no frame.
        """
        check_kind("Pipeline.run: a frame of the sequence", frame, Frame)
        recording = recording_of(self.sequence)
        scale = getattr(recording, "depth_scale", None)
        if self.scale_checked or scale is None:
            return
        self.scale_checked = bool(is_reading(frame.depth).any())
        if isinstance(recording, Recording):
            scale = recording.scale_of(frame.index)
        if guess := guess_depth_scale(frame.depth, scale):
            self.warn(f"{frame.label}: {guess}")
            self.doubts.append(self.warnings[-1])

    def count_readings(self, frame: Frame) -> None:
        """Note how many readings of a frame are too near or too far to be used."""
        some = frame.depth[::SPARSE, ::SPARSE]
        readings = some[(some > 0) & (some <= FARTHEST)]
        near = np.count_nonzero(readings < self.settings.depth_min)
        far = np.count_nonzero(readings > self.settings.depth_max)
        self.readings += np.array([near, far, len(readings)])

    def check_range(self) -> None:
        """Warn where many readings were left out for their depth alone."""
        near, far, total = self.readings.tolist()
        if near + far <= MOST_OUTSIDE * total:
            return
        shares = [
            f"{count / total:.0%} of the depth readings lie {where} (preprocess.{name}), and are left out"
            for count, where, name in (
                (near, f"nearer than {self.settings.depth_min:g} m", "depth_min"),
                (far, f"beyond {self.settings.depth_max:g} m", "depth_max"),
            )
            if count > MOST_OUTSIDE / 2 * total
        ]
        self.warn("; ".join(shares))

    def check_poses(self, frame: Frame) -> None:
        """Once there are enough early pairs of frames, warn if the poses do not fit their depth."""
        self.early.add(frame)
        if self.early.enough:
            self._judge_poses()

    def _judge_poses(self) -> None:
        pairs = self.early.take()
        if self.doubts:  # poses in metres cannot fit a depth whose unit is wrong
            return
        if pairs is not None and (sentence := judge_poses(pairs).sentence):
            self.warn(sentence)
            self.doubts.append(sentence)

    def add_step(self, frame: Frame, step: StepResult, waited: float) -> None:
        for name, reason in step.lacking.items():
            if not any(name in earlier.lacking for earlier in self.steps):
                self.warn(f"{reason}; frames without it add to the other maps only")
        self.steps.append(replace(step, milliseconds={"load": 1e3 * waited, **step.milliseconds}))
        self.poses.append((frame.timestamp, frame.require_pose()))
        self.check_poses(frame)
        self.count_readings(frame)

    def add_flush(self, milliseconds: Mapping[str, float]) -> None:
        """Add what fusing the last window took to the last step."""
        if self.steps:
            last = self.steps[-1]
            stages = dict.fromkeys((*last.milliseconds, *milliseconds))
            total = {
                stage: last.milliseconds.get(stage, 0.0) + milliseconds.get(stage, 0.0)
                for stage in stages
            }
            self.steps[-1] = replace(last, milliseconds=total)

    def add_skipped(self, i: int, error: UniFusionError) -> SkippedFrame:
        reason = next(reason for kind, reason in SKIP_REASONS.items() if isinstance(error, kind))
        if reason not in self.reasons:
            self.warn(f"frame skipped, {reason}: {error}")
        self.reasons[reason] += 1
        skipped = SkippedFrame(index_in_recording(self.sequence, i), reason, str(error))
        self.skipped.append(skipped)
        return skipped

    def result(self, interrupted: bool, failure: Exception | None) -> RunResult:
        if not self.steps and not interrupted:
            raise failure or DatasetError(self._nothing_used())
        for error in (failure, failure and failure.__cause__):
            if error is not None:
                error.__traceback__ = None  # it would hold the maps as long as the result lives
        self.check_range()
        self._judge_poses()
        trajectory = Trajectory.of(
            [stamp for stamp, _ in self.poses],
            [step.index for step in self.steps],
            [T for _, T in self.poses],
        )
        return RunResult(
            tuple(self.steps),
            tuple(self.skipped),
            trajectory,
            tuple(self.warnings),
            time.perf_counter() - self.started,
            interrupted,
            failure,
            tuple(self.doubts),
        )

    def _nothing_used(self) -> str:
        if not self.skipped:
            return f"{self.name}: there are no frames to use"
        reason, count = self.reasons.most_common(1)[0]
        first = next(frame.message for frame in self.skipped if frame.reason == reason)
        return f"{self.name}: none of {len(self.skipped)} frames could be used, {count} for '{reason}' (first: {first})"
