"""A results folder that can be looked at, asked, and extracted again: what viewers get from its maps,
which are loaded when they are first needed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..config import MeshSettings, load_config
from ..errors import FileError, InputError
from ..maps.stored import read_description
from ..results.run_folder import RunFolder
from ..types import Mesh
from .answers import ShownAnswer, show_answer
from .results_scene import SceneOptions, find_recorded_run, layers_of, open_scene, with_images
from .scene import Scene, SceneMesh

if TYPE_CHECKING:
    from ..maps import PropertyMap, SurfaceMap
    from ..maps.by_tiles import Features
    from ..maps.working_set import MapMemory
    from ..networks.encoders import TextEncoder

PIECE = 64  # blocks that are extracted at once
WORDS = 5  # that are nearest to the features at a point
# gives the text encoder that belongs to features of a source, which is named after their network
MakeEncoder = Callable[[str, Path], "TextEncoder"]


def welded(pieces: Sequence[Mesh]) -> Mesh:
    """One mesh of pieces with normals that share the vertices of their borders to the last bit."""
    pieces = [piece for piece in pieces if len(piece.faces)] or list(pieces[:1])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    normals = np.concatenate([piece.normals for piece in pieces if piece.normals is not None])
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces[:-1])])
    faces = np.concatenate([piece.faces + at for piece, at in zip(pieces, starts, strict=True)])
    bits = np.ascontiguousarray(vertices).view(np.dtype((np.void, 3 * vertices.itemsize)))
    _, first, number = np.unique(bits.ravel(), return_index=True, return_inverse=True)
    attributes = {
        name: np.concatenate([piece.attributes[name] for piece in pieces])[first]
        for name in pieces[0].attributes
    }
    return Mesh(
        vertices[first], number.reshape(-1)[faces].astype(np.int32), normals[first], attributes
    )


@dataclass(frozen=True)
class ResultsSource:
    """A results folder, or a mesh file, as viewers use it."""

    path: Path
    options: SceneOptions = field(default_factory=SceneOptions)
    make_encoder: MakeEncoder | None = None

    @property
    def folder(self) -> RunFolder | None:
        """The results folder; None for a mesh file."""
        return RunFolder(self.path) if self.path.is_dir() else None

    def open(self) -> Scene:
        """Everything there is to see; raises as `open_scene`."""
        return open_scene(self.path, self.options)

    def with_images(self, scene: Scene) -> Scene:
        """The scene with what its cameras saw, as far as the recording is still there."""
        run = None if self.folder is None else find_recorded_run(self.folder)
        return scene if run is None else with_images(scene, run, self.options.image_width)

    @property
    def has_maps(self) -> bool:
        """Whether the mesh can be extracted again."""
        return self.folder is not None and "surface" in self.folder.maps

    @property
    def mesh_settings(self) -> MeshSettings:
        """How the run made its mesh; raises ConfigError where its settings cannot be read."""
        config = self._folder.config
        return load_config(config).mesh if config.exists() else MeshSettings()

    @property
    def has_features(self) -> bool:
        """Whether there is a map that questions can be put to, and an encoder for the words."""
        return (
            self.make_encoder is not None
            and self.folder is not None
            and self.folder.features.exists()
        )

    @property
    def page(self) -> Path:
        """Where a page to share is written; raises FileError where the results are gone, as do those
        below.
        """
        return self._beside.page

    def next_part(self) -> Path:
        """Where the next part that is cut out is written: no file is replaced."""
        number = 1
        while self._beside.part(number).exists():
            number += 1
        return self._beside.part(number)

    @property
    def _beside(self) -> RunFolder:
        self._check_there()
        return self.folder or RunFolder(self.path.parent)

    def _check_there(self) -> None:
        if not self.path.exists():
            raise FileError(f"{self.path}: is gone; it was there when this page was opened")

    def extract(
        self,
        scene: Scene,
        shown: SceneMesh,
        resolution: int,
        on_piece: Callable[[int, int], None] = lambda done, total: None,
    ) -> SceneMesh:
        """The mesh again in the place of `shown`, of so many cells a voxel, with all its layers;
        `on_piece` is told how many of its blocks are done.

        Raises InputError for a resolution that cannot be, FileError or MapCorrupt where a map
        cannot be read.
        """
        from ..maps.tiled_mesh import joined_mesh

        folder, settings = self._folder, self.mesh_settings
        if self._memory is not None:
            mesh = joined_mesh(self._memory, resolution, settings.min_area, on_piece=on_piece)
        else:
            mesh = self._whole_mesh(resolution, settings.min_area, on_piece)
        own = replace(scene, T_up_world=scene.T_up_world @ shown.T_scene_map)
        layers = layers_of(mesh, folder, own, self.options.compare)
        return SceneMesh(shown.name, mesh, layers).placed(shown.T_scene_map)

    def _whole_mesh(
        self, resolution: int, min_area: float, on_piece: Callable[[int, int], None]
    ) -> Mesh:
        """The mesh of maps that are in memory."""
        from ..maps.meshing import drop_small_parts, mesh_blocks
        from ..pipeline import extract_mesh

        surface, pieces = self._surface, []
        blocks = mesh_blocks(surface.grid.voxel_keys())
        for first in range(0, len(blocks), PIECE):
            part = blocks[first : first + PIECE]
            pieces.append(extract_mesh(surface, self._properties, resolution, blocks=part))
            on_piece(min(first + PIECE, len(blocks)), len(blocks))
        return drop_small_parts(welded(pieces), min_area)

    def ask(self, shown: SceneMesh, text: str) -> ShownAnswer:
        """Where on a mesh of this folder something is; raises InputError where the encoder has no
        vector for the text, or there is none.
        """
        from ..language.questions import ask

        mesh = shown.colored(shown.layers[0].name)
        there = replace(shown, mesh=mesh).in_map()
        answer = ask(self._features, there, self._encoder, [text])[0]
        found = show_answer(mesh, text, answer.relevance, answer.regions)
        return found.placed(shown.T_scene_map)

    def words_at(self, point: NDArray) -> list[tuple[str, float]]:
        """The words nearest to the features at a point (3,) [m] of the map, with their cosines, best
        first; none where the map knows nothing.
        """
        names, vectors = self._vocabulary
        similarity, known = self._features.similarity(
            np.asarray(point, np.float32)[None], vectors, return_valid=True
        )
        if not known[0]:
            return []
        best = np.argsort(-similarity[0], kind="stable")[:WORDS]
        return [(names[i], float(similarity[0, i])) for i in best]

    @property
    def _folder(self) -> RunFolder:
        self._check_there()
        if self.folder is None:
            raise InputError(f"{self.path}: is a mesh; give a results folder")
        return self.folder

    @cached_property
    def _memory(self) -> MapMemory | None:
        from ..results.tiled import open_memory

        runtime.current()
        return open_memory(self._folder.maps)

    @cached_property
    def _surface(self) -> SurfaceMap:
        from ..maps import SurfaceMap

        runtime.current()
        return SurfaceMap.load(self._folder.saved_map("surface"))

    @cached_property
    def _properties(self) -> dict[str, PropertyMap]:
        from ..maps import PropertyMap

        runtime.current()
        return {
            name: PropertyMap.load(path)
            for name, path in self._folder.maps.items()
            if read_description(path).kind == PropertyMap.kind
        }

    @cached_property
    def _features(self) -> Features:
        from ..maps.by_tiles import open_features

        runtime.current()
        features = self._folder.features
        if not features.exists():
            raise FileError(
                f"{self.path}: no {self._folder.relative(features)} here; give the results folder of "
                "`unifusion understand`"
            )
        return open_features(features)

    @cached_property
    def _encoder(self) -> TextEncoder:
        if self.make_encoder is None:
            raise InputError(f"{self.path}: there is no text encoder; give one with --text")
        return self.make_encoder(self._features.settings.source, self.path)

    @cached_property
    def _vocabulary(self) -> tuple[tuple[str, ...], NDArray[np.float32]]:
        """Words and their vectors (n, c): those of a file of embeddings, else what rooms are made
        of.
        """
        from ..language.embeddings import TextEmbeddings
        from ..language.prompts import NEGATIVES, embed

        if isinstance(self._encoder, TextEmbeddings):
            return self._encoder.names, self._encoder.vectors
        return NEGATIVES, embed(self._encoder, NEGATIVES)
