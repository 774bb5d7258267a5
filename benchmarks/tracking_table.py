"""Trackers over many stretches of recordings, one table: every row is kept in a file, so that the
table is made in pieces.

    python benchmarks/tracking_table.py PATH/data --cache rows
    python benchmarks/tracking_table.py PATH/data --cache rows --methods ours open3d-model --stretches kitchen room
    python benchmarks/tracking_table.py PATH/data --cache rows --minutes 15     # goes on where it ended
    python benchmarks/tracking_table.py PATH/data --cache rows --minutes 0      # shows what is there

PATH/data holds 7scenes-redkitchen, aws-small-house and tum-fr1desk9; what is not there is left out.
Per method: trajectory error (ATE, RMSE [cm]) where poses are exact, else the map's error on frames
left out [cm], as benchmarks/tracking.py has it; "n of m" where frames have no pose.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from tracking import METHODS, map_error, trajectory_error
from tracking_stretches import STRETCHES

import taichi_unifusion as uf
from taichi_unifusion.results.tables import format_table

GIVEN = "given"
DEFAULT = ("ours", "open3d-model", "open3d-hybrid", "opencv-rgbd", GIVEN)


def measure(name: str, method: str, data: Path) -> dict:
    """One row: a method on a stretch, as JSON values."""
    stretch = STRETCHES[name]
    frames = stretch.load(data)
    poses, seconds = (
        ({frame.index: frame.T_world_camera for frame in frames}, 0.0)
        if method == GIVEN
        else track(method, frames)
    )
    truth = {frame.index: frame.T_world_camera for frame in frames}
    ate, rpe = trajectory_error(poses, truth)
    mean, median = (None, None) if stretch.exact else map_error(frames, poses)
    return {
        "frames": len(frames),
        "tracked": len(poses),
        "exact": stretch.exact,
        "ate_cm": ate,
        "rpe_cm": rpe,
        "map_l1_cm": mean,
        "map_median_cm": median,
        "ms_a_frame": round(1e3 * seconds / max(1, len(frames)), 1),
    }


def track(method: str, frames: uf.datasets.Dataset) -> tuple[dict[int, np.ndarray], float]:
    """Poses of the frames by a method, and its process time [s]."""
    tracker, seconds = METHODS[method](frames[0].camera), 0.0
    for frame in frames:
        start = time.process_time()
        tracker.track(replace(frame, T_world_camera=None))
        seconds += time.process_time() - start
    start = time.process_time()
    poses = tracker.finish()
    return poses, seconds + time.process_time() - start


def table(rows: dict[tuple[str, str], dict], methods: Sequence[str]) -> str:
    """Stretches down, methods across; worst and mean of those stretches that all methods have which
    have any of the kind.
    """
    names = [name for name in STRETCHES if any((name, method) in rows for method in methods)]
    shown = [["stretch", "judged by", *methods]]
    for name in names:
        kinds = {row["exact"] for (at, _), row in rows.items() if at == name}
        cells = [_cell(rows.get((name, method))) for method in methods]
        shown.append([name, "ATE" if kinds == {True} else "map", *cells])
    for exact, what in ((True, "ATE"), (False, "map")):
        known = {
            method: {
                name: _value(row)
                for (name, each), row in rows.items()
                if each == method and row["exact"] is exact and _value(row) is not None
            }
            for method in methods
        }
        having = [set(of) for of in known.values() if of]
        common = set.intersection(*having) if having else set()
        values = {m: [of[name] for name in of if name in common] for m, of in known.items()}
        for label, of in (("worst", max), ("mean", np.mean)):
            cells = [f"{of(values[m]):.2f}" if values[m] else "-" for m in methods]
            shown.append([label, what, *cells])
    return format_table(shown)


def _value(row: dict) -> float | None:
    return row["ate_cm"] if row["exact"] else row["map_l1_cm"]


def _cell(row: dict | None) -> str:
    if row is None:
        return ""
    value = _value(row)
    lost = "" if row["tracked"] == row["frames"] else f" ({row['tracked']} of {row['frames']})"
    return ("-" if value is None else f"{value:.2f}") + lost


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("--cache", type=Path, required=True, help="folder of rows, one file each")
    parser.add_argument("--methods", nargs="+", default=DEFAULT, choices=[*METHODS, GIVEN])
    parser.add_argument("--stretches", nargs="+", default=list(STRETCHES), choices=list(STRETCHES))
    parser.add_argument("--minutes", type=float, default=15, help="begin no row after them")
    parser.add_argument("--threads", type=int, help="CPU threads of Taichi (default: all)")
    parser.add_argument(
        "--row", nargs=2, metavar=("STRETCH", "METHOD"), help="measure one, write its file"
    )
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    if options.row:
        name, method = options.row
        uf.init("cpu", threads=options.threads)
        found = json.dumps(measure(name, method, options.data), indent=1)
        (options.cache / f"{name}--{method}.json").write_text(found)
        return
    rows, until = {}, time.monotonic() + 60 * options.minutes
    for name in options.stretches:
        for method in options.methods:
            file = options.cache / f"{name}--{method}.json"
            if not file.exists() and time.monotonic() < until:
                # in a process of its own: Taichi does not give a map's memory back
                row = [sys.executable, __file__, str(options.data), "--cache", str(options.cache)]
                if options.threads:
                    row += ["--threads", str(options.threads)]
                subprocess.run([*row, "--row", name, method], check=False)
            if file.exists():
                rows[name, method] = json.loads(file.read_text())
    print(table(rows, options.methods))


if __name__ == "__main__":
    main()
