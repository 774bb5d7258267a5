"""How well a colour camera that is not registered to depth is found from the frames alone: rigs of
known geometry in rendered scenes.

    python benchmarks/color_camera.py                                   the synthetic room
    python benchmarks/color_camera.py --house ../shared/data/aws-small-house    along the path "living" too

Depth has a Kinect's noise. Prints what is true, what was found, the gain on frames left out, and
the processor time without rendering.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from house import load_house
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion.datasets import ColorCamera, Dataset, estimate_color_camera
from taichi_unifusion.datasets.camera_pair import CameraPair
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.geometry import se3
from taichi_unifusion.geometry.velocities import FRAME_RATE
from taichi_unifusion.types import Frame, PinholeCamera

Render = Callable[[PinholeCamera, NDArray], NDArray[np.uint8]]  # colour from T_world_camera


@dataclass(frozen=True)
class Rig:
    """A colour camera beside the depth camera."""

    turn: tuple[float, float, float] = (0, 0, 0)  # [degrees]
    move: tuple[float, float, float] = (0, 0, 0)  # [m]
    focal: float = 1.0  # by the depth camera's
    offset: float = 0.0  # [s]
    poses: float = 0.0  # [m], [rad] error of each number of the poses that are told

    def camera(self, depth: PinholeCamera) -> ColorCamera:
        """It beside a depth camera with these intrinsics."""
        T_color_depth = se3.exp(np.array([0, 0, 0, *np.radians(self.turn)]))
        T_color_depth[:3, 3] = self.move
        pinhole = replace(depth, fx=depth.fx * self.focal, fy=depth.fy * self.focal)
        return ColorCamera(pinhole, T_color_depth, clock_offset=self.offset)


RIGS = {
    "registered": Rig(),
    "registered, poses 3 mm off": Rig(poses=0.003),
    "turned 0.5 degrees": Rig(turn=(0, 0.5, 0)),
    "turned 2 degrees": Rig(turn=(0, -2, 0)),
    "5 cm beside": Rig(move=(0, -0.05, 0)),
    "1 cm beside, focal +3 %": Rig(move=(0.01, 0, 0), focal=1.03),
    "focal -3 %, 20 ms late": Rig(focal=0.97, offset=0.02),
    "as a Kinect": Rig(turn=(0.5, -1, 1), move=(-0.025, 0, 0), focal=0.9, offset=-0.01),
    "as a Kinect, poses 3 mm off": Rig((0.5, -1, 1), (-0.025, 0, 0), 0.9, -0.01, 0.003),
}


class RiggedScene(CameraPair):
    """Frames of a rendered recording whose colour is that of a rig's colour camera."""

    name = "rig"
    runs_kernels = True

    def __init__(self, frames: Dataset, render: Render, rig: Rig) -> None:
        self.frames, self.render, self.seconds = frames, render, 0.0
        self.T_world_camera = np.asarray(frames.T_world_camera)
        self.camera = frames.camera
        self.rig = rig.camera(self.camera)
        off = np.random.default_rng(0).normal(size=(len(frames), 6)) * rig.poses
        self.told = self.T_world_camera @ se3.exp(off)

    def __len__(self) -> int:
        return len(self.frames)

    def pose_at(self, index: int) -> tuple[float, NDArray[np.float64]]:
        return index / FRAME_RATE, self.told[index]

    def load(self, index: int) -> Frame:
        started = time.process_time()
        frame = replace(self.frames[index], color=None, T_world_camera=self.told[index].copy())
        later = index + self.rig.clock_offset * FRAME_RATE
        color = self.render(
            self.rig.pinhole, self._pose(later) @ se3.inverse(self.rig.T_color_depth)
        )
        self.seconds += time.process_time() - started
        return self.with_color(frame, color, f"colour {index}")

    def _pose(self, at: float) -> NDArray[np.float64]:
        """Between two frames, on the motion from one to the other."""
        first = int(np.clip(np.floor(at), 0, len(self) - 2))
        T_first, T_next = self.T_world_camera[[first, first + 1]]
        return T_first @ se3.exp((at - first) * se3.log(se3.inverse(T_first) @ T_next))


def synthetic(frames: int) -> tuple[Dataset, Render]:
    """The synthetic room."""
    room = SyntheticRoom(frames=frames)

    def render(camera: PinholeCamera, T_world_camera: NDArray) -> NDArray[np.uint8]:
        scene = room._scene  # noqa: SLF001
        return scene.shade(camera, T_world_camera, *scene.cast(camera, T_world_camera))[0]

    return room, render


def house(path: Path) -> tuple[Dataset, Render]:
    """The flat, around the sofa."""
    frames = load_house(path)
    return frames, lambda camera, T: frames.scene.render(camera, T).color


def row(name: str, scene: tuple[Dataset, Render], rig: Rig) -> str:
    """One row of the table."""
    frames = RiggedScene(*scene, rig)
    started = time.process_time()
    estimate = estimate_color_camera(frames)
    seconds = time.process_time() - started - frames.seconds
    if estimate.camera is None:
        gain = "" if estimate.gain_db is None else f"{estimate.gain_db:+.1f}"
        return f"| {name} | {estimate.verdict} | | | | | {gain} | {seconds:.1f} |"
    off = se3.log(se3.inverse(frames.rig.T_color_depth) @ estimate.camera.T_color_depth)
    focal = estimate.camera.pinhole.fx / frames.rig.pinhole.fx - 1
    late = estimate.camera.clock_offset - frames.rig.clock_offset
    return (
        f"| {name} | found | {np.degrees(np.linalg.norm(off[3:])):.2f} | {1e3 * np.linalg.norm(off[:3]):.0f} "
        f"| {100 * focal:+.2f} | {1e3 * late:+.1f} | {estimate.gain_db:+.1f} | {seconds:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--house", type=Path, help="folder of aws-small-house")
    parser.add_argument("--frames", type=int, default=240, help="of the synthetic room")
    parser.add_argument("--rigs", nargs="*", default=list(RIGS), choices=list(RIGS))
    options = parser.parse_args()
    uf.init("cpu")
    scenes = {"synthetic": synthetic(options.frames)}
    if options.house:
        scenes["house"] = house(options.house)
    for name, scene in scenes.items():
        print(f"\n{name}: off by\n")
        print("| rig | | degrees | mm | focal % | ms | gain dB | s |")
        print("|---|---|---:|---:|---:|---:|---:|---:|")
        for rig in options.rigs:
            print(row(rig, scene, RIGS[rig]), flush=True)


if __name__ == "__main__":
    main()
