"""What maps hold of every voxel, and voxels by value: what is saved, loaded and merged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import prod

import numpy as np
from numpy.typing import NDArray

from ..kernels.cells import BLOCK_CELLS
from ..kernels.layout import Layout
from .settings import FeatureSettings, PropertySettings, SurfaceSettings

PRECISIONS = {  # of a map of features: name -> types of means and of slopes
    "int8": (np.dtype(np.float16), np.dtype(np.int8)),
    "float16": (np.dtype(np.float16), np.dtype(np.float16)),
    "float32": (np.dtype(np.float32), np.dtype(np.float32)),
}


@dataclass(frozen=True)
class VoxelField:
    """What one pool holds of every voxel; storage, export, files and checks all go by it."""

    name: str  # of the pool, and of the tensor in a map file
    dtype: np.dtype
    shape: tuple[int, ...] = ()  # of one voxel

    @property
    def bytes(self) -> int:
        """Bytes of one voxel."""
        return self.dtype.itemsize * prod(self.shape)


KEYS = VoxelField("keys", np.dtype(np.int32), (3,))
WEIGHTS = VoxelField("weights", np.dtype(np.float32))
MASKS = VoxelField("masks", np.dtype(np.uint32), (2,))  # support of the voxel's cells
# frames that saw surface in a cell minus frames that saw through it
# w of the local LIMs that show fronts, and backs, and their support
SIDE_WEIGHTS = VoxelField("side_weights", np.dtype(np.float32), (2,))
FRONT_MASKS = VoxelField("front_masks", np.dtype(np.uint32), (2,))
BACK_MASKS = VoxelField("back_masks", np.dtype(np.uint32), (2,))
EVIDENCE = VoxelField("evidence", np.dtype(np.int8), (BLOCK_CELLS,))


def latents(rows: int, channels: int) -> VoxelField:
    """The field of latents (r, c): F, and a prior mean."""
    return VoxelField("latents", np.dtype(np.float32), (rows, channels))


def backs(rank: int) -> VoxelField:
    """The field of latents (l,) of backs: their mean F."""
    return VoxelField("backs", np.dtype(np.float16), (rank,))


@dataclass(frozen=True)
class VoxelData:
    """Voxels by value, sorted by index (i, then j, then k): what maps save, load and merge."""

    keys: NDArray[np.int32]  # (N, 3) voxel index
    fields: Mapping[str, NDArray]  # (N, ...) each, by name

    def __len__(self) -> int:
        return len(self.keys)

    @property
    def latents(self) -> NDArray[np.float32]:
        """(N, r, c)."""
        return self.fields["latents"]

    @property
    def weights(self) -> NDArray[np.float32]:
        """(N,)."""
        return self.fields["weights"]

    @property
    def masks(self) -> NDArray[np.uint32]:
        """(N, 2) support."""
        return self.fields["masks"]

    @property
    def evidence(self) -> NDArray[np.int8] | None:
        """(N, 64) frames for a cell minus frames against it; None where the map counts none."""
        return self.fields.get("evidence")

    @property
    def sides(self) -> tuple[NDArray, ...] | None:
        """F (N, l) of backs, w (N, 2) of fronts and backs, the support (N, 2) of fronts, of backs; None
        where the map does not keep them apart.
        """
        if "backs" not in self.fields:
            return None
        return tuple(
            self.fields[name] for name in ("backs", "side_weights", "front_masks", "back_masks")
        )

    @property
    def sums(self) -> NDArray[np.float32] | None:
        """(N, q) of the regression, with `fusion: information`."""
        return self.fields.get("sums")

    @property
    def tensors(self) -> dict[str, NDArray]:
        """Keys and fields, as the arrays of a map file."""
        return {"keys": self.keys, **self.fields}


def surface_layout(settings: SurfaceSettings) -> Layout:
    """Sizes of the regression of a surface map."""
    return Layout(
        settings.encoder.rank,
        1,
        centered=False,
        derivatives=settings.gpis != "samples",
        some_normals=settings.gpis == "both",
        information=settings.fusion == "information",
    )


def property_layout(channels: int, settings: PropertySettings) -> Layout:
    """Sizes of the regression of a property map."""
    return Layout(
        settings.encoder.rank,
        channels,
        centered=settings.prior == "mean",
        information=settings.fusion == "information",
    )


def regression_fields(layout: Layout, more: tuple[VoxelField, ...] = ()) -> tuple[VoxelField, ...]:
    """What a map of such a regression holds of a voxel beside its key, and `more`."""
    sums = (VoxelField("sums", np.dtype(np.float32), (layout.sums,)),) * layout.information
    return (latents(layout.latent_rows, layout.channels), WEIGHTS, MASKS, *more, *sums)


def surface_extras(settings: SurfaceSettings) -> tuple[VoxelField, ...]:
    """What a surface map holds of a voxel that other maps do not."""
    sides = (backs(settings.encoder.rank), SIDE_WEIGHTS, FRONT_MASKS, BACK_MASKS)
    apart = settings.two_sides and settings.fusion == "mean"
    return (EVIDENCE,) * settings.carve + sides * apart


def surface_fields(settings: SurfaceSettings) -> tuple[VoxelField, ...]:
    """What a surface map holds of a voxel beside its key."""
    return regression_fields(surface_layout(settings), surface_extras(settings))


def property_fields(channels: int, settings: PropertySettings) -> tuple[VoxelField, ...]:
    """What a property map holds of a voxel beside its key."""
    return regression_fields(property_layout(channels, settings))


def feature_fields(channels: int, settings: FeatureSettings) -> tuple[VoxelField, ...]:
    """What a map of features holds of a voxel beside its key: moments, weights, and rows of
    features; masks are kept for the form of the files.
    """
    mean, slope = PRECISIONS[settings.precision]
    q = settings.encoder.rank - 1  # the mean replaces the first eigenfunction
    return (
        latents(q + q * (q + 1) // 2, 1),
        WEIGHTS,
        MASKS,
        VoxelField("means", mean, (channels,)),
        VoxelField("slopes", slope, (q * channels,)),
        VoxelField("scales", np.dtype(np.float32), (q,)),
    )
