"""Groups of maps: property maps of equal settings are fused from one encoding (Sec. IV-C, VI-I)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from .. import runtime
from ..errors import InputError
from ..kernels.layout import Layout
from ..kernels.patches import Patches, Values
from ..types import Frame, PointCloud
from .base_map import BaseMap, Integration
from .binner import Binner, SurfelBinner
from .encoder import Encoder
from .local_lim import LocalLim
from .property_map import PropertyMap, encode_values
from .regression_map import RegressionMap

SPREAD = 2  # voxels that the samples beside a block's surfels may bring, the block not counted


@dataclass(frozen=True)
class Part:
    """Maps whose values are binned and encoded side by side, by the index of the first."""

    maps: tuple[RegressionMap, ...]
    binner: Binner
    encoder: Encoder

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(each.name for each in self.maps)

    def carried(self, patches: Patches) -> list[Values]:
        """What the maps take from patches."""
        return [each.carried(patches) for each in self.maps]

    def reserve(self, blocks: int) -> None:
        """Make room for so many voxels more in every map; raises CapacityError."""
        for each in self.maps:
            each.grid.reserve(blocks)

    def expect(self, blocks: int, touched: int) -> None:
        """Make sure that a window of so many blocks, of which `touched` are new, can be fused;
        raises CapacityError.
        """
        for each in self.maps:
            own = touched if each is self.maps[0] else blocks
            more = self._most_voxels(blocks)
            each.grid.expect(more, more - blocks, own)

    def grow_ahead(self, blocks: int) -> list[Callable[[], None]]:
        """What makes room, a pool at a time, for what a window of so many blocks adds and for another
        one like it; by expectation, since most of their voxels are the same.
        """
        extra = 3 * self._most_voxels(blocks) // 2
        return [grow for each in self.maps for grow in each.grid.grow_ahead(extra)]

    def _most_voxels(self, blocks: int) -> int:
        """How many voxels a window of so many blocks may add to a map."""
        return (1 + (SPREAD if isinstance(self.binner, SurfelBinner) else 0)) * blocks

    def fuse(self, local: LocalLim) -> dict[str, int]:
        """Fuse to each map its part; by name how many voxels that were."""
        fused = {}
        for each, part in self._split(local):
            fused[each.name] = each.grid.fuse(part)
        return fused

    def take_out(self, local: LocalLim) -> None:
        """Undo `fuse`."""
        for each, part in self._split(local):
            each.grid.take_out(part)

    def _split(self, local: LocalLim) -> Iterator[tuple[RegressionMap, LocalLim]]:
        parts = local.parts([each.channels for each in self.maps])
        return zip(self.maps, parts, strict=True)


class MapGroup:
    """Maps that are given the same clouds; this one fuses each of them by itself."""

    def __init__(self, maps: Sequence[BaseMap]) -> None:
        self.maps = tuple(maps)

    @property
    def sums_up(self) -> bool:
        """Whether these maps can take averages of several frames, or of one on the device."""
        return not any(isinstance(each, RegressionMap) and not each.sums_up for each in self.maps)

    def names_in(self, cloud: PointCloud) -> list[str]:
        """The names of the maps that want a cloud."""
        return [each.name for each in self.maps if each.wants(cloud)]

    def integrate(self, cloud: PointCloud) -> dict[str, Integration]:
        """Fuse a cloud in world coordinates into the maps that want it; by name what that did."""
        return {each.name: each.integrate(cloud) for each in self.maps if each.wants(cloud)}

    def parts(self, frame: Frame) -> list[Part]:
        """The maps that a frame has something for, and that can take averages of several frames, as
        they are encoded together.
        """
        return [
            Part((each,), each.binner, each.encoder)
            for each in self.maps
            if isinstance(each, RegressionMap) and each.sums_up and each.wants(frame)
        ]

    def part_of(self, names: tuple[str, ...]) -> Part | None:
        """The maps of these names as they are encoded together; None where they are not here."""
        found = [each for each in self.maps if each.name in names]
        if len(found) == 1 == len(names) and isinstance(found[0], RegressionMap):
            return Part((found[0],), found[0].binner, found[0].encoder)
        return None


class PropertyGroup(MapGroup):
    """Property maps that take their voxels, position features and factorised Gram matrices from one
    computation a frame.

        group = PropertyGroup([infrared, style])
        group.integrate(cloud)

    A regression's left side depends on positions only (Eq. 18), so the properties of a cloud are
    encoded as columns of one right side. Every map keeps its own voxels and weights: it may lack
    frames that others have, and is saved, loaded and merged alone.
    """

    maps: tuple[PropertyMap, ...]

    def __init__(self, maps: Sequence[PropertyMap]) -> None:
        super().__init__(maps)
        first = self.maps[0]
        for other in self.maps[1:]:
            if other.settings != first.settings:
                raise InputError(
                    f"property group: '{first.name}' and '{other.name}' have other settings: "
                    f"{first.settings} and {other.settings}"
                )
        self._encoders: dict[Layout, Encoder] = {}

    def integrate(self, cloud: PointCloud) -> dict[str, Integration]:
        """Fuse a cloud in world coordinates into the maps whose attribute it has; by name what that
        did.

        Each map is as after an `integrate` of its own; raises as that does, with all maps
        unchanged.
        """
        present = [each for each in self.maps if each.wants(cloud)]
        finite = [
            each for each in present if len(present) > 1 and np.isfinite(each.observed(cloud).sum())
        ]
        # nothing to share; a map whose values are not all finite leaves points out
        if len(finite) < 2 or not len(cloud):
            return super().integrate(cloud)
        done = self._integrate_together(finite, cloud)
        return done | {each.name: each.integrate(cloud) for each in present if each not in finite}

    def parts(self, frame: Frame) -> list[Part]:
        parts = super().parts(frame)
        # a map whose values are not all finite leaves points out
        together = [part.maps[0] for part in parts if part.names[0] in frame.carried]
        if len(together) < 2:
            return parts
        return [self._part(together), *(part for part in parts if part.maps[0] not in together)]

    def part_of(self, names: tuple[str, ...]) -> Part | None:
        together = [each for each in self.maps if each.name in names]
        if len(together) != len(names) or len(names) < 2:
            return super().part_of(names)
        return self._part(together)

    def _integrate_together(
        self, maps: Sequence[PropertyMap], cloud: PointCloud
    ) -> dict[str, Integration]:
        """Encode the maps' values side by side, and fuse to each map its part."""
        for each in maps:
            each.flush()
        part = self._part(maps)
        runtime.check_alive(part.binner.grid.runtime)
        local = encode_values(maps, part.binner, part.encoder, cloud)
        part.reserve(local.count)  # what does not fit is said before the first map changes
        encoded = part.fuse(local)
        return {each.name: Integration(len(cloud), encoded[each.name], len(each)) for each in maps}

    def _part(self, maps: Sequence[RegressionMap]) -> Part:
        """Maps together: an encoder of all their values which is otherwise that of each."""
        lead, channels = maps[0], sum(each.channels for each in maps)
        layout = Layout(
            lead.layout.rank, channels, lead.layout.centered, information=lead.layout.information
        )
        if layout not in self._encoders:
            self._encoders[layout] = Encoder(lead.grid.runtime, lead.settings, layout)
        binner = Binner(lead.grid, lead.voxel_size, channels)
        return Part(tuple(maps), binner, self._encoders[layout])


def group_maps(maps: Iterable[BaseMap]) -> list[MapGroup]:
    """The maps in their order, property maps of equal settings together."""
    groups: dict[object, list[BaseMap]] = {}
    for each in maps:
        key = each.settings if isinstance(each, PropertyMap) else each.name
        groups.setdefault(key, []).append(each)
    return [
        PropertyGroup(together)
        if (together := [each for each in members if isinstance(each, PropertyMap)])
        else MapGroup(members)
        for members in groups.values()
    ]
