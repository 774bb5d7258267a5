"""A map larger than memory: a building of many flats, which is the same flat laid out beside itself.

    python benchmarks/scale.py PATH/aws-small-house [--rows 12 --columns 10 --every 10] [--out FOLDER]
    python benchmarks/scale.py PATH/aws-small-house --out FOLDER --only-mesh

Its poses are the true ones, and it is mapped within --map-memory. Prints a row for every ten flats: how
long a frame takes, what is in memory and on disk; in the end what Open3D's grid would need. Then the
mesh is made, piece by piece, and looked through for vertices that lie twice at one place.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import tempfile
import time
from collections.abc import Iterator
from dataclasses import astuple, replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_unifusion.config import Config
from taichi_unifusion.files.ply import FACE_ROW
from taichi_unifusion.files.tiles import TileFolder
from taichi_unifusion.maps.stored import read_tile
from taichi_unifusion.maps.tiled_mesh import on_border
from taichi_unifusion.maps.working_set import MapMemory
from taichi_unifusion.results.tiled import open_memory, stream_mesh
from taichi_unifusion.types import Frame, PinholeCamera

PITCH = np.array([22.0, 14.0])  # [m] from one flat to the next, which is 19 x 11 m
# an Open3D VoxelBlockGrid with colour holds per voxel a float, a weight and three colours, as floats
# and 16-bit numbers: attributes tsdf f32, weight u16, color 3 u16
OPEN3D_BYTES_A_VOXEL, OPEN3D_VOXEL, BLOCK = 4 + 2 + 3 * 2, 0.01, 16
FIRST_FLATS = 4  # that the time of a frame is compared with
VERTEX_ROW = np.dtype(
    [(name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz")] + [("rgb", "u1", 3)]
)
ROWS = 1 << 20  # of a mesh that are read at once


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("path", type=Path)
    parser.add_argument("--rows", type=int, default=12)
    parser.add_argument("--columns", type=int, default=10)
    parser.add_argument("--every", type=int, default=10)
    parser.add_argument("--map-memory", default="1GB")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--resolution", type=int, default=4, help="cells a voxel of the mesh")
    parser.add_argument("--no-mesh", action="store_true")
    parser.add_argument("--only-mesh", action="store_true", help="of the maps that are in --out")
    options = parser.parse_args()
    if not options.only_mesh:
        run_building(options)
    elif options.out is None:
        parser.error("--only-mesh needs --out")
    else:
        memory = open_memory({name: options.out / "maps" / name for name in ("surface", "color")})
        assert memory is not None
        mesh_building(options.out, options.resolution, memory)


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
                    width, height, *rest = values["camera"].tolist()
                    camera = PinholeCamera(int(width), int(height), *rest)
                    yield n, Frame(values["depth"], camera, values["color"], T, n * len(files) + i)


def run_building(options: argparse.Namespace) -> None:
    """Map the building, and print a row for every ten flats."""
    from taichi_unifusion.pipeline import Pipeline

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
        mesh_building(out, options.resolution, pipeline.memory)
    if options.out is None:
        shutil.rmtree(out)


def mesh_building(out: Path, resolution: int, memory: MapMemory) -> None:
    """Write the mesh of all tiles, and print what that takes and whether its seams are closed."""
    path, settings = out / "mesh.ply", replace(Config().mesh, resolution=resolution)
    started, spent = time.perf_counter(), time.process_time()
    mesh = stream_mesh(path, memory, settings)
    print(
        f"mesh: {mesh.triangles:,} triangles in {time.perf_counter() - started:.0f} s, "
        f"{time.process_time() - spent:.0f} s of the processor, peak memory {peak_mb():.0f} MB, "
        f"{path.stat().st_size / 1e9:.2f} GB",
        flush=True,
    )
    edges, rims, gaps = seams(path, memory.sets["surface"].map.voxel_size)
    print(
        f"seams: of {edges:,} edges along borders of tiles {rims:,} end the surface; {gaps:,} have another "
        "one at the same place, which is not welded"
    )


def seams(path: Path, voxel_size: float) -> tuple[int, int, int]:
    """Of a mesh's edges on borders between tiles: how many there are, how many have one triangle, and
    how many of these lie where another one does.
    """
    with open(path, "rb") as file:
        header = list(iter(file.readline, b"end_header\n"))
        begin = file.tell()
    vertices, faces = (int(line.split()[2]) for line in header if line.startswith(b"element"))
    rows = np.memmap(path, VERTEX_ROW, "r", begin, (vertices,))
    triangles = np.memmap(path, FACE_ROW, "r", begin + rows.nbytes, (faces,))
    border, places = np.zeros(vertices, bool), []
    for first in range(0, vertices, ROWS):
        some = rows[first : first + ROWS]
        at = np.stack([some[axis] for axis in "xyz"], axis=1)
        border[first : first + ROWS] = on_border(at, voxel_size)
        places.append(at[border[first : first + ROWS]])
    found = []
    for first in range(0, faces, ROWS):
        some = triangles[first : first + ROWS]["indices"]
        for a, b in ((0, 1), (1, 2), (2, 0)):
            found.append(some[border[some[:, a]] & border[some[:, b]]][:, [a, b]])
    ends = np.searchsorted(np.flatnonzero(border), np.concatenate(found))  # (E, 2)
    at = np.concatenate(places).view("V12").ravel()
    _, place = np.unique(at, return_inverse=True)
    edges, rims = uses_of(ends, len(at))
    return edges, rims, rims - uses_of(place.reshape(-1)[ends], len(at))[1]


def uses_of(ends: NDArray[np.int64], count: int) -> tuple[int, int]:
    """How many edges there are among the ends (E, 2) of triangles' edges, numbers below `count`, and how
    many come once.
    """
    codes = ends.min(axis=1).astype(np.int64) * count + ends.max(axis=1)
    uses = np.unique(codes, return_counts=True)[1]
    return len(uses), int((uses == 1).sum())


def blocks_of(surface: TileFolder) -> int:
    """Blocks of a grid of 1 cm voxels that hold a voxel of a surface map's centre, at least."""
    total = 0
    for tile in surface.tiles:
        centers = (read_tile(surface, tile).keys + 0.5) * surface.manifest["settings"]["voxel_size"]
        places = np.floor(centers / (BLOCK * OPEN3D_VOXEL)).astype(np.int64)
        total += len(np.unique(places, axis=0))
    return total


def peak_mb() -> float:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
