"""Time a frame and a mesh, beside Open3D's TSDF on the same frames in the same run.

    python benchmarks/speed.py 7scenes PATH --end 300 --every 1 3 10
    python benchmarks/speed.py synthetic --window 1           # frame by frame
    python benchmarks/speed.py 7scenes PATH --growth          # the 300th frame against the 30th
    python benchmarks/speed.py 7scenes PATH --end 60 --every 3 --profile     # by kernel

Ours: surface and colour with the defaults (5 cm and 2.5 cm voxels) through `Pipeline.step`, and the
same maps given cloud after cloud. Peer: `VoxelBlockGrid` with colour at 1 cm in blocks of 8, on the
CPU. They take turns, ten frames each, so that a busy machine slows all; the first turn, in which
kernels are compiled, does not count. Figures are means, by the clock on the wall and as processor
time of all threads: work that a pipeline puts off to a later frame is in them, what is left at the
end too. Frames are loaded before the clock starts. The mesh with colour is the mean of three.
"""

from __future__ import annotations

import argparse
import os
import resource
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from speed_sides import ByHand, OpenTsdf, Ours, Side, Times, timed
from speed_tables import HEADER, markdown, rows_of

import taichi_unifusion as uf
from taichi_unifusion.config import MeshSettings
from taichi_unifusion.errors import MissingDependency
from taichi_unifusion.preprocessing import PreprocessSettings

TURN, REST = 10, 0.5  # frames; seconds in which all threads come to rest
MESHES = 3  # that count, after one that compiles
WORST = 3.0  # goal: the worst frame, as a multiple of the mean
VIEWS, ROUNDS = 20, 15  # of `--growth`
GROWTH = 1.3  # goal: the last round against the second


def measure(sides: Sequence[Side], frames: Sequence[uf.Frame]) -> dict[str, Times]:
    """Times by side; raises InputError where there are not more frames than the first turn has."""
    if len(frames) <= TURN:
        raise uf.errors.InputError(
            f"{len(frames)} frames: more than {TURN} are needed, since the first {TURN} do not count"
        )
    laps: dict[str, list] = {side.name: [] for side in sides}
    for first in range(0, len(frames), TURN):
        for side in sides:
            time.sleep(REST)
            for frame in frames[first : first + TURN]:
                laps[side.name].append(timed(side.step, side.prepare(frame)))
            if first == 0:  # or frames that count would do work of those that do not
                side.finish()
    finish = {side.name: timed(side.finish) for side in sides}
    meshes: dict[str, list] = {side.name: [] for side in sides}
    for side in [*sides] * (1 + MESHES):
        time.sleep(REST)
        meshes[side.name].append(timed(side.mesh))
    return {
        name: Times(np.array(laps[name][TURN:]), finish[name], np.mean(meshes[name][1:], axis=0))
        for name in laps
    }


def compare(dataset: uf.Dataset, samplings: Sequence[int], config: uf.Config) -> None:
    """Print the table of all samplings, and what the worst frame and memory came to."""
    rows, worst = [], []
    for every in samplings:
        times = measure(all_sides(config), list(dataset[::every]))
        rows += rows_of(every, times)
        worst.append(times[Ours.name].worst)
    print(markdown(HEADER, rows))
    wall, cpu = np.max(worst, axis=0)
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(
        f"\nworst frame / mean at most {wall:.1f} by the clock and {cpu:.1f} of the processors (goal "
        f"{WORST:g}); peak memory of all sides and the frames {memory:.2f} GB"
    )


def all_sides(config: uf.Config) -> list[Side]:
    """New maps of every side; a peer that is not installed is left out, and that is said."""
    sides: list[Side] = [Ours(config), ByHand(config)]
    try:
        sides.append(OpenTsdf(config))
    except MissingDependency as error:
        print(f"without a peer: {error}")
    return sides


def grow(views: Sequence[uf.Frame], config: uf.Config, rounds: int = ROUNDS) -> None:
    """Print the time a frame by round: the same views in every round, while the map grows
    elsewhere.
    """
    ours, laps = Ours(config), []
    for n in range(rounds):
        shift = np.eye(4)
        shift[0, 3] = 10.0 * n  # the scene again, beside itself
        for view in views:
            frame = replace(view, T_world_camera=shift @ view.T_world_camera)
            laps.append(timed(ours.step, frame))
    means = np.array(laps).reshape(rounds, len(views), 2).mean(axis=1)
    size = len(views)
    rows = [
        [f"{size * n} to {size * (n + 1) - 1}", f"{wall:.1f}", f"{cpu:.1f}"]
        for n, (wall, cpu) in enumerate(means)
    ]
    print(markdown(("frames", "wall [ms]", "CPU [ms]"), rows))
    wall, cpu = means[-1] / means[1]
    sizes = {name: len(each) for name, each in ours.pipeline.maps.items()}
    print(
        f"\nlast round / second: {wall:.2f} by the clock, {cpu:.2f} of the processors (goal {GROWTH:g}); "
        f"{', '.join(f'{count:,} voxels of {name}' for name, count in sizes.items())}"
    )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("format")
    parser.add_argument("path", nargs="?")
    parser.add_argument("--end", type=int, help="leave out the frames from this one on")
    parser.add_argument("--every", type=int, nargs="+", default=[1], help="a row for each")
    parser.add_argument("--window", type=int, help="frames that are fused at once (Config.window)")
    parser.add_argument("--depth-max", type=float, default=5.0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--growth", action="store_true", help="time by the size of the map")
    parser.add_argument("--profile", action="store_true", help="time by kernel")
    options = parser.parse_args(arguments)
    config = uf.Config(
        preprocess=PreprocessSettings(depth_max=options.depth_max), mesh=MeshSettings(min_area=0.0)
    )
    if options.window is not None:
        config = replace(config, window=options.window)
    if options.profile:
        os.environ["TI_KERNEL_PROFILER"] = "1"  # read when Taichi starts
    live = uf.init(options.device)
    dataset = uf.open_dataset(options.format, options.path)[: options.end]
    print(f"{options.format}, {live.description}")
    if options.growth:
        grow(list(dataset[: VIEWS * options.every[0] : options.every[0]]), config)
    elif options.profile:
        from speed_profile import profile

        print(profile(list(dataset[:: options.every[0]]), config, TURN))
    else:
        compare(dataset, options.every, config)


if __name__ == "__main__":
    main()
