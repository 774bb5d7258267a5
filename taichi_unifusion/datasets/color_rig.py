"""Points of a surface in the images of a colour camera that is not known exactly: what they look
like, by how much they differ between frames, and how that depends on the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..types import PinholeCamera
from .color_camera import ColorCamera
from .color_sightings import Sightings

# of a rig: rotation [rad], translation [m], log of the focal length, clock offset [s]
PARAMETERS = 8
NEAREST = 0.1  # [m] in front of the colour camera


@dataclass(frozen=True)
class Rig:
    """A colour camera while it is estimated, without distortion: X_color = R X_depth + t."""

    start: PinholeCamera
    R: NDArray[np.float64]
    t: NDArray[np.float64]
    log_focal: float = 0.0  # of the focal length by that of `start`
    offset: float = 0.0  # [s]

    @property
    def focal(self) -> tuple[float, float]:
        """fx and fy [pixels]."""
        scale = float(np.exp(self.log_focal))
        return self.start.fx * scale, self.start.fy * scale

    @property
    def values(self) -> NDArray[np.float64]:
        """The PARAMETERS of it."""
        T = np.eye(4)
        T[:3, :3] = self.R
        return np.array([*se3.log(T)[3:], *self.t, self.log_focal, self.offset])

    def moved(self, by: NDArray) -> Rig:
        """The rig after a change of its PARAMETERS; the rotation is turned on from where it is."""
        R = se3.exp(np.array([0, 0, 0, *by[:3]]))[:3, :3] @ self.R
        log_focal, offset = self.log_focal + float(by[6]), self.offset + float(by[7])
        return replace(self, R=R, t=self.t + by[3:6], log_focal=log_focal, offset=offset)

    def camera(self) -> ColorCamera:
        """The colour camera that it stands for."""
        T_color_depth = np.eye(4)
        T_color_depth[:3, :3], T_color_depth[:3, 3] = self.R, self.t
        fx, fy = self.focal
        return ColorCamera(
            replace(self.start, fx=fx, fy=fy), T_color_depth, clock_offset=self.offset
        )


def residuals_of(
    group: Sightings,
    images: Sequence[NDArray[np.float32]],
    shrink: int,
    rig: Rig,
    derivatives: bool = False,
) -> tuple[NDArray[np.float32], NDArray[np.bool_], NDArray[np.float32]]:
    """By how much a frame sees a point brighter than the mean of all that see it, [grey levels]
    (M, G), where that is known (M, G), and its derivatives (M, G, PARAMETERS).

    The exposure of a frame, the median of its residuals, is taken out.
    """
    members, count = group.seen.shape
    values, used = np.zeros((members, count), np.float32), group.seen.copy()
    J = np.zeros((members, count, PARAMETERS if derivatives else 0), np.float32)
    for k, image in enumerate(images):
        at = project(rig, group.points[k], group.velocity[k])
        found, inside = look_up(image, at.u, at.v, shrink)
        values[k], used[k] = found[:, 0], used[k] & inside & (at.point[:, 2] > NEAREST)
        if derivatives:
            J[k] = _derivatives(rig, at, found[:, 1], found[:, 2])
    seen_by = used.sum(axis=0)
    used &= seen_by >= 2
    share = (used / np.maximum(seen_by, 1)).astype(np.float32)
    residuals = np.where(used, values - (values * share).sum(axis=0), 0)
    if derivatives:
        J -= np.einsum("mgp,mg->gp", J, share)
        J[~used] = 0
    for k in range(members):
        if used[k].any():
            residuals[k][used[k]] -= np.median(residuals[k][used[k]])
    return residuals, used, J


@dataclass(frozen=True)
class Projection:
    """Points of a frame in its colour image."""

    u: NDArray[np.float32]  # (G,) [pixels]
    v: NDArray[np.float32]
    point: NDArray[np.float32]  # (G, 3) colour camera [m]
    turned: NDArray[np.float32]  # (G, 3) the same before the translation
    drift: NDArray[np.float32]  # (G, 3) its velocity as the depth camera moves [m/s]


def project(rig: Rig, points: NDArray[np.float32], velocity: NDArray) -> Projection:
    """Where points (G, 3) of a depth camera [m] that moves with this twist a second, (6,), lie in
    the colour image taken `rig.offset` later.
    """
    move = -(velocity[:3] + np.cross(velocity[3:], points))  # to first order
    R = rig.R.astype(np.float32)
    turned = (points + rig.offset * move).astype(np.float32) @ R.T
    point = turned + rig.t.astype(np.float32)
    z = np.maximum(point[:, 2], np.float32(1e-3))
    fx, fy = rig.focal
    u = (fx * point[:, 0] / z + rig.start.cx).astype(np.float32)
    v = (fy * point[:, 1] / z + rig.start.cy).astype(np.float32)
    return Projection(u, v, point, turned, move.astype(np.float32) @ R.T)


def _derivatives(
    rig: Rig, at: Projection, across: NDArray[np.float32], down: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Of the grey value at a projected point, (G, PARAMETERS); `across` and `down` are the image's
    derivatives there, a pixel.
    """
    x, y, z = at.point.T
    z = np.maximum(z, np.float32(1e-3))
    gx, gy = across * np.float32(rig.focal[0]) / z, down * np.float32(rig.focal[1]) / z
    of_point = np.stack([gx, gy, -(gx * x + gy * y) / z], axis=1)
    of_rotation = np.cross(at.turned, of_point)
    of_focal = gx * x + gy * y
    of_offset = (of_point * at.drift).sum(axis=1)
    return np.concatenate(
        [of_rotation, of_point, of_focal[:, None], of_offset[:, None]], axis=1
    ).astype(np.float32)


def shrunk(color: NDArray[np.uint8], shrink: int) -> NDArray[np.float32]:
    """Grey values of a smaller image and their derivatives by column and row of the whole one,
    (h, w, 3).
    """
    gray = np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.float32)
    size = gray.shape[1] // shrink, gray.shape[0] // shrink
    gray = gray[: size[1] * shrink, : size[0] * shrink]
    gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
    gray = cv2.GaussianBlur(gray, (0, 0), 1.0)
    scale = 1 / (8 * shrink)  # of Sobel's weights
    slopes = [cv2.Sobel(gray, cv2.CV_32F, *axis, scale=scale) for axis in ((1, 0), (0, 1))]
    return np.asarray(cv2.merge([gray, *slopes]), np.float32)


def look_up(
    image: NDArray[np.float32], u: NDArray, v: NDArray, shrink: int = 1
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """What a shrunk image shows at columns and rows of the whole one, (G, c), and which lie in it."""
    u, v = ((each + 0.5) / shrink - 0.5 for each in (u, v))
    inside = (u >= 0) & (v >= 0) & (u <= image.shape[1] - 1) & (v <= image.shape[0] - 1)
    columns, rows = (np.where(inside, each, 0).astype(np.float32)[:, None] for each in (u, v))
    found = cv2.remap(image, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, np.float32)[:, 0], inside
