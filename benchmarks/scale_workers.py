"""What work on many processes costs, and whether it survives that they are killed.

    python benchmarks/scale_workers.py workers 7scenes PATH [--end 120] [--workers 1 2 8]
    python benchmarks/scale_workers.py chaos 7scenes PATH [--kills 20]
    python benchmarks/scale_workers.py pieces 7scenes PATH [--end 120]
    python benchmarks/scale_workers.py model [--workers 100 --scans 10000 --frames 1000]

`workers` compares one process with workers that share the cores; `chaos` kills workers at random
moments, and compares the map with that of an undisturbed run; `pieces` measures every piece of work by
itself, in seconds of one core, which is steady also on a busy machine; `model` adds these pieces up for
many workers and many scans.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path

import numpy as np

from taichi_unifusion.cluster.run import plan
from taichi_unifusion.cluster.shards import Job
from taichi_unifusion.cluster.work import MAPS, VOTES, add_group, fuse_shard, merge_group, vote
from taichi_unifusion.config import Config
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.tiles import TileFolder, map_bytes
from taichi_unifusion.maps.stored import read_stored
from taichi_unifusion.results.record import Source


@dataclass(frozen=True)
class Pieces:
    """What every piece of work takes, in seconds of one core, and bytes; see `pieces`."""

    start: float  # of a worker, kernels read from the disk
    fuse: float  # a frame
    vote: float  # a frame
    merge: float  # of a million voxels of a shard
    add_votes: float  # to a million voxels of the surface
    shard_voxels: float  # millions, a frame
    surface_voxels: float  # millions, a frame
    shard_bytes: float  # a frame


def command_of(options: argparse.Namespace, out: Path, *more: str) -> list[str]:
    """`unifusion reconstruct` of the recording, in tiles."""
    code = "import sys; from taichi_unifusion.cli.main import main; sys.exit(main())"
    words = ["reconstruct", options.format, options.path, "--end", str(options.end)]
    words += ["--out", str(out), "--color-camera", "none", "--mesh.formats", "ply", *more]
    return [sys.executable, "-c", code, *words]


def run_workers(options: argparse.Namespace) -> None:
    """One process on all cores against workers that share them."""
    print("processes  seconds  CPU seconds  ratio of CPU  maps MB  surface voxels  mesh triangles")
    base = 0.0
    for workers in (0, *options.workers):
        out = Path(tempfile.mkdtemp(prefix="workers"))
        more = ["--workers", str(workers)] if workers else ["--map-memory", "2GB"]
        started, spent = time.perf_counter(), cpu_of_children()
        subprocess.run(command_of(options, out, *more), check=True, capture_output=True)
        seconds, spent = time.perf_counter() - started, cpu_of_children() - spent
        base = base or spent
        stored = sum(map_bytes(path) for path in (out / "maps").iterdir())
        _, surface = read_stored(out / "maps" / "surface")
        mesh = read_mesh(out / "mesh.ply")
        print(
            f"{workers or 'one':>9}  {seconds:7.1f}  {spent:11.1f}  {spent / base:12.2f}  "
            f"{stored / 1e6:7.1f}  {len(surface):14,d}  {len(mesh.faces):14,d}",
            flush=True,
        )
        shutil.rmtree(out)


def cpu_of_children() -> float:
    """Seconds that processes which have ended, and theirs, were on a core."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def run_chaos(options: argparse.Namespace) -> None:
    """Kill a worker now and then, until the run is done or so many were killed; compare the maps."""
    calm, wild = (Path(tempfile.mkdtemp(prefix=name)) for name in ("calm", "wild"))
    more = ["--workers", "2"]
    subprocess.run(command_of(options, calm, *more), check=True, capture_output=True)
    rng, killed, tries, code = random.Random(0), 0, 0, 1
    while code and tries < options.kills + 3:
        tries += 1
        run = subprocess.Popen(
            command_of(options, wild, *more, "--resume"),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        drain = threading.Thread(target=run.communicate)
        drain.start()
        while run.poll() is None and killed < options.kills:
            time.sleep(rng.uniform(2, 10))
            if workers := _workers_of(run.pid):
                os.kill(rng.choice(workers), signal.SIGKILL)
                killed += 1
                print(f"worker {killed} killed", flush=True)
        drain.join()
        code = run.returncode
    print(f"{killed} workers killed in {tries} tries, the last ended with {code}")
    for name in ("surface", "color"):
        (_, a), (_, b) = (read_stored(each / "maps" / name) for each in (calm, wild))
        equal = all(np.array_equal(a.tensors[part], b.tensors[part]) for part in a.tensors)
        print(
            f"{name}: {len(a):,} and {len(b):,} voxels, {'equal' if equal else 'DIFFERENT'} bytes"
        )
    shutil.rmtree(calm)
    shutil.rmtree(wild)


def _workers_of(parent: int) -> list[int]:
    """Process numbers of the workers that a run has started, its own nannies left out."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            line = (path / "cmdline").read_bytes().replace(b"\0", b" ")
            status = (path / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(status[1]) == parent and b"spawn_main" in line:
            found.append(int(path.name))
    return found


def run_pieces(options: argparse.Namespace) -> None:
    """Two shards, fused, added up and voted in by this process; the first one reads the kernels."""
    with tempfile.TemporaryDirectory(prefix="pieces") as folder:
        print_pieces(measure(options, Path(folder)))


def measure(options: argparse.Namespace, folder: Path) -> Pieces:
    """The pieces of two shards of a recording."""
    recording = open_dataset(options.format, options.path)[: options.end]
    source = Source(
        format=options.format,
        path=options.path,
        start=0,
        end=options.end,
        every=1,
        frames=len(recording),
    )
    job = Job(source, None, replace(Config(voxel_size=0.05), threads=1), str(folder / "shards"))
    shards = plan(job, 1)
    done = [timed(fuse_shard, job, each) for each in shards]
    parts = {
        name: [str(each.folder(job) / MAPS / name) for each in shards]
        for name in ("surface", "color")
    }
    merge_seconds, voxels = 0.0, 0
    for name, paths in parts.items():
        folders = [TileFolder.open(path) for path in paths]
        tiles = sorted({tile for each in folders for tile in each.tiles})
        merge_seconds += timed(merge_group, job, name, paths, str(folder / name), tiles)[0]
        voxels += sum(each.voxels for each in folders)
    merged = folder / "surface"
    votes = [timed(vote, job, each, str(merged)) for each in shards]
    surface = TileFolder.open(merged)
    added = timed(
        add_group,
        job,
        str(merged),
        [str(each.folder(job) / VOTES) for each in shards],
        str(folder / "voted"),
        sorted(surface.tiles),
    )[0]
    last = shards[-1].last - shards[-1].first
    return Pieces(
        start=start_seconds(),
        fuse=done[-1][0] / last,
        vote=votes[-1][0] / last,
        merge=1e6 * merge_seconds / voxels,
        add_votes=1e6 * added / surface.voxels,
        shard_voxels=voxels / 1e6 / len(recording),
        surface_voxels=surface.voxels / 1e6 / len(recording),
        shard_bytes=sum(each[1].bytes for each in done) / len(recording),
    )


def timed(work: Callable, *arguments: object) -> tuple[float, object]:
    """Seconds of this process on a core that work takes, and its result."""
    started = time.process_time()
    result = work(*arguments)
    return time.process_time() - started, result


def start_seconds() -> float:
    """What a process takes until it could fuse a frame."""
    code = "from taichi_unifusion import pipeline; pipeline.warm_up()"
    before = cpu_of_children()
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
    return cpu_of_children() - before


def print_pieces(pieces: Pieces) -> None:
    """As `model` takes them."""
    print(
        " ".join(
            f"--{f.name.replace('_', '-')} {getattr(pieces, f.name):.4g}" for f in fields(pieces)
        )
    )


def run_model(options: argparse.Namespace) -> None:
    """Core hours and bytes of many scans on many workers, of so many frames a scan."""
    pieces = Pieces(**{each.name: getattr(options, each.name) for each in fields(Pieces)})
    frames = options.scans * options.frames
    hours = {
        "starting workers": pieces.start * options.workers,
        "fusing": pieces.fuse * frames,
        "adding up": pieces.merge * pieces.shard_voxels * frames,
        "voting": pieces.vote * frames + pieces.add_votes * pieces.surface_voxels * frames,
    }
    total = sum(hours.values())
    moved = (
        4 * pieces.shard_bytes * frames
    )  # written, read to be added up, written, read for the mesh
    print(
        f"{options.scans:,} scans of {options.frames:,} frames on {options.workers} workers of one core:"
    )
    for name, seconds in hours.items():
        print(f"{name:18} {seconds / 3600:10.1f} core hours {100 * seconds / total:5.1f} %")
    print(f"{'together':18} {total / 3600 / options.workers:10.1f} hours")
    print(f"{'disk':18} {moved / options.disk / 3600:10.1f} hours for {moved / 1e12:.1f} TB")
    print(f"the disk is the limit from {total * options.disk / moved:,.0f} workers on")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    for name, function in (("workers", run_workers), ("chaos", run_chaos), ("pieces", run_pieces)):
        command = commands.add_parser(name)
        command.add_argument("format")
        command.add_argument("path")
        command.add_argument("--end", type=int, default=120)
        command.set_defaults(run=function)
        if name == "workers":
            command.add_argument("--workers", type=int, nargs="+", default=[1, 2])
        elif name == "chaos":
            command.add_argument("--kills", type=int, default=20)
    model = commands.add_parser("model")
    for each in fields(Pieces):
        model.add_argument(f"--{each.name.replace('_', '-')}", type=float, required=True)
    model.add_argument("--workers", type=int, default=100)
    model.add_argument("--scans", type=int, default=10_000)
    model.add_argument("--frames", type=int, default=1000, help="of a scan")
    model.add_argument("--disk", type=float, default=1e9, help="bytes a second of the shared disk")
    model.set_defaults(run=run_model)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
