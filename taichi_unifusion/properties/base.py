"""What a property of the surface is: the paper's f_im, a function of a frame (Fig. 6)."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError, UniFusionError
from ..maps.settings import PropertySettings
from ..rendering.look import Look
from ..types import Frame

if TYPE_CHECKING:
    from ..maps import PropertyMap

# names that files and attributes of a results folder already have
RESERVED = ("surface", "color", "mesh", "preview", "normals", "features", "segmentation")
RESERVED_BEGINNINGS = ("query-", "part-")


@dataclass(frozen=True)
class SurfaceProperty:
    """A property that a function makes from every frame; it becomes a map, a mesh and a picture of
    its name.

        SurfaceProperty("redness", channels=1, function=redness)

    `function` takes a Frame and returns (H, W) or (H, W, c) numbers as large as the depth image;
    NaN means no value. It raises FrameError for a frame that lacks what it needs;
    that frame is then fused into the other maps only.
    """

    name: str
    channels: int
    function: Callable[[Frame], NDArray]
    look: Look = field(default_factory=Look)
    settings: PropertySettings | None = None  # of its map; None: the configuration's `property_map`
    voxel_size: float = 0.1  # [m] of its map in a room, where its settings say none

    def __post_init__(self) -> None:
        taken = self.name in RESERVED or self.name.startswith(RESERVED_BEGINNINGS)
        if taken or not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", self.name):
            raise InputError(
                f"property '{self.name}': a name has letters, digits, _ and -, and is none of "
                f"{', '.join(RESERVED)}, {', '.join(f'{beginning}*' for beginning in RESERVED_BEGINNINGS)}"
            )
        if self.channels < 1:
            raise InputError(
                f"property '{self.name}': channels must be at least 1, got {self.channels}"
            )

    def with_settings(self, settings: PropertySettings, scale: float = 1.0) -> SurfaceProperty:
        """The same, with these settings of its map where it has none of its own, and with its usual
        voxel size, times `scale`, where they have none.
        """
        settings = self.settings or settings
        size = settings.voxel_size or float(f"{scale * self.voxel_size:.6g}")
        return replace(self, settings=replace(settings, voxel_size=size))

    def make_map(self, frame: Frame | None = None) -> PropertyMap:
        """An empty map for the property."""
        from ..maps import PropertyMap  # Taichi starts with the first map, not with a property

        settings = self.with_settings(PropertySettings()).settings
        return PropertyMap(self.name, self.channels, settings)

    def add_to(self, frame: Frame) -> Frame:
        """The frame with its image of the property; raises as `image`."""
        return frame.with_image(self.name, self.image(frame))

    def image(self, frame: Frame) -> NDArray[np.float32]:
        """The property of a frame, (H, W, c); raises FrameError where the frame has none,
        InputError for a wrong function.
        """
        at = f"property '{self.name}', {frame.label}"
        try:
            values = np.asarray(self.function(frame))
        except FrameError as error:
            raise FrameError(f"{at}: {error}") from error
        except UniFusionError:
            raise
        # a bug in somebody's function ends the run, and what was mapped until then is kept
        except Exception as error:
            raise InputError(
                f"{at}: its function failed with {type(error).__name__}: {error}"
            ) from error
        height, width = frame.depth.shape
        if values.ndim == 2:
            values = values[..., None]
        if values.shape != (height, width, self.channels) or values.dtype.kind not in "fiub":
            raise InputError(
                f"{at}: its function must return numbers of shape "
                f"({height}, {width}, {self.channels}), got {values.shape} {values.dtype}"
            )
        values = values.astype(np.float32, copy=False)
        if not np.isfinite(values.max(initial=-np.inf, where=np.isfinite(values))):
            raise FrameError(f"{at}: all values are NaN or infinite")
        return values


def color_of(frame: Frame) -> NDArray[np.uint8]:
    """The colour image (H, W, 3) that the property is made from, or FrameError."""
    if frame.color is None:
        raise FrameError("there is no colour image to make it from")
    return frame.color
