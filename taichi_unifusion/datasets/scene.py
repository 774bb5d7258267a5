"""Frames rendered from a textured scene along a trajectory: exact depth or a Kinect's, colour, and
which object is seen.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import DatasetError, InputError
from ..files.trajectories import read_trajectory
from ..rendering.textured_scene import SceneImages, TexturedScene, load_scene
from ..types import Frame, Mesh, PinholeCamera, Trajectory
from .dataset import Dataset
from .synthetic import FOCAL_PER_WIDTH


class SceneDataset(Dataset):
    """Views of a scene from the poses of a trajectory; a frame is a function of its index, the
    scene and the seed alone.

    `noise` gives a Kinect's depth instead of the exact one, `seed` changes the noise and nothing
    else. `classes` names the class of objects; one that it leaves out is its own class.
    """

    runs_kernels = registered = True

    def __init__(
        self,
        scene: TexturedScene,
        trajectory: Trajectory,
        camera: PinholeCamera | None = None,
        *,
        noise: bool = True,
        seed: int = 0,
        classes: Mapping[str, str] | None = None,
        name: str = "scene",
    ) -> None:
        self.scene, self.trajectory, self.noise, self.seed, self.name = (
            scene,
            trajectory,
            noise,
            seed,
            name,
        )
        self.camera = camera or kinect_camera()
        self.warnings = scene.warnings
        of_object = [(classes or {}).get(item, item) for item in scene.object_names]
        self.class_names = tuple(sorted(set(of_object)))
        self.class_of_object = np.array(
            [self.class_names.index(item) for item in of_object], np.int32
        )

    def __len__(self) -> int:
        return len(self.trajectory)

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        """Poses of all frames, (N, 4, 4)."""
        return self.trajectory.T_world_camera

    def load(self, index: int) -> Frame:
        """Render frame `index`: depth as a Kinect reads it (whole millimetres, 0.4-5.5 m), unless
        `noise=False`.
        """
        view = self.view(index)
        depth = kinect_reading(view, self.camera, self.seed, index) if self.noise else view.depth
        return Frame(
            depth,
            self.camera,
            view.color,
            self.T_world_camera[index].copy(),
            index,
            float(self.trajectory.timestamps[index]),
            f"{self.name} frame {index}",
        )

    def view(self, index: int) -> SceneImages:
        """Exact depth, colour, object and incidence of every pixel of frame `index`."""
        return self.scene.render(self.camera, self.T_world_camera[index])

    def exact_depth(self, index: int) -> NDArray[np.float32]:
        """Depth of frame `index` without noise or range limits, (H, W) [m], 0 where nothing is hit."""
        return self.scene.render_depth(self.camera, self.T_world_camera[index])

    def labels(self, index: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Class (row of class_names) and object (row of scene.object_names) of every pixel, (H, W),
        -1 where nothing is hit.
        """
        objects = self.scene.render_objects(self.camera, self.T_world_camera[index])
        return np.where(objects >= 0, self.class_of_object[objects], np.int32(-1)), objects

    def ground_truth_mesh(self) -> Mesh:
        """The scene's exact surface in world [m], hidden parts included."""
        return self.scene.mesh()


def open_scene(
    path: str | Path,
    *,
    trajectory: Path | str | Trajectory | None = None,
    camera: PinholeCamera | None = None,
    noise: bool = True,
    seed: int = 0,
    classes: Mapping[str, str] | None = None,
) -> SceneDataset:
    """Render the scene file at `path` along `trajectory`, a Trajectory or a file in TUM's format."""
    if trajectory is None:
        raise InputError(
            f"{path}: a scene has no cameras of its own; give a file of poses, lines 'timestamp tx ty tz qx qy qz "
            "qw', camera to world: trajectory=, or --camera-path on the command line"
        )
    poses = trajectory if isinstance(trajectory, Trajectory) else read_trajectory(trajectory)
    if not len(poses):
        raise DatasetError(f"{trajectory}: there is no pose in it")
    return SceneDataset(
        load_scene(path), poses, camera, noise=noise, seed=seed, classes=classes, name=str(path)
    )


def kinect_camera(width: int = 640, height: int = 480) -> PinholeCamera:
    """A Kinect v1's depth camera at this size."""
    focal = FOCAL_PER_WIDTH * width
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def kinect_reading(
    view: SceneImages, camera: PinholeCamera, seed: int, frame: int
) -> NDArray[np.float32]:
    """What a Kinect v1 would read there, (H, W) [m], 0 where it has no reading; depends on seed,
    frame and pixel alone.
    """
    runtime.current()
    from ..rendering.kernels.solids import kinect_depth

    depth = np.zeros_like(view.depth)
    hits = view.depth[view.depth > 0]
    if len(hits):
        kinect_depth(
            view.depth, view.cosine, float(hits.min()), seed & 0x7FFFFFFF, frame, camera.fx, depth
        )
    return depth
