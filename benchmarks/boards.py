"""Boards thinner than a voxel, seen from all around: how much of either face the mesh has where it is.

    python benchmarks/boards.py
    python benchmarks/boards.py --thickness 0.01 0.05 --voxel-size 0.04

A board of a metre stands in an empty room; 16 frames of 320x240 with a Kinect's noise look at it in a
circle. Rays at right angles to each face, 2 cm from its rim and farther in, say where the mesh is.
"""

from __future__ import annotations

import argparse

import numpy as np

import taichi_unifusion as uf
from taichi_unifusion.datasets.synthetic import Scene, SyntheticRoom, look_at
from taichi_unifusion.maps import SurfaceSettings
from taichi_unifusion.rendering.primitives import box
from taichi_unifusion.rendering.raycaster import RayCaster
from taichi_unifusion.rendering.room import furnished_room
from taichi_unifusion.types import Mesh, PinholeCamera

VIEWS, TOLERANCE = 16, 0.005  # [m]
FAR = 40.0  # [m] from the face, from where rays are as good as parallel
CAMERA = PinholeCamera(97, 97, 4000.0, 4000.0, 48.0, 48.0)


class Board(SyntheticRoom):
    """A board in an empty room, in the plane y = 0."""

    def __init__(self, thickness: float) -> None:
        super().__init__(frames=VIEWS, width=320, height=240)
        self.T_world_camera = np.stack(
            [
                look_at((1.4 * np.cos(a), 1.4 * np.sin(a), 1.1 + 0.3 * np.sin(2 * a)), (0, 0, 1))
                for a in np.arange(VIEWS) * 2 * np.pi / VIEWS
            ]
        )
        room, y = furnished_room()[0], thickness / 2
        # takes the place of the furnished room, which is made when it is first needed
        self.__dict__["_scene"] = Scene((room, box(room.material, (-0.5, -y, 0.5), (0.5, y, 1.5))))


def errors(mesh: Mesh, thickness: float, side: int) -> np.ndarray:
    """How far in front of a face of the board, seen from a side of it, the mesh is met (N,) [m]."""
    near = np.abs(mesh.vertices[:, 1]) < 0.3  # what stands before the room's walls
    caster = RayCaster(mesh.part(near[mesh.faces].all(axis=1))[0])
    eye = (0.0, side * (FAR + thickness / 2), 1.0)
    return FAR - caster.cast(CAMERA, look_at(eye, (0, 0, 1))).depth.ravel()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--thickness", type=float, nargs="+", default=[0.01, 0.02, 0.03], help="metres"
    )
    parser.add_argument("--voxel-size", type=float, default=0.05, help="metres")
    asked = parser.parse_args()
    uf.init()
    print("| board | sides | within 5 mm, from either side | median error, either side |")
    print("|---|---|---:|---:|")
    for thickness in asked.thickness:
        frames = list(Board(thickness))
        for two_sides in (True, False):
            surface = SurfaceSettings(voxel_size=asked.voxel_size, two_sides=two_sides)
            pipeline = uf.Pipeline(uf.Config(surface=surface))
            for frame in frames:
                pipeline.step(frame)
            mesh = pipeline.extract_mesh(4)
            off = [np.abs(errors(mesh, thickness, side)) for side in (1, -1)]
            shares = " and ".join(f"{100 * (each < TOLERANCE).mean():.1f} %" for each in off)
            medians = " and ".join(f"{1000 * np.median(each):.2f} mm" for each in off)
            name = "apart" if two_sides else "in one field"
            print(f"| {1000 * thickness:g} mm | {name} | {shares} | {medians} |", flush=True)


if __name__ == "__main__":
    main()
