"""A recording whose depth and colour images show the same view in different sizes, as a phone's do.

Depth keeps its pixels; each takes the mean of the colour pixels that it covers, of which a phone has
some fifty. Where pixels are so coarse that a map would show more colours, they can be divided: depth is then
interpolated within surfaces. Every frame may have a camera of its own, for images of the colour's size.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError, SizeMismatch
from ..files.images import SAME_ASPECT, resize_image
from ..files.trajectories import Pose
from ..types import Frame, PinholeCamera
from .dataset import Dataset
from .depth_registration import LensCamera
from .plausibility import camera_warnings, pose_warnings

logger = logging.getLogger(__name__)
ARKIT_UP = (0.0, 1.0, 0.0)  # its worlds are levelled
LOW, MIDDLE, HIGH = 0, 1, 2  # how sure a phone is of a reading
MOST_DETAIL = 8
AS_FITS = 0  # detail: by how coarse pixels are
COARSE = 0.006  # [m] what a pixel spans: a quarter of a voxel of colour of the usual size
TRIED = 5  # frames that are looked at for that
BLACK = 4  # of 255; JPEG does not keep black exactly


@dataclass(frozen=True)
class Shot:
    """What a frame is made from. The functions read files, and raise FrameError."""

    name: str  # for messages
    lens: Callable[[], LensCamera]  # of an image that shows the view
    depth: Callable[[], NDArray[np.float32]]  # (h, w) [m], 0 no reading
    color: Callable[[], NDArray[np.uint8]] | None = None  # (H, W, 3) RGB
    confidence: Callable[[], NDArray[np.uint8]] | None = None  # LOW, MIDDLE, HIGH
    pose: Pose | None = None
    timestamp: float | None = None  # [s]


@dataclass(frozen=True)
class Confidence:
    """What becomes of readings that the phone is not sure of."""

    least: int = MIDDLE
    weigh: bool = False  # below HIGH counts half

    def __post_init__(self) -> None:
        if self.least not in (LOW, MIDDLE, HIGH):
            raise InputError(f"min_confidence: must be 0, 1 or 2, got {self.least}")

    def drop(
        self, depth: NDArray[np.float32], confidence: NDArray[np.uint8], where: str
    ) -> NDArray[np.float32]:
        """The depth image without the readings that are left out."""
        height, width = depth.shape
        if confidence.shape != depth.shape:
            raise SizeMismatch(
                f"{where}: confidence is {confidence.shape[1]}x{confidence.shape[0]} but depth is {width}x{height}"
            )
        return np.where(confidence >= self.least, depth, np.float32(0))

    def weights(self, confidence: NDArray[np.uint8] | None) -> NDArray[np.uint8] | None:
        """Halves of a pixel that each reading counts, as `Frame.weights` has them."""
        if not self.weigh or confidence is None:
            return None
        return np.where(confidence >= HIGH, np.uint8(2), np.uint8(1))


class SharedView(Dataset):
    """Frames of depth and colour images of one view, read when indexed.

    `no_poses` says what is missing where no frame has a pose; black at the border of colour images
    is no colour where `black_border`; `up` is as `Dataset` has it.
    """

    registered = True

    def __init__(
        self,
        name: str,
        shots: Sequence[Shot],
        *,
        confidence: Confidence | None = None,
        detail: int = 1,
        warnings: Iterable[str] = (),
        no_poses: str = "",
        black_border: bool = False,
        up: tuple[float, float, float] | None = None,
    ) -> None:
        self.black_border, self.up = black_border, up
        self.name, self.shots, self.no_poses = name, tuple(shots), no_poses
        self.confidence, self.asked_detail = confidence or Confidence(), detail
        if not AS_FITS <= detail <= MOST_DETAIL:
            raise InputError(
                f"color_detail: must be from 1 to {MOST_DETAIL}, or {AS_FITS} for what fits, got {detail}"
            )
        self.pose_warnings = (
            (f"{no_poses}, so the frames have no poses",)
            if no_poses
            else tuple(pose_warnings([shot.pose for shot in shots if shot.pose is not None]))
        )
        self.warnings = (*warnings, *_lens_warnings(self.shots), *self.pose_warnings)

    def __len__(self) -> int:
        return len(self.shots)

    @cached_property
    def detail(self) -> int:
        """Pixels for each of the depth image's, across and down, in all frames."""
        return self.asked_detail or self._fitting_detail()

    def _fitting_detail(self) -> int:
        """2 where colour is larger and pixels of the first frames are coarse, else 1."""
        for shot in self.shots[:TRIED]:
            try:
                depth, lens = shot.depth(), shot.lens()
                height, width = depth.shape
                own = resized_lens(lens, width, height, f"{shot.name}: depth").pinhole
            except FrameError:
                continue
            if not (depth > 0).any():
                continue
            span = float(np.median(depth[depth > 0])) / own.fx
            if span <= COARSE or shot.color is None or lens.pinhole.width < 2 * width:
                return 1
            logger.info(
                "colour: pixels of depth span %.0f mm, so each is divided by two across and down "
                "(--option color_detail=1 keeps them)",
                1e3 * span,
            )
            return 2
        return 1

    def without_poses(self) -> SharedView:
        """The same frames, their poses left out; so are the warnings about those."""
        bare = copy(self)
        bare.shots = tuple(replace(shot, pose=None) for shot in self.shots)
        bare.warnings = tuple(each for each in self.warnings if each not in self.pose_warnings)
        return bare

    def pose_at(self, index: int) -> tuple[float | None, NDArray[np.float64] | None]:
        shot = self.shots[index]
        return shot.timestamp, shot.pose.usable if shot.pose else None

    def load(self, index: int) -> Frame:
        """Read frame `index`; FrameError (PoseError, SizeMismatch) names what is wrong."""
        shot = self.shots[index]
        T_world_camera = shot.pose.checked() if shot.pose else None
        lens, depth = shot.lens(), shot.depth()
        confidence = None if shot.confidence is None else shot.confidence()
        if confidence is not None:
            depth = self.confidence.drop(depth, confidence, shot.name)
        weights = self.confidence.weights(confidence)
        height, width = depth.shape
        own = resized_lens(lens, width, height, f"{shot.name}: depth")
        camera = own.pinhole.resized(self.detail * width, self.detail * height)
        if any(lens.distortion) or self.detail > 1:
            depth = own.undistort_depth(depth, camera)
            if weights is not None:
                weights = np.maximum(own.undistort(weights, camera), np.uint8(1))
        color = None if shot.color is None else _color(shot, lens, camera)
        frame = Frame(
            depth,
            camera,
            color,
            T_world_camera,
            index,
            shot.timestamp,
            shot.name,
            weights=weights,
        )
        border = _black_border(color) if self.black_border and color is not None else None
        if color is None or border is None or not border.any():
            return frame
        known = color.astype(np.float32) / np.float32(255)
        known[border] = np.nan
        return frame.with_image("color", known)


def resized_lens(lens: LensCamera, width: int, height: int, what: str) -> LensCamera:
    """The lens for an image of that size of the same view; SizeMismatch for another shape."""
    own = lens.pinhole
    if abs(width * own.height / (height * own.width) - 1) > SAME_ASPECT:
        turned = abs(width * own.width / (height * own.height) - 1) <= SAME_ASPECT
        raise SizeMismatch(
            f"{what} is {width}x{height} but its camera is for {own.width}x{own.height} images, "
            + ("which are turned by a quarter" if turned else "another shape")
        )
    return replace(lens, pinhole=own.resized(width, height))


def _color(shot: Shot, lens: LensCamera, camera: PinholeCamera) -> NDArray[np.uint8]:
    """The colour (h, w, 3) of a depth image's pixels: means of those they cover."""
    assert shot.color is not None
    color = shot.color()
    height, width = color.shape[:2]
    own = resized_lens(lens, width, height, f"{shot.name}: colour")
    if any(lens.distortion):
        color = own.undistort(color, own.pinhole)
    return resize_image(color, *camera.size, f"{shot.name}: colour")


def _black_border(color: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The pixels (h, w) that are black and hang together with the image's border."""
    black = (color.max(axis=2) <= BLACK).astype(np.uint8)
    _, labels = cv2.connectedComponents(black, connectivity=4)
    at_border = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return np.isin(labels, at_border[at_border > 0])


def _lens_warnings(shots: Sequence[Shot]) -> list[str]:
    """What is odd about the first frame's camera."""
    try:
        return camera_warnings(shots[0].lens().pinhole) if shots else []
    except FrameError:
        return []
