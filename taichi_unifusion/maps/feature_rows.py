"""Storage of high-dimensional features: a mean and q slopes of c numbers for every voxel, in one of
several precisions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import taichi as ti
from numpy.typing import NDArray

from ..errors import CapacityError, MapCorrupt
from ..kernels.voxels import copy_rows, gather_rows

MAX_ELEMENTS = 2**31 - 1  # of an array of Taichi
PRECISIONS = {  # name -> types of means and of slopes
    "int8": (np.dtype(np.float16), np.dtype(np.int8)),
    "float16": (np.dtype(np.float16), np.dtype(np.float16)),
    "float32": (np.dtype(np.float32), np.dtype(np.float32)),
}
_TAICHI = {"float16": ti.f16, "float32": ti.f32, "int8": ti.i8}


@dataclass(frozen=True)
class RowData:
    """Features of voxels by value."""

    means: NDArray  # (N, c)
    slopes: NDArray  # (N, q c), times the scale of their row
    scales: NDArray[np.float32]  # (N, q); 1 where slopes are floating-point numbers


class FeatureRows:
    """Pools of means, slopes and scales, addressed by slot like those of a `VoxelGrid`."""

    def __init__(self, slope_rows: int, channels: int, precision: str) -> None:
        self.slope_rows, self.channels, self.precision = slope_rows, channels, precision
        self.bits8 = precision == "int8"
        self.dtypes = PRECISIONS[precision]
        self._allocate(1)

    def _allocate(self, capacity: int) -> None:
        mean, slope = (_TAICHI[dtype.name] for dtype in self.dtypes)
        self.means = ti.ndarray(mean, (capacity, self.channels))
        self.slopes = ti.ndarray(slope, (capacity, self.slope_rows * self.channels))
        self.scales = ti.ndarray(ti.f32, (capacity, self.slope_rows))

    @property
    def pools(self) -> tuple[ti.Ndarray, ti.Ndarray, ti.Ndarray]:
        """Means, slopes and scales, as kernels take them."""
        return self.means, self.slopes, self.scales

    @property
    def bytes_per_voxel(self) -> int:
        mean, slope = (dtype.itemsize for dtype in self.dtypes)
        return self.channels * (mean + self.slope_rows * slope) + 4 * self.slope_rows

    def reserve(self, capacity: int, used: int) -> None:
        """Room for `capacity` voxels, the first `used` of which are kept; raises CapacityError
        beyond Taichi's arrays.
        """
        if self.means.shape[0] == capacity:
            return
        if capacity * self.slope_rows * self.channels > MAX_ELEMENTS:
            raise CapacityError(
                f"the map holds {used:,} voxels of {self.slope_rows} x {self.channels} numbers, as many as fit "
                "into an array: use larger voxels or save the map and start a new one"
            )
        old, kept = self.pools, min(self.means.shape[0], used)
        self._allocate(capacity)
        if kept:
            for source, target in zip(old, self.pools, strict=True):
                copy_rows(kept, source, target)

    def export(self, slots: NDArray[np.int32]) -> RowData:
        """Features of the voxels in `slots`, in order."""
        mean, slope = self.dtypes
        data = RowData(
            np.empty((len(slots), self.channels), mean),
            np.empty((len(slots), self.slope_rows * self.channels), slope),
            np.empty((len(slots), self.slope_rows), np.float32),
        )
        if len(slots):
            for source, target in zip(self.pools, vars(data).values(), strict=True):
                gather_rows(slots, source, target)
        return data

    def fill(self, slots: NDArray[np.int32], data: RowData) -> None:
        """Put features into the first slots, which `slots` (N,) gives an order."""
        order = np.argsort(slots, kind="stable").astype(np.int32)
        for source, target in zip(vars(data).values(), self.pools, strict=True):
            gather_rows(order, source, target)

    def check(self, path: object, count: int, data: RowData) -> None:
        """MapCorrupt where a file's features are not those of `count` voxels of this storage."""
        wanted = {
            "means": ((count, self.channels), self.dtypes[0]),
            "slopes": ((count, self.slope_rows * self.channels), self.dtypes[1]),
            "scales": ((count, self.slope_rows), np.dtype(np.float32)),
        }
        for name, (shape, dtype) in wanted.items():
            array = getattr(data, name)
            if (
                array is None
                or array.shape != shape
                or array.dtype != dtype
                or not np.isfinite(array).all()
            ):
                raise MapCorrupt(
                    f"{path}: tensor '{name}' should be {shape} finite {dtype}; integrate the frames again"
                )
