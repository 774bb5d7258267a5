"""A results folder as exports need it: its mesh in the colours to be shown, these colours as a field,
and which way is up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import FileError, InputError
from ..files.mesh_reading import read_mesh
from ..geometry.gravity import Up
from ..geometry.triangles import sample_patches
from ..maps.by_tiles import open_property
from ..rendering.baking import ColorField
from ..rendering.legend import property_mesh
from ..rendering.look import Look, colorize, shown_range
from ..rendering.mesh_checks import check_mesh
from ..types import Mesh
from .outlook import read_up
from .property_files import recorded_looks
from .run_folder import RunFolder, why_no_mesh

COLOR = "color"


@dataclass(frozen=True)
class ExportSource:
    """What an export starts from."""

    folder: RunFolder
    name: str  # of the property that is shown
    mesh: Mesh  # as it was extracted, with its colours as "color" if it has any
    up: Up
    device: str
    to_color: Callable[[NDArray], NDArray]  # values (N, c) -> RGB (N, 3) in [0, 1]

    @property
    def has_map(self) -> bool:
        """Whether the colours are also known between the vertices."""
        return self.name in self.folder.maps

    @cached_property
    def colors(self) -> ColorField:
        """The colours as a field, which says where its map knows them; raises FileError where there
        is no such map.
        """
        file = self.folder.saved_map(self.name)
        if not self.has_map:
            raise FileError(
                f"{file}: no such file, so there are no colours between the vertices: keep every "
                "triangle with --vertex-colors, or map them with `unifusion reconstruct`"
            )
        runtime.init(self.device)
        field = open_property(file)

        def color(points: NDArray) -> tuple[NDArray, NDArray]:
            values, known = field.query(points, return_valid=True)
            return self.to_color(values), known

        return color

    def sample(self, count: int) -> Mesh:
        """Points evenly over the surface, with normals, as a mesh without triangles; coloured by the
        map, or where there is none by the nearest vertex.
        """
        full = self.mesh
        points, normals = sample_patches(full.vertices, full.faces, count, np.random.default_rng(0))
        colors = {}
        if self.has_map:
            colors = {COLOR: self.colors(points)[0]}
        elif COLOR in full.attributes:
            from scipy.spatial import KDTree

            colors = {COLOR: full.attributes[COLOR][KDTree(full.vertices).query(points)[1]]}
        none = np.zeros((0, 3), np.int32)
        return Mesh(points.astype(np.float32), none, normals.astype(np.float32), colors)


def read_export_source(folder: RunFolder, name: str, device: str) -> ExportSource:
    """The source of exports in the colours of property `name`; raises FileError where the folder has
    no mesh, InputError where the mesh is empty or does not carry the property.
    """
    if not folder.mesh.exists():
        raise FileError(why_no_mesh(folder))
    mesh = check_mesh(read_mesh(folder.mesh), str(folder.mesh))
    up = read_up(folder, mesh)
    if name == COLOR:
        return ExportSource(folder, name, mesh, up, device, np.asarray)
    known = [key for key, values in mesh.attributes.items() if values.shape[1] in (1, 3)]
    if name not in known:
        raise InputError(
            f"--property: {folder.mesh} shows no '{name}'; it shows {', '.join(known) or 'none'}"
        )
    look = recorded_looks(folder).get(name, Look(range=None))
    low, high = shown_range(mesh.attributes[name], look)
    shown = property_mesh(mesh, name, look)
    return ExportSource(
        folder, name, shown, up, device, lambda v: colorize(v, look.colormap, low, high)
    )
