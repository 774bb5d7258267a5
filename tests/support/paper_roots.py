"""Miniatures of the data sets that the paper's tables are made of, exactly as these unpack: the
synthetic room, whose surface and classes are known.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from dataset_writers import (
    PERIOD,
    START,
    Sample,
    write_replica,
    write_sens,
    write_stanford,
    write_tum,
)

from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.types import Frame, Mesh, PinholeCamera

SIZE = {"width": 80, "height": 60}
LOOP = 120  # frames of the walk; few of them are written
FREIBURG3 = PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6)  # its images are always that large
BANDS = (0.4, 1.0, 1.6)  # [m] heights at which one class ends and the next begins
SETTINGS = """\
surface: {voxel_size: 0.1, support_points: 1}
color: {voxel_size: 0.05}
"""


def room(count: int, camera: PinholeCamera | None = None) -> list[Frame]:
    """The first frames of the walk, without noise."""
    size = SIZE if camera is None else {"width": camera.width, "height": camera.height}
    frames = SyntheticRoom(frames=LOOP, noise=False, **size)
    frames.camera = camera or frames.camera
    return [frames[i] for i in range(count)]


def samples_of(frames: Sequence[Frame], depth_scale: float) -> list[Sample]:
    return [
        Sample(
            frame.color,
            np.rint(frame.depth * depth_scale).astype(np.uint16),
            frame.T_world_camera,
            START + i * PERIOD,
        )
        for i, frame in enumerate(frames)
    ]


def band(heights: np.ndarray) -> np.ndarray:
    """The place in BANDS of heights above the floor: a class that is known everywhere."""
    return np.searchsorted(BANDS, heights)


def labelled_points(labels: Sequence[int], count: int) -> Mesh:
    """Points that the first frames see, with the label of their band."""
    points = np.concatenate([seen_points(frame)[::5, ::5].reshape(-1, 3) for frame in room(count)])
    values = np.array(labels, np.float32)[band(points[:, 2])]
    faces = np.empty((0, 3), np.int32)
    return Mesh(points.astype(np.float32), faces, attributes={"label": values[:, None]})


def seen_points(frame: Frame) -> np.ndarray:
    """What every pixel sees, (H, W, 3) world [m]."""
    camera, T = frame.camera, frame.T_world_camera
    v, u = np.indices(frame.depth.shape)
    rays = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)]
    return (np.dstack(rays) * frame.depth[..., None]) @ T[:3, :3].T + T[:3, 3]


def write_scannet_root(
    root: Path, names: Sequence[str], count: int = 6, labels: Sequence[int] = (2, 14, 6, 1)
) -> Path:
    """`scans/NAME/` with the .sens, the mesh and the labelled one, by NYU40 numbers."""
    frames = room(count)
    for name in names:
        folder = write_sens(
            root / "scans" / name, samples_of(frames, 1000.0), name, frames[0].camera
        )
        truth = SyntheticRoom(frames=LOOP, **SIZE).ground_truth_mesh()
        truth.save(folder / f"{name}_vh_clean_2.ply")
        labelled_points(labels, count).save(folder / f"{name}_vh_clean_2.labels.ply")
    return root


def write_replica_root(root: Path, names: Sequence[str], count: int = 6) -> Path:
    """`NAME/results/`, `NAME/traj.txt`, `NAME_mesh.ply`, and `cam_params.json` for all."""
    frames = room(count)
    for name in names:
        write_replica(root / name, samples_of(frames, 6553.5), camera=frames[0].camera)
        (root / name / "cam_params.json").replace(root / "cam_params.json")
        mesh = SyntheticRoom(frames=LOOP, **SIZE).ground_truth_mesh()
        mesh.save(root / f"{name}_mesh.ply")
    return root


def write_tum_root(root: Path, count: int = 5) -> Path:
    """The one sequence of Table II whose camera is the third."""
    samples = samples_of(room(count, FREIBURG3), 5000.0)
    write_tum(root / "rgbd_dataset_freiburg3_long_office_household", samples)
    return root


def write_stanford_root(root: Path, rooms: Mapping[str, Sequence[str]], count: int = 3) -> Path:
    """`area_N/data/` and S3DIS' `Annotations/` of the rooms of areas."""
    frames, classes = room(count), ("floor", "sofa", "window", "wall")
    for area, names in rooms.items():
        for name in names:
            write_stanford(root / area, samples_of(frames, 512.0), name, frames[0].camera)
            cloud = labelled_points(range(len(classes)), count)
            write_annotations(root / "Stanford3dDataset_v1.2" / area.title() / name, classes, cloud)
    return root


def write_annotations(room_folder: Path, classes: Sequence[str], cloud: Mesh) -> None:
    """A room of S3DIS: a text file an object, x y z r g b."""
    folder = room_folder / "Annotations"
    folder.mkdir(parents=True)
    for i, name in enumerate(classes):
        points = cloud.vertices[cloud.attributes["label"][:, 0] == i]
        rows = np.hstack([points, np.full((len(points), 3), 127.0)])
        np.savetxt(folder / f"{name}_1.txt", rows, fmt="%.3f")
    (folder / "stairs_1.txt").write_text("0.0 0.0 0.0 1 2 3\n")


def write_band_features(
    folder: Path, files: Sequence[str], rows: Sequence[int], channels: int, count: int = 6
) -> Path:
    """Features of frames as a network that knows the bands would make them: the unit vector of the
    band's row, a block of 4 x 4 pixels each.
    """
    folder.mkdir(parents=True)
    for name, frame in zip(files, room(count), strict=False):
        heights = seen_points(frame)[..., 2]
        kinds = np.eye(channels, dtype=np.float32)[np.array(rows)[band(heights)]]
        height, width = heights.shape
        blocks = kinds.reshape(height // 4, 4, width // 4, 4, channels).mean(axis=(1, 3))
        np.save(folder / f"{name}.npy", blocks.astype(np.float16))
    return folder
