"""A surface cut into flat charts, and the charts packed into a rectangle of texels, by xatlas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, MissingDependency
from ..geometry.triangles import areas
from ..types import Mesh

PADDING = 4  # texels between charts: two mip levels keep them apart
FILLED = 0.6  # of the rectangle that charts usually fill
SMALLER = 0.95  # a further try, where the rectangle came out too large
TRIES = 60


@dataclass(frozen=True)
class Atlas:
    """A mesh and where its vertices lie in a rectangle of texels; those on seams are doubled."""

    mesh: Mesh
    places: NDArray[np.float64]  # (V, 2) [texels], right and down; the first covers [0, 1]
    width: int
    height: int
    texel_m: float  # edge of a texel on the surface

    @property
    def coordinates(self) -> NDArray[np.float32]:
        """The places as texture coordinates (V, 2) in [0, 1]."""
        return np.clip(self.places / (self.width, self.height), 0, 1).astype(np.float32)


def unwrap(mesh: Mesh, texel_m: float, max_side: int) -> Atlas:
    """Cut a mesh, of triangles that have an area, into charts and pack them.

    A texel is `texel_m` wide on the surface, or as much wider as it must be for the rectangle to be
    at most `max_side` texels wide and high. Raises InputError where there are more charts than fit,
    MissingDependency without xatlas.
    """
    try:
        import xatlas
    except ImportError:
        raise MissingDependency(
            "textures need fast-simplification and xatlas: pip install 'taichi-unifusion[texture]'"
        ) from None
    charts = xatlas.Atlas()
    charts.add_mesh(mesh.vertices, mesh.faces.astype(np.uint32))
    charts.generate()
    source, faces, places = charts[0]
    cut = Mesh(
        mesh.vertices[source],
        faces.astype(np.int32),
        None if mesh.normals is None else mesh.normals[source],
    )
    metres = np.ascontiguousarray(
        places * np.array([charts.width, charts.height]) / charts.texels_per_unit, np.float32
    )
    area = float(areas(mesh.vertices, mesh.faces).sum())
    texel_m = max(texel_m, np.sqrt(area / FILLED) / max_side)
    for _ in range(TRIES):
        packed, options = xatlas.Atlas(), xatlas.PackOptions()
        packed.add_uv_mesh(metres, faces)
        options.texels_per_unit, options.padding = 1 / texel_m, PADDING
        packed.generate(xatlas.ChartOptions(), options)
        if max(packed.width, packed.height) <= max_side:
            return _read(packed, cut, texel_m)
        texel_m /= SMALLER
    raise InputError(
        f"texture: {charts.chart_count:,} charts do not fit into {max_side} x {max_side} texels; "
        "allow a larger texture, or ask for fewer triangles"
    )


def _read(packed, cut: Mesh, texel_m: float) -> Atlas:
    """The atlas that xatlas packed of the charts of a mesh."""
    source, faces, places = packed[0]
    mesh = Mesh(
        cut.vertices[source],
        faces.astype(np.int32),
        None if cut.normals is None else cut.normals[source],
    )
    size = np.array([packed.width, packed.height], np.float64)
    return Atlas(mesh, places * size, packed.width, packed.height, texel_m)
