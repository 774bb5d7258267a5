"""RegressionMap: a LIM that is regressed from a cloud's points, voxel by voxel, and fused frame by
frame (Fig. 5).
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..device_arrays import DeviceArray
from ..kernels import fusion, sides
from ..kernels.cells import BLOCK_CELLS
from ..kernels.keeping import round_rows
from ..kernels.layout import Layout
from ..kernels.patches import Patches, Values
from ..types import PointCloud
from .base_map import BaseMap, Integration, S, check_cloud
from .binner import Binner
from .encoder import Decoder, Encoder
from .local_lim import LocalLim
from .voxel_data import KEYS, VoxelData, VoxelField, regression_fields
from .voxel_grid import VoxelGrid

# What is fused exactly is rounded to steps of one part in this: sums in float64 are exact to 5e8.
STEPS = 2.0**24
SUPPORTED = VoxelField("supported", np.dtype(np.uint16), (BLOCK_CELLS,))  # local LIMs, by cell


class RegressionGrid(VoxelGrid):
    """The voxels of a regression map, into which local LIMs are fused (Eq. 19).

    With `sum_exactly`, F w and w are also kept as sums in which rounding has no part: the map is
    then the same, to the bit, whatever was fused and taken out in between, and in whatever order.
    """

    def __init__(self, layout: Layout, noise: float, more: Sequence[VoxelField] = ()) -> None:
        super().__init__(regression_fields(layout, tuple(more)))
        self.layout, self.noise = layout, noise
        self.lean: DeviceArray | None = (
            None  # (l,) tells which local LIMs show backs; None: no matter
        )
        self.steps = 0.0  # of 1, to which local LIMs are rounded; 0: they are fused as they are

    def sum_exactly(self, steps: float = STEPS) -> None:
        """Keep exact sums from now on: of local LIMs rounded to one part in `steps`, a power of two."""
        if self.steps:
            return
        self.steps, layout = steps, self.layout
        name = "sums" if layout.information else "totals"
        columns = layout.sums if layout.information else 1 + layout.latent_rows * layout.channels
        before = self["sums"].to_numpy() if layout.information and self.count else None
        self.add_pool(VoxelField(name, np.dtype(np.float64), (columns,)))
        counted = ["supported"]
        if self.lean is not None:
            self.add_pool(VoxelField("back_totals", np.dtype(np.float64), (columns,)))
            counted += ["front_supported", "back_supported"]
        for each in counted:
            self.add_pool(replace(SUPPORTED, name=each))
        if not self.count:
            return
        if before is None:
            before = self._totals(self["weights"].to_numpy(), "latents")
        self[name].from_numpy(before.astype(np.float64))
        if self.lean is not None:
            self["back_totals"].from_numpy(
                self._totals(self["side_weights"].to_numpy()[:, 1], "backs")
            )
        for each in counted:
            words = self[each.replace("supported", "masks")].to_numpy().astype(">u4").view(np.uint8)
            self[each].from_numpy(np.unpackbits(words, axis=1).astype(np.uint16))

    def exact_sums(self) -> dict[str, NDArray]:
        """What `sum_exactly` keeps, which no file of the map holds: by name, of the voxels (N, ...) in the
        order of `export`.
        """
        slots = self.sorted_slots()
        return {
            name: pool.take(slots)
            for name, pool in self._pools.items()
            if pool.field not in (KEYS, *self.fields)
        }

    def restore_sums(self, steps: float, sums: Mapping[str, NDArray]) -> None:
        """Go on with the `exact_sums` of the voxels that were added to an empty grid; raises ValueError where
        they do not fit.
        """
        self.sum_exactly(steps)
        slots = np.arange(self.count, dtype=np.int32)
        for name, rows in sums.items():
            pool = self._pools.get(name)
            if pool is None or rows.shape != (self.count, *pool.field.shape):
                raise ValueError(f"sums '{name}' of {rows.shape} do not fit the map")
            pool.put(slots, rows.astype(pool.field.dtype, copy=False))

    def _totals(self, weights: NDArray[np.float32], name: str) -> NDArray[np.float64]:
        """(S, 1 + r c) sums of w (S,) and F w, to steps."""
        w, F = weights.astype(np.float64), self[name].to_numpy().astype(np.float64)
        F = np.rint(F.reshape(len(w), -1) * self.steps) / self.steps
        return np.column_stack([w, F * w[:, None]])

    def fuse(self, local: LocalLim) -> int:
        """F <- (F w + F' w') / (w + w'), or the sums of one regression over all frames; returns the
        number of voxels that the local LIM holds.

        Raises RuntimeStateError for a local LIM whose loan is over, CapacityError, with the grid
        unchanged.
        """
        local.check()
        slots = np.empty(max(local.count, 1), np.int32)
        encoded = self.claim(local.count, local.keys, local.weights, slots)
        self._fuse(local, slots, 1.0)
        return encoded

    def take_out(self, local: LocalLim) -> int:
        """Undo `fuse`; returns the number of voxels that it touched.

        Support is cleared with `sum_exactly` alone: else other frames may have set it.
        """
        local.check()
        slots = np.empty(max(local.count, 1), np.int32)
        known = self.find(local.count, local.keys, local.weights, slots)
        self._fuse(local, slots, -1.0)
        self.release(local.count, local.keys, slots)
        return known

    def _fuse(self, local: LocalLim, slots: NDArray[np.int32], sign: float) -> None:
        support = local.support if sign > 0 else np.zeros((local.count, 2), np.uint32)
        if self.steps:
            round_rows(local.count, self.steps, local.encoded, local.weights)
            fusion.count_support(
                local.count, slots, local.support, int(sign), self["supported"], self["masks"]
            )
        if self.layout.information:
            fusion.fuse_information(
                self.layout,
                local.first,
                local.channels,
                local.count,
                slots,
                local.encoded,
                local.weights,
                support,
                sign,
                self.noise,
                self["sums"],
                self["weights"],
                self["masks"],
                self["latents"],
            )
            return
        what = self.layout, local.first, local.count, slots, local.encoded, local.weights
        maps = self["latents"], self["weights"]
        if self.steps:
            fusion.fuse_exactly(*what, int(sign), self["totals"], *maps)
        else:
            fusion.fuse(*what, support, sign, *maps, self["masks"])
        if self.lean is not None:
            self._fuse_sides(local, slots, sign)

    def _fuse_sides(self, local: LocalLim, slots: NDArray[np.int32], sign: float) -> None:
        """Fuse what shows backs once more, into a mean of its own; note weight and support of both sides."""
        n, given = local.count, local.sides
        if given is None:
            encoded, weights = local.encoded, np.zeros((max(n, 1), 2), np.float32)
            sides.weigh_sides(n, self.lean, encoded, local.weights, weights)
            front, back = (np.where(w > 0, slots[:n], -1).astype(np.int32) for w in weights[:n].T)
            support = (front, local.support), (back, local.support)
        else:
            encoded, weights = given[0].astype(np.float32)[:, :, None], given[1]
            support = (slots, given[2]), (slots, given[3])
        totals = self["back_totals"] if self.steps else np.zeros((1, 1))
        what = self.layout.rank, bool(self.steps), n, slots, encoded, weights, int(sign)
        sides.fuse_sides(*what, totals, self["backs"], self["side_weights"])
        for side, (rows, cells) in zip(("front", "back"), support, strict=True):
            if self.steps:
                counts = self[f"{side}_supported"]
                fusion.count_support(n, rows, cells, int(sign), counts, self[f"{side}_masks"])
            elif sign > 0:
                sides.note_support(n, rows, cells, self[f"{side}_masks"])


class RegressionMap(BaseMap[S]):
    """A map that a subclass gives (x, y) pairs: `observed`, `carried` and `encode`."""

    binner: Binner

    def __init__(
        self,
        name: str,
        channels: int,
        settings: S,
        layout: Layout,
        fields: Sequence[VoxelField] = (),
    ) -> None:
        self.layout = layout
        self.grid: RegressionGrid = RegressionGrid(layout, settings.noise, fields)
        super().__init__(name, channels, settings, self.grid)
        self.encoder = Encoder(self.grid.runtime, settings, self.layout)
        self.decoder = Decoder(self.encoder.tables, self.layout, settings.voxel_size)

    @property
    def sums_up(self) -> bool:
        """Whether frames can be summed up before they are encoded: not if every point counts."""
        return self.settings.sampling == "cells"

    def integrate(self, cloud: PointCloud) -> Integration:
        check_cloud(f"{type(self).__name__}.integrate", cloud)
        self.flush()
        runtime.check_alive(self.grid.runtime)
        cloud = self.usable(cloud)
        if len(cloud) == 0:
            return Integration(0, 0, len(self))
        local = self.encode(cloud)  # local LIM: F', w' of every voxel that the cloud touches
        encoded = self.grid.fuse(local)  # global LIM, Eq. 19
        self.learn_visibility(cloud, local, 1)
        return Integration(len(cloud), encoded, len(self))

    integrate.__doc__ = BaseMap.integrate.__doc__

    def remove(self, cloud: PointCloud) -> Integration:
        """Take a cloud out again that was integrated, for example to integrate it at a better pose;
        errors as `integrate`.

        Latents and weights become what they were without it, up to rounding. Support bits are not
        cleared; evidence is undone only where frames since have not changed the surface. Removing
        what was never integrated spoils the voxels that it touches.
        """
        check_cloud(f"{type(self).__name__}.remove", cloud)
        self.flush()
        runtime.check_alive(self.grid.runtime)
        cloud = self.usable(cloud)
        if len(cloud) == 0:
            return Integration(0, 0, len(self))
        local = self.encode(cloud)  # first: it may raise, and then the map must be unchanged
        self.learn_visibility(cloud, local, -1)
        return Integration(len(cloud), self.grid.take_out(local), len(self))

    @abstractmethod
    def observed(self, cloud: PointCloud) -> NDArray[np.float32]:
        """What this map takes from the cloud beside its points, (N, c); raises InputError where
        that is missing.
        """

    @abstractmethod
    def carried(self, patches: Patches) -> Values:
        """What this map takes from patches beside their points; raises InputError where that is
        missing.
        """

    @abstractmethod
    def encode(self, cloud: PointCloud) -> LocalLim:
        """The local LIM of a cloud without points that are not usable, on loan until the next."""

    def learn_visibility(self, cloud: PointCloud, local: LocalLim, sign: int) -> None:
        """Hook: update evidence from the cloud's depth image, after it was fused (sign 1) or before
        it is taken out (-1). Only SurfaceMap does.
        """

    def usable(self, cloud: PointCloud) -> PointCloud:
        """The cloud without the points at which something observed is NaN or infinite."""
        observed = self.observed(cloud)
        if np.isfinite(observed.sum()):  # one pass; a sum is finite only if all its terms are
            return cloud
        return cloud.take(np.flatnonzero(np.isfinite(observed).all(axis=1)))

    def fuse_voxels(self, data: VoxelData) -> None:
        if len(data) == 0:
            return
        sums = data.sums
        local = LocalLim(
            None,
            len(data),
            data.keys,
            data.latents if sums is None else sums[:, :, None],
            data.weights,
            data.masks,
            self.channels,
            sides=data.sides,
        )
        self.grid.fuse(local)
