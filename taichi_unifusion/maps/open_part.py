"""OpenPart: what a window sums up for the maps that are encoded together."""

from __future__ import annotations

from dataclasses import dataclass

from ..device_arrays import Arena
from .kept_cells import KeptCells
from .local_lim import OpenCells
from .property_group import Part


@dataclass
class OpenPart:
    """What a window sums up for the maps of one part."""

    part: Part
    cells: OpenCells
    arena: Arena  # of what comes out of them

    @property
    def bytes(self) -> int:
        return self.cells.count * self.cells.arrays.block_bytes

    def kept_cells(self) -> KeptCells:
        """What is summed up, which becomes what is kept of it."""
        channels = [each.channels for each in self.part.maps]
        return KeptCells.of(self.cells, self.part.binner, channels)
