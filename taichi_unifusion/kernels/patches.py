"""The front end: depth image -> patches, up to 2 x 2 pixels on one surface each, with a normal
(Sec. IV-B, V-A).

Patches lie in *runs*: one task writes the patches of a few quads side by side, and one task reads
them, so that neighbours in the image, which mostly share a voxel, stay together.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import taichi as ti

from ..device_arrays import DeviceArray
from .arrays import Bytes2, Bytes3, Floats2, Floats3, Ints1, Ints2, Sums3
from .camera import Intrinsics, Pose, lift, move, ray, rotate
from .images import inverse_depth_slope, segment, segments
from .index import Index
from .patch_cells import (
    QUAD,
    add_colors,
    add_surfels,
    ask_ahead,
    find_cells,
    patch_color,
    whole_pixels,
)
from .tasks import small_stride

IS_NUMBER = 0x7F800000  # bits of a float, without its sign, below this


# Most change of depth on one surface, as a share of it; least cosine between a normal and the ray
# back to the camera; inverse depth [1/m] from which on the pixels of a quad are put together.
Rules = ti.types.vector(3, ti.f32)
# 1, or -1 to take back what a frame added; the frame's number in its window; stamps of the window, and
# blocks from which on is added, each of the surface and of the colours.
Now = ti.types.vector(6, ti.i32)
PatchPack = ti.types.argpack(
    found=Ints1,  # (R,) patches in each run
    points=Floats2,  # (R slots, 3) world [m], mean of the pixels
    normals=Floats2,  # (R slots, 3) unit, towards the camera
    counts=Ints1,  # (R slots,) pixels, by their weights
    places=Ints1,  # (R slots,) 16 times the quad's number, row by row, plus a bit for each pixel
)


@dataclass(frozen=True)
class Sink:
    """A map whose cells patches are summed in."""

    index: Index | None  # None in the place of one that there is not
    per_meter: float  # 1 / voxel size


@dataclass(frozen=True)
class Sinks:
    """How patches are made and where they go, as one compile-time argument."""

    write: bool  # to arrays, for whoever else wants them
    radius: int  # of the window of a normal [pixels]
    surface: Sink | None = None
    color: Sink | None = None
    weighted: bool = False  # pixels count by their weights

    @property
    def has_surface(self) -> bool:
        return self.surface is not None

    @property
    def has_color(self) -> bool:
        return self.color is not None


@dataclass(frozen=True, eq=False)
class Target:
    """The cells of one map, open for the patches of a frame."""

    sink: Sink
    stamp: int
    blocks: int  # that there are
    keys: DeviceArray  # (B, 5)
    sums: DeviceArray  # (B, 64, 1 + c)


@dataclass(frozen=True, eq=False)
class Targets:
    """Where the patches of one frame are summed up while they are made."""

    frame: int = 0  # its number in the window
    surface: Target | None = None
    color: Target | None = None
    first: tuple[int, int] = (0, 0)  # blocks from which on is added
    sign: int = 1  # -1 takes back what was added


@dataclass(frozen=True, eq=False)
class Values:
    """What patches carry beside their points."""

    values: DeviceArray  # (R slots or more, c)
    counts: DeviceArray  # (R slots or more,) pixels that have one
    whole: bool = True  # whether all pixels do


@dataclass(frozen=True, eq=False)
class Patches:
    """Points in the world on the device, in R runs of `slots` places; each stands for `counts`
    pixels. Arrays may be longer, and are on loan until the next frame's patches.
    """

    slots: int
    found: DeviceArray  # (R,) places that are filled, the first of each run
    points: DeviceArray  # (R slots or more, 3) world [m]
    counts: DeviceArray  # (R slots or more,) pixels
    normals: DeviceArray | None  # (R slots or more, 3) unit, towards the camera
    attributes: Mapping[str, Values]
    total: int  # patches
    pixels: int  # of all of them
    blocks: tuple[int, int]  # of surface and colour that there are now, where they were targets
    # images (h, w, c) of features that see them: `ImageView`s in the world
    features: Mapping[str, Any] = field(default_factory=dict)


def quads_of_run() -> int:
    """Quads of a row that one task takes: few enough on the CPU to share a frame out evenly."""
    return 40 if ti.lang.impl.current_cfg().arch in (ti.x64, ti.arm64) else 1


def slots_of_run() -> int:
    """Places of a run: every pixel of its quads may be a patch."""
    return quads_of_run() * QUAD


def runs_of(height: int, width: int) -> int:
    """How many runs an image has."""
    return (height + 1) // 2 * (-(-((width + 1) // 2) // quads_of_run()))


@ti.kernel
def clip_and_invert(
    # in:
    depth: Floats2,  # (H, W) [m], with any values
    depth_min: ti.f32,
    depth_max: ti.f32,  # farther readings give no point...
    farthest: ti.f32,  # ...but up to here show that the space before them is free
    view: ti.i32,
    # out:
    clipped: Floats3,  # (K, H, W) [m]; image `view`: readings, 0 where there is none
    inverse: Floats2,  # (H, W) [1/m], 0 where there is no reading in range
):
    least, most = ti.bit_cast(depth_min, ti.i32), ti.bit_cast(farthest, ti.i32)
    height, width = depth.shape[0], depth.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            z = depth[v, u]
            # ordered as positive floats are; NaN and inf lie above, negatives below
            bits = ti.bit_cast(z, ti.i32)
            known = bits >= least and bits <= most
            clipped[view, v, u] = z if known else 0.0
            inverse[v, u] = 1.0 / z if known and z <= depth_max else 0.0


@ti.kernel
def make_patches(
    # in:
    inverse: Floats2,  # (H, W) 1/z [1/m], 0: none
    color: Bytes3,  # (H, W, 3); any image where no map takes colour
    weights: Bytes2,  # (H, W) halves of a pixel that each counts, 1 and more; any image unless `weighted`
    K: Intrinsics,
    T_world_camera: Pose,
    rules: Rules,
    now: Now,
    # in and out:
    sinks: ti.template(),  # new voxels get a block in their indices
    totals: Ints1,  # (4,) += [patches, pixels, blocks of the surface, blocks of the colours]
    keys_s: Ints2,  # (B, 5) of the surface: voxels of new blocks, and bits for the frame
    sums_s: Sums3,  # (B, 64, 7) += counts, normals, positions, as `bin_points` adds them
    keys_c: Ints2,  # (B, 5) of the colours
    sums_c: Sums3,  # (B, 64, 4) += counts, colours
    # out:
    patches: PatchPack,
):
    height, width = inverse.shape[0], inverse.shape[1]
    quads, slots = ti.static(quads_of_run(), slots_of_run())
    across = (width + 1) // 2
    runs = (across + quads - 1) // quads
    jump, cos_max_angle, least = rules[0], rules[1], rules[2]
    stride = ti.static(small_stride())
    for i in range((height + 1) // 2 * runs * stride):
        if i % stride == 0:
            part = i // stride
            row, start = part // runs, part % runs * quads
            n, pixels = 0, 0
            # the patches of the run
            middles, facing = ti.Vector([0.0] * (3 * slots)), ti.Vector([0.0] * (3 * slots))
            sizes, marks = ti.Vector([0] * slots), ti.Vector([0] * slots)
            for column in range(start, ti.min(start + quads, across)):
                # slopes of a surface, and its inverse depth
                slope_u, slope_v, of, known = 0.0, 0.0, 0.0, False
                count, mask = 0, 0
                normal, x = ti.Vector([0.0, 0.0, 0.0]), ti.Vector([0.0, 0.0, 0.0])
                for p in range(QUAD + 1):  # the last round is for what is left
                    v, u = row * 2 + p // 2, column * 2 + p % 2
                    q = 0.0
                    if p < QUAD:
                        if v < height:
                            if u < width:
                                q = inverse[v, u]
                    other = ti.abs(q - of) > 0.5 * jump * q
                    if count > 0:
                        if p == QUAD or (q > 0 and (other or q < least)):
                            x = move(T_world_camera, x / ti.cast(count, ti.f32))
                            if ti.static(sinks.weighted):
                                count = whole_pixels(count, row + column, mask)
                            if count > 0:
                                for d in ti.static(range(3)):
                                    middles[3 * n + d], facing[3 * n + d] = x[d], normal[d]
                                sizes[n] = count
                                marks[n] = (row * across + column) * 16 + mask
                                n += 1
                                pixels += count
                            count, mask = 0, 0
                            x.fill(0.0)
                    if q > 0:
                        if other or not known:
                            of = q
                            slope_u, slope_v, known = inverse_depth_slope(
                                inverse, v, u, ti.static(sinks.radius), jump
                            )
                        good = count > 0
                        if not good:
                            if known:
                                along_z = q - slope_u * (u - K[2]) - slope_v * (v - K[3])
                                m = ti.Vector([slope_u * K[0], slope_v * K[1], along_z]) / q
                                # m . ray = 1
                                good = cos_max_angle * m.norm() * ray(u, v, K).norm() <= 1.0
                                normal = -rotate(T_world_camera, m).normalized()
                        if good:
                            mask |= 1 << p
                            if ti.static(sinks.weighted):
                                halves = ti.cast(weights[v, u], ti.i32)
                                count += halves
                                x += lift(u, v, 1.0 / q, K) * ti.cast(halves, ti.f32)
                            else:
                                count += 1
                                x += lift(u, v, 1.0 / q, K)
            if ti.static(sinks.has_surface):
                blocks, cells = ti.Vector([0] * slots), ti.Vector([0] * slots)
                find_cells(
                    2,
                    sinks.surface.per_meter,
                    n,
                    middles,
                    now,
                    sinks.surface.index,
                    totals,
                    keys_s,
                    sums_s,
                    blocks,
                    cells,
                )
                ask_ahead(n, sums_s, blocks, cells)
                add_surfels(
                    sinks.surface.per_meter, n, middles, facing, sizes, now, blocks, cells, sums_s
                )
            if ti.static(sinks.has_color):
                blocks_c, cells_c = ti.Vector([0] * slots), ti.Vector([0] * slots)
                find_cells(
                    3,
                    sinks.color.per_meter,
                    n,
                    middles,
                    now,
                    sinks.color.index,
                    totals,
                    keys_c,
                    sums_c,
                    blocks_c,
                    cells_c,
                )
                ask_ahead(n, sums_c, blocks_c, cells_c)
                add_colors(n, color, across, marks, sizes, now, blocks_c, cells_c, sums_c)
            if ti.static(sinks.write):
                patches.found[part] = n
                for m in range(n):
                    at = part * slots + m
                    for d in ti.static(range(3)):
                        patches.points[at, d] = middles[3 * m + d]
                        patches.normals[at, d] = facing[3 * m + d]
                    patches.counts[at], patches.places[at] = sizes[m], marks[m]
            ti.atomic_add(totals[0], n)
            ti.atomic_add(totals[1], pixels)


@ti.kernel
def average_color(
    # in:
    found: Ints1,  # (R,)
    places: Ints1,  # (R slots,)
    color: Bytes3,  # (H, W, 3)
    # out:
    values: Floats2,  # (R slots, 3) in [0, 1], mean of a patch's pixels
):
    across = (color.shape[1] + 1) // 2
    for part in range(found.shape[0]):
        first = part * ti.static(slots_of_run())
        for n in range(first, first + found[part]):
            row, column = (places[n] >> 4) // across * 2, (places[n] >> 4) % across * 2
            mean = patch_color(color, row, column, places[n] & 15)
            for c in ti.static(range(3)):
                values[n, c] = mean[c]


@ti.kernel
def average_image(
    # in:
    found: Ints1,  # (R,)
    places: Ints1,  # (R slots,)
    sizes: Ints1,  # (R slots,) pixels of each patch, by their weights
    image: Floats3,  # (H, W, c)
    # out:
    values: Floats2,  # (R slots, c) mean of those pixels of a patch whose values are all numbers
    counts: Ints1,  # (R slots,) their share of its pixels
):
    across = (image.shape[1] + 1) // 2
    for part in range(found.shape[0]):
        first = part * ti.static(slots_of_run())
        for n in range(first, first + found[part]):
            row, column = (places[n] >> 4) // across * 2, (places[n] >> 4) % across * 2
            count, pixels = 0, 0
            for c in range(image.shape[2]):
                values[n, c] = 0.0
            for p in range(QUAD):
                if (places[n] >> p) & 1 != 0:
                    pixels += 1
                    v, u = row + p // 2, column + p % 2
                    finite = True
                    for c in range(image.shape[2]):
                        bits = ti.bit_cast(image[v, u, c], ti.i32) & 0x7FFFFFFF
                        finite = finite and bits < IS_NUMBER
                    if finite:
                        count += 1
                        for c in range(image.shape[2]):
                            values[n, c] = values[n, c] + image[v, u, c]
            counts[n] = sizes[n] * count // pixels
            for c in range(image.shape[2]):
                values[n, c] = values[n, c] / ti.max(ti.cast(count, ti.f32), 1.0)
