"""Where a frame's time goes: milliseconds by kernel, beside the least that this machine needs for the
bytes and operations that the kernel cannot do without; `speed.py --profile`.
"""

from __future__ import annotations

import inspect
import re
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from os import cpu_count
from typing import Any

import numpy as np
import taichi as ti
from speed_sides import Ours, timed
from speed_tables import markdown
from taichi.lang import kernel_impl

import taichi_unifusion as uf

# what Taichi adds to a kernel's name: which compiled form of it, and which of its loops
TASK = re.compile(r"^(?P<kernel>.+)_c\d+(?P<form>_\d+)_kernel_\d+_\w+$")
SHOWN = 0.002  # kernels of a smaller share of the time go into one row
COPIED, MULTIPLIED, TRIES = 1 << 24, 1024, 5  # floats of a copy, edge of a product


@dataclass(frozen=True)
class Machine:
    """What NumPy reaches on all processors."""

    bytes_per_ms: float  # of a copy, read and written
    flops_per_ms: float  # of a product of float32 matrices

    def least(self, moved: float, flops: float) -> float:
        """Milliseconds, where moving and computing overlap."""
        return max(moved / self.bytes_per_ms, flops / self.flops_per_ms)


def measure_machine() -> Machine:
    """The best of a few copies and products."""
    threads = cpu_count() or 1
    rng = np.random.default_rng(0)
    source = [rng.random(COPIED // threads, np.float32) for _ in range(threads)]
    target = [np.zeros_like(part) for part in source]
    a = rng.random((MULTIPLIED, MULTIPLIED), np.float32)
    with ThreadPoolExecutor(threads) as pool:
        copy = min(
            _seconds(lambda: list(pool.map(np.copyto, target, source))) for _ in range(TRIES)
        )
    product = min(_seconds(lambda: a @ a) for _ in range(TRIES))
    moved = 2 * sum(part.nbytes for part in source)
    return Machine(moved / copy / 1e3, 2 * MULTIPLIED**3 / product / 1e3)


def _seconds(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


Arguments = Mapping[str, Any]  # of one launch, by name


@dataclass(frozen=True)
class Count:
    """Bytes and floating-point operations of one launch: what it must read and write once, from
    the shapes of its arguments."""

    how: str
    of: Callable[[Arguments], tuple[float, float]]


def _pixels(image: Any) -> int:
    return image.shape[0] * image.shape[1]


def _cells(masks: np.ndarray) -> np.ndarray:
    """How many cells masks (..., 2) hold."""
    words = np.ascontiguousarray(masks, np.uint32)
    return np.unpackbits(words.view(np.uint8), axis=-1).sum(axis=-1)


def _rows(array: Any, rows: int | None) -> np.ndarray:
    """The first rows of an array that may have more room; None: all."""
    return (array.to_numpy() if hasattr(array, "to_numpy") else np.asarray(array))[:rows]


def _clipping(of: Arguments) -> tuple[float, float]:
    return 4 * 3 * _pixels(of["depth"]), 0


def _patches(of: Arguments) -> tuple[float, float]:
    pixels, pairs = _pixels(of["inverse"]), 2 * (2 * of["sinks"].radius + 1)
    # a quarter as many patches, which read and write a cell of the surface and one of the colours
    moved = pixels * (4 + 3) + pixels / 4 * 2 * 8 * (7 + 4)
    return moved, pixels * (6 * pairs / 4 + 35) + pixels / 4 * 40


def _compacting(of: Arguments) -> tuple[float, float]:
    cells = int(_cells(_rows(of["masks"], of["blocks"])).sum())
    channels = of["channels"]
    return cells * (2 * 8 * (1 + channels) + 4 * (1 + channels)), cells * (2 + 2 * channels)


def _encoding(of: Arguments) -> tuple[float, float]:
    layout = of["layout"]
    begin, end = of["begin"], of["end"]
    points = _rows(of["rows"], end)[begin:, 1]
    masks, neighbors = _rows(of["masks"], None), _rows(of["neighbors"], end)[begin:]
    seen = _cells(masks[neighbors] & _rows(of["window"], 27))  # (B, 27) cells
    solved = points >= of["minimum"]
    columns = np.where(neighbors >= 0, seen, 0).sum(axis=1)[solved].sum()
    if layout.derivatives:
        normals = _rows(of["cells"], None)[:, 2:5] if layout.some_normals else np.ones((1, 3))
        columns *= 1 + 3 * normals.any(axis=1).mean()  # three more for a sample with a normal
    size, rows = layout.size // 4, layout.rows // 4  # in patches of 4 x 4
    patches = sum(min(i + 1, size) for i in range(rows))
    solve = layout.size**3 / 3 + layout.size**2 * (layout.rows - layout.size + 2 * layout.channels)
    flops = 32.0 * patches * columns + solve * solved.sum()
    cells = int(_cells(masks[begin:end]).sum())
    moved = cells * 4 * (1 + layout.channels) + (end - begin) * 4 * (27 + 2 + 3)
    return moved + 4 * solved.sum() * layout.latent_rows * layout.channels, flops


def _voting(of: Arguments) -> tuple[float, float]:
    begin, end = of["slots"]
    rank, K, poses = (
        of["rank"],
        np.array(of["K"]),
        _rows(of["T_camera_world"], None).reshape(-1, 3, 4),
    )
    height, width = of["depth"].shape[-2:]
    centers = (_rows(of["keys"], end)[begin:] + 0.5) * of["voxel_size"]
    supported = _cells(_rows(of["masks"], end)[begin:])
    anywhere, flops, cells = np.zeros(end - begin, bool), 0.0, 0
    for T in poses.astype(np.float64):
        x, y, z = T[:, :3] @ centers.T + T[:, 3:]
        u, v = x / np.maximum(z, 1e-3) * K[0] + K[2], y / np.maximum(z, 1e-3) * K[1] + K[3]
        seen = (z > 0) & (u > 0) & (v > 0) & (u < width) & (v < height)
        anywhere, cells = anywhere | seen, cells + 64 * int(seen.sum())
        flops += 90.0 * supported[seen].sum() + 30.0 * (64 - supported[seen]).sum()
    moved = 12.0 * (end - begin) + anywhere.sum() * (8 + 4 * rank + 2 * 64)
    images = 4.0 * min(height * width * len(poses), cells)  # a pixel a cell, or all pixels
    return moved + images, flops + 8.0 * rank * supported[anywhere].sum()


COUNTS = {
    "clip_and_invert": Count("a float in, two out a pixel", _clipping),
    "make_patches": Count(
        "a float and a colour in a pixel, a cell of each map in and out a quad; 6 operations a pair of "
        "the window, shared by 4 pixels, 35 a pixel and 40 a quad",
        _patches,
    ),
    "compact_cells": Count(
        "sums of cells with points in and set to 0, their means out", _compacting
    ),
    "encode_cells": Count(
        "cells in once, latents out; 32 operations a patch of the Gram matrix's lower half and sample "
        "of the doubled voxel, then Cholesky",
        _encoding,
    ),
    "vote_cells": Count(
        "all keys, masks, latents and evidence of voxels in view, a pixel a cell and view; 8 l operations a "
        "cell with support, and a view 90, 30 without support",
        _voting,
    ),
}


@contextmanager
def counted_launches() -> Iterator[dict[str, list[tuple[float, float]]]]:
    """Bytes and operations of every launch of the kernels in COUNTS, by name."""
    launch, counted = kernel_impl.Kernel.__call__, defaultdict(list)

    def counting(self, *arguments, **keywords):
        count = COUNTS.get(self.func.__name__)
        if count is not None:
            names = inspect.signature(self.func).parameters
            of = dict(zip(names, arguments, strict=False))
            counted[self.func.__name__].append(count.of(of))
        return launch(self, *arguments, **keywords)

    kernel_impl.Kernel.__call__ = counting
    try:
        yield counted
    finally:
        kernel_impl.Kernel.__call__ = launch


def kernel_times() -> dict[str, tuple[float, int]]:
    """Milliseconds and launches by kernel, since the profiler was cleared."""
    program = ti.lang.impl.get_runtime().prog
    program.sync_kernel_profiler()
    program.update_kernel_profiler()
    found: dict[str, tuple[float, int]] = defaultdict(lambda: (0.0, 0))
    loops: dict[str, str] = {}
    for record in program.get_kernel_profiler_records():
        parts = TASK.match(record.name)
        kernel, form = parts.group("kernel", "form") if parts else (record.name, "")
        first = loops.setdefault(kernel + form, record.name)  # every launch has one of these
        ms, calls = found[kernel]
        found[kernel] = ms + record.kernel_time, calls + (record.name == first)
    return found


def profile(frames: Sequence[uf.Frame], config: uf.Config, warm_up: int) -> str:
    """Two tables in Markdown, for frames after the first `warm_up`; Taichi must have been started
    with its profiler on.
    """
    ours = Ours(config)
    for frame in frames[:warm_up]:
        ours.step(frame)
    ours.finish()
    count = len(frames) - warm_up
    ti.profiler.clear_kernel_profiler_info()
    laps = [timed(ours.step, frame) for frame in frames[warm_up:]]
    wall, cpu = (np.sum(laps, axis=0) + timed(ours.finish)) / count
    times = kernel_times()
    del ours  # gives its index trees to the next one, for which kernels are compiled
    again = Ours(config)
    with counted_launches() as counted:  # apart: counting takes time of its own
        for n, frame in enumerate(frames):
            if n == warm_up:
                again.finish()
                counted.clear()
            again.step(frame)
        again.finish()
    machine = measure_machine()
    return (
        f"{count} frames, Pipeline.step {wall:.1f} ms a frame by the clock, {cpu:.1f} of the processors\n\n"
        f"{kernel_table(times, counted, machine, count)}\n\n{how_counted(counted)}\n\n"
        "Kernels are timed by the clock. This machine, NumPy on all processors: "
        f"{machine.bytes_per_ms / 1e6:.1f} GB/s (a copy), {machine.flops_per_ms / 1e6:.0f} GFlop/s (a "
        "product of matrices)."
    )


def kernel_table(
    times: Mapping[str, tuple[float, int]],
    counted: Mapping[str, Sequence[tuple[float, float]]],
    machine: Machine,
    frames: int,
) -> str:
    """Rows by kernel, the slowest first."""
    total = sum(ms for ms, _ in times.values())
    rows, rest = [], 0.0
    for name, (ms, calls) in sorted(times.items(), key=lambda item: -item[1][0]):
        if ms < SHOWN * total:
            rest += ms
            continue
        cells = ["-"] * 4
        if name in counted:
            moved, flops = np.sum(counted[name], axis=0) / frames
            least = machine.least(moved, flops)
            times_least = f"{ms / frames / least:.0f}"
            cells = [f"{moved / 1e6:.1f}", f"{flops / 1e6:.1f}", f"{least:.2f}", times_least]
        share = f"{100 * ms / total:.0f}"
        rows.append([name, f"{ms / frames:.2f}", share, f"{calls / frames:.1f}", *cells])
    rows.append(["others", f"{rest / frames:.2f}", *["-"] * 6])
    rows.append(["all kernels", f"{total / frames:.2f}", "100", *["-"] * 5])
    header = ["kernel", "ms a frame", "%", "calls a frame", "MB", "MFlop", "least ms", "times that"]
    return markdown(header, rows)


def how_counted(names: Iterable[str]) -> str:
    rows = [[name, COUNTS[name].how] for name in sorted(names)]
    return markdown(["kernel", "how its bytes and operations are counted"], rows)
