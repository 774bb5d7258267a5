"""Frame -> patches on the device, or a PointCloud: readings in range, normals towards the camera
(Sec. IV-B, V-A).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from . import runtime
from .device_arrays import DeviceArray
from .errors import InputError, check_kind, check_types, strict
from .types import Frame, ImageView, PointCloud

if TYPE_CHECKING:
    from .kernels.patches import Patches, Target, Targets, Values

NO_METRES = 100.0  # nearest reading of an image that cannot be in metres
FARTHEST = 1e4  # [m] readings beyond it are dropped


@strict
@dataclass(frozen=True)
class PreprocessSettings:
    """What makes a pixel a point."""

    depth_min: float = 0.1
    """Nearest reading that is used, in metres."""
    depth_max: float = 5.0
    """Farthest reading that is used, in metres."""
    edge_jump: float = 0.03
    """Neighbouring pixels whose depths differ by more than this share of the depth lie on different
    surfaces.
    """
    normal_radius: int = 2
    """Radius in pixels of the window from which a normal is estimated."""
    max_angle: float = 80.0
    """Pixels seen at a more grazing angle than this, in degrees between ray and normal, are left
    out.
    """
    patch_size: float = 0.0125
    """Two by two pixels that lie on one surface and span at most this, in metres, become one point;
    half the finest voxel at most. 0: every pixel is a point."""

    def __post_init__(self) -> None:
        check_types(self)
        if not 0 < self.depth_min < self.depth_max:
            raise InputError(
                f"preprocess: need 0 < depth_min < depth_max, got {self.depth_min} and {self.depth_max}"
            )
        if not 0 < self.edge_jump < 1:
            raise InputError(f"preprocess: need 0 < edge_jump < 1, got {self.edge_jump}")
        if not 0 <= self.patch_size < float("inf"):
            raise InputError(
                f"preprocess: patch_size must be a number from 0, got {self.patch_size}"
            )
        if not 1 <= self.normal_radius <= 20 or not 0 < self.max_angle <= 90:
            raise InputError(
                f"preprocess: need normal_radius in 1..20 and max_angle in (0, 90], got {self.normal_radius} "
                f"and {self.max_angle}"
            )


def preprocess(frame: Frame, settings: PreprocessSettings | None = None) -> PointCloud:
    """Points, normals, colour and property images of a frame's usable pixels, in camera
    coordinates; where pixels were put together, `counts` says how many.

    A frame without a usable pixel gives an empty cloud.
    """
    if not isinstance(frame, Frame):
        raise InputError(f"preprocess: expected a Frame, got {type(frame).__name__}")
    settings = settings or PreprocessSettings()
    check_kind("preprocess", settings, PreprocessSettings)
    check_metres(frame, settings)
    runtime.current()
    views = np.empty((1, *frame.depth.shape), np.float32)
    patches = find_patches(frame, settings, invert_depth(frame, settings, views, 0), np.eye(4))
    found = patches.found.to_numpy()
    places = np.arange(len(found) * patches.slots, dtype=np.int32)
    rows = places[(np.arange(patches.slots) < found[:, None]).ravel()]
    attributes = {}
    for name, each in patches.attributes.items():
        attributes[name] = _take(each.values, rows)
        if not each.whole:  # maps leave out points whose value is not finite
            attributes[name][_take(each.counts, rows) == 0] = np.nan
    return PointCloud(
        _take(patches.points, rows),
        _take(patches.normals, rows),
        attributes,
        ImageView(views[0], frame.camera),
        frame.features,
        _take(patches.counts, rows),
    )


def check_metres(frame: Frame, settings: PreprocessSettings) -> None:
    """Raise InputError for a depth image whose readings are so large that they are no metres."""
    readings = frame.depth[np.isfinite(frame.depth) & (frame.depth > 0)]
    if len(readings) and readings.min() > max(NO_METRES, settings.depth_max):
        raise InputError(
            f"{frame.label}: depth must be in metres, but its median is {np.median(readings):g}: "
            "divide millimetres by 1000"
        )


def _take(array: DeviceArray, rows: NDArray[np.int32]) -> NDArray:
    """Rows of an array on the device, by value."""
    from .kernels.pools import gather_rows

    counts = len(array.shape) == 1
    taken = np.empty((len(rows), *array.shape[1:]), np.int32 if counts else np.float32)
    if len(rows):
        gather_rows(rows, array, taken)
    return taken


def invert_depth(
    frame: Frame, settings: PreprocessSettings, views: DeviceArray, view: int
) -> DeviceArray:
    """1/z (H, W) of a frame's readings in range, 0 elsewhere, on loan until the next frame.

    Its depth image becomes image `view` of `views` (K, H, W), with all readings: those too far for
    a point still show that the space in front of them is free.
    """
    from .kernels.patches import clip_and_invert

    inverse = _image("inverse depth", frame)
    clip_and_invert(
        np.ascontiguousarray(frame.depth),
        settings.depth_min,
        settings.depth_max,
        FARTHEST,
        view,
        views,
        inverse,
    )
    return inverse


def find_patches(
    frame: Frame,
    settings: PreprocessSettings,
    inverse: DeviceArray,
    T_world_camera: NDArray[np.float64],
    targets: Targets | None = None,
    write: bool = True,
) -> Patches:
    """A frame's usable pixels as patches in the world, on the device, with what they carry; summed
    up on the way in the cells of `targets`. Without `write` they are only summed up.
    """
    from .kernels import patches as kernels

    targets = targets or kernels.Targets()
    surface, color = targets.surface, targets.color
    found, counts, places = _column("found", frame), _column("counts", frame), _column("at", frame)
    points, normals = _rows("points", frame, 3), _rows("normals", frame, 3)
    spread = settings.patch_size * min(frame.camera.fx, frame.camera.fy) / 2  # of two pixels
    totals = np.array(
        [0, 0, surface.blocks if surface else 0, color.blocks if color else 0], np.int32
    )
    image = np.ascontiguousarray(frame.color) if color else np.zeros((1, 1, 3), np.uint8)
    none = np.zeros((1, 1), np.uint8)
    kernels.make_patches(
        inverse,
        image,
        none if frame.weights is None else np.ascontiguousarray(frame.weights),
        frame.camera.intrinsics,
        T_world_camera[:3],
        (
            settings.edge_jump,
            float(np.cos(np.radians(settings.max_angle))),
            1.0 / spread if spread > 0 else float("inf"),
        ),
        (
            targets.sign,
            targets.frame,
            surface.stamp if surface else 0,
            color.stamp if color else 0,
            *targets.first,
        ),
        kernels.Sinks(
            write,
            settings.normal_radius,
            surface.sink if surface else None,
            color.sink if color else None,
            frame.weights is not None,
        ),
        totals,
        (surface or _nothing()).keys,
        (surface or _nothing()).sums,
        (color or _nothing()).keys,
        (color or _nothing()).sums,
        kernels.PatchPack(
            found=found, points=points, normals=normals, counts=counts, places=places
        ),
    )
    names = _attributes(frame) if write else []
    attributes = {name: _averages(name, frame, found, places, counts) for name in names}
    runtime.synchronize()
    return kernels.Patches(
        kernels.slots_of_run(),
        found,
        points,
        counts,
        normals,
        attributes,
        int(totals[0]),
        int(totals[1]),
        (int(totals[2]), int(totals[3])),
        {name: image.transformed(T_world_camera) for name, image in frame.features.items()},
    )


def _nothing() -> Target:
    """Arrays in the place of a target that there is none of."""
    import taichi as ti

    from .kernels.patches import Sink, Target

    def make() -> Target:
        keys, sums = ti.ndarray(ti.i32, (1, 5)), ti.ndarray(ti.i64, (1, 1, 1))
        return Target(Sink(None, 0.0), 0, 0, keys, sums)

    return runtime.current().arena.exact("no target", make, ())


def normal_image(frame: Frame, settings: PreprocessSettings | None = None) -> NDArray[np.float32]:
    """Unit normals (H, W, 3) towards the camera, in camera coordinates, of a frame's usable pixels;
    0 elsewhere.
    """
    runtime.current()
    from .kernels.images import clip_depth, estimate_normals

    settings = settings or PreprocessSettings()
    depth = np.empty_like(frame.depth)
    clip_depth(np.ascontiguousarray(frame.depth), settings.depth_min, settings.depth_max, depth)
    normals = np.empty((*depth.shape, 3), np.float32)
    estimate_normals(
        np.divide(1.0, depth, where=depth > 0, out=np.zeros_like(depth)),
        frame.camera.intrinsics,
        settings.normal_radius,
        settings.edge_jump,
        float(np.cos(np.radians(settings.max_angle))),
        normals,
    )
    return normals


def why_empty(frame: Frame, settings: PreprocessSettings) -> str:
    """Why no pixel of a frame can be used, as a clause."""
    positive = np.isfinite(frame.depth) & (frame.depth > 0)
    readings = frame.depth[positive & (frame.depth <= FARTHEST)]
    if not len(readings):
        beyond = f" up to {FARTHEST:g} m" if positive.any() else ""
        return f"the depth image holds no reading at all{beyond}"
    if not ((readings >= settings.depth_min) & (readings <= settings.depth_max)).any():
        return (
            f"all depth readings lie outside {settings.depth_min:g}..{settings.depth_max:g} m "
            f"(median {np.median(readings):.3g} m); is the depth scale wrong? "
            "Else see preprocess.depth_min and depth_max"
        )
    return f"all {len(readings)} depth readings lie on edges, on grazing surfaces or too far apart"


def _averages(
    name: str, frame: Frame, found: DeviceArray, places: DeviceArray, counts: DeviceArray
) -> Values:
    """The mean of an image over the pixels of each patch."""
    from .kernels import patches as kernels

    if name not in frame.images:
        values = _rows(name, frame, 3)
        kernels.average_color(found, places, np.ascontiguousarray(frame.color), values)
        return kernels.Values(values, counts)
    image = np.ascontiguousarray(frame.images[name])
    values, known = _rows(name, frame, image.shape[2]), _column(f"{name} known", frame)
    kernels.average_image(found, places, counts, image, values, known)
    whole = name in frame.carried
    return kernels.Values(values, counts if whole else known, whole)


def _attributes(frame: Frame) -> list[str]:
    """What the patches of a frame carry."""
    color = ["color"] if frame.color is not None and "color" not in frame.images else []
    return [*color, *frame.images]


def _image(use: str, frame: Frame) -> DeviceArray:
    import taichi as ti

    shape = frame.depth.shape
    return runtime.current().arena.exact(use, lambda: ti.ndarray(ti.f32, shape), shape)


def _rows(use: str, frame: Frame, columns: int) -> DeviceArray:
    """A row for every place of a patch."""
    import taichi as ti

    from .kernels.patches import runs_of, slots_of_run

    shape = (runs_of(*frame.depth.shape) * slots_of_run(), columns)
    return runtime.current().arena.exact(
        f"patches: {use}", lambda: ti.ndarray(ti.f32, shape), shape
    )


def _column(use: str, frame: Frame) -> DeviceArray:
    """A whole number for every place of a patch; of `found`, for every run."""
    import taichi as ti

    from .kernels.patches import runs_of, slots_of_run

    runs = runs_of(*frame.depth.shape)
    shape = (runs if use == "found" else runs * slots_of_run(),)
    return runtime.current().arena.exact(
        f"patches: {use}", lambda: ti.ndarray(ti.i32, shape), shape
    )
