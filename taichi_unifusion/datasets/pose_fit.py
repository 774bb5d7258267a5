"""How well do the depth images of a recording agree with poses? Pairs of overlapping frames tell.

Points of one frame, moved by the poses into another, must lie where that frame measured them, or
be hidden there: a frame never looks through what another one saw.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import se3
from ..types import Frame, PinholeCamera
from .plausibility import is_reading

GRID = 32  # points along each image axis
NEAREST = 0.02  # of the median depth; nothing nearer to a camera is compared
# share of the depth within which two measurements agree, and what a sensor may be off by however near [m]
TOLERANCE, LEAST_TOLERANCE = 0.03, 0.02
LEAST_ERROR = 5e-4  # relative; below it is rounding, and no difference between readings
MIN_POINTS = 100  # compared in a pair; with fewer it says nothing
MIN_MOTION = 0.05, np.radians(3)  # [m], [rad]; with less, all readings of poses agree
MOST_PAIRS = 6  # of early frames
# a step [m], [rad] after which an early frame is compared with the one before; if there are too few of them,
# what there is
EARLY_STEP = 0.12, np.radians(7)
MOST_KEPT = 16  # frames that are kept until there are enough


@dataclass(frozen=True)
class Fit:
    """How well pairs of frames agree."""

    share: float  # of the points that could be compared: measured at the same depth
    closeness: float  # 1 where depths are equal, 0 where they differ by the tolerance; the mean
    compared: float  # share of all points that were compared
    error: float = (
        1.0  # median difference of the two depths, relative; of all points that were measured
    )


NOTHING = Fit(0.0, 0.0, 0.0)


class View:
    """A frame as it is compared: some of its points, and its depth image."""

    def __init__(self, frame: Frame) -> None:
        self.frame, self.camera = frame, frame.camera
        held = is_reading(frame.depth)
        self.depth = np.where(held, frame.depth, np.float32(0))
        self.median = float(np.median(frame.depth[held])) if held.any() else 1.0
        v, u = (np.linspace(0, n - 1, GRID).astype(int) for n in frame.depth.shape)
        self.v, self.u = (x.ravel() for x in np.meshgrid(v, u, indexing="ij"))
        z = self.depth[self.v, self.u].astype(np.float64)
        self.v, self.u, self.z = (x[z > 0] for x in (self.v, self.u, z))
        self.own_points = self.points(self.camera)

    def points(self, camera: PinholeCamera) -> NDArray[np.float64]:
        """Points (N, 3) in front of a camera [m], the frame's own or another in its place."""
        return camera.rays(self.u, self.v) * self.z[:, None]


class PosePairs:
    """Pairs of frames of one recording that are compared under one reading of their poses after
    another.
    """

    def __init__(self, frames: Sequence[Frame], pairs: Sequence[tuple[int, int]]) -> None:
        self.views = [View(frame) for frame in frames]
        poses = [frame.require_pose() for frame in frames]
        self.T_world_camera = np.array(poses, np.float64).reshape(-1, 4, 4)
        self.pairs = tuple(pairs)

    def fits(
        self,
        T_world_camera: NDArray[np.float64] | None = None,
        scale: float = 1.0,
        camera: PinholeCamera | None = None,
        unit: float = 1.0,
    ) -> list[Fit]:
        """The fit of every pair with these poses (N, 4, 4) of the frames, their translations times
        `scale`, a camera in place of the frames' own, and depth that is `unit` times too large. Where
        the pose of either is NaN, nothing can be compared.
        """
        T = self.T_world_camera if T_world_camera is None else T_world_camera
        found = []
        for a, b in self.pairs:
            if not np.isfinite(T[[a, b]]).all():
                found.append(NOTHING)
                continue
            T_b_a = np.linalg.inv(T[b]) @ T[a]
            T_b_a[:3, 3] *= scale
            found.append(compare(self.views[a], self.views[b], T_b_a, camera, unit))
        return found

    def between(self, pairs: Sequence[tuple[int, int]]) -> PosePairs:
        """The same frames, other pairs of them."""
        others = copy(self)
        others.pairs = tuple(pairs)
        return others

    def thinned(self) -> PosePairs:
        """Every other pair, for a first look."""
        return self.between(self.pairs[::2])

    def fit(
        self,
        T_world_camera: NDArray[np.float64] | None = None,
        scale: float = 1.0,
        camera: PinholeCamera | None = None,
        unit: float = 1.0,
    ) -> Fit:
        """The mean of `fits`."""
        return mean_fit(self.fits(T_world_camera, scale, camera, unit))


def mean_fit(fits: Sequence[Fit]) -> Fit:
    """The mean over pairs; one in which nothing could be compared counts as not close, and not for
    the share.
    """
    told = [fit for fit in fits if fit is not NOTHING]
    if not told:
        return NOTHING
    return Fit(
        float(np.mean([fit.share for fit in told])),
        float(np.mean([fit.closeness for fit in fits])),
        float(np.mean([fit.compared for fit in fits])),
        float(np.exp(np.mean([np.log(fit.error) for fit in told]))),
    )


def compare(
    a: View, b: View, T_b_a: NDArray, camera: PinholeCamera | None = None, unit: float = 1.0
) -> Fit:
    """The fit of two frames, each seen from the other."""
    there = _beyond(a, b, T_b_a, camera)
    back = _beyond(b, a, se3.inverse(T_b_a), camera)
    wanted, beyond = (np.concatenate(x) for x in zip(there, back, strict=True))
    # how much farther a view sees, in tolerances
    off = beyond / np.maximum(TOLERANCE * wanted, LEAST_TOLERANCE * unit)
    agree, through = np.abs(off) < 1, int((off >= 1).sum())
    told = int(agree.sum()) + through
    if told < MIN_POINTS:
        return NOTHING
    judged = told + through  # what lies too deep is hidden, as often as it is seen through
    return Fit(
        agree.sum() / judged,
        (1 - np.abs(off[agree])).sum() / judged,
        told / max(len(a.z) + len(b.z), 1),
        max(float(np.median(np.abs(beyond) / wanted)), LEAST_ERROR),
    )


def _beyond(
    view: View, other: View, T_other_view: NDArray, camera: PinholeCamera | None
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depths [m] of a view's points in another one that measured something there, and how much
    farther that is.
    """
    points = view.points(camera) if camera else view.own_points
    points = points @ T_other_view[:3, :3].T + T_other_view[:3, 3]
    nearest = NEAREST * other.median
    measured, inside = (camera or other.camera).look_up(other.depth, points, nearest)
    wanted = points[inside, 2]
    measured, wanted = measured[measured > 0], wanted[measured > 0]
    return wanted, measured - wanted


class EarlyPairs:
    """Collects the first frames of a run that show how poses and depth fit."""

    def __init__(self) -> None:
        self.kept: list[Frame] | None = []  # None: done

    def add(self, frame: Frame) -> None:
        """Keep the frame if it has moved on from the last one kept."""
        if self.kept is None or len(self.kept) > MOST_KEPT:
            return
        if not self.kept or has_moved(self.kept[-1], frame):
            bare = Frame(frame.depth, frame.camera, None, frame.T_world_camera, frame.index)
            self.kept.append(bare)

    @property
    def enough(self) -> bool:
        """Whether there are pairs enough, or no more frames are kept."""
        if self.kept is None:
            return False
        return len(self.kept) > MOST_KEPT or len(self._apart()) > MOST_PAIRS

    def take(self) -> PosePairs | None:
        """The pairs, once; None if there are none, or they were taken."""
        if self.kept is None:
            return None
        frames, every = self._apart(), self.kept
        self.kept = None
        if len(frames) <= MOST_PAIRS // 2:
            frames = every
        frames = frames[: MOST_PAIRS + 1]
        if len(frames) < 2:
            return None
        return PosePairs(frames, [(i, i + 1) for i in range(len(frames) - 1)])

    def _apart(self) -> list[Frame]:
        """Kept frames, each a step from the one before."""
        found: list[Frame] = []
        for frame in self.kept or ():
            if not found or has_moved(found[-1], frame, EARLY_STEP):
                found.append(frame)
        return found


def has_moved(a: Frame, b: Frame, motion: tuple[float, float] = MIN_MOTION) -> bool:
    """Whether the poses of two frames differ by a motion [m], [rad], enough to tell readings apart."""
    T_a_b = np.linalg.inv(a.require_pose()) @ b.require_pose()
    angle = np.arccos(np.clip((np.trace(T_a_b[:3, :3]) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(T_a_b[:3, 3]) > motion[0] or angle > motion[1])
