"""A scene as pictures, from any camera: drawn in software, no screen needed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, did_you_mean
from ..geometry.triangles import sample_surface
from ..rendering.drawing import Drawable, Viewpoint
from ..types import Mesh, PinholeCamera, Trajectory
from .answers import layer_name
from .captions import add_legend, add_marks
from .paths import ROUND_SECONDS, circle_round, flight_along, flight_seconds, is_short, sway
from .scene import Scene

NEAR = 0.05  # [m] nothing nearer is drawn
POINTS = 20_000  # of the surface, that a circle keeps in the picture
WAYS = ("trajectory", "circle")


def camera_of(size: tuple[int, int], fov: float) -> PinholeCamera:
    """The camera of pictures of `size` (width, height) with a vertical field of view [degrees]."""
    if not 1 <= fov <= 150:
        raise InputError(f"fov: must be between 1 and 150 degrees, got {fov:g}")
    width, height = size
    focal = 0.5 * height / math.tan(math.radians(fov) / 2)
    return PinholeCamera(width, height, focal, focal, width / 2 - 0.5, height / 2 - 0.5)


@dataclass(frozen=True)
class Picturing:
    """A scene as one camera shows it in the colours of one layer."""

    scene: Scene
    layer: str
    camera: PinholeCamera
    samples: int = 2  # per pixel and axis
    legend: bool = True

    def __post_init__(self) -> None:
        names = self.scene.layer_names
        if self.layer not in names:
            asked = layer_name(self.layer)  # "sofa" for what a query about it gave
            if asked not in names:
                near = did_you_mean(self.layer, names)
                raise InputError(
                    f"layer: {self.scene.name} has no '{self.layer[:80]}'{near}; it has {', '.join(names)}"
                )
            object.__setattr__(self, "layer", asked)

    def picture(self, T_world_camera: NDArray) -> NDArray[np.uint8]:
        """(H, W, 3) RGB from a pose (4, 4), with legend, boxes and labels."""
        view = Viewpoint(self.camera, T_world_camera, NEAR)
        picture = self._drawable.draw(view, self.samples)
        boxes, labels = self.scene.boxes, self.scene.labels
        picture = add_marks(picture, self.camera, T_world_camera, boxes, labels)
        legend = self.scene.legend(self.layer)
        return add_legend(picture, legend) if legend is not None and self.legend else picture

    def depth(self, T_world_camera: NDArray) -> NDArray[np.float32]:
        """(H, W) [m] along the optical axis at the pixels' centres, 0 where nothing is seen."""
        view = Viewpoint(self.camera, T_world_camera, NEAR)
        return self._drawable.depth_buffer(view).depth(nothing=0.0)

    def normals(self, T_world_camera: NDArray) -> NDArray[np.uint8]:
        """(H, W, 3) unit normals at the pixels' centres as (255 (n + 1) / 2), x right, y up, z
        towards the camera; black where nothing is seen.
        """
        axes = T_world_camera[:3, :3] * (1, -1, -1)
        colors = ((self._drawable.normals @ axes + 1) / 2).astype(np.float32)
        flat = replace(self._drawable, colors=np.ascontiguousarray(colors), shading=0.0)
        view = Viewpoint(self.camera, T_world_camera, NEAR)
        return flat.draw(view, samples=1, occluded=False, background=(0.0, 0.0, 0.0))

    @cached_property
    def _drawable(self) -> Drawable:
        parts = [shown.colored(self.layer) for shown in self.scene.meshes]
        starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
        faces = [part.faces + start for part, start in zip(parts, starts, strict=False)]
        normals = [shown.normals for shown in self.scene.meshes]
        whole = Mesh(
            np.concatenate([part.vertices for part in parts]),
            np.concatenate(faces).astype(np.int32),
            np.concatenate(normals),
            {"color": np.concatenate([part.attributes["color"] for part in parts])},
        )
        return Drawable.of(whole)


def plan_path(
    scene: Scene,
    trajectory: Trajectory | None,
    way: str,
    camera: PinholeCamera,
    rate: float,
    seconds: float | None = None,
) -> NDArray[np.float64]:
    """Poses (N, 4, 4), `rate` of them a second, of one of WAYS through a scene: along a trajectory,
    smoothed (around what it looks at, if it hardly moves), or once around everything. Raises
    InputError where there is no trajectory to fly along.
    """
    poses = np.empty((0, 4, 4)) if trajectory is None else trajectory.T_world_camera
    if way == "trajectory" and not len(poses):
        raise InputError(f"path: {scene.name} has no trajectory; take --path circle, or a file")
    moving = way == "trajectory" and not is_short(poses)
    usual = flight_seconds(poses) if moving else ROUND_SECONDS
    steps = max(1, round((usual if seconds is None else seconds) * rate))
    if moving:
        return flight_along(poses, scene.up, steps)
    points = _surface_points(scene)
    if way == "trajectory":
        pose = poses[len(poses) // 2]
        ahead = (points - pose[:3, 3]) @ pose[:3, 2]
        depth = float(np.median(ahead[ahead > NEAR])) if (ahead > NEAR).any() else 1.0
        return sway(pose, depth, scene.up, steps)
    start = poses[:, :3, 2].mean(axis=0) if len(poses) else None
    return circle_round(points, scene.up, camera, steps, start)


def _surface_points(scene: Scene) -> NDArray[np.float64]:
    """Points (N, 3) [m] evenly over the surface of all meshes."""
    rng, total = np.random.default_rng(0), max(scene.triangles, 1)
    return np.concatenate(
        [
            sample_surface(
                shown.mesh.vertices,
                shown.mesh.faces,
                max(1, POINTS * len(shown.mesh.faces) // total),
                rng,
            )
            for shown in scene.meshes
        ]
    )
