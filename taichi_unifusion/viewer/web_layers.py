"""The controls of a page that choose what is seen: which layer and results, how high, how fine."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .web_cameras import CameraPanel
from .web_results import ShownResults
from .web_text import legend_html, paragraph

if TYPE_CHECKING:
    import viser


class LayerPanel:
    """Which layer, which results, how high, how fine."""

    def __init__(self, results: ShownResults) -> None:
        self.results, stage, gui = results, results.stage, results.viewer.server.gui
        request = results.viewer.request
        self.layer = gui.add_dropdown("Layer", stage.scene.layer_names)
        self.layer.on_update(lambda _: request(self.show_chosen))
        self.legend = gui.add_html("")
        if len(stage.scene.meshes) > 1:
            for i, mesh in enumerate(stage.scene.meshes):
                box = gui.add_checkbox(mesh.name, True)
                box.on_update(
                    lambda event, i=i: request(
                        lambda: results.stage.set_visible(i, event.target.value), event.client
                    )
                )
        low, high = stage.scene.heights()
        step = max((high - low) / 100, 1e-3)
        self.height = gui.add_slider(
            "Cut above [m]", round(low, 3), round(high + step, 3), step, round(high + step, 3)
        )
        self.height.on_update(lambda _: request(self._cut))
        self.cameras = CameraPanel(results)
        self.with_maps = [i for i, source in enumerate(results.sources) if source.has_maps]
        if self.with_maps:
            usual = results.sources[self.with_maps[0]].mesh_settings.resolution
            self.resolution = gui.add_slider("Cells a voxel", 1, 8, 1, min(usual, 8))
            again = gui.add_button("Extract the mesh again")
            again.on_click(lambda event: request(lambda: self._extract(event.client), event.client))
            self.progress = gui.add_progress_bar(0.0, visible=False)
        self.notes = gui.add_html("")
        self.refresh()

    def show(self, name: str) -> None:
        """Choose a layer, as the user of the page would."""
        self.layer.options = self.results.scene.layer_names
        self.layer.value = name
        self.show_chosen()

    def show_chosen(self) -> None:
        """Show the layer that is chosen, with its legend."""
        self.results.stage.show_layer(self.layer.value)
        self.legend.content = legend_html(self.results.scene.legend(self.layer.value))

    def refresh(self) -> None:
        """Say what there is now."""
        if self.layer.options != self.results.scene.layer_names:
            self.layer.options = self.results.scene.layer_names
        self.notes.content = "".join(
            paragraph(
                f"{mesh.name}: {mesh.note or f'{len(mesh.mesh.faces):,} triangles, all of them'}"
            )
            for mesh in self.results.scene.meshes
        )
        self.show_chosen()

    def _cut(self) -> None:
        self.results.stage.cut_above(self.height.value)

    def _extract(self, client: viser.ClientHandle | None) -> None:
        results, resolution = self.results, int(self.resolution.value)
        self.progress.value, self.progress.visible = 0.0, True
        try:
            for i in self.with_maps:
                shown = results.wholes[i]
                whole = results.sources[i].extract(results.scene, shown, resolution, self._piece)
                results.replace_mesh(i, whole)
        finally:
            self.progress.visible = False
        self.refresh()
        results.viewer.say("Extracted", f"{results.scene.triangles:,} triangles are shown", client)

    def _piece(self, done: int, total: int) -> None:
        self.progress.value = 100 * done / total
