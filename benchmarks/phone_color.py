"""What a phone's colour, which is larger than its depth, is worth by how depth's pixels take it up.

    python benchmarks/phone_color.py PATH/aws-small-house       256x192 of depth beside 1920x1440 of colour
    python benchmarks/phone_color.py PATH/aws-small-house --noise 0.004
    python benchmarks/phone_color.py PATH/aws-small-house --recording PATH/formats/record3d-exr

Exact poses of the rendered flat, and depth that is exact or has noise: each of depth's pixels takes the
colour in its middle, or the mean of those that it covers, or is divided (`color_detail`). A map of some
frames is asked for the colours of other ones, at random pixels of the large images, whose surface points
are exact there; also how far from its surface these points are. With --recording the same of a real one,
at the eighths of depth's pixels; its odd frames are left out.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from house import load_house
from numpy.typing import NDArray

import taichi_unifusion as uf
from taichi_unifusion.datasets import Dataset, shared_view
from taichi_unifusion.datasets.depth_registration import LensCamera
from taichi_unifusion.datasets.shared_view import SharedView, Shot
from taichi_unifusion.files.trajectories import Pose
from taichi_unifusion.types import PinholeCamera

DEPTH_SIZE = 256, 192
COLOR_CAMERA = PinholeCamera(1920, 1440, 1450.0, 1450.0, 959.5, 719.5)
EVERY, FRAMES = 4, 12  # of the path through the flat; every other one is left out of the map
ASKED = 40_000  # pixels of each frame that is left out
VOXELS = 0.025, 0.0125, 0.006  # [m] of colour; the first is the default
LARGEST = 8  # pixels for each of depth's that real colours are looked at with
WAYS = {  # how a pixel takes colours up: detail, in its middle alone
    "in the middle": (1, True),
    "mean": (1, False),
    "divided by 2": (2, False),
    "divided by 4": (4, False),
}


def middle(shot: Shot, lens: LensCamera, camera: PinholeCamera) -> NDArray[np.uint8]:
    """The colours (h, w, 3) in the middle of the camera's pixels."""
    assert shot.color is not None
    color = shot.color()
    rows, columns = (
        np.minimum((np.arange(count) + 0.5) * size / count, size - 1).astype(int)
        for count, size in zip((camera.height, camera.width), color.shape[:2], strict=True)
    )
    return color[rows][:, columns]


def phone(folder: Path, noise: float) -> tuple[list[Shot], list[NDArray[np.float32]]]:
    """Shots along the path through the living room, with `noise` as a share of depth, and exact depth of
    the large images.
    """
    rng = np.random.default_rng(1)
    scene = load_house(folder)
    shots, depths = [], []
    for i in range(0, EVERY * FRAMES, EVERY):
        T = scene.T_world_camera[i]
        images = scene.scene.render(COLOR_CAMERA, T)
        small = scene.scene.render_depth(COLOR_CAMERA.resized(*DEPTH_SIZE), T)
        small = small * (1 + noise * rng.normal(size=small.shape)).astype(np.float32)
        lens = LensCamera(COLOR_CAMERA, ())
        shots.append(
            Shot(
                f"frame {i}",
                lambda lens=lens: lens,
                lambda small=small: small,
                lambda color=images.color: color,
                pose=Pose("", T),
            )
        )
        depths.append(images.depth)
    return shots, depths


def truth(shots: list[Shot], depths: list[NDArray]) -> tuple[NDArray, NDArray]:
    """Points (N, 3) world [m] of frames that are left out and their colours (N, 3) of 0..1."""
    rng, points, colors = np.random.default_rng(0), [], []
    for shot, depth in list(zip(shots, depths, strict=True))[1::2]:
        at = rng.choice(np.flatnonzero(depth), ASKED)
        v, u = np.unravel_index(at, depth.shape)
        T = shot.pose.checked()
        rays = COLOR_CAMERA.rays(u, v) * depth[v, u][:, None]
        points.append(rays @ T[:3, :3].T + T[:3, 3])
        colors.append(shot.color()[v, u] / 255.0)
    return np.concatenate(points), np.concatenate(colors)


def truth_of(frames: Dataset) -> tuple[NDArray, NDArray]:
    """The same of a recording, whose depth lies between its pixels where these are on one surface."""
    rng, points, colors = np.random.default_rng(0), [], []
    for frame in frames:
        at = rng.choice(np.flatnonzero(frame.depth), ASKED)
        v, u = np.unravel_index(at, frame.depth.shape)
        T = frame.T_world_camera
        rays = frame.camera.rays(u, v) * frame.depth[v, u][:, None]
        points.append(rays @ T[:3, :3].T + T[:3, 3])
        colors.append(frame.color[v, u] / 255.0)
    return np.concatenate(points), np.concatenate(colors)


def score(frames: Dataset, voxel: float, points: NDArray, colors: NDArray) -> str:
    """dB by which a map of frames knows colours of points, and mm from its surface to these."""
    config = uf.Config()
    config = replace(config, color=replace(config.color, voxel_size=voxel))
    pipeline = uf.Pipeline(replace(config, voxel_size=0.05))
    for frame in frames:
        pipeline.step(frame)
    values, known = pipeline.properties["color"].query(points.astype(np.float32), True)
    error = np.clip(values[known], 0, 1) - colors[known]
    distances, near = pipeline.surface.sdf(points.astype(np.float32))
    away = 1e3 * np.mean(np.abs(distances[near]))
    return f"{-10 * np.log10(np.mean(error**2)):.2f}, {away:.2f} mm"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("house", type=Path, help="folder of aws-small-house")
    parser.add_argument("--recording", type=Path, help="of Record3D, instead of the flat")
    parser.add_argument("--noise", type=float, default=0.0, help="of depth, as a share of it")
    parser.add_argument("--voxels", type=float, nargs="*", default=VOXELS)
    parser.add_argument("--ways", nargs="*", default=list(WAYS), choices=list(WAYS))
    options = parser.parse_args()
    uf.init("cpu")
    if options.recording:
        recording = uf.open_dataset("record3d", options.recording)
        shots = list(recording.shots)
        known = truth_of(SharedView("phone", shots[1::2], detail=LARGEST))
    else:
        shots, depths = phone(options.house, options.noise)
        known = truth(shots, depths)
    print(
        "| a pixel takes colour | " + " | ".join(f"{1e3 * v:g} mm" for v in options.voxels) + " |"
    )
    print("|---|" + "---:|" * len(options.voxels))
    mean = shared_view._color  # noqa: SLF001
    for name in options.ways:
        detail, in_the_middle = WAYS[name]
        shared_view._color = middle if in_the_middle else mean  # noqa: SLF001
        frames = SharedView("phone", shots[::2], detail=detail)
        row = [score(frames, voxel, *known) for voxel in options.voxels]
        print(f"| {name} | {' | '.join(row)} |", flush=True)


if __name__ == "__main__":
    main()
