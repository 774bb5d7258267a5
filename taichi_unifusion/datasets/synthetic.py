"""A furnished, textured room, rendered when a frame is asked for: no download, a Kinect's noise,
exact ground truth.

The camera walks one loop through the room and looks across it. World: metres, z up, floor at z = 0;
camera x right, y down, z forward. Colour is a function of the surface point alone. Every frame is a
pure function of its index and the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..rendering.kernels.solids import TILE, cast_rays, kinect_depth
from ..rendering.kernels.textures import PATTERNS, shade_surfaces
from ..rendering.primitives import Primitive, tessellate
from ..rendering.room import MATERIALS, ROOM_SIZE, furnished_room
from ..runtime import current
from ..types import Frame, Mesh, PinholeCamera
from .dataset import Dataset

FOCAL_PER_WIDTH = 575.0 / 640.0  # Kinect v1's depth camera
FRAME_RATE = 30.0  # [Hz]
NEAR_PLANE = 0.05  # [m] of culling
GROUND_STEP = 0.02  # [m] grid of the shadows on the floor
UNIT_CORNERS = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)
UNIT_EDGES = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]


class SyntheticRoom(Dataset):
    """`frames` views of a furnished room; `noise=False` gives exact depth, `seed` changes the noise
    and nothing else.

    Nothing is read: `path` is there because every format has one. Raises InputError where a size is
    not positive.
    """

    runs_kernels = registered = True

    def __init__(
        self,
        path: str | Path | None = None,
        *,
        frames: int = 60,
        width: int = 640,
        height: int = 480,
        noise: bool = True,
        seed: int = 0,
    ) -> None:
        if frames < 1:
            raise InputError(f"frames: a synthetic room needs at least 1 frame, got {frames}")
        self.name = "synthetic room"
        self.noise, self.seed = noise, seed
        focal = FOCAL_PER_WIDTH * width
        self.camera = PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        # (N, 4, 4)
        self.T_world_camera = np.stack([camera_on_loop(i / frames) for i in range(frames)])

    def __len__(self) -> int:
        return len(self.T_world_camera)

    def load(self, index: int) -> Frame:
        """Render frame `index`: depth in whole millimetres and 0 where a Kinect has no reading,
        unless `noise=False`.
        """
        scene, camera, T_world_camera = self._scene, self.camera, self.T_world_camera[index]
        depth, hit = scene.cast(camera, T_world_camera)
        color, cosine = scene.shade(camera, T_world_camera, depth, hit)
        if self.noise:
            exact, depth = depth, np.zeros_like(depth)
            kinect_depth(
                exact, cosine, exact.min(), self.seed & 0x7FFFFFFF, index, camera.fx, depth
            )
        return Frame(
            depth,
            camera,
            color,
            T_world_camera.copy(),
            index,
            index / FRAME_RATE,
            f"synthetic frame {index}",
        )

    def exact_depth(self, index: int) -> NDArray[np.float32]:
        """Depth of frame `index` without noise or range limits, (H, W) [m]."""
        return self._scene.cast(self.camera, self.T_world_camera[index])[0]

    def ground_truth_mesh(self) -> Mesh:
        """All surfaces in world [m], within 0.15 mm; where solids touch, their hidden faces are in
        it too.
        """
        return tessellate(self._scene.primitives)

    @cached_property
    def _scene(self) -> Scene:
        return Scene(furnished_room())


def camera_on_loop(t: float) -> NDArray[np.float64]:
    """T_world_camera at t of [0, 1) of the loop: an ellipse at eye height, looking at what stands
    across the room.
    """
    # slower along the flat sides, so that the speed is even
    a = 2 * np.pi * t + 0.07 * np.sin(4 * np.pi * t)
    b = a + np.radians(150)
    eye = (1.0 * np.cos(a), -0.05 + 0.7 * np.sin(a), 1.45 + 0.08 * np.sin(2 * a))
    return look_at(eye, (1.9 * np.cos(b), 1.5 * np.sin(b), 0.85 + 0.12 * np.sin(3 * a)))


def look_at(eye: Sequence[float], target: Sequence[float]) -> NDArray[np.float64]:
    """T_world_camera of an upright camera at `eye` with `target` on its optical axis; both in world
    [m].
    """
    forward = np.subtract(target, eye, dtype=float)
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3] = np.stack(
        [right, np.cross(forward, right), forward, np.asarray(eye)], axis=1
    )
    return T_world_camera


class Scene:
    """Primitives as the arrays that the kernels read; the first of them is the room."""

    def __init__(self, primitives: tuple[Primitive, ...]) -> None:
        self.primitives = primitives
        self.shapes = np.array([p.shape for p in primitives], np.int32)
        self.half_extents = np.array([p.half_extents for p in primitives], np.float32)
        T_world_local = np.tile(np.eye(4), (len(primitives), 1, 1))
        T_world_local[:, :3, :3] = [p.R * p.half_extents for p in primitives]
        T_world_local[:, :3, 3] = [p.center for p in primitives]
        self.T_local_world = np.linalg.inv(T_world_local)  # (P, 4, 4) to the unit solid
        # (P, 8, 3) [m]
        self.corners = (
            UNIT_CORNERS @ T_world_local[:, :3, :3].swapaxes(1, 2) + T_world_local[:, None, :3, 3]
        )
        names = list(MATERIALS)
        self.materials = np.array([[names.index(p.material)] * 4 for p in primitives], np.int32)
        self.materials[0, 2:] = names.index("floor"), names.index("ceiling")
        self.patterns = np.array([PATTERNS[m.pattern] for m in MATERIALS.values()], np.int32)
        self.looks = np.array(
            [
                (m.size, m.grain, m.stretch, *(c / 255 for c in bytes.fromhex(m.colors)))
                for m in MATERIALS.values()
            ],
            np.float32,
        )
        self.ground = self._shadow_on_floor()

    def cast(
        self, camera: PinholeCamera, T_world_camera: NDArray
    ) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
        """Depth [m] and primitive of every pixel, both (H, W)."""
        current()
        shape = camera.height, camera.width
        depth, hit = np.zeros(shape, np.float32), np.zeros(shape, np.int32)
        nearest, starts, members = self._cull(camera, T_world_camera)
        cast_rays(
            camera.intrinsics,
            self.shapes,
            self._maps(T_world_camera),
            nearest,
            starts,
            members,
            depth,
            hit,
        )
        return depth, hit

    def shade(
        self, camera: PinholeCamera, T_world_camera: NDArray, depth: NDArray, hit: NDArray
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour, (H, W, 3) RGB, and cosine of incidence, (H, W), of the surface that each pixel
        sees.
        """
        color, cosine = np.zeros((*depth.shape, 3), np.uint8), np.zeros_like(depth)
        shade_surfaces(
            camera.intrinsics,
            T_world_camera[:3],
            self.corners[0, [0, -1]],  # of the room
            depth,
            hit,
            self.shapes,
            self._maps(T_world_camera),
            self.half_extents,
            self.materials,
            self.patterns,
            self.looks,
            self.ground,
            color,
            cosine,
        )
        return color, cosine

    def _maps(self, T_world_camera: NDArray) -> NDArray[np.float32]:
        return np.ascontiguousarray((self.T_local_world @ T_world_camera)[:, :3], np.float32)

    def _cull(
        self, camera: PinholeCamera, T_world_camera: NDArray
    ) -> tuple[NDArray[np.float32], NDArray[np.int32], NDArray[np.int32]]:
        """Nearest depth [m] of every primitive, (P,), and which may show in which tile: row starts,
        members nearest first.
        """
        # (P, 8, 3) camera [m]
        corners = (self.corners - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        nearest = np.maximum(corners[..., 2].min(axis=1), 0)
        nearest[0] = 0  # the camera is inside the room
        order = np.argsort(nearest, kind="stable")
        # (P, 12, 3)
        a, b = (corners[order][:, list(ends)] for ends in zip(*UNIT_EDGES, strict=True))
        z = np.maximum(np.stack([a[..., 2], b[..., 2]]), NEAR_PLANE)  # clipped to the near plane
        step = b[..., 2] - a[..., 2]
        share = (z - a[..., 2]) / np.where(np.abs(step) > 1e-12, step, 1.0)
        points = a + share[..., None] * (b - a)
        visible = np.maximum(a[..., 2], b[..., 2]) > NEAR_PLANE
        low, high = [], []
        for axis, focal, center, size in (
            (0, camera.fx, camera.cx, camera.width),
            (1, camera.fy, camera.cy, camera.height),
        ):
            tile = np.floor(np.clip(focal * points[..., axis] / z + center, -1, size) / TILE)
            low.append(np.where(visible, tile, np.inf).min(axis=(0, 2)))
            high.append(np.where(visible, tile, -np.inf).max(axis=(0, 2)))
        columns, rows = np.arange(-(-camera.width // TILE)), np.arange(-(-camera.height // TILE))
        in_columns = (columns >= low[0][:, None]) & (columns <= high[0][:, None])
        in_rows = (rows >= low[1][:, None]) & (rows <= high[1][:, None])
        # (tiles, P) nearest first
        shows = (in_rows[:, :, None] & in_columns[:, None, :]).reshape(len(order), -1).T
        starts = np.concatenate([[0], np.cumsum(shows.sum(axis=1))]).astype(np.int32)
        return nearest.astype(np.float32), starts, order[np.nonzero(shows)[1]].astype(np.int32)

    def _shadow_on_floor(self) -> NDArray[np.float32]:
        """Share of the light that reaches each spot of the floor, (X, Y): soft below furniture,
        darker where it stands.
        """
        size = np.array(ROOM_SIZE[:2])
        steps = np.round(size / GROUND_STEP).astype(int) + 1
        x, y = np.meshgrid(
            *(np.linspace(-s / 2, s / 2, n) for s, n in zip(size, steps, strict=True)),
            indexing="ij",
        )
        cover = np.zeros((2, *steps), np.float32)
        for p, T, corners in zip(
            self.primitives[1:], self.T_local_world[1:], self.corners[1:], strict=True
        ):
            u, v = (T[k, 0] * x + T[k, 1] * y + T[k, 2] * p.center[2] + T[k, 3] for k in (0, 1))
            bottom, top = corners[:, 2].min(), corners[:, 2].max()
            if top > 0.03 and bottom < 1.0:  # neither rugs nor what hangs on the walls
                cover[int(bottom > 0.15)][np.maximum(np.abs(u), np.abs(v)) <= 1] = 1
        contact, above = (
            cv2.GaussianBlur(np.asarray(c), (0, 0), s / GROUND_STEP)
            for c, s in zip(cover, (0.05, 0.16), strict=True)
        )
        return np.ascontiguousarray((1 - 0.45 * contact) * (1 - 0.4 * above), np.float32)
