"""A coloured mesh as a picture from one viewpoint: soft light and ambient occlusion, in software."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..geometry.triangles import vertex_normals
from ..types import Mesh, PinholeCamera
from .depth_buffer import DepthBuffer, draw_depth_buffer

BACKGROUND = (0.965, 0.97, 0.975)
GREY = 0.78  # of a mesh without colour
# how much light changes the colours, 0..1, of a mesh with (True) and without its own
SHADING = {True: 0.22, False: 0.6}
# direction to the light, camera frame: above, a little left, behind the camera
LIGHT = (-0.35, -0.75, -0.55)
OCCLUSION_RADIUS = 0.25  # [m] of ambient occlusion
OCCLUSION_TAPS = 6  # depths looked at for the samples of a pixel that see one surface
LOOKED_AT = 960  # samples of a row that are enough to find it: they stay within the cache
SAMPLES = 2  # per pixel and axis


@dataclass(frozen=True)
class Viewpoint:
    """A camera that looks at a mesh; nothing nearer than `near` [m] is drawn."""

    camera: PinholeCamera
    T_world_camera: NDArray[np.float64]  # (4, 4)
    near: float = 0.05


@dataclass(frozen=True)
class Drawable:
    """A mesh that kernels can take as it is: finite, indices checked, with normals and colours."""

    vertices: NDArray[np.float32]  # (V, 3) world [m]
    faces: NDArray[np.int32]  # (F, 3)
    normals: NDArray[np.float32]  # (V, 3) unit
    colors: NDArray[np.float32]  # (V, 3) RGB in [0, 1]
    shading: float  # how much light changes the colours, 0..1

    @classmethod
    def of(cls, mesh: Mesh) -> Drawable:
        """The finite triangles of a mesh; raises InputError where there are none, or its arrays do
        not fit each other.
        """
        vertices = np.ascontiguousarray(mesh.vertices, np.float32)
        faces = np.ascontiguousarray(mesh.faces, np.int32)
        if len(faces) and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise InputError(
                f"preview: the faces name vertices {faces.min()}..{faces.max()}, but the mesh has {len(vertices)}"
            )
        bad = ~np.isfinite(vertices)
        if bad.any():
            faces = np.ascontiguousarray(faces[~bad[faces].any(axis=(1, 2))])
            vertices = np.where(bad.any(axis=1, keepdims=True), np.float32(0), vertices)
        if not len(faces):
            raise InputError("preview: the mesh is empty, there is nothing to draw")
        normals = (
            vertex_normals(vertices, faces) if mesh.normals is None else np.nan_to_num(mesh.normals)
        )
        color = mesh.attributes.get("color")
        if color is not None and color.shape[1:] != (3,):
            raise InputError(
                f"preview: attribute 'color' must be (V, 3) RGB in [0, 1], got {color.shape}"
            )
        colors = (
            np.full_like(vertices, GREY)
            if color is None
            else np.clip(np.nan_to_num(color, nan=0.0), 0, 1)
        )
        return cls(
            vertices,
            faces,
            np.ascontiguousarray(normals, np.float32),
            np.ascontiguousarray(colors, np.float32),
            SHADING[color is not None],
        )

    def draw(
        self,
        view: Viewpoint,
        samples: int = SAMPLES,
        *,
        occluded: bool = True,
        background: tuple[float, float, float] = BACKGROUND,
    ) -> NDArray[np.uint8]:
        """Picture (H, W, 3) RGB of the sides that face the camera, the mean of samples^2 a pixel;
        corners are darker where light is `occluded`.
        """
        camera = view.camera.resized(view.camera.width * samples, view.camera.height * samples)
        drawn = self.depth_buffer(replace(view, camera=camera))
        from .kernels.raster import shade_pixels, thin_out

        image = np.empty((view.camera.height, view.camera.width, 3), np.uint8)
        thinned = max(1, camera.width // LOOKED_AT)
        depth = np.empty((-(-camera.height // thinned), -(-camera.width // thinned)), np.float32)
        thin_out(drawn.nearest, thinned, depth)
        light = np.array(LIGHT) / np.linalg.norm(LIGHT)
        shade_pixels(
            self.vertices,
            self.normals,
            self.colors,
            self.faces,
            drawn.projection,
            np.linalg.inv(view.T_world_camera)[:3],
            camera.intrinsics,
            drawn.nearest,
            depth,
            (*light, self.shading),
            OCCLUSION_RADIUS,
            (OCCLUSION_TAPS if occluded else 0, thinned),
            background,
            image,
        )
        return image

    def depth_buffer(self, view: Viewpoint) -> DepthBuffer:
        """What the camera sees of the sides that face it."""
        return draw_depth_buffer(
            self.vertices, self.faces, view.camera, view.T_world_camera, view.near, two_sided=False
        )


def render_mesh(mesh: Mesh, view: Viewpoint) -> NDArray[np.uint8]:
    """Picture (H, W, 3) RGB of the sides of `mesh` that face the camera; InputError for a mesh
    without a finite triangle.
    """
    return Drawable.of(mesh).draw(view)
