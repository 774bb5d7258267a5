"""Colored ICP on image pyramids: surfel images, and the 6x6 normal equations of one Gauss-Newton
step (Sec. V-A.1).

A *surfel image* holds what registration reads of every pixel side by side in memory: depth, normal,
intensity and its slopes. Association is projective: a source pixel's point, moved into the target
camera, is paired with the pixel that it falls in. Every block of source rows has sums of its own, so
that the result does not depend on the order in which threads run.
"""

import taichi as ti

from .arrays import Bytes2, Bytes3, Floats2, Floats3
from .camera import Intrinsics, Pose, lift, project
from .images import segment, segments

# of a surfel image; 8 numbers fill half a cache line
DEPTH, NORMAL, INTENSITY, SLOPE_U, SLOPE_V, CHANNELS = 0, 1, 4, 5, 6, 8
BLOCK_ROWS = 4  # used source rows that one thread sums
CHUNK = 512  # iterations that a CPU thread takes at a time

# Columns of the sums: the upper triangle of H row by row, b, then these.
H_SIZE, B_SIZE = 21, 6
SOURCE = H_SIZE + B_SIZE  # source surfels
IN_VIEW = SOURCE + 1  # those of them that are paired with a target surfel
INLIERS = SOURCE + 2  # those of them that lie near its plane and have a similar normal
SQUARED_DISTANCE = SOURCE + 3  # of the inliers [m^2]
COLORED = SOURCE + 4  # inliers whose intensity counts
PHOTOMETRIC_SCALE = SOURCE + 5  # their weighted squared residuals
SUMS = SOURCE + 6
FREEDOM = 5.0  # degrees of freedom of the residuals' t distribution (Kerl et al. 2013)
# [1/px] smallest slope of intensity that counts; flatter ones are mostly noise, which would look like
# texture on a blank wall
LEAST_SLOPE = 0.012
COMPARED = 3  # numbers of a compared pixel, see `compare_pixel`
UNSEEN = 1e9  # the first of them where there is nothing to compare with
NEAR = 0.05  # [m] points nearer to the target camera are not projected


@ti.kernel
def average_inverse_depth(
    # in:
    inverse: Floats2,  # (H, W) [1/m], 0: none
    factor: ti.template(),
    jump: ti.f32,  # readings that differ by less than this share lie on one surface
    # out:
    # (H / factor, W / factor) mean over the nearest surface of a block, 0 where it fills less than
    # half
    averaged: Floats2,
):
    height, width = averaged.shape[0], averaged.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            nearest = 0.0
            for i in ti.static(range(factor)):
                for j in ti.static(range(factor)):
                    nearest = ti.max(nearest, inverse[v * factor + i, u * factor + j])
            total, count = 0.0, 0
            for i in ti.static(range(factor)):
                for j in ti.static(range(factor)):
                    q = inverse[v * factor + i, u * factor + j]
                    if q > 0 and nearest - q <= jump * nearest:
                        total += q
                        count += 1
            averaged[v, u] = total / count if count > 0 and 2 * count >= factor * factor else 0.0


@ti.kernel
def average_color(
    # in:
    color: Bytes3,  # (H, W, 3) RGB
    factor: ti.template(),
    # out:
    intensity: Floats2,  # (H / factor, W / factor) in [0, 1], Rec. 601 luma
):
    height, width = intensity.shape[0], intensity.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            total = 0.0
            for i in ti.static(range(factor)):
                for j in ti.static(range(factor)):
                    y, x = v * factor + i, u * factor + j
                    light = 0.299 * color[y, x, 0] + 0.587 * color[y, x, 1]
                    total += light + 0.114 * color[y, x, 2]
            intensity[v, u] = total / (255.0 * factor * factor)


@ti.kernel
def average_intensity(
    # in:
    intensity: Floats2,  # (H, W)
    # out:
    averaged: Floats2,  # (H / 2, W / 2)
):
    height, width = averaged.shape[0], averaged.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            averaged[v, u] = 0.25 * (
                intensity[2 * v, 2 * u]
                + intensity[2 * v, 2 * u + 1]
                + intensity[2 * v + 1, 2 * u]
                + intensity[2 * v + 1, 2 * u + 1]
            )


@ti.func
def sobel(image: ti.template(), v: ti.i32, u: ti.i32):
    """Slopes of an image by u and v over 3x3 pixels [1/px]; zero at the border."""
    along_u, along_v = 0.0, 0.0
    if v > 0 and u > 0 and v < image.shape[0] - 1 and u < image.shape[1] - 1:
        for k in ti.static(range(-1, 2)):
            weight = ti.static(0.25 if k == 0 else 0.125)
            along_u += weight * (image[v + k, u + 1] - image[v + k, u - 1])
            along_v += weight * (image[v + 1, u + k] - image[v - 1, u + k])
    return along_u, along_v


@ti.kernel
def pack_surfels(
    # in:
    inverse: Floats2,  # (H, W) [1/m], 0: none
    normals: Floats3,  # (H, W, 3) unit, towards the camera; zero: none
    intensity: Floats2,  # (H, W)
    # out:
    surfels: Floats3,  # (H, W, CHANNELS) depth 0 where there is no reading or no normal
):
    height, width = inverse.shape[0], inverse.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            q = inverse[v, u]
            surfels[v, u, DEPTH] = 1.0 / q if q > 0 and normals[v, u, 2] != 0 else 0.0
            for d in ti.static(range(3)):
                surfels[v, u, NORMAL + d] = normals[v, u, d]
            along_u, along_v = sobel(intensity, v, u)
            surfels[v, u, INTENSITY], surfels[v, u, SLOPE_U], surfels[v, u, SLOPE_V] = (
                intensity[v, u],
                along_u,
                along_v,
            )
            surfels[v, u, CHANNELS - 1] = 0.0


@ti.func
def axial_variance(z: ti.f32) -> ti.f32:
    """Of a Kinect's depth [m^2] (Nguyen et al. 2012, Eq. 3)."""
    return (0.0012 + 0.0019 * (z - 0.4) ** 2) ** 2


@ti.func
def add_row(
    weight: ti.f32, slope: ti.template(), p: ti.template(), residual: ti.f32, total: ti.template()
):
    """Add one residual with d residual / d p = slope: its row of the Jacobian by a left
    perturbation is (slope, p x slope).
    """
    turn = p.cross(slope)
    row = ti.Vector([slope[0], slope[1], slope[2], turn[0], turn[1], turn[2]])
    for i in ti.static(range(6)):
        scaled = weight * row[i]
        for j in ti.static(range(i, 6)):
            total[ti.static(i * 6 - i * (i - 1) // 2 + j - i)] += scaled * row[j]
        total[H_SIZE + i] += scaled * residual


@ti.func
def add_intensity(
    intensity: ti.f32,
    target: ti.template(),
    i: ti.i32,
    j: ti.i32,
    x: ti.f32,
    y: ti.f32,
    p: ti.template(),
    K: ti.template(),
    sigma: ti.f32,
    weight: ti.f32,
    total: ti.template(),
):
    """Add the photometric residual of a point p that projects to (x, y), next to target pixel (i,
    j).
    """
    along_u, along_v = target[i, j, SLOPE_U], target[i, j, SLOPE_V]
    if along_u * along_u + along_v * along_v > LEAST_SLOPE * LEAST_SLOPE:
        e = target[i, j, INTENSITY] + along_u * (x - j) + along_v * (y - i) - intensity
        slope = (
            ti.Vector(
                [along_u * K[0], along_v * K[1], -(along_u * (x - K[2]) + along_v * (y - K[3]))]
            )
            / p[2]
        )
        w = (FREEDOM + 1.0) / (FREEDOM + e * e / (sigma * sigma))
        total[COLORED] += 1.0
        total[PHOTOMETRIC_SCALE] += w * e * e
        add_row(w * weight / (sigma * sigma), slope, p, e, total)


@ti.func
def add_pixel(
    source: ti.template(),
    v: ti.i32,
    u: ti.i32,
    target: ti.template(),
    K_source: ti.template(),
    K_target: ti.template(),
    R: ti.template(),
    t: ti.template(),
    limits: ti.template(),
    total: ti.template(),
):
    """Associate one source surfel by projection and add its residuals; `limits` are gate, cosine,
    width, sigma and weight as in `sum_normal_equations`.
    """
    z = source[v, u, DEPTH]
    total[SOURCE] += 1.0
    p = R @ lift(u, v, z, K_source) + t
    x, y = -1.0, -1.0
    if p[2] > NEAR:
        x, y = project(p, K_target)
    if x >= 0 and y >= 0 and x <= target.shape[1] - 1 and y <= target.shape[0] - 1:
        j, i = ti.cast(x + 0.5, ti.i32), ti.cast(y + 0.5, ti.i32)
        depth = target[i, j, DEPTH]
        if depth > 0:
            total[IN_VIEW] += 1.0
            n = ti.Vector([target[i, j, NORMAL + d] for d in range(3)])
            m = R @ ti.Vector([source[v, u, NORMAL + d] for d in range(3)])
            r = n.dot(p - lift(j, i, depth, K_target))
            if ti.abs(r) < limits[0] and n.dot(m) > limits[1]:
                total[INLIERS] += 1.0
                total[SQUARED_DISTANCE] += r * r
                w = 1.0 / (axial_variance(depth) + axial_variance(z))
                w /= 1.0 + r * r * w / (limits[2] * limits[2])
                add_row(w, n, p, r, total)
                if limits[4] > 0:
                    add_intensity(
                        source[v, u, INTENSITY],
                        target,
                        i,
                        j,
                        x,
                        y,
                        p,
                        K_target,
                        limits[3],
                        limits[4],
                        total,
                    )


@ti.kernel
def sum_normal_equations(
    # in:
    source: Floats3,  # (h, w, CHANNELS)
    target: Floats3,  # (H, W, CHANNELS)
    K_source: Intrinsics,
    K_target: Intrinsics,
    T_target_source: Pose,
    step: ti.i32,  # every step-th pixel of every step-th row of the source is used
    gate: ti.f32,  # farthest distance of an inlier from the target's plane [m]
    cosine: ti.f32,  # smallest cosine between the normals of an inlier
    width: ti.f32,  # distance that counts half [standard deviations]
    sigma: ti.f32,  # scale of intensity residuals
    # of a squared intensity residual against a squared distance, both in standard deviations; 0:
    # geometry alone
    weight: ti.f32,
    # out:
    sums: Floats2,  # (blocks, SUMS) a row for every BLOCK_ROWS used source rows
):
    R, t = T_target_source[:3, :3], T_target_source[:, 3]
    limits = ti.Vector([gate, cosine, width, sigma, weight])
    rows, columns = (source.shape[0] + step - 1) // step, (source.shape[1] + step - 1) // step
    for launch in range(sums.shape[0] * CHUNK):
        if launch % CHUNK == 0:
            block = launch // CHUNK
            total = ti.Vector([0.0] * SUMS)
            for row in range(block * BLOCK_ROWS, ti.min((block + 1) * BLOCK_ROWS, rows)):
                for column in range(columns):
                    if source[row * step, column * step, DEPTH] > 0:
                        add_pixel(
                            source,
                            row * step,
                            column * step,
                            target,
                            K_source,
                            K_target,
                            R,
                            t,
                            limits,
                            total,
                        )
            for k in range(SUMS):
                sums[block, k] = total[k]


@ti.kernel
def leave_out(
    # in:
    moving: Bytes2,  # (h, w) not 0: belongs to something that moves; of any size
    # in and out:
    surfels: Floats3,  # (H, W, CHANNELS) a depth below 0 is one that is left out
):
    height, width = surfels.shape[0], surfels.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            i, j = v * moving.shape[0] // height, u * moving.shape[1] // width
            depth = ti.abs(surfels[v, u, DEPTH])
            surfels[v, u, DEPTH] = -depth if moving[i, j] != 0 else depth


@ti.kernel
def read_surfels(
    # in:
    surfels: Floats3,  # (H, W, CHANNELS)
    step: ti.i32,  # every step-th pixel of every step-th row is read
    # out:
    read: Floats3,  # (H / step, W / step, c) the first c channels, copied
):
    height, width = read.shape[0], read.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            for k in range(read.shape[2]):
                read[v, u, k] = surfels[v * step, u * step, k]


@ti.func
def compare_pixel(
    source: ti.template(),
    v: ti.i32,
    u: ti.i32,
    target: ti.template(),
    K_source: ti.template(),
    K_target: ti.template(),
    R: ti.template(),
    t: ti.template(),
):
    """How far a source surfel lies in front of the surface that the target saw where it projects to
    [standard deviations], by how much it is darker, and the difference that a shift of a pixel makes;
    UNSEEN where the target says nothing.
    """
    found = ti.Vector([UNSEEN, 0.0, 0.0])
    z = ti.abs(source[v, u, DEPTH])
    p = R @ lift(u, v, z, K_source) + t
    x, y = -1.0, -1.0
    if z > 0 and p[2] > NEAR:
        x, y = project(p, K_target)
    if x >= 0 and y >= 0 and x <= target.shape[1] - 1 and y <= target.shape[0] - 1:
        j, i = ti.cast(x + 0.5, ti.i32), ti.cast(y + 0.5, ti.i32)
        depth = target[i, j, DEPTH]
        if depth > 0:
            n = ti.Vector([target[i, j, NORMAL + d] for d in range(3)])
            r = n.dot(p - lift(j, i, depth, K_target))
            along_u, along_v = target[i, j, SLOPE_U], target[i, j, SLOPE_V]
            there = target[i, j, INTENSITY] + along_u * (x - j) + along_v * (y - i)
            found[0] = r / ti.sqrt(axial_variance(depth) + axial_variance(z))
            found[1] = there - source[v, u, INTENSITY]
            found[2] = ti.abs(along_u) + ti.abs(along_v)
    return found


@ti.kernel
def compare_surfels(
    # in:
    source: Floats3,  # (h, w, CHANNELS) surfels that are left out are compared too
    target: Floats3,  # (H, W, CHANNELS)
    K_source: Intrinsics,
    K_target: Intrinsics,
    T_target_source: Pose,
    step: ti.i32,  # every step-th pixel of every step-th row of the source is compared
    # out:
    compared: Floats3,  # (h / step, w / step, COMPARED) as `compare_pixel` says
):
    R, t = T_target_source[:3, :3], T_target_source[:, 3]
    height, width = compared.shape[0], compared.shape[1]
    for part in range(height * segments(width)):
        v, first, end = segment(part, width)
        for u in range(first, end):
            found = compare_pixel(source, v * step, u * step, target, K_source, K_target, R, t)
            for k in ti.static(range(COMPARED)):
                compared[v, u, k] = found[k]
