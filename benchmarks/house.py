"""The furnished flat of AWS RoboMaker, rendered as RGB-D: its labels and the paths that a hand
could carry a camera along.

    python benchmarks/house.py PATH/aws-small-house --out frames
    python benchmarks/house.py PATH/aws-small-house --paths tour --shown 207 290 456 --out docs

The first looks at all paths: clearance, steps, contact sheets. `PATH` is the folder that holds
house.glb and objects.json.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.scene import SceneDataset
from taichi_unifusion.datasets.synthetic import FRAME_RATE, look_at
from taichi_unifusion.errors import InputError
from taichi_unifusion.files.trajectories import write_trajectory
from taichi_unifusion.types import Trajectory

STEP, TURN = 0.045, 2.5  # [m], [degrees] between frames, at most
BOB, BOB_PERIOD = 0.012, 0.7  # [m] of the carrying hand's rise and fall, over this way
ROLL, ROLL_PERIOD = 1.2, 1.9  # [degrees] over [m]
SHORT = 0.25  # [m] two waypoints count as at least so far apart: turning on the spot takes time too
DENSITY = 400  # poses a waypoint that the speed is measured on

# Closed paths: eye x, y, z and what it looks at x, y, z [m]
PATHS = {
    "living": [  # around the sofa
        (3.3, -3.3, 1.45, 0.9, -2.2, 0.5),
        (3.5, -1.2, 1.50, 1.0, -1.8, 0.5),
        (2.4, 0.3, 1.50, 0.2, -1.7, 0.5),
        (0.4, 0.6, 1.45, -0.1, -1.8, 0.5),
        (-1.3, 0.0, 1.45, -0.2, -2.0, 0.5),
        (-1.8, -1.8, 1.50, 0.1, -2.7, 0.6),
        (-1.7, -3.4, 1.50, -0.2, -4.9, 0.7),
        (-0.2, -3.9, 1.45, 0.9, -5.4, 0.8),
        (1.4, -3.9, 1.45, 2.7, -5.4, 1.0),
        (2.9, -3.8, 1.45, 3.4, -5.4, 0.9),
        (3.6, -3.9, 1.45, 2.0, -4.6, 0.6),
    ],
    "tour": [  # living room, balcony, dining room, kitchen
        (3.3, -3.0, 1.45, 0.8, -2.3, 0.5),
        (3.3, -0.9, 1.45, 0.8, -1.9, 0.5),
        (1.6, 0.5, 1.50, -0.2, -1.4, 0.5),
        (-0.4, 0.9, 1.50, -1.8, 2.6, 0.8),
        (-0.9, 2.2, 1.45, -0.7, 4.4, 0.5),
        (0.4, 2.7, 1.45, 0.2, 4.6, 0.6),
        (1.4, 2.2, 1.45, 3.1, 3.5, 0.8),
        (2.9, 1.0, 1.45, 3.9, 3.0, 0.8),
        (4.3, 0.6, 1.50, 6.3, 1.6, 0.6),
        (5.0, -0.6, 1.50, 6.8, 0.8, 0.6),
        (6.4, -1.3, 1.50, 8.7, -0.7, 0.9),
        (6.6, -2.3, 1.50, 9.0, -2.9, 0.9),
        (6.9, -3.3, 1.50, 8.8, -4.5, 0.9),
        (6.3, -3.6, 1.50, 7.0, -5.5, 0.9),
        (5.2, -3.2, 1.45, 4.9, -5.3, 0.9),
        (4.0, -3.4, 1.45, 2.9, -5.4, 0.9),
        (3.4, -3.8, 1.45, 1.4, -4.4, 0.7),
    ],
    "bedroom": [  # from the living room around the wall between bedroom and study
        (-1.6, -1.2, 1.50, -3.9, -0.3, 0.9),
        (-3.0, -0.6, 1.50, -4.3, 1.9, 0.7),
        (-4.4, 0.2, 1.50, -5.6, 2.3, 0.6),
        (-5.8, 0.1, 1.50, -7.0, 2.3, 0.6),
        (-7.1, 0.2, 1.50, -8.6, 2.1, 0.8),
        (-7.7, 0.0, 1.50, -9.2, 0.7, 0.8),
        (-8.2, -0.5, 1.50, -9.3, -1.6, 0.7),
        (-8.7, -1.2, 1.50, -8.9, -3.6, 0.6),
        (-8.5, -2.3, 1.50, -8.1, -4.7, 0.6),
        (-7.1, -3.2, 1.45, -6.6, -5.4, 0.8),
        (-5.6, -3.6, 1.45, -3.9, -5.2, 0.9),
        (-4.6, -3.5, 1.50, -2.6, -4.2, 0.9),
        (-3.5, -2.6, 1.50, -2.3, -1.0, 1.0),
        (-3.2, -1.5, 1.50, -3.2, 0.6, 0.9),
        (-2.3, -1.0, 1.50, -4.3, 0.6, 0.8),
    ],
}


def load_house(
    path: str | Path, name: str = "living", *, noise: bool = True, seed: int = 0
) -> SceneDataset:
    """Frames along the path `name` of PATHS; `path` is the folder with house.glb and objects.json.

    Classes are those of objects.json (`.class_names`, `.labels(i)`), objects the placed meshes
    (`.scene.object_names`).
    """
    return open_dataset(
        "scene",
        Path(path) / "house.glb",
        trajectory=trajectory(name),
        classes=read_classes(path),
        noise=noise,
        seed=seed,
    )


def read_classes(path: str | Path) -> dict[str, str]:
    """Class of every object (placed mesh) of the house."""
    objects = json.loads((Path(path) / "objects.json").read_text())
    return {name: entry["class"] for name, entry in objects.items()}


def trajectory(name: str) -> Trajectory:
    """The closed path `name` of PATHS at a hand's even speed, at most STEP and TURN a frame, from
    the last to the first too.
    """
    if name not in PATHS:
        raise InputError(f"house: path '{name}' is unknown; there are {', '.join(PATHS)}")
    t = np.linspace(0, 1, DENSITY * len(PATHS[name]) + 1)
    dense = poses_on(PATHS[name], t)
    effort = np.concatenate([[0], np.cumsum(np.hypot(steps(dense) / STEP, turns(dense) / TURN))])
    count = int(np.ceil(effort[-1])) + 1
    return Trajectory(
        np.arange(count) / FRAME_RATE,
        poses_on(PATHS[name], np.interp(np.arange(count) / count * effort[-1], effort, t)),
    )


def poses_on(path: Sequence[Sequence[float]], t: NDArray) -> NDArray[np.float64]:
    """T_world_camera (N, 4, 4) at t of [0, 1] on the smooth closed curve through a path's
    waypoints.
    """
    from scipy.interpolate import CubicSpline

    points = np.array([*path, path[0]])
    way = np.linalg.norm(np.diff(points[:, :3], axis=0), axis=1)
    # centripetal: no loops at close waypoints
    knots = np.concatenate([[0], np.cumsum(np.sqrt(np.maximum(way, SHORT)))])
    at = CubicSpline(knots / knots[-1], points, bc_type="periodic")(t)
    phase = 2 * np.pi * t * way.sum()
    at[:, 2] += BOB * np.sin(phase / BOB_PERIOD * _whole(way.sum() / BOB_PERIOD))
    roll = np.radians(ROLL) * np.sin(phase / ROLL_PERIOD * _whole(way.sum() / ROLL_PERIOD))
    poses = np.stack([look_at(row[:3], row[3:]) for row in at])
    turned = np.tile(np.eye(4), (len(t), 1, 1))
    turned[:, 0, 0] = turned[:, 1, 1] = np.cos(roll)
    turned[:, 1, 0] = np.sin(roll)
    turned[:, 0, 1] = -turned[:, 1, 0]
    return poses @ turned


def _whole(periods: float) -> float:
    """The factor that makes the number of periods whole, so that a closed path stays closed."""
    return round(periods) / periods


def steps(T_world_camera: NDArray) -> NDArray[np.float64]:
    """Distances [m] between consecutive poses, (N - 1,)."""
    return np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1)


def turns(T_world_camera: NDArray) -> NDArray[np.float64]:
    """Angles [degrees] between consecutive poses, (N - 1,)."""
    R = T_world_camera[:, :3, :3]
    # 2 sqrt(2) sin(angle / 2): exact for small angles too
    chord = np.linalg.norm(R[1:] - R[:-1], axis=(1, 2))
    return np.degrees(2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1)))


def clearance(dataset: SceneDataset, samples: int = 2_000_000) -> NDArray[np.float64]:
    """Distance [m] of every camera centre to the nearest surface, (N,), to the spacing of samples
    on it.
    """
    import trimesh
    from scipy.spatial import cKDTree

    scene = dataset.scene
    mesh = trimesh.Trimesh(scene.vertices, scene.faces, process=False)
    points, _ = trimesh.sample.sample_surface(mesh, samples, seed=0)
    points = np.vstack([points, mesh.triangles_center])
    return cKDTree(points).query(dataset.T_world_camera[:, :3, 3])[0]


def picture(dataset: SceneDataset, index: int, width: int = 240) -> NDArray[np.uint8]:
    """One frame, (H, width, 3) BGR: colour, depth as read (0-5.5 m, black: no reading), classes,
    one below the other.
    """
    frame, (classes, _) = dataset[index], dataset.labels(index)
    depth = cv2.applyColorMap(
        (np.clip(frame.depth / 5.5, 0, 1) * 255).astype(np.uint8), cv2.COLORMAP_TURBO
    )
    depth[frame.depth == 0] = 0
    palette = np.random.default_rng(0).integers(
        40, 256, (len(dataset.class_names) + 1, 3), dtype=np.uint8
    )
    palette[-1] = 0  # -1: nothing there
    parts = frame.color[..., ::-1], depth, palette[classes]
    size = width, width * frame.camera.height // frame.camera.width
    return np.vstack([cv2.resize(part, size, interpolation=cv2.INTER_AREA) for part in parts])


def contact_sheet(dataset: SceneDataset, columns: int = 6, rows: int = 5) -> NDArray[np.uint8]:
    """Pictures of frames evenly over a path, numbered, (H, W, 3) BGR."""
    cells = [
        cv2.putText(
            picture(dataset, i), str(i), (4, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 255), 1
        )
        for i in np.linspace(0, len(dataset) - 1, columns * rows).astype(int)
    ]
    return np.vstack([np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("path", type=Path)
    parser.add_argument("--paths", nargs="+", default=list(PATHS), choices=list(PATHS))
    parser.add_argument(
        "--shown",
        nargs="+",
        type=int,
        metavar="N",
        help="only write one picture, of these frames of a path",
    )
    parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.paths:
        dataset = load_house(options.path, name)
        if options.shown:
            shown = [picture(dataset, i, 320) for i in options.shown]
            cv2.imwrite(
                str(options.out / f"house-{name}.jpg"),
                np.hstack(shown),
                [cv2.IMWRITE_JPEG_QUALITY, 80],
            )
            continue
        write_trajectory(options.out / f"{name}.txt", dataset.trajectory)
        cv2.imwrite(str(options.out / f"{name}.jpg"), contact_sheet(dataset))
        T, free = dataset.T_world_camera, clearance(dataset)
        closed = np.concatenate([T, T[:1]])
        print(
            f"{name}: {len(T)} frames, {steps(closed).sum():.1f} m, "
            f"steps up to {100 * steps(closed).max():.1f} cm and {turns(closed).max():.1f} degrees, "
            f"nearest surface {free.min():.2f} m (frame {free.argmin()})"
        )


if __name__ == "__main__":
    main()
