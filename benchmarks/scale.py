"""What maps in tiles and work on many processes cost.

    python benchmarks/scale.py building PATH/aws-small-house [--rows 12 --columns 10 --every 10]
    python benchmarks/scale.py workers 7scenes PATH [--end 120] [--workers 1 2]
    python benchmarks/scale.py chaos 7scenes PATH [--kills 20]
    python benchmarks/scale.py model --shard-seconds S --shard-bytes B --merge-seconds M

`building` lays the flat out beside itself, with true poses, and maps it within --map-memory; `workers`
compares one process on all cores with workers of a thread each; `chaos` kills workers at random moments,
and compares the map with that of an undisturbed run; `model` tells from these figures how long many
workers need for many scans.
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
from collections.abc import Iterator
from dataclasses import astuple, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from taichi_unifusion.config import Config
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.tiles import TileFolder, map_bytes
from taichi_unifusion.maps.stored import read_stored, read_tile
from taichi_unifusion.types import Frame, PinholeCamera

PITCH = np.array([22.0, 14.0])  # [m] from one flat to the next, which is 19 x 11 m
# an Open3D VoxelBlockGrid with colour holds per voxel a float, a weight and three colours, as floats
# and 16-bit numbers: attributes tsdf f32, weight u16, color 3 u16
OPEN3D_BYTES_A_VOXEL, OPEN3D_VOXEL, BLOCK = 4 + 2 + 3 * 2, 0.01, 16
FIRST_FLATS = 4  # that the time of a frame is compared with


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    commands = parser.add_subparsers(required=True)
    building = commands.add_parser("building")
    building.add_argument("path", type=Path)
    building.add_argument("--rows", type=int, default=12)
    building.add_argument("--columns", type=int, default=10)
    building.add_argument("--every", type=int, default=10)
    building.add_argument("--map-memory", default="1GB")
    building.add_argument("--out", type=Path)
    building.add_argument("--no-mesh", action="store_true")
    building.set_defaults(run=run_building)
    for name, function in (("workers", run_workers), ("chaos", run_chaos)):
        command = commands.add_parser(name)
        command.add_argument("format")
        command.add_argument("path")
        command.add_argument("--end", type=int, default=120)
        command.set_defaults(run=function)
        if name == "workers":
            command.add_argument("--workers", type=int, nargs="+", default=[1, 2])
        else:
            command.add_argument("--kills", type=int, default=20)
    model = commands.add_parser("model")
    for flag in ("--shard-seconds", "--shard-bytes", "--merge-seconds"):
        model.add_argument(flag, type=float, required=True)
    model.add_argument("--workers", type=int, default=100)
    model.add_argument("--scans", type=int, default=10_000)
    model.add_argument("--disk", type=float, default=1e9, help="bytes a second of the shared disk")
    model.set_defaults(run=run_model)
    options = parser.parse_args()
    options.run(options)


def render_flat(path: Path, every: int, folder: Path) -> None:
    """Render the frames of one flat into files, in a process of its own: the meshes and images of the
    flat do not count to the memory of the mapping.
    """
    from house import load_house

    tour = load_house(path, "tour")
    for n, i in enumerate(range(0, len(tour), every)):
        frame = tour[i]
        assert frame.color is not None
        values = {"depth": frame.depth, "color": frame.color, "T": frame.require_pose()}
        np.savez(folder / f"{n:03d}.npz", camera=astuple(frame.camera), **values)


def building_frames(options: argparse.Namespace) -> Iterator[tuple[int, Frame]]:
    """The flat of every frame, and the frame at its place in the building."""
    center = (options.columns - 1) / 2, (options.rows - 1) / 2  # the index reaches 205 m each way
    with tempfile.TemporaryDirectory() as rendered:
        spawned = get_context("spawn").Process(
            target=render_flat, args=(options.path, options.every, Path(rendered))
        )
        spawned.start()
        spawned.join()
        files = sorted(Path(rendered).iterdir())
        for n in range(options.rows * options.columns):
            row, column = divmod(n, options.columns)
            column = column if row % 2 == 0 else options.columns - 1 - column  # to and fro
            for i, file in enumerate(files):
                with np.load(file) as values:
                    T = values["T"].copy()
                    T[:2, 3] += PITCH * (column - center[0], row - center[1])
                    fx, fy, cx, cy, width, height = values["camera"].tolist()
                    camera = PinholeCamera(fx, fy, cx, cy, int(width), int(height))
                    yield n, Frame(values["depth"], camera, values["color"], T, n * len(files) + i)


def run_building(options: argparse.Namespace) -> None:
    """Map the building, and print a row for every ten flats."""
    from taichi_unifusion.pipeline import Pipeline
    from taichi_unifusion.results.tiled import stream_mesh

    out = options.out or Path(tempfile.mkdtemp(prefix="building"))
    config = replace(Config(voxel_size=0.05), map_memory=options.map_memory)
    pipeline = Pipeline(config, tiles=out / "maps")
    assert pipeline.memory is not None
    spent: dict[int, list[float]] = {}
    print("flats  ms a frame (CPU)  voxels in memory  on disk MB  peak memory MB", flush=True)
    for flat, frame in building_frames(options):
        started = time.process_time()
        pipeline.step(frame)
        spent.setdefault(flat, []).append(1e3 * (time.process_time() - started))
        if (flat + 1) % 10 == 0 and frame.index % len(spent[0]) == len(spent[0]) - 1:
            recent = [ms for n in range(flat - 9, flat + 1) for ms in spent[n]]
            held = sum(len(each.grid) for each in pipeline.maps.values())
            disk = sum(each.folder.bytes for each in pipeline.memory.sets.values())
            print(
                f"{flat + 1:5d}  {np.mean(recent):16.1f}  {held:16,d}  {disk / 1e6:10.0f}  {peak_mb():14.0f}",
                flush=True,
            )
    pipeline.flush()
    pipeline.memory.save()
    early = np.mean([ms for n in range(1, 1 + FIRST_FLATS) for ms in spent.get(n, [np.nan])])
    late = np.mean([ms for n in sorted(spent)[-FIRST_FLATS:] for ms in spent[n]])
    for name, each in pipeline.memory.sets.items():
        print(f"{name}: {each.folder.voxels:,} voxels in {len(each.folder.tiles)} tiles")
    print(f"the last flats take {late / early:.2f} of the first ones' time")
    blocks = blocks_of(pipeline.memory.sets["surface"].folder)
    size = blocks * BLOCK**3 * OPEN3D_BYTES_A_VOXEL
    print(
        f"Open3D at 1 cm: {blocks:,} blocks of {BLOCK}^3 voxels hold this surface, {size / 1e9:.1f} GB at "
        f"{OPEN3D_BYTES_A_VOXEL} bytes a voxel"
    )
    if not options.no_mesh:
        started = time.perf_counter()
        mesh = stream_mesh(out / "mesh.ply", pipeline.memory, config.mesh)
        print(
            f"mesh: {mesh.triangles:,} triangles in {time.perf_counter() - started:.0f} s, "
            f"peak memory {peak_mb():.0f} MB"
        )
    if options.out is None:
        shutil.rmtree(out)


def blocks_of(surface: TileFolder) -> int:
    """Blocks of a grid of 1 cm voxels that hold a voxel of a surface map's centre, at least."""
    total = 0
    for tile in surface.tiles:
        centers = (read_tile(surface, tile).keys + 0.5) * surface.manifest["settings"]["voxel_size"]
        places = np.floor(centers / (BLOCK * OPEN3D_VOXEL)).astype(np.int64)
        total += len(np.unique(places, axis=0))
    return total


def command_of(options: argparse.Namespace, out: Path, *more: str) -> list[str]:
    """`unifusion reconstruct` of the recording, in tiles."""
    code = "import sys; from taichi_unifusion.cli.main import main; sys.exit(main())"
    words = ["reconstruct", options.format, options.path, "--end", str(options.end)]
    words += ["--out", str(out), "--color-camera", "none", "--mesh.formats", "ply", *more]
    return [sys.executable, "-c", code, *words]


def run_workers(options: argparse.Namespace) -> None:
    """One process on all cores against workers of one thread each; the second run of each counts."""
    print(
        "processes  seconds  ratio  bytes of shards MB  surface voxels  mesh triangles", flush=True
    )
    base = 0.0
    for workers in (0, *options.workers):
        seconds, out = 0.0, Path(tempfile.mkdtemp(prefix="workers"))
        more = ["--workers", str(workers)] if workers else ["--map-memory", "2GB"]
        for _ in range(2):
            started = time.perf_counter()
            subprocess.run(command_of(options, out, *more), check=True, capture_output=True)
            seconds = time.perf_counter() - started
        base = base or seconds
        stored = [map_bytes(path) for path in (out / "maps").iterdir()]
        _, surface = read_stored(out / "maps" / "surface")
        mesh = read_mesh(out / "mesh.ply")
        print(
            f"{workers or 'one':>9}  {seconds:7.1f}  {seconds / base:5.2f}  {sum(stored) / 1e6:18.1f}  "
            f"{len(surface):14,d}  {len(mesh.faces):14,d}",
            flush=True,
        )
        shutil.rmtree(out)


def run_chaos(options: argparse.Namespace) -> None:
    """Kill a worker now and then, until the run is done or so many were killed; compare the maps."""
    calm, wild = (Path(tempfile.mkdtemp(prefix=name)) for name in ("calm", "wild"))
    more = ["--workers", "2"]
    subprocess.run(command_of(options, calm, *more), check=True, capture_output=True)
    rng, killed, tries, code = random.Random(0), 0, 0, 1
    while code and tries < options.kills + 3:
        tries += 1
        run = subprocess.Popen(
            command_of(options, wild, *more), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
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


def run_model(options: argparse.Namespace) -> None:
    """Hours and bytes of many scans on many workers, each scan one shard: fusing goes in parallel, what
    is read and written goes through one disk.
    """
    fuse = options.scans * options.shard_seconds / options.workers
    merge = options.scans * options.merge_seconds / options.workers
    moved = options.scans * options.shard_bytes * 4  # written, read to merge, merged, and its mesh
    disk = moved / options.disk
    print(f"{options.scans:,} scans on {options.workers} workers:")
    print(f"fusing and voting  {fuse / 3600:8.1f} h")
    print(f"adding up          {merge / 3600:8.1f} h")
    print(f"shared disk        {disk / 3600:8.1f} h for {moved / 1e12:.2f} TB")
    most = options.workers * disk / (fuse + merge)
    print(
        f"the disk is the limit from {options.workers * (fuse + merge) / disk:,.0f} workers on ({most:.2f} busy)"
    )


def peak_mb() -> float:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
