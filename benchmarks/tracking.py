"""Tracking: trajectory error and time from RGB-D frames alone, and how well a pair of frames is refined, against peers.

    python benchmarks/tracking.py 7scenes PATH --end 300
    python benchmarks/tracking.py 7scenes PATH --end 300 --methods ours ours-no-loops ours-geometry
    python benchmarks/tracking.py synthetic --methods ours ours-no-loops
    python benchmarks/tracking.py house-living PATH/aws-small-house --methods ours ours-no-loops
    python benchmarks/tracking.py tum PATH/rgbd_dataset_freiburg1_desk
    python benchmarks/tracking.py 7scenes PATH --end 300 --refine 100      # a pair of frames, disturbed so many times

ATE is the RMSE of camera positions after the best rigid motion, RPE that of the motion from frame to frame, both against the
recording's poses; "end" is how far the last camera is off, seen from the first. "agree" needs no truth: the share of what
frames ten apart see in common that lies within 4 cm at these poses, with normals within 25 degrees. Times are process CPU time of
all threads, loading left out: a busy machine changes them less than others.
Open3D and OpenCV get the same frames and intrinsics, and their own defaults.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
import tracking_peers as peers

import taichi_unifusion as uf
from taichi_unifusion.evaluation.trajectory import evaluate_trajectory
from taichi_unifusion.terminal import format_table
from taichi_unifusion.tracking import TrackingSettings, se3
from taichi_unifusion.tracking.pyramid import build_pyramid, reduce_frame
from taichi_unifusion.tracking.registration import evaluate, register
from taichi_unifusion.tracking.rgbd import RgbdTracker
from taichi_unifusion.types import Trajectory

DEPTH_RANGE = 0.1, 6.0
PAIRED = 10                          # frames apart that are compared by "agree"
DISTURBANCE = 0.03, np.radians(2.0)  # [m, rad] at most
BACK = 0.003, np.radians(0.2)        # what counts as found back


class Ours:
    """Our tracker in the shape of the peers: frames in, poses out."""

    def __init__(self, settings: TrackingSettings) -> None:
        self.tracker = RgbdTracker(settings)

    def track(self, frame: uf.Frame) -> None:
        self.tracker.track(frame)

    def finish(self) -> dict[int, np.ndarray]:
        return {tracked.index: tracked.T_world_camera for tracked in self.tracker.finish().frames
                if tracked.T_world_camera is not None}


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
    """Share of what two frames see in common that lies within 4 cm, frames a few apart: says of poses how well depths agree."""
    kept = [index for index in pyramids if poses.get(index) is not None]
    shares = [evaluate(pyramids[b], pyramids[a], se3.inverse(poses[a]) @ poses[b]).agreement
              for a, b in zip(kept, kept[1:], strict=False)]
    return f"{100 * np.mean(shares):.1f}" if shares else "-"


def run(name: str, frames, truth: dict, pyramids: dict) -> list[str]:
    """One row of the table; fills the given poses and every tenth frame's pyramid when it is the first."""
    method, laps = None, []
    for i, frame in enumerate(frames):
        method = method or METHODS[name](frame.camera)
        truth[frame.index] = frame.T_world_camera
        if i % PAIRED == 0 and frame.index not in pyramids:
            pyramids[frame.index] = build_pyramid(reduce_frame(frame, *DEPTH_RANGE))
        start = time.process_time()
        method.track(frame)
        laps.append(1e3 * (time.process_time() - start))
    start = time.process_time()
    poses = method.finish()
    finish = 1e3 * (time.process_time() - start)
    found = [index for index in poses if truth[index] is not None]
    if len(found) < 3:
        return [name, f"{len(poses)} of {len(truth)}", *["-"] * 6]
    estimate, given = (Trajectory(np.array(found, float), np.array([source[i] for i in found])) for source in (poses, truth))
    result = evaluate_trajectory(estimate, given)
    last = se3.distance(se3.inverse(poses[found[0]]) @ poses[found[-1]], se3.inverse(truth[found[0]]) @ truth[found[-1]])
    return [name, f"{len(poses)} of {len(truth)}", f"{result.ate_cm.rmse:.2f}", f"{100 * last[0]:.2f}",
            f"{result.rpe_translation_cm.rmse:.2f}", agreement(pyramids, poses), f"{np.median(laps):.0f}",
            f"{(sum(laps[1:]) + finish) / max(len(laps) - 1, 1):.0f}"]


def refine(frames, trials: int, apart: int) -> str:
    """Pairs of frames from known disturbances: how often, how near and how fast they come back to where they came from."""
    from taichi_unifusion.tracking.pyramid import SurfelPyramid

    def pyramid(frame: uf.Frame) -> SurfelPyramid:
        return build_pyramid(reduce_frame(frame, *DEPTH_RANGE))

    rng, rows = np.random.default_rng(0), []
    starts = rng.integers(0, len(frames) - apart, trials)
    pairs, back, errors, times, theirs = {}, 0, [], [], []
    for trial, start in enumerate(starts):
        if start not in pairs:
            a, b = frames[int(start)], frames[int(start) + apart]
            T = se3.inverse(a.T_world_camera) @ b.T_world_camera
            pairs[start] = a, b, pyramid(a), pyramid(b), register(pyramid(b), pyramid(a), T).T_target_source
        a, b, first, second, optimum = pairs[start]
        twist = rng.normal(size=6)
        size = np.repeat(rng.uniform(0, 1, 2) * DISTURBANCE, 3)
        twist *= size / np.repeat([np.linalg.norm(twist[:3]), np.linalg.norm(twist[3:])], 3)
        guess = se3.exp(twist) @ optimum
        began = time.process_time()
        found = register(second, first, guess)
        times.append(1e3 * (time.process_time() - began))
        error = se3.distance(found.T_target_source, optimum)
        back += error[0] < BACK[0] and error[1] < BACK[1]
        errors.append((1e3 * error[0], np.degrees(error[1])))
        if trial % 10 == 1:  # a few are enough for the ratio of times: turn by turn, in the same run
            cloud = time.process_time()
            pyramid(a), pyramid(b)
            middle = time.process_time()
            with suppress(RuntimeError):  # it raises where it finds no correspondence
                peers.colored_icp(a, b, guess)
            theirs.append((1e3 * (middle - cloud), 1e3 * (time.process_time() - middle)))
    errors, theirs = np.array(errors), np.array(theirs)
    both = np.median(times) + np.median(theirs[:, 0])
    rows = [["what", "value"], ["found back", f"{back} of {trials}"],
            ["median error", f"{np.median(errors[:, 0]):.2f} mm, {np.median(errors[:, 1]):.3f} degrees"],
            ["largest error", f"{errors[:, 0].max():.2f} mm, {errors[:, 1].max():.3f} degrees"],
            ["alignment", f"{np.median(times):.0f} ms"], ["with both pyramids", f"{both:.0f} ms"],
            ["Open3D colored ICP, 3 scales",
             f"{np.median(theirs[:, 1]):.0f} ms, {np.median(theirs[:, 1]) / both:.1f} times as long"]]
    return format_table(rows)


def open_frames(format: str, path: str | None) -> uf.datasets.Dataset:
    """A recording, or a path through the rendered house (benchmarks/house.py)."""
    if format.startswith("house-"):
        from house import load_house

        return load_house(path, format.removeprefix("house-"), noise=True, seed=0)
    return uf.open_dataset(format, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format")
    parser.add_argument("path", nargs="?")
    parser.add_argument("--end", type=int)
    parser.add_argument("--every", type=int, default=1)
    parser.add_argument("--methods", nargs="+", default=list(METHODS), choices=list(METHODS))
    parser.add_argument("--refine", type=int, metavar="TRIALS")
    parser.add_argument("--apart", type=int, default=10, help="frames between the two of a pair (default: 10)")
    parser.add_argument("--threads", type=int)
    options = parser.parse_args()
    uf.init("cpu", threads=options.threads)
    frames = open_frames(options.format, options.path)[:options.end:options.every]
    if options.refine:
        print(refine(frames, options.refine, options.apart))
        return
    header, truth, pyramids = ["method", "tracked", "ATE cm", "end cm", "RPE cm", "agree %", "median ms", "mean ms"], {}, {}
    rows = []
    for name in options.methods:
        rows.append(run(name, frames, truth, pyramids))
        print(*rows[-1], sep="  ", file=sys.stderr, flush=True)
    given = ["given poses", f"{len(truth)} of {len(truth)}", "-", "-", "-", agreement(pyramids, truth), "-", "-"]
    print(format_table([header, *rows, given]))


if __name__ == "__main__":
    main()
