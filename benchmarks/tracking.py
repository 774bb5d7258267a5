"""Tracking: trajectory error and time from RGB-D frames alone, and how well a pair of frames is
refined, against peers.

    python benchmarks/tracking.py 7scenes PATH --end 300
    python benchmarks/tracking.py 7scenes PATH --end 300 --methods ours ours-no-loops ours-geometry
    python benchmarks/tracking.py synthetic --methods ours ours-no-loops
    python benchmarks/tracking.py house-tour PATH/aws-small-house --methods ours ours-no-loops --every 5
    python benchmarks/tracking.py tum PATH/rgbd_dataset_freiburg1_desk
    python benchmarks/tracking.py 7scenes PATH --end 300 --refine 100      # a pair of frames, disturbed so many times

ATE is the RMSE of camera positions after the best rigid motion, RPE that of the motion from frame
to frame, both against the recording's poses; "end" is how far the last camera is off, seen from the
first. "agree" needs no truth: the share of what frames ten apart see in common that lies within 4
cm at these poses, with normals within 25 degrees. Times are process CPU time of all threads, after
a warm-up, reading of frames left out; "mean" holds keyframes, loops and the final optimisation. The
methods take the frames turn by turn. Open3D and OpenCV get the same frames and intrinsics, and
their own defaults.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise

import numpy as np
import tracking_peers as peers

import taichi_unifusion as uf
from taichi_unifusion.datasets.loading import index_in_recording
from taichi_unifusion.evaluation.rendering import evaluate_rendering
from taichi_unifusion.evaluation.trajectory import evaluate_trajectory
from taichi_unifusion.geometry import se3
from taichi_unifusion.results.tables import format_table
from taichi_unifusion.tracking import TrackingSettings
from taichi_unifusion.tracking.pyramid import SurfelPyramid, build_pyramid, reduce_frame
from taichi_unifusion.tracking.registration import evaluate, register
from taichi_unifusion.tracking.rgbd import RgbdTracker
from taichi_unifusion.types import Trajectory

DEPTH_RANGE = 0.1, 6.0
PAIRED = 10  # frames apart that are compared by "agree"
COMMON = 0.25  # share of a frame that must be seen by both
DISTURBANCE = 0.03, np.radians(2.0)  # [m, rad] at most
BACK = 0.003, np.radians(0.2)  # what counts as found back
WARM_UP = 3  # frames
HEADER = [
    *("method", "tracked", "ATE cm", "end cm", "RPE cm", "agree %", "map cm", "map median"),
    *("median ms", "mean ms"),
]
MAPPED = 10  # the map is made of every so many frames ...
JUDGED = 5  # ... and judged by the frame so many after each of them


class Ours:
    """Our tracker in the shape of the peers: frames in, poses out."""

    def __init__(self, settings: TrackingSettings) -> None:
        self.tracker = RgbdTracker(settings)

    def track(self, frame: uf.Frame) -> None:
        self.tracker.track(frame)

    def finish(self) -> dict[int, np.ndarray]:
        return {
            tracked.index: tracked.T_world_camera
            for tracked in self.tracker.finish().frames
            if tracked.T_world_camera is not None
        }


METHODS: dict[str, Callable[[uf.PinholeCamera], object]] = {
    "ours": lambda camera: Ours(TrackingSettings()),
    "ours-no-loops": lambda camera: Ours(TrackingSettings(loops=False)),
    "ours-geometry": lambda camera: Ours(TrackingSettings(photometric_weight=0.0)),
    "open3d-hybrid": lambda camera: peers.TensorHybrid(camera),
    "open3d-legacy": lambda camera: peers.LegacyHybrid(camera),
    "open3d-model": lambda camera: peers.FrameToModel(camera),
    "opencv-rgbd": lambda camera: peers.OpenCv(camera),
}


def agreement(pyramids: dict, poses: dict[int, np.ndarray]) -> str:
    """Share of what two frames see in common that lies within 4 cm, frames a few apart: says of
    poses how well depths agree.
    """
    kept = [index for index in pyramids if poses.get(index) is not None]
    found = [
        evaluate(pyramids[b], pyramids[a], se3.inverse(poses[a]) @ poses[b])
        for a, b in pairwise(kept)
    ]
    shares = [pair.agreement for pair in found if pair.overlap > COMMON]
    return f"{100 * np.mean(shares):.1f}" if shares else "-"


def map_error(
    frames: uf.datasets.Dataset, poses: Mapping[int, np.ndarray | None]
) -> tuple[float | None, float | None]:
    """Mean and median error [cm] of a map of every tenth frame at these poses, judged by the depth
    of frames left out; None where there are too few.
    """
    kept = [i for i in range(0, len(frames), MAPPED) if poses.get(i) is not None]
    left_out = [i for i in range(JUDGED, len(frames), MAPPED) if poses.get(i) is not None]
    if not kept or not left_out:
        return None, None

    def posed(index: int) -> uf.Frame:
        return replace(frames[index], T_world_camera=poses[index])

    pipeline = uf.Pipeline()
    pipeline.run([posed(i) for i in kept])
    result = evaluate_rendering(
        pipeline.extract_mesh(), (replace(posed(i), color=None) for i in left_out)
    )
    return result.depth_l1_cm, result.depth_median_cm


def trajectory_error(
    poses: Mapping[int, np.ndarray], truth: Mapping[int, np.ndarray | None]
) -> tuple[float | None, float | None]:
    """ATE and RPE [cm] of the frames that both have; None for fewer than three."""
    found = [index for index in poses if truth[index] is not None]
    if len(found) < 3:
        return None, None
    result = evaluate_trajectory(
        *(
            Trajectory(np.array(found, float), np.array([source[index] for index in found]))
            for source in (poses, truth)
        )
    )
    return result.ate_cm.rmse, result.rpe_translation_cm.rmse


class Run:
    """One method on its way through the frames: one row of the table."""

    def __init__(self, name: str, camera: uf.PinholeCamera) -> None:
        self.name, self.method, self.laps = name, METHODS[name](camera), []

    def track(self, frame: uf.Frame) -> None:
        start = time.process_time()
        self.method.track(frame)
        self.laps.append(1e3 * (time.process_time() - start))

    def row(self, truth: dict, pyramids: dict, frames: uf.datasets.Dataset) -> list[str]:
        start = time.process_time()
        poses = self.method.finish()
        total = sum(self.laps) + 1e3 * (time.process_time() - start)
        counted = [self.name, f"{len(poses)} of {len(truth)}"]
        times = [f"{np.median(self.laps):.0f}", f"{total / len(self.laps):.0f}"]
        ate, rpe = trajectory_error(poses, truth)
        if ate is None or rpe is None:
            return [*counted, *["-"] * 6, *times]
        found = [index for index in poses if truth[index] is not None]
        first, end = found[0], found[-1]
        last, _ = se3.distance(*(se3.inverse(T[first]) @ T[end] for T in (poses, truth)))
        return [
            *counted,
            f"{ate:.2f}",
            f"{100 * last:.2f}",
            f"{rpe:.2f}",
            agreement(pyramids, poses),
            *_shown(map_error(frames, _by_place(poses, frames))),
            *times,
        ]


def _by_place(poses: Mapping, frames: uf.datasets.Dataset) -> dict[int, np.ndarray]:
    """Poses by the frame's place in what is tracked, where they go by its place in the recording."""
    places = {index_in_recording(frames, i): i for i in range(len(frames))}
    return {places[index]: T for index, T in poses.items()}


def _shown(values: Sequence[float | None]) -> list[str]:
    return ["-" if value is None else f"{value:.2f}" for value in values]


def compare(names: Sequence[str], frames: uf.datasets.Dataset) -> list[list[str]]:
    """Rows of all methods and of the given poses; they take the frames turn by turn, so that their
    times compare.
    """
    warm_up(names, frames[:WARM_UP])
    runs, truth, pyramids = [Run(name, frames[0].camera) for name in names], {}, {}
    for i, frame in enumerate(frames):
        truth[frame.index] = frame.T_world_camera
        if i % PAIRED == 0:
            pyramids[frame.index] = pyramid(frame)
        for run in runs:
            run.track(frame)
    given = [
        "given poses",
        f"{len(truth)} of {len(truth)}",
        *["-"] * 3,
        agreement(pyramids, truth),
        *_shown(map_error(frames, _by_place(truth, frames))),
        "-",
        "-",
    ]
    return [*(run.row(truth, pyramids, frames) for run in runs), given]


def warm_up(names: Sequence[str], frames: uf.datasets.Dataset) -> None:
    """Load kernels and libraries, as happens once a process, before times are taken."""
    runs = [Run(name, frames[0].camera) for name in names]
    for frame in frames:
        for run in runs:
            run.track(frame)
    for run in runs:
        run.method.finish()


def pyramid(frame: uf.Frame) -> SurfelPyramid:
    return build_pyramid(reduce_frame(frame, *DEPTH_RANGE))


def disturbance(rng: np.random.Generator) -> np.ndarray:
    """A motion in any direction, of any size up to DISTURBANCE."""
    twist = rng.normal(size=6)
    length = np.repeat([np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])], 3)
    return se3.exp(twist / length * np.repeat(rng.uniform(0, 1, 2) * DISTURBANCE, 3))


def refine(frames: uf.datasets.Dataset, trials: int, apart: int) -> str:
    """Pairs of frames from known disturbances: how often, how near and how fast they come back to
    where they came from.
    """
    rng = np.random.default_rng(0)
    errors, times, pyramid_times, their_times = [], [], [], []
    for trial, start in enumerate(rng.integers(0, len(frames) - apart, trials)):
        a, b = frames[int(start)], frames[int(start) + apart]
        began = time.process_time()
        first, second = pyramid(a), pyramid(b)
        pyramid_times.append(time.process_time() - began)
        optimum = register(
            second, first, se3.inverse(a.T_world_camera) @ b.T_world_camera
        ).T_target_source
        guess = disturbance(rng) @ optimum
        began = time.process_time()
        found = register(second, first, guess).T_target_source
        times.append(time.process_time() - began)
        errors.append(se3.distance(found, optimum))
        # a few are enough for the ratio of times: turn by turn, in the same run
        if trial % 10 == 1:
            began = time.process_time()
            with suppress(RuntimeError):  # it raises where it finds no correspondence
                peers.colored_icp(a, b, guess)
            their_times.append(time.process_time() - began)
    errors, (ours, pyramids, theirs) = (
        np.array(errors),
        (1e3 * np.median(t) for t in (times, pyramid_times, their_times)),
    )
    back = int((errors < BACK).all(axis=1).sum())
    shown = [
        f"{1e3 * distance:.2f} mm, {np.degrees(angle):.3f} degrees"
        for distance, angle in (np.median(errors, axis=0), errors.max(axis=0))
    ]
    return format_table(
        [
            ["what", "value"],
            ["found back", f"{back} of {trials}"],
            ["median error", shown[0]],
            ["largest error", shown[1]],
            ["alignment", f"{ours:.0f} ms"],
            ["with both pyramids", f"{ours + pyramids:.0f} ms"],
            [
                "Open3D colored ICP, 3 scales",
                f"{theirs:.0f} ms, {theirs / (ours + pyramids):.1f} times as long",
            ],
        ]
    )


def open_frames(format: str, path: str | None) -> uf.datasets.Dataset:
    """A recording, or a path through the rendered house (benchmarks/house.py)."""
    if format.startswith("house-"):
        from house import load_house

        return load_house(path, format.removeprefix("house-"), noise=True, seed=0)
    return uf.open_dataset(format, path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("format")
    parser.add_argument("path", nargs="?")
    parser.add_argument("--end", type=int)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--refine", type=int, metavar="TRIALS")
    parser.add_argument(
        "--apart", type=int, default=10, help="frames between the two of a pair (default: 10)"
    )
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    uf.init("cpu", threads=options.threads)
    frames = open_frames(options.format, options.path)[: options.end : options.every]
    if options.refine:
        print(refine(frames, options.refine, options.apart))
        return
    print(format_table([HEADER, *compare(options.methods, frames)]))


if __name__ == "__main__":
    main()
