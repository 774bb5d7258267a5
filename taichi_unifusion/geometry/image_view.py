"""Images, and where they were taken from."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, SizeMismatch
from .camera import PinholeCamera
from .checks import check_rigid


@dataclass(frozen=True)
class ImageView:
    """An image, depth or features, and where it was taken from."""

    values: NDArray[np.float32]  # (h, w) or (h, w, c)
    camera: PinholeCamera  # of this image: w x h
    # (4, 4) from the points that it belongs to
    T_camera_cloud: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if self.values.ndim not in (2, 3) or self.values.dtype != np.float32:
            raise FrameError(
                f"image: must be (h, w) or (h, w, c) float32, got {self.values.shape} "
                f"{self.values.dtype}"
            )
        if self.values.shape[1::-1] != self.camera.size:
            raise SizeMismatch(
                f"image: is {self.values.shape[1]}x{self.values.shape[0]} but its camera is "
                f"{self.camera.width}x{self.camera.height}"
            )
        object.__setattr__(self, "values", np.ascontiguousarray(self.values))  # as kernels take it
        object.__setattr__(
            self, "T_camera_cloud", check_rigid(self.T_camera_cloud, "T_camera_cloud")
        )

    def transformed(self, T_b_a: NDArray) -> ImageView:
        """The same image for points that were given in frame a and now are in frame b."""
        return replace(self, T_camera_cloud=self.T_camera_cloud @ np.linalg.inv(T_b_a))


@dataclass(frozen=True)
class ColorView:
    """Where a colour image was taken, beside a depth image: X_color = T_color_depth X_depth."""

    camera: PinholeCamera  # of the image as recorded
    T_color_depth: NDArray[np.float64]  # (4, 4) [m]
    distortion: tuple[float, ...] = ()  # as OpenCV has it: none, 4, 5 or 8 numbers

    def image(self, values: NDArray[np.float32]) -> ImageView:
        """What was made of the recorded image, (h, w, c) at any resolution, without its distortion; NaN
        beyond its border.
        """
        height, width = values.shape[:2]
        camera = self.camera.resized(width, height)
        if any(self.distortion):
            import cv2

            columns, rows = (
                np.rint(each).astype(np.int32)
                for each in cv2.initUndistortRectifyMap(
                    camera.matrix,
                    np.array(self.distortion),
                    np.eye(3),
                    camera.matrix,
                    camera.size,
                    cv2.CV_32FC1,
                )
            )
            inside = (columns >= 0) & (rows >= 0) & (columns < width) & (rows < height)
            moved = np.full_like(values, np.nan)
            moved[inside] = values[rows[inside], columns[inside]]
            values = moved
        return ImageView(values, camera, self.T_color_depth)
