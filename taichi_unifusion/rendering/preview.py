"""A picture of a coloured mesh from well-chosen viewpoints, drawn in software: no GPU, no graphics
library, no screen.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, check_choice
from ..files.images import write_png
from ..geometry.gravity import find_up
from ..geometry.triangles import area_vectors
from ..types import Mesh, PinholeCamera, Trajectory, check_rigid
from .drawing import Drawable, Viewpoint

VIEWS = {  # name -> what it shows
    "camera": "from a camera of the recording, drawn back a little",
    "overview": "from above, walls and ceilings that face away left out",
    "opposite": "the overview from another side",
}
# vertical; wider than a recorded image, so that the surroundings count too
JUDGED_FOV = math.radians(55)
CANDIDATES = 12  # cameras, evenly over the recording, of which the best is taken
THUMBNAIL = (64, 48)  # pixels of the image that a candidate is judged by
CAMERA_FOV = math.radians(48)  # vertical
DRAWN_BACK = 0.15  # of the median depth: the camera moves back to show more
OVERVIEW_FOV = math.radians(32)  # vertical; narrow, so that upright edges stay nearly parallel
ELEVATION = math.radians(48)  # of the overview
AZIMUTHS = 24
MARGIN = 1.04  # size of the picture over the size of what is fitted into it
# share of the surface that may lie outside each side, so that specks do not shrink the rest
STRAY = 0.002


def render_preview(
    mesh: Mesh,
    path: str | os.PathLike,
    *,
    trajectory: Trajectory | None = None,
    up: NDArray | None = None,
    views: Sequence[str] | None = None,
    size: tuple[int, int] = (960, 720),
) -> None:
    """Write what `draw_preview` gives as a PNG; raises FileError on writing."""
    write_png(path, draw_preview(mesh, trajectory=trajectory, up=up, views=views, size=size))


def draw_preview(
    mesh: Mesh,
    *,
    trajectory: Trajectory | None = None,
    up: NDArray | None = None,
    views: Sequence[str] | None = None,
    size: tuple[int, int] = (960, 720),
) -> NDArray[np.uint8]:
    """One picture (H, W, 3) RGB of views of `mesh`, as `choose_views` finds them, side by side."""
    return draw_views(
        mesh, choose_views(mesh, trajectory=trajectory, up=up, views=views, size=size)
    )


def draw_views(mesh: Mesh, views: Sequence[Viewpoint]) -> NDArray[np.uint8]:
    """One picture (H, W, 3) RGB of a mesh from one or more viewpoints of equal height, side by side."""
    drawable = Drawable.of(mesh)
    camera = views[0].camera
    gap = np.full((camera.height, max(2, camera.width // 120), 3), 255, np.uint8)
    panels = [panel for view in views for panel in (gap, drawable.draw(view))]
    return np.hstack(panels[1:])


def choose_views(
    mesh: Mesh,
    *,
    trajectory: Trajectory | None = None,
    up: NDArray | None = None,
    views: Sequence[str] | None = None,
    size: tuple[int, int] = (960, 720),
) -> tuple[Viewpoint, ...]:
    """Where to look at `mesh` from, each for a picture of `size` (width, height) pixels.

    `views` are names of VIEWS: camera and overview where there are poses, else overview and
    opposite. `up` (3,) is a unit vector of the world; without it `find_up` tells. Raises
    InputError for a mesh without a finite triangle or an unknown view.
    """
    has_poses = trajectory is not None and len(trajectory) > 0
    names = (
        tuple(views)
        if views
        else (("camera", "overview") if has_poses else ("overview", "opposite"))
    )
    for name in names:
        check_choice("preview: view", name, VIEWS)
        if name == "camera" and not has_poses:
            raise InputError("preview: view 'camera' needs a trajectory")
    matrices = trajectory.T_world_camera if trajectory is not None and has_poses else ()
    poses = np.array([check_rigid(T, f"preview: pose {i}") for i, T in enumerate(matrices)])
    return _choose_views(Drawable.of(mesh), poses.reshape(-1, 4, 4), up, names, size)


@dataclass(frozen=True)
class _Surface:
    """Triangles drawn evenly from the mesh, each standing for the same area, to judge views by."""

    corners: NDArray[np.float64]  # (N, 3, 3) world [m]
    normals: NDArray[np.float64]  # (N, 3) unit


def _choose_views(
    drawable: Drawable,
    poses: NDArray[np.float64],
    up: NDArray | None,
    names: Sequence[str],
    size: tuple[int, int],
) -> tuple[Viewpoint, ...]:
    surface = _sample_surface(drawable)
    if up is None:
        up = find_up(drawable.vertices, drawable.faces, poses).direction
    directions = _overview_directions(up)
    shown = _shown_area(surface, directions)
    best = int(shown.argmax())
    turned = np.minimum(np.arange(AZIMUTHS), AZIMUTHS - np.arange(AZIMUTHS)) >= AZIMUTHS // 6
    second = (best + int(np.where(turned, np.roll(shown, -best), -1.0).argmax())) % AZIMUTHS
    makers = {
        "camera": lambda: _camera_view(drawable, poses, up, size),
        "overview": lambda: _overview(surface, directions[best], up, size),
        "opposite": lambda: _overview(surface, directions[second], up, size),
    }
    return tuple(makers[name]() for name in names)


def _sample_surface(drawable: Drawable, count: int = 30_000) -> _Surface:
    vectors = area_vectors(drawable.vertices, drawable.faces).astype(np.float64)
    areas = np.linalg.norm(vectors, axis=1)
    total = np.cumsum(areas)
    if not 0 < total[-1] < math.inf:
        raise InputError(
            "preview: the triangles of the mesh have no area, or are too large to draw"
        )
    picked = np.searchsorted(total, (np.arange(count) + 0.5) * (total[-1] / count))
    corners = drawable.vertices[drawable.faces[picked]].astype(np.float64)
    return _Surface(corners, vectors[picked] / areas[picked, None])


def _shown_area(surface: _Surface, directions: NDArray) -> NDArray[np.float64]:
    """Share of the surface's area that shows from each direction (N, 3), foreshortened, hidden
    parts counted too.
    """
    return np.maximum(surface.normals @ directions.T, 0).mean(axis=0)


def _overview_directions(up: NDArray) -> NDArray[np.float64]:
    """Directions (AZIMUTHS, 3) from the scene to an eye above it, around `up`."""
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    angles = np.arange(AZIMUTHS) * (2 * math.pi / AZIMUTHS)
    level = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(up, side)
    return math.cos(ELEVATION) * level + math.sin(ELEVATION) * up


def _rotation_looking(forward: NDArray, up: NDArray) -> NDArray[np.float64]:
    """Rotation R_world_camera (3, 3) of a level camera that looks along `forward`."""
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _pinhole(size: tuple[int, int], fov: float) -> PinholeCamera:
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * fov)
    return PinholeCamera(width, height, focal, focal, 0.5 * width - 0.5, 0.5 * height - 0.5)


def _view(R_world_camera: NDArray, eye: NDArray, camera: PinholeCamera, near: float) -> Viewpoint:
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3], T_world_camera[:3, 3] = R_world_camera, eye
    return Viewpoint(camera, T_world_camera, near)


def _fitted_eye(
    points: NDArray, R: NDArray, camera: PinholeCamera, stray: float
) -> NDArray[np.float64]:
    """Where a camera of orientation R stands so that `points`, (N, 3) world [m], but for some
    strays just fill its picture.
    """
    points = points @ R  # right, down, forward [m]
    tangents = np.array([camera.width / camera.fx, camera.height / camera.fy]) / (2 * MARGIN)
    # a point is in the picture where |p - eye| <= tangent * (forward distance): one number a side
    # decides
    high = np.quantile(points[:, :2] - tangents * points[:, 2:], 1 - stray, axis=0)
    low = np.quantile(points[:, :2] + tangents * points[:, 2:], stray, axis=0)
    return R @ np.array([*(high + low) / 2, ((low - high) / (2 * tangents)).min()])


def _overview(
    surface: _Surface, direction: NDArray, up: NDArray, size: tuple[int, int]
) -> Viewpoint:
    """The view from `direction` that the surface seen from there just fills."""
    R = _rotation_looking(-direction, up)
    camera = _pinhole(size, OVERVIEW_FOV)
    seen = surface.normals @ direction > 0
    eye = _fitted_eye(
        surface.corners[seen if seen.any() else ~seen].reshape(-1, 3), R, camera, STRAY
    )
    depth = (surface.corners.reshape(-1, 3) - eye) @ R[:, 2]
    return _view(R, eye, camera, max(1e-3 * depth.max(), 0.2 * depth.min()))


def _camera_view(
    drawable: Drawable, poses: NDArray, up: NDArray, size: tuple[int, int]
) -> Viewpoint:
    """The view of the recorded camera that sees most, levelled and moved back; what lies in front of
    the recorded camera's place is not drawn.
    """
    candidates = poses[
        np.unique(np.linspace(0, len(poses) - 1, min(len(poses), CANDIDATES)).astype(int))
    ]
    seen = [_seen_depth(drawable, T_world_camera) for T_world_camera in candidates]
    # few holes first, then much space
    scores = [np.sqrt(depth).sum() * (depth > 0).sum() for depth in seen]
    best = int(np.argmax(scores))
    T_world_camera, depth = candidates[best], seen[best]
    typical_depth = float(np.median(depth[depth > 0])) if (depth > 0).any() else 1.0
    forward = T_world_camera[:3, 2]
    R = _rotation_looking(forward, up if abs(forward @ up) < 0.95 else -T_world_camera[:3, 1])
    back = DRAWN_BACK * typical_depth  # along the line of sight only: a wall may stand beside it
    return _view(
        R,
        T_world_camera[:3, 3] - back * forward,
        _pinhole(size, CAMERA_FOV),
        back + 0.03 * typical_depth,
    )


def _seen_depth(drawable: Drawable, T_world_camera: NDArray) -> NDArray[np.float32]:
    """A small depth image [m] of the mesh from a recorded camera, 0 where nothing or only a back is
    seen.
    """
    camera = _pinhole(THUMBNAIL, JUDGED_FOV)
    return drawable.depth_buffer(Viewpoint(camera, T_world_camera)).depth(nothing=0.0)
