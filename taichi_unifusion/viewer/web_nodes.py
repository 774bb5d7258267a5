"""A mesh as nodes of a viser server: layers are switched, and heights cut away, by hiding nodes.

viser has neither colours that change nor clipping planes. So each layer of a mesh is a node of its
own, made when it is first chosen, that holds one GLB for each *band* of height.
"""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..files.glb import write_glb
from ..files.srgb import LINEAR_OF_BYTE
from ..geometry.triangles import vertex_normals
from ..types import Mesh
from .scene import Layer, SceneMesh
from .tone_mapping import light_that_shows

if TYPE_CHECKING:
    import viser

BANDS = 24  # of height: a cut moves in steps of a 24th of the scene
RELIEF = 0.12  # share of the light by which a side is lighter or darker, at most
PLAIN_RELIEF = 0.6  # the same where no colour has a meaning: of a map without colour
LIT_FROM = np.array([0.66, 0.36, 0.66])  # unit, in the scene: no two sides of a box look alike
KEPT_LAYERS = 4  # of a mesh that stay in the browser; each costs some 30 MB per million triangles


class MeshNodes:
    """One mesh of a scene on a server; nothing is sent before `show`."""

    def __init__(
        self, server: viser.ViserServer, node: str, shown: SceneMesh, face_band: NDArray[np.int64]
    ) -> None:
        """`face_band` (F,) is the band, 0..BANDS - 1, that each triangle lies in."""
        self.server, self.node, self.shown, self.face_band = server, node, shown, face_band
        self.layers: dict[str, LayerNodes] = {}  # by name, the one shown last at the end
        self.current, self.bands, self.visible = "", BANDS, True

    def show(self, layer: str) -> None:
        """Show a layer, or the first one where there is none of that name."""
        name = self.shown.layer(layer).name
        nodes = self.layers.pop(name, None) or LayerNodes(self, self.shown.layer(name))
        self.layers[name] = nodes
        nodes.keep(self.bands)
        nodes.visible = self.visible
        if self.current != name and self.current in self.layers:
            self.layers[self.current].visible = False
        self.current = name
        for old in list(self.layers)[:-KEPT_LAYERS]:
            self.layers.pop(old).remove()

    def cut(self, bands: int) -> None:
        """Show the lowest so many bands only."""
        self.bands = bands
        self.layers[self.current].keep(bands)

    def set_visible(self, visible: bool) -> None:
        """Show or hide the mesh."""
        self.visible = visible
        self.layers[self.current].visible = visible

    def relayer(self, shown: SceneMesh) -> None:
        """Take the same mesh with other layers; those that changed are sent again when shown."""
        for name in list(self.layers):
            if all(layer is not self.layers[name].layer for layer in shown.layers):
                self.layers.pop(name).remove()
        self.shown = shown
        self.show(self.current)

    def remove(self) -> None:
        """Take everything off the server."""
        for name in list(self.layers):
            self.layers.pop(name).remove()

    @property
    def kept(self) -> NDArray[np.bool_]:
        """(F,) triangles that are not cut away."""
        return self.face_band < self.bands


class LayerNodes:
    """A layer of a mesh on a server, hidden at first."""

    def __init__(self, mesh: MeshNodes, layer: Layer) -> None:
        self.layer = layer
        scene, node = mesh.server.scene, f"{mesh.node}/{_node_name(layer.name)}"
        with mesh.server.atomic():
            self.frame = scene.add_frame(node, show_axes=False, visible=False)
            self.bands = {
                int(band): scene.add_glb(
                    f"{node}/{band}",
                    glb_of(mesh.shown.mesh, layer, mesh.face_band == band),
                    cast_shadow=False,
                    receive_shadow=False,
                    visible=bool(band < mesh.bands),
                )
                for band in np.unique(mesh.face_band)
            }

    def keep(self, bands: int) -> None:
        """Show the lowest so many bands only."""
        for band, node in self.bands.items():
            if node.visible != (band < bands):
                node.visible = band < bands

    @property
    def visible(self) -> bool:
        return self.frame.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        if self.frame.visible != visible:
            self.frame.visible = visible

    def remove(self) -> None:
        """Take the layer off the server."""
        self.frame.remove()  # and with it the bands, its children


def glb_of(mesh: Mesh, layer: Layer, kept: NDArray[np.bool_]) -> bytes:
    """The triangles that are `kept` (F,) in the colours of a layer, as the bytes of a GLB.

    They are drawn as they are, without lights, so that the legend says what is seen. Those of values
    are a little lighter on one side and darker on the other, so that shapes can be told.
    """
    part, rows = Mesh(mesh.vertices, mesh.faces, mesh.normals).part(kept)
    light = LINEAR_OF_BYTE[layer.colors[rows]]
    if layer.lit:
        relief = RELIEF if layer.legend is not None else PLAIN_RELIEF
        normals = part.normals
        if normals is None:
            normals = vertex_normals(part.vertices, part.faces)
        light = np.clip(light * (1 + relief * normals @ LIT_FROM)[:, None], 0, 1)
    file = io.BytesIO()
    bare = Mesh(part.vertices, part.faces)
    write_glb(file, bare, light=light_that_shows(light))
    return file.getvalue()


def _node_name(text: str) -> str:
    """A text as a part of a node's name, in which / has a meaning; other texts give other names."""
    return text.encode().hex()
