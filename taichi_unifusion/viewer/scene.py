"""Scene: what there is to see, as frozen values that know no back end.

Frames of reference: *scene* is what the arrays here are in; `up` is a frame whose z points away
from gravity. A mesh that stands elsewhere than in its own world says how (`T_scene_map`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.ply import color_to_uint8
from ..geometry.triangles import area_vectors, vertex_normals
from ..rendering.look import Look, color_table, colorize, shown_range
from ..types import Mesh, PinholeCamera, check_rigid

UNKNOWN = (120, 120, 125)  # RGB of a vertex that has no value
OUTLIERS = 0.5  # percent of the vertices at either end that do not count for the size of a scene
AZIMUTHS, LOOKED_AT = 24, 50_000  # sides that an overview may be from; triangles that choose it
LEAST_SHARE = 5e-4  # of the range of a layer, below which a value at a point is said to be 0
DISTANCE = 1.8  # of an overview from the middle of a scene, in half its diagonal


@dataclass(frozen=True)
class Legend:
    """What the colours of a layer mean."""

    label: str  # what the values are, with their unit in brackets
    # RGB sRGB: evenly from `low` to `high`, (256, 3); of each of `names`, (n, 3); none, (0, 3), where
    # three channels of values are red, green and blue themselves
    colors: NDArray[np.uint8]
    low: float = 0.0
    high: float = 1.0
    names: tuple[str, ...] = ()  # of classes


@dataclass(frozen=True)
class Layer:
    """One way to colour a mesh: a colour a vertex, and the values that it stands for."""

    name: str
    colors: NDArray[np.uint8]  # (V, 3) RGB sRGB
    values: NDArray[np.float32] | None = None  # (V, c), NaN where unknown; None: the colours
    legend: Legend | None = None
    shaded: bool = False  # values that are shown with the light and dark of the colours

    @property
    def lit(self) -> bool:
        """Whether light is to be added: colours of a recording hold theirs already."""
        return self.values is not None and not self.shaded

    def __post_init__(self) -> None:
        if self.colors.ndim != 2 or self.colors.shape[1] != 3 or self.colors.dtype != np.uint8:
            raise InputError(
                f"layer '{self.name}': colours must be (V, 3) uint8, got {self.colors.shape} {self.colors.dtype}"
            )
        if self.values is not None and (
            self.values.ndim != 2 or len(self.values) != len(self.colors)
        ):
            raise InputError(
                f"layer '{self.name}': values must be ({len(self.colors)}, c), got {self.values.shape}"
            )

    @classmethod
    def of_values(cls, name: str, values: NDArray, look: Look) -> Layer:
        """Values (V,) or (V, c) in the colours of `look`: by the colour map for one channel, as RGB
        for three. Raises InputError for another number of channels.
        """
        values = np.asarray(values, np.float32)
        values = values[:, None] if values.ndim == 1 else values
        channels = values.shape[1]
        if channels not in (1, 3):
            raise InputError(f"layer '{name}': {channels} channels have no colours, 1 and 3 have")
        low, high = shown_range(values, look)
        colors = color_to_uint8(colorize(values, look.colormap, low, high))
        colors[~np.isfinite(values).all(axis=1)] = UNKNOWN
        label = look.label or name
        if channels == 3:
            legend = Legend(f"{label}: red, green and blue", np.zeros((0, 3), np.uint8), low, high)
        else:
            legend = Legend(label, color_to_uint8(color_table(look.colormap)), low, high)
        return cls(name, colors, values, legend)

    @classmethod
    def of_labels(
        cls,
        name: str,
        labels: NDArray[np.integer],
        names: Sequence[str],
        colors: NDArray[np.uint8],
    ) -> Layer:
        """Classes (V,), rows of `names` and `colors` (n, 3), -1 for none. The legend holds those
        that occur, the commonest first; values are their places in it.
        """
        known = (labels >= 0) & (labels < len(names))
        shown = np.tile(np.array(UNKNOWN, np.uint8), (len(labels), 1))
        shown[known] = colors[labels[known]]
        counts = np.bincount(labels[known], minlength=len(names))
        present = [i for i in np.argsort(-counts, kind="stable") if counts[i]]
        legend = Legend(name, colors[present], names=tuple(str(names[i]) for i in present))
        rank = np.zeros(max(len(names), 1))
        rank[present] = np.arange(len(present))
        values = np.where(known, rank[np.where(known, labels, 0)], np.nan)
        return cls(name, shown, values.astype(np.float32)[:, None], legend)

    def take(self, rows: NDArray) -> Layer:
        """The layer of the vertices at `rows`, indices or a mask."""
        values = None if self.values is None else self.values[rows]
        return replace(self, colors=self.colors[rows], values=values)

    def describe(self, values: NDArray) -> str:
        """Values (c,) of this layer at a point, in words: 0.73, (0.1, 0.2, 0.3), the name of a
        class, "unknown".
        """
        values = np.asarray(values, np.float64)
        if not np.isfinite(values).all():
            return "unknown"
        if self.legend is not None and self.legend.names:
            return self.legend.names[int(values[0])]
        if self.legend is not None:  # of a range of 1, 3.2e-13 is read as 0
            least = LEAST_SHARE * (self.legend.high - self.legend.low)
            values = np.where(np.abs(values) < least, 0.0, values)
        numbers = ", ".join(map(short_number, values))
        return numbers if len(values) == 1 else f"({numbers})"


@dataclass(frozen=True)
class SceneMesh:
    """A surface with everything that can be shown on it."""

    name: str
    mesh: Mesh  # scene [m]; its attributes are not looked at
    layers: tuple[Layer, ...]  # at least one; the first is shown first
    note: str = ""  # what was done to it, for whoever looks at it
    # (4, 4) from the mesh's own world, that of its map: results may stand side by side
    T_scene_map: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        if not self.layers:
            raise InputError(f"{self.name}: a mesh in a scene needs a layer")
        for layer in self.layers:
            if len(layer.colors) != len(self.mesh.vertices):
                raise InputError(
                    f"{self.name}: {len(self.mesh.vertices)} vertices but layer '{layer.name}' has "
                    f"{len(layer.colors)}"
                )

    def layer(self, name: str) -> Layer:
        """The layer of that name, else the first one."""
        return next((layer for layer in self.layers if layer.name == name), self.layers[0])

    def with_layers(self, layers: Iterable[Layer]) -> SceneMesh:
        """A copy with further layers, in place of those of the same names."""
        named = {layer.name: layer for layer in (*self.layers, *layers)}
        return replace(self, layers=tuple(named.values()))

    def colored(self, name: str) -> Mesh:
        """The mesh with the colours of a layer as its attribute "color", RGB in [0, 1]."""
        bare = Mesh(self.mesh.vertices, self.mesh.faces, self.normals)
        return bare.with_attribute("color", self.layer(name).colors / 255)

    @property
    def normals(self) -> NDArray[np.float32]:
        """(V, 3) unit, into free space."""
        if self.mesh.normals is not None:
            return self.mesh.normals
        return vertex_normals(self.mesh.vertices, self.mesh.faces)

    def placed(self, T: NDArray) -> SceneMesh:
        """The same mesh elsewhere in the scene, moved and turned by a rigid T (4, 4)."""
        return replace(self, mesh=_turned(self.mesh, T), T_scene_map=T @ self.T_scene_map)

    def in_map(self) -> Mesh:
        """The mesh in its own world."""
        return _turned(self.mesh, np.linalg.inv(self.T_scene_map))

    def part(self, inside: NDArray[np.bool_]) -> SceneMesh:
        """The triangles of which all corners are `inside` (V,), with their vertices."""
        mesh, rows = self.mesh.part(np.all(inside[self.mesh.faces], axis=1))
        return replace(self, mesh=mesh, layers=tuple(each.take(rows) for each in self.layers))


@dataclass(frozen=True)
class SceneCamera:
    """Where a picture was taken from, and the picture."""

    name: str
    camera: PinholeCamera
    T_world_camera: NDArray[np.float64]  # (4, 4), of the scene
    image: NDArray[np.uint8] | None = None  # (h, w, 3) RGB, of any size
    frame: int | None = None  # place in its recording

    def placed(self, T: NDArray) -> SceneCamera:
        """The same camera elsewhere in the scene, moved and turned by a rigid T (4, 4)."""
        return replace(self, T_world_camera=T @ self.T_world_camera)


@dataclass(frozen=True)
class Box:
    """A box along the axes of the scene."""

    name: str
    corners: NDArray[np.float64]  # (2, 3) [m] lowest and highest
    color: tuple[int, int, int] = (255, 210, 60)

    def placed(self, T: NDArray) -> Box:
        """A box around this one, moved and turned by a rigid T (4, 4)."""
        corners = np.array(np.meshgrid(*self.corners.T)).reshape(3, -1).T @ T[:3, :3].T + T[:3, 3]
        return replace(self, corners=np.stack([corners.min(axis=0), corners.max(axis=0)]))


@dataclass(frozen=True)
class Label:
    """A text at a point."""

    text: str
    position: NDArray[np.float64]  # (3,) [m]

    def placed(self, T: NDArray) -> Label:
        """The same text elsewhere, moved and turned by a rigid T (4, 4)."""
        return replace(self, position=T[:3, :3] @ self.position + T[:3, 3])


@dataclass(frozen=True)
class Scene:
    """What there is to see."""

    name: str
    meshes: tuple[SceneMesh, ...]
    cameras: tuple[SceneCamera, ...] = ()
    boxes: tuple[Box, ...] = ()
    labels: tuple[Label, ...] = ()
    # (4, 4) to a frame whose z points up and whose floor, where one is known, is z = 0
    T_up_world: NDArray[np.float64] = field(default_factory=lambda: np.eye(4))

    def __post_init__(self) -> None:
        object.__setattr__(self, "T_up_world", check_rigid(self.T_up_world, "T_up_world"))

    def named(self, name: str) -> Scene:
        """The same scene of one mesh under another name."""
        return replace(
            self, name=name, meshes=tuple(replace(each, name=name) for each in self.meshes)
        )

    def placed(self, T: NDArray) -> Scene:
        """The same scene, moved and turned by a rigid T (4, 4)."""
        return replace(
            self,
            meshes=tuple(each.placed(T) for each in self.meshes),
            cameras=tuple(each.placed(T) for each in self.cameras),
            boxes=tuple(each.placed(T) for each in self.boxes),
            labels=tuple(each.placed(T) for each in self.labels),
            T_up_world=self.T_up_world @ np.linalg.inv(T),
        )

    @property
    def up(self) -> NDArray[np.float64]:
        """(3,) unit, away from gravity, in the scene."""
        return self.T_up_world[2, :3].copy()

    @property
    def layer_names(self) -> tuple[str, ...]:
        """The layers of all meshes, in their order, each name once."""
        return tuple(dict.fromkeys(layer.name for mesh in self.meshes for layer in mesh.layers))

    def legend(self, name: str) -> Legend | None:
        """What the colours of a layer mean, on whichever mesh has it."""
        layers = (layer for mesh in self.meshes for layer in mesh.layers)
        return next((layer.legend for layer in layers if layer.name == name), None)

    @property
    def triangles(self) -> int:
        """How many triangles there are in all meshes."""
        return sum(len(mesh.mesh.faces) for mesh in self.meshes)

    def bounds(self) -> NDArray[np.float64]:
        """(2, 3) lowest and highest corner [m] of the meshes, a few stray vertices left out; around
        the origin where there are none.
        """
        points = [mesh.mesh.vertices for mesh in self.meshes if len(mesh.mesh.vertices)]
        if not points:
            return np.array([[-1.0, -1, -1], [1, 1, 1]])
        ends = [np.percentile(each, (OUTLIERS, 100 - OUTLIERS), axis=0) for each in points]
        return np.stack(
            [np.min([low for low, _ in ends], axis=0), np.max([high for _, high in ends], axis=0)]
        ).astype(np.float64)

    def heights(self) -> tuple[float, float]:
        """The lowest and highest place [m] along `up`, measured from the floor z = 0 of T_up_world."""
        heights = [self.heights_of(mesh.mesh.vertices) for mesh in self.meshes]
        heights = [each for each in heights if len(each)]
        if not heights:
            return 0.0, 1.0
        return float(min(map(np.min, heights))), float(max(map(np.max, heights)))

    def heights_of(self, points: NDArray) -> NDArray[np.float64]:
        """Heights (N,) [m] of points (N, 3) of the scene above the floor z = 0 of T_up_world."""
        return np.asarray(points, np.float64) @ self.T_up_world[2, :3] + self.T_up_world[2, 3]

    def overview(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Where to look from, (3,) [m], and at what, to see everything from above, and from the side
        that most of the surface faces: of a corner of a room not the backs of its walls.
        """
        low, high = self.bounds()
        center, radius = (low + high) / 2, float(np.linalg.norm(high - low)) / 2
        side = np.cross(self.up, np.eye(3)[np.abs(self.up).argmin()])
        side /= np.linalg.norm(side)
        angles = np.arange(AZIMUTHS)[:, None] * (2 * np.pi / AZIMUTHS) + 0.6
        level = np.cos(angles) * side + np.sin(angles) * np.cross(self.up, side)
        ways = 0.75 * level + 0.66 * self.up
        towards = ways[0]
        for part in self.meshes[:1]:  # one decides: others stand beside it as it is seen
            faces = part.mesh.faces[:: max(1, len(part.mesh.faces) // LOOKED_AT)]
            shown = np.maximum(area_vectors(part.mesh.vertices, faces) @ ways.T, 0).sum(axis=0)
            towards = ways[int(shown.argmax())]
        return center + DISTANCE * max(radius, 0.1) * towards / np.linalg.norm(towards), center


def short_number(value: float) -> str:
    """A number as people read it: three digits, or a whole number where it has more."""
    return f"{value:,.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def _turned(mesh: Mesh, T: NDArray) -> Mesh:
    """A mesh moved and turned by a rigid T (4, 4), with its normals."""
    vertices = mesh.vertices @ T[:3, :3].T + T[:3, 3]
    normals = None if mesh.normals is None else (mesh.normals @ T[:3, :3].T).astype(np.float32)
    return replace(mesh, vertices=vertices.astype(np.float32), normals=normals)
