"""What a map can be told: the settings are checked here, shown by `--help`, and saved with every
map.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import Literal, Self

from ..errors import (
    InputError,
    check_choice,
    check_range,
    check_types,
    check_whole,
    shortened,
    strict,
)
from .encoding import EncoderSettings

MAX_RESOLUTION = 32  # mesh cells along a voxel's edge
MAX_WINDOW = 31  # frames that are fused at once: a voxel has a bit for each
# of a map: kernels unroll over it, and with more would compile for minutes, deaf to Ctrl-C
MAX_RANK = 64
LEAST_VOXEL, LARGEST_VOXEL = 1e-4, 2.0  # [m]
MAX_FEATURE_RANK = 20  # of a map of features: its kernels unroll over it
# of a map of a property: its kernels unroll over them, and compile for half a minute
MAX_PROPERTY_CHANNELS = 64
MAX_FEATURE_CHANNELS = 8192
MAX_NAME = 200  # letters of a map's name


def check_voxel_size(size: float) -> None:
    """Raise InputError unless a voxel may be so large [m]; 0 stands for a size that is not chosen yet."""
    if size != 0:
        check_range("voxel_size", size, LEAST_VOXEL, LARGEST_VOXEL, "metres")


@strict
@dataclass(frozen=True)
class MapSettings:
    """Settings that every Latent Implicit Map has."""

    voxel_size: float = 0.0
    """Voxel edge in metres; a latent describes a cube of twice this edge. 0: 0.05 in a room, as
    `detail` says; 0.05 for a map by itself.
    """
    noise: float = 1.0
    """Observation noise d of the regression (Eq. 6) relative to the kernel's variance; larger is
    smoother.
    """
    min_points: int = 4
    """Voxels with fewer samples in a frame are left out of that frame."""
    sampling: Literal["cells", "points"] = "cells"
    """cells: average a frame's points in 4x4x4 cells a voxel before the regression (fast); points:
    every point (the paper).
    """
    margin: int = 1
    """Cells (quarters of a voxel) around a voxel that its regression takes in: 2 is the whole
    doubled voxel, 1 is faster; sampling points always takes the whole."""
    fusion: Literal["mean", "information"] = "mean"
    """mean: latents of frames are averaged by weight (Eq. 19); information: the regression runs
    over all frames at once, with several times the memory."""
    encoder: EncoderSettings = field(default_factory=EncoderSettings)
    """The position encoding."""

    usual_voxel_size = 0.05  # [m] not a setting: has no type

    @property
    def sized(self) -> Self:
        """The same, with the usual voxel size where none is given."""
        return self if self.voxel_size else replace(self, voxel_size=self.usual_voxel_size)

    def __post_init__(self) -> None:
        check_types(self)
        check_voxel_size(self.voxel_size)
        check_range("noise", self.noise, 1e-9, 1e9)
        check_range("min_points", self.min_points, 1, 1_000_000)
        if self.margin not in (1, 2):
            raise InputError(f"margin: must be 1 or 2 cells, got {self.margin}")
        check_range("encoder: rank", self.encoder.rank, 1, MAX_RANK)
        check_choice("sampling", self.sampling, ("cells", "points"))
        check_choice("fusion", self.fusion, ("mean", "information"))


@strict
@dataclass(frozen=True)
class SurfaceSettings(MapSettings):
    """Settings of the surface map (Sec. IV-B)."""

    gpis: Literal["samples", "derivatives", "both"] = "both"
    """samples: points on and beside the surface carry signed distances; derivatives: points carry
    their normals (Eq. 14-17); both: points on the surface carry both, those beside it distances.
    """
    sample_distance: float = 0.2
    """Distance of the off-surface samples along the normal, in voxels (d_s)."""
    support_points: int = 4
    """Surface is extracted only in cells (quarters of a voxel) that held this many samples of one
    frame (fewer where a whole voxel has few); 0: everywhere in voxels that held any."""

    support_closing: int = 10
    """Cells with at least this many of their 26 neighbours seen count as seen, which closes
    pinholes; 27: none, 1: a rim all around."""
    carve: bool = True
    """Cut the mesh where more frames saw through the surface than saw it."""
    two_sides: bool = True
    """Keep apart what is seen from opposite sides, so that a board thinner than a voxel gets both of its
    faces; not with fusion: information.
    """
    min_evidence: float = 0.5
    """With `carve`: keep surface that at least this many more frames saw than saw through, between
    cells in proportion; 1.5 asks for two frames.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 0 < self.sample_distance <= 1:
            raise InputError(
                f"sample_distance: must lie in (0, 1] voxels, got {self.sample_distance}"
            )
        check_range("support_points", self.support_points, 0, 1_000_000)
        check_range("support_closing", self.support_closing, 1, 27, "neighbours")
        check_range("min_evidence", self.min_evidence, -127, 127, "frames")
        check_choice("gpis", self.gpis, ("samples", "derivatives", "both"))


@strict
@dataclass(frozen=True)
class PropertySettings(MapSettings):
    """Settings of a property map (Sec. IV-C)."""

    usual_voxel_size = 0.025

    voxel_size: float = 0.0
    """Voxel edge in metres; a latent describes a cube of twice this edge. Smaller is sharper where
    colour fits depth well. 0: 0.025 for colour in a room, as `detail` says, and for other
    properties what fits them; 0.025 for a map by itself.
    """
    noise: float = 0.1
    """Observation noise d of the regression (Eq. 18) relative to the kernel's variance; larger is
    smoother.
    """
    min_points: int = 1
    """Voxels with fewer samples in a frame are left out of that frame."""
    encoder: EncoderSettings = field(default_factory=lambda: EncoderSettings(rank=12))
    """The position encoding; 12 eigenpairs render nearly as well as 20 here, at half the work."""
    prior: Literal["mean", "zero"] = "mean"
    """What the field falls back to where a voxel has no data: the voxel's mean, or zero as
    published.
    """
    blend: bool = True
    """Decode from all voxels that contain a point, with tent weights; off: from its own voxel only,
    as published.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("prior", self.prior, ("mean", "zero"))


def color_settings() -> PropertySettings:
    """Those of colour, which every pixel has, with less noise than most properties."""
    return PropertySettings(noise=0.01)


@strict
@dataclass(frozen=True)
class FeatureSettings(MapSettings):
    """Settings of a map of high-dimensional features (Sec. IV-D)."""

    usual_voxel_size = 0.1

    voxel_size: float = 0.0
    """Voxel edge in metres; a latent describes a cube of twice this edge. 0: 0.1 in a room, as
    `detail` says; 0.1 for a map by itself.
    """
    noise: float = 1.0
    """Observation noise d of the regression (Eq. 6) for one feature pixel, relative to the kernel's
    variance.
    """
    fusion: Literal["mean", "information"] = "information"
    """information: the regression runs over all frames at once; there is no other way here, as it
    costs no more memory.
    """
    encoder: EncoderSettings = field(default_factory=lambda: EncoderSettings(rank=8))
    """The position encoding; a voxel keeps so many numbers a channel: their mean, and slopes for
    eigenpairs from the second.
    """
    precision: Literal["int8", "float16", "float32"] = "int8"
    """What a voxel's numbers are kept in; int8: means in half precision, slopes in 8 bits and a
    scale for each.
    """
    source: str = ""
    """What made the features, as in clip:MODEL; written by the pipeline, and merged only with the
    same.
    """

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.sampling != "cells" or self.fusion != "information":
            raise InputError(
                "a map of features knows sampling 'cells' and fusion 'information' only, got "
                f"'{self.sampling}' and '{self.fusion}'"
            )
        check_choice("precision", self.precision, ("int8", "float16", "float32"))
        if not 2 <= self.encoder.rank <= MAX_FEATURE_RANK:
            raise InputError(
                f"encoder: rank must lie in 2..{MAX_FEATURE_RANK} in a map of features, got {self.encoder.rank}"
            )


def check_channels(what: str, channels: int, most: int) -> None:
    """Raise InputError for a map of no or too many channels; `what` names the map."""
    check_whole(f"{what}: channels", channels, -(2**63), 2**63)
    if not 1 <= channels <= most:
        hint = "; vectors of hundreds of numbers go into a FeatureMap" * (most < channels)
        raise InputError(f"{what}: channels must lie in 1..{most}, got {channels}{hint}")


def check_name(what: str, name: object) -> None:
    """Raise InputError for a map's name that is no text to print; `what` names the map."""
    if not isinstance(name, str) or not name.isprintable() or not 0 < len(name) <= MAX_NAME:
        raise InputError(
            f"{what}: must be 1 to {MAX_NAME} printable letters, got {shortened(name)}"
        )


def parse_bytes(text: str, what: str) -> int:
    """A size as people write it, in powers of 1000: 2GB, 500 MB; raises InputError, which says
    `what` it is of.
    """
    found = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([kMGT]?)i?B?\s*", text, re.IGNORECASE)
    power = "kmgt".find((found.group(2) or " ").lower()) + 1 if found else 0
    count = float(found.group(1)) * 1000**power if found else 0.0
    if not 1e6 <= count <= 1e15:
        raise InputError(
            f"{what}: expected a size as 2GB or 500MB, at least 1 MB, got {shortened(text)}"
        )
    return int(count)
