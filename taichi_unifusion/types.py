"""Values that travel through the pipeline: frozen, checked once at the door.

Frames of reference: *camera* is x right, y down, z forward; `T_a_b` maps coordinates in b to
coordinates in a. Metres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import NoneType

import numpy as np
from numpy.typing import NDArray

from .errors import FrameError, InputError, PoseError, SizeMismatch, check_kind, shortened, strict
from .geometry.camera import PinholeCamera
from .geometry.checks import as_numbers, check_array, check_rigid
from .geometry.image_view import ColorView, ImageView
from .geometry.triangles import used_vertices


def largest_magnitude(values: NDArray[np.float32]) -> float:
    """The largest |value| that is finite; 0 where there is none."""
    if not values.size:
        return 0.0
    high, low = (ends.reduce(values, axis=None) for ends in (np.fmax, np.fmin))  # pass NaN over
    largest = max(float(high), -float(low))
    if np.isfinite(largest):
        return largest
    finite = values[np.isfinite(values)]
    return float(np.abs(finite).max()) if len(finite) else 0.0


@strict
@dataclass(frozen=True)
class Frame:
    """One RGB-D image with its camera and, if known, its pose."""

    depth: NDArray[np.float32]  # (H, W) [m]; 0, negative, NaN, inf: no reading
    camera: PinholeCamera  # of the depth image
    color: NDArray[np.uint8] | None = None  # (H, W, 3) RGB
    T_world_camera: NDArray[np.float64] | None = None  # (4, 4)
    index: int = 0  # place in its sequence
    timestamp: float | None = None  # [s]
    name: str = ""  # where it came from, for messages
    # property images, (H, W, c)
    images: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    features: Mapping[str, ImageView] = field(default_factory=dict)  # of any size, (h, w, c)
    # its pose lies in a world of its own: it is kept, and fused once its place in the map is known
    apart: bool = False
    # (H, W) uint8 halves of a pixel that each reading counts in the maps' sums, from 1; None: 2, whole ones
    weights: NDArray[np.uint8] | None = None
    color_view: ColorView | None = None  # whose image colour was, before it was registered to depth

    def __post_init__(self) -> None:
        at = self.label
        check_array(f"{at}: depth", self.depth, FrameError)
        if self.color is not None:
            check_array(f"{at}: color", self.color, FrameError)
        if not isinstance(self.camera, PinholeCamera):
            raise FrameError(f"{at}: camera must be a PinholeCamera, got {shortened(self.camera)}")
        if self.depth.ndim != 2 or self.depth.dtype != np.float32:
            raise FrameError(
                f"{at}: depth must be (H, W) float32 in metres, got {self.depth.shape} {self.depth.dtype}"
            )
        height, width = self.depth.shape
        if (width, height) != self.camera.size:
            raise SizeMismatch(
                f"{at}: depth is {width}x{height} but the camera is {self.camera.width}x{self.camera.height}"
            )
        if self.color is not None:
            if self.color.ndim != 3 or self.color.shape[2] != 3 or self.color.dtype != np.uint8:
                raise FrameError(
                    f"{at}: color must be (H, W, 3) uint8 RGB, got {self.color.shape} {self.color.dtype}"
                )
            self._check_size(at, "color", self.color)
        check_kind(f"{at}: images", self.images, Mapping, "; name an image by frame.with_image")
        check_kind(f"{at}: features", self.features, Mapping, "; frame.with_features adds some")
        for name, image in self.images.items():
            check_kind(f"{at}: name of an image", name, str)
            check_array(f"{at}: image '{name}'", image, FrameError)
            if image.ndim != 3 or image.dtype != np.float32:
                raise FrameError(
                    f"{at}: image '{name}' must be (H, W, c) float32, got {image.shape} {image.dtype}"
                )
            self._check_size(at, f"image '{name}'", image)
        if self.weights is not None:
            self._check_weights(at)
        if self.T_world_camera is not None:
            object.__setattr__(
                self, "T_world_camera", check_rigid(self.T_world_camera, f"{at}: T_world_camera")
            )

    def __repr__(self) -> str:
        width, height = self.camera.size
        parts = ["color" if self.color is not None else "no color", *self.images, *self.features]
        if self.T_world_camera is None:
            parts.append("no pose")
        return f"<Frame {self.index} {self.name}: {width}x{height}, {', '.join(parts)}>"

    @property
    def label(self) -> str:
        """The frame in messages."""
        return self.name or f"frame {self.index}"

    def _check_size(self, at: str, what: str, image: NDArray) -> None:
        if image.shape[:2] != self.depth.shape:
            raise SizeMismatch(
                f"{at}: {what} is {image.shape[1]}x{image.shape[0]} but depth is "
                f"{self.depth.shape[1]}x{self.depth.shape[0]}; register or resize one of them"
            )

    def _check_weights(self, at: str) -> None:
        check_array(f"{at}: weights", self.weights, FrameError)
        assert self.weights is not None
        if self.weights.ndim != 2 or self.weights.dtype != np.uint8 or self.weights.min() < 1:
            raise FrameError(
                f"{at}: weights must be (H, W) uint8 of 1 (half a pixel) and more, got {self.weights.shape} "
                f"{self.weights.dtype} from {self.weights.min()}; what does not count has depth 0"
            )
        self._check_size(at, "weights", self.weights)

    @cached_property
    def carried(self) -> frozenset[str]:
        """What a pixel carries; "NAME?" for an image in which not all values are finite."""
        color = ["color"] if self.color is not None and "color" not in self.images else []
        # one pass: a sum is finite only if all its terms are
        marks = {name: "" if np.isfinite(x.sum()) else "?" for name, x in self.images.items()}
        return frozenset(color).union(name + mark for name, mark in marks.items())

    @cached_property
    def largest(self) -> Mapping[str, float]:
        """The largest magnitude in each image of a property, of the values that are finite."""
        return {name: largest_magnitude(image) for name, image in self.images.items()}

    @property
    def attributes(self) -> frozenset[str]:
        """Names of what a pixel carries."""
        return frozenset(name.removesuffix("?") for name in self.carried)

    def require_pose(self) -> NDArray[np.float64]:
        """T_world_camera; raises PoseError where there is none."""
        if self.T_world_camera is None:
            raise PoseError(f"{self.label}: there is no pose for this frame")
        return self.T_world_camera

    def with_image(self, name: str, image: NDArray) -> Frame:
        """A copy that also carries the property image `name`, (H, W) or (H, W, c)."""
        image = as_numbers(f"{self.label}: image '{name}'", image)
        return replace(
            self, images={**self.images, name: image[..., None] if image.ndim == 2 else image}
        )

    def without_image(self, name: str) -> Frame:
        """A copy that lacks the property image `name`."""
        return replace(
            self, images={key: image for key, image in self.images.items() if key != name}
        )

    def with_features(self, name: str, values: NDArray, view: ColorView | None = None) -> Frame:
        """A copy that also carries the feature image `name`, (h, w, c) at any resolution, of its own view
        or of another one.
        """
        values = as_numbers(f"{self.label}: features '{name}'", values)
        if values.ndim != 3:
            raise FrameError(
                f"{self.label}: features '{name}' must be (h, w, c), got {values.shape}"
            )
        view = view or ColorView(self.camera, np.eye(4))
        return replace(self, features={**self.features, name: view.image(values)})


# of a squared normal: half precision and rounding in files stay below it
UNIT_TOLERANCE = 0.02


@strict
@dataclass(frozen=True)
class PointCloud:
    """Points with unit normals towards the camera and any sampled properties, all in one frame of
    reference.
    """

    points: NDArray[np.float32]  # (N, 3) [m]
    normals: NDArray[np.float32] | None = None  # (N, 3) unit, towards the camera
    # name -> (N, c); "color" is RGB in [0, 1]
    attributes: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    # the depth image that saw it, if there is one: (H, W) [m], 0: no reading; what lies between the
    # camera and a reading is free
    view: ImageView | None = None
    # (h, w, c) images that see these points; pixels that are not finite are left out
    features: Mapping[str, ImageView] = field(default_factory=dict)
    counts: NDArray[np.int32] | None = None  # (N,) pixels that each point is the mean of; None: one

    def __post_init__(self) -> None:
        for what in (self.attributes, self.features):
            check_kind(
                "point cloud: attributes and features", what, Mapping, ", as {'color': array}"
            )
        check_array("point cloud: points", self.points)
        for name, array, columns in (
            ("points", self.points, 3),
            ("normals", self.normals, 3),
            *((f"attribute '{k}'", v, None) for k, v in self.attributes.items()),
        ):
            if array is None:
                continue
            check_array(f"point cloud: {name}", array)
            if (
                array.ndim != 2
                or (columns and array.shape[1] != columns)
                or array.dtype != np.float32
            ):
                raise InputError(
                    f"point cloud: {name} must be (N, {columns or 'c'}) float32, got {array.shape} {array.dtype}"
                )
            if len(array) != len(self.points):
                raise InputError(
                    f"point cloud: {len(self.points)} points but {len(array)} rows of {name}"
                )
        # as kernels take them
        object.__setattr__(self, "points", np.ascontiguousarray(self.points))
        object.__setattr__(
            self,
            "attributes",
            {name: np.ascontiguousarray(v) for name, v in self.attributes.items()},
        )
        if self.normals is not None:
            object.__setattr__(self, "normals", np.ascontiguousarray(self.normals))
            self._check_unit_normals()
        if self.counts is not None:
            check_array("point cloud: counts", self.counts)
            if self.counts.shape != (len(self.points),) or self.counts.dtype != np.int32:
                raise InputError(
                    f"point cloud: counts must be ({len(self.points)},) int32, got "
                    f"{self.counts.shape} {self.counts.dtype}"
                )
            object.__setattr__(self, "counts", np.ascontiguousarray(self.counts))
        check_kind("point cloud: view", self.view, (ImageView, NoneType))
        if self.view is not None and (
            self.view.values.ndim != 2 or not np.isfinite(self.view.values.sum())
        ):
            raise InputError(
                "point cloud: its view must be a depth image (H, W) of finite numbers, 0 where "
                "there is no reading"
            )

    def _check_unit_normals(self) -> None:
        """Raise InputError for normals of another length than 1; those that are not finite are left
        out later.
        """
        normals = np.asarray(self.normals, np.float32)
        squares = np.einsum("ij,ij->i", normals, normals)
        off = np.abs(squares - 1)
        if (off > UNIT_TOLERANCE).any():  # False for NaN
            worst = int(np.nanargmax(off))
            if np.isfinite(squares[worst]):
                raise InputError(
                    f"point cloud: normals must have unit length, that of point {worst} has "
                    f"{np.sqrt(squares[worst]):.3g}: divide them by their length"
                )

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        normals = ["normals"] * (self.normals is not None)
        parts = [*normals, *self.attributes, *self.features]
        return f"<PointCloud: {len(self):,} points{' with ' if parts else ''}{', '.join(parts)}>"

    def take(self, rows: NDArray) -> PointCloud:
        """The points at `rows`, indices (M,) or a mask (N,), with what belongs to them."""
        return replace(
            self,
            points=self.points[rows],
            normals=None if self.normals is None else self.normals[rows],
            attributes={name: values[rows] for name, values in self.attributes.items()},
            counts=None if self.counts is None else self.counts[rows],
        )

    def transformed(self, T_b_a: NDArray) -> PointCloud:
        """This cloud, given in frame a, in frame b."""
        from . import runtime

        runtime.current()  # Taichi starts with the first kernel, not with the first type
        from .kernels.images import transform

        T_b_a = check_rigid(T_b_a, "T_b_a")
        rotation = np.hstack([T_b_a[:3, :3], np.zeros((3, 1))])

        def moved(vectors: NDArray[np.float32], T: NDArray) -> NDArray[np.float32]:
            result = np.empty_like(vectors)
            if len(vectors):
                transform(vectors, T, result)
            return result

        view = None if self.view is None else self.view.transformed(T_b_a)
        features = {name: image.transformed(T_b_a) for name, image in self.features.items()}
        return replace(
            self,
            points=moved(self.points, T_b_a[:3]),
            normals=None if self.normals is None else moved(self.normals, rotation),
            view=view,
            features=features,
        )


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh, welded and indexed."""

    vertices: NDArray[np.float32]  # (V, 3) [m]
    faces: NDArray[np.int32]  # (F, 3), counter-clockwise seen from outside (from free space)
    normals: NDArray[np.float32] | None = None  # (V, 3) unit, into free space
    # name -> (V, c); "color" is RGB in [0, 1]
    attributes: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_array("mesh: vertices", self.vertices)
        check_array("mesh: faces", self.faces)
        if self.faces.dtype.kind not in "iu":
            raise InputError(f"mesh: faces must be whole numbers, got {self.faces.dtype}")
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3:
            raise InputError(f"mesh: vertices must be (V, 3), got {self.vertices.shape}")
        if self.faces.ndim != 2 or self.faces.shape[1] != 3:
            raise InputError(f"mesh: faces must be (F, 3), got {self.faces.shape}")
        for name, array in (("normals", self.normals), *self.attributes.items()):
            if array is not None and len(array) != len(self.vertices):
                raise InputError(
                    f"mesh: {len(self.vertices)} vertices but {len(array)} rows of {name}"
                )

    def __repr__(self) -> str:
        normals = ["normals"] * (self.normals is not None)
        parts = [*normals, *self.attributes]
        size = f"{len(self.vertices):,} vertices, {len(self.faces):,} triangles"
        return f"<Mesh: {size}{' with ' if parts else ''}{', '.join(parts)}>"

    def with_attribute(self, name: str, values: NDArray) -> Mesh:
        """A copy with `values`, (V,) or (V, c), at the vertices under `name`."""
        values = as_numbers(f"mesh: attribute '{name}'", values)
        return replace(
            self,
            attributes={**self.attributes, name: values[:, None] if values.ndim == 1 else values},
        )

    def part(self, kept: NDArray[np.bool_]) -> tuple[Mesh, NDArray[np.intp]]:
        """The faces that are kept (F,) with their vertices, and which of this mesh's these are."""
        rows, faces = used_vertices(self.faces[kept])
        normals = None if self.normals is None else self.normals[rows]
        attributes = {name: values[rows] for name, values in self.attributes.items()}
        return Mesh(self.vertices[rows], faces, normals, attributes), rows

    def transformed(self, T_b_a: NDArray) -> Mesh:
        """This mesh of frame a in frame b, by a rigid transform (4, 4); without normals."""
        T_b_a = check_rigid(T_b_a, "T_b_a")
        vertices = self.vertices @ T_b_a[:3, :3].T + T_b_a[:3, 3]
        return Mesh(vertices.astype(np.float32), self.faces, None, self.attributes)

    def save(self, path) -> None:
        """Write the mesh; the suffix chooses PLY, GLB or OBJ."""
        from .files.meshes import write_mesh

        write_mesh(path, self)


@dataclass(frozen=True)
class Trajectory:
    """Camera poses in time order."""

    timestamps: NDArray[np.float64]  # (N,) [s]
    T_world_camera: NDArray[np.float64]  # (N, 4, 4)

    def __post_init__(self) -> None:
        check_array("trajectory: timestamps", self.timestamps)
        check_array("trajectory: T_world_camera", self.T_world_camera)
        n = len(self.timestamps)
        if self.timestamps.shape != (n,) or self.T_world_camera.shape != (n, 4, 4):
            raise InputError(
                f"trajectory: expected (N,) and (N, 4, 4), got {self.timestamps.shape} and "
                f"{self.T_world_camera.shape}"
            )

    @classmethod
    def of(
        cls,
        timestamps: Sequence[float | None],
        numbers: Sequence[int],
        T_world_camera: Sequence[NDArray],
    ) -> Trajectory:
        """Poses of frames; their numbers stand in for time stamps where a recording has none."""
        stamps = numbers if None in timestamps else timestamps
        return cls(np.array(stamps, np.float64), np.array(T_world_camera).reshape(-1, 4, 4))

    def __len__(self) -> int:
        return len(self.timestamps)

    def __repr__(self) -> str:
        span = f", {self.timestamps[0]:g} to {self.timestamps[-1]:g} s" if len(self) else ""
        return f"<Trajectory: {len(self)} poses{span}>"
