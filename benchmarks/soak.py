"""A camera that looks at one scene for thousands of frames: memory of the process must not grow (R8, S6).

.venv/bin/python benchmarks/soak.py --frames 10000
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from taichi_unifusion import Pipeline
from taichi_unifusion.config import Config
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.maps.settings import PropertySettings, SurfaceSettings

CONFIG = Config(
    device="cpu",
    surface=SurfaceSettings(voxel_size=0.1, support_points=1),
    color=PropertySettings(voxel_size=0.05),
)
MOST_GROWTH = 1.0  # [MB] per 1000 frames, as R8 has it
VIEWS = 20  # frames of the room that are repeated


def resident() -> float:
    """Resident memory of this process [MB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1e3


def main() -> int:
    """Fuse frames and print memory; exit code 1 where it grows."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=10_000)
    options = parser.parse_args()
    frames = list(SyntheticRoom(frames=VIEWS, width=160, height=120))
    pipeline, start = Pipeline(CONFIG), time.perf_counter()
    seen, memory = [], []
    for i in range(options.frames):
        pipeline.step(replace(frames[i % VIEWS], index=i))
        if i % max(options.frames // 20, 1) == 0 or i == options.frames - 1:
            seen.append(i)
            memory.append(resident())
            spent = time.perf_counter() - start
            print(f"frame {i:6d}  {memory[-1]:7.1f} MB  {spent:6.0f} s", flush=True)
    half = len(seen) // 2  # kernels are compiled and pools grow in the first
    slope = 1000 * np.polyfit(seen[half:], memory[half:], 1)[0]
    print(f"growth over the second half: {slope:.2f} MB per 1000 frames (at most {MOST_GROWTH})")
    return int(slope > MOST_GROWTH)


if __name__ == "__main__":
    raise SystemExit(main())
