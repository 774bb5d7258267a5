"""A colour field baked into a texture: queried at the place on the surface that every texel shows.

Texels between charts hold what their nearest chart would show there, so that neither interpolation
nor mip levels bring in what is not on the surface.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..files.ply import color_to_uint8
from ..files.texture import Texture
from ..geometry.triangles import areas
from ..types import Mesh
from .atlas import Atlas, unwrap
from .mesh_checks import check_mesh

TEXEL_M = 0.005
MAX_SIDE, SIDES = 4096, (16, 16_384)  # texels: the default, and what can be asked for
MIN_AREA = 1e-12  # [m^2] of a triangle; smaller ones have no normal, and are left out
REACH = 2.0  # texels beyond a chart where its plane still says what is there
CHUNK = 1 << 19  # texels queried at once
LENDERS = 200_000  # texels that lend their colour to those without one

# points (N, 3) world [m] -> RGB (N, 3) in [0, 1], and where (N,) it is known
ColorField = Callable[[NDArray], tuple[NDArray, NDArray]]


@dataclass(frozen=True)
class TexturedMesh:
    """A mesh and its texture; vertices on the seams between charts are doubled."""

    mesh: Mesh
    texture: Texture
    texel_m: float  # edge of a texel on the surface


def bake(
    mesh: Mesh, color: ColorField, *, texel_m: float = TEXEL_M, max_side: int = MAX_SIDE
) -> TexturedMesh:
    """The mesh with a texture of the colours of a field.

    A texel is `texel_m` wide on the surface, or wider where the texture would else be more than
    `max_side` texels wide or high. What the field does not know takes the colour of the nearest
    place that it knows. Raises InputError where it knows nothing of the mesh, or the mesh is empty,
    MissingDependency without xatlas.
    """
    if not texel_m > 0 or not SIDES[0] <= max_side <= SIDES[1]:
        raise InputError(
            f"texture: need a texel wider than 0 m and {SIDES[0]}..{SIDES[1]} texels a side, got "
            f"{texel_m:g} and {max_side}"
        )
    mesh = check_mesh(mesh, "texture")
    seen = areas(mesh.vertices, mesh.faces) > MIN_AREA
    atlas = unwrap(replace(mesh, faces=mesh.faces[seen]), texel_m, max_side)
    nearest, distance = nearest_faces(atlas)
    shown = np.flatnonzero(distance <= REACH)
    colors, known = np.empty((len(shown), 3), np.float32), np.empty(len(shown), bool)
    points = np.empty((len(shown), 3), np.float32)
    for start in range(0, len(shown), CHUNK):
        part = slice(start, start + CHUNK)
        points[part] = atlas.points(shown[part], nearest.ravel()[shown[part]])
        colors[part], known[part] = color(points[part])
    image = _filled(distance.shape, shown, _lend(points, colors, known))
    return TexturedMesh(atlas.mesh, Texture(atlas.coordinates, image), atlas.texel_m)


def nearest_faces(atlas: Atlas) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """The face (H, W) that covers each texel's centre or, where none does, the nearest covered one,
    and how far (H, W) that is [texels].
    """
    face = atlas.draw_faces()
    _claim_centers(atlas, face)
    covered = face >= 0
    label, distance = _nearest(covered)
    of_label = np.zeros(label.max() + 1, np.int32)
    of_label[label[covered]] = face[covered]
    return of_label[label], distance


def _claim_centers(atlas: Atlas, face: NDArray[np.int32]) -> None:
    """Give faces that cover no texel's centre the texel that they lie in, if nothing covers it."""
    x, y = np.floor(atlas.places[atlas.mesh.faces].mean(axis=1)).astype(np.int64).T
    x, y = np.clip(x, 0, atlas.width - 1), np.clip(y, 0, atlas.height - 1)
    free = np.flatnonzero(face[y, x] < 0)
    face[y[free], x[free]] = free


def _lend(points: NDArray, colors: NDArray, known: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Colours (N, 3) as bytes, those that are not known from the nearest point with one."""
    if not known.any():
        raise InputError(
            "texture: the colours know nothing of this mesh; is it that of these maps?"
        )
    if not known.all():
        from scipy.spatial import KDTree

        lenders = np.flatnonzero(known)[:: max(1, int(known.sum()) // LENDERS)]
        _, nearest = KDTree(points[lenders]).query(points[~known])
        colors[~known] = colors[lenders[nearest]]
    return color_to_uint8(colors)


def _filled(
    shape: tuple[int, ...], shown: NDArray[np.int64], colors: NDArray[np.uint8]
) -> NDArray[np.uint8]:
    """An image (H, W, 3) of texels and their colours; the others take those of the nearest."""
    image, known = np.zeros((*shape, 3), np.uint8), np.zeros(shape, bool)
    image.reshape(-1, 3)[shown] = colors
    known.reshape(-1)[shown] = True
    label, _ = _nearest(known)
    of_label = np.zeros((label.max() + 1, 3), np.uint8)
    of_label[label[known]] = image[known]
    return of_label[label]


def _nearest(chosen: NDArray[np.bool_]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
    """For every texel (H, W) the number of the nearest chosen one, which is that texel's own number
    there, and how far (H, W) it is [texels].
    """
    distance, label = cv2.distanceTransformWithLabels(
        (~chosen).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    return np.asarray(label, np.int32), np.asarray(distance, np.float32)
