"""The charts of a surface packed into a rectangle of texels, by xatlas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import InputError, MissingDependency
from ..geometry.triangles import areas
from ..types import Mesh
from .charts import Charts, cut_charts
from .depth_buffer import EMPTY

PADDING = 4  # texels between charts: two mip levels keep them apart
FILLED = 0.7  # of the rectangle that charts usually fill
SMALLER = 0.85  # a further try, where the rectangle came out too large
TRIES = 25
LAYERS = 20  # that a chart may lie on itself in
# texels: two steep triangles of one chart, one of them seen beyond its rim, are less far apart
ONE_PLACE = 8.0
# barycentric, of the places of a triangle that are looked at for others that lie there
LOOKED_AT = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / [[3], [6], [6], [6]]


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

    def draw_faces(self) -> NDArray[np.int32]:
        """The face (H, W) that covers each texel's centre, -1 where none does."""
        runtime.current()  # before Taichi is imported: it says what it starts
        from .kernels.raster import rasterize

        flat = np.zeros((len(self.places), 3), np.float32)
        flat[:, :2] = self.places - 0.5  # the rasteriser's pixels are centred at integers
        drop_z = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], np.float64)
        drawn = np.empty((self.height, self.width), np.int64)
        rasterize(flat, self.mesh.faces, 1, drop_z, 0.5, drawn)
        return np.where(drawn == EMPTY, -1, drawn & 0xFFFFFFFF).astype(np.int32)

    def points(self, texels: NDArray[np.int64], faces: NDArray) -> NDArray[np.float32]:
        """Places (N, 3) world [m] on the planes of faces (N,) that the centres of texels (N,),
        numbered row by row, lie at.
        """
        corners = self.mesh.faces[faces]
        a, b, c = (self.places[corners[:, k]] for k in range(3))
        at = np.column_stack([texels % self.width, texels // self.width]) + 0.5 - a
        u, v = b - a, c - a
        det = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
        thin = np.abs(det) < 1e-9
        det = np.where(thin, 1, det)
        s = np.where(thin, 1 / 3, (at[:, 0] * v[:, 1] - at[:, 1] * v[:, 0]) / det)[:, None]
        t = np.where(thin, 1 / 3, (u[:, 0] * at[:, 1] - u[:, 1] * at[:, 0]) / det)[:, None]
        a, b, c = (self.mesh.vertices[corners[:, k]].astype(np.float64) for k in range(3))
        return (a + s * (b - a) + t * (c - a)).astype(np.float32)

    def covered(self, chart: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Faces (F,) that lie below another of their `chart` (F,), which shows another place of the
        surface.
        """
        drawn, hidden = self.draw_faces(), np.zeros(len(self.mesh.faces), bool)
        corners = self.places[self.mesh.faces]
        for weights in LOOKED_AT:
            x, y = np.floor(np.einsum("k,nkd->dn", weights, corners)).astype(np.int64)
            x, y = np.clip(x, 0, self.width - 1), np.clip(y, 0, self.height - 1)
            above = drawn[y, x]
            own = np.arange(len(above))
            asked = np.flatnonzero((above >= 0) & (above != own) & (chart[above] == chart))
            texels = (y * self.width + x)[asked]
            apart = self.points(texels, asked) - self.points(texels, above[asked])
            hidden[asked] |= np.linalg.norm(apart, axis=1) > ONE_PLACE * self.texel_m
        return hidden


def unwrap(mesh: Mesh, texel_m: float, max_side: int) -> Atlas:
    """Cut a mesh, of triangles that have an area, into charts and pack them.

    A texel is `texel_m` wide on the surface, or as much wider as it must be for the rectangle to be
    at most `max_side` texels wide and high. Raises InputError where there are more charts than fit,
    MissingDependency without xatlas.
    """
    area = float(areas(mesh.vertices, mesh.faces).sum())
    texel_m = max(texel_m, np.sqrt(area / FILLED) / max_side)
    charts = cut_charts(mesh)
    for _ in range(LAYERS):
        atlas = _pack(charts, texel_m, max_side)
        hidden = atlas.covered(charts.chart)
        if not hidden.any():
            return atlas
        charts, texel_m = charts.split(hidden), atlas.texel_m
    return _pack(charts, texel_m, max_side)


def _pack(charts: Charts, texel_m: float, max_side: int) -> Atlas:
    try:
        import xatlas
    except ImportError:
        raise MissingDependency(
            "textures need fast-simplification and xatlas: pip install 'taichi-unifusion[texture]'"
        ) from None
    mesh, flat = charts.mesh, charts.flattened()
    keep, pack = xatlas.ChartOptions(), xatlas.PackOptions()
    keep.use_input_mesh_uvs = True
    pack.padding = PADDING
    for _ in range(TRIES):
        packed, pack.texels_per_unit = xatlas.Atlas(), 1 / texel_m
        packed.add_mesh(mesh.vertices[flat.source], flat.faces.astype(np.uint32), uvs=flat.places)
        packed.generate(keep, pack)
        if max(packed.width, packed.height) <= max_side:
            return _read(packed, mesh, flat.source, texel_m)
        texel_m /= SMALLER
    raise InputError(
        f"texture: {int(charts.chart.max()) + 1:,} charts do not fit into {max_side} x {max_side} "
        "texels; allow a larger texture, or ask for fewer triangles"
    )


def _read(packed, mesh: Mesh, source: NDArray[np.int64], texel_m: float) -> Atlas:
    """The atlas that xatlas packed; its vertices come from those that were given, from `source`."""
    given, faces, places = packed[0]
    source = source[given]
    normals = None if mesh.normals is None else mesh.normals[source]
    cut = Mesh(mesh.vertices[source], faces.astype(np.int32), normals)
    size = np.array([packed.width, packed.height], np.float64)
    return Atlas(cut, places * size, packed.width, packed.height, texel_m)
