"""A textured triangle scene from a file (GLB, OBJ, PLY), as the arrays that the renderer's kernels
read.

Opaque surfaces only, drawn from both sides: alpha is ignored. Textures repeat; of a material only
its base colour is used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .. import runtime
from ..errors import CapacityError, DatasetError, MissingDependency, UniFusionError
from ..files.atomic import read_bytes
from ..files.glb_reading import parse_own_glb
from ..files.obj_materials import read_obj_materials
from ..files.srgb import linear_to_srgb
from ..types import Mesh, PinholeCamera, check_rigid
from .depth_buffer import DepthBuffer, draw_depth_buffer

NEAR_PLANE = 0.02  # [m] nothing nearer is drawn
LIGHT = (0.36, 0.24, 0.9)  # towards the light, world; not unit
BACKGROUND = (0.72, 0.80, 0.88)  # RGB in [0, 1] where a ray leaves the scene
GREY = 178  # of 255: a mesh without any colour
MAX_TEXELS = 2**31 // 3  # an array of Taichi holds at most 2^31 - 1 numbers


@dataclass(frozen=True)
class SceneImages:
    """What a camera sees: at the pixels' centres, but colour as the mean over each pixel."""

    depth: NDArray[np.float32]  # (H, W) [m], 0 where nothing is hit
    color: NDArray[np.uint8]  # (H, W, 3) RGB
    object: NDArray[np.int32]  # (H, W) row of object_names, -1 where nothing is hit
    cosine: NDArray[np.float32]  # (H, W) of the angle of incidence


@dataclass(frozen=True, eq=False)
class TexturedScene:
    """Triangles with texture coordinates, textures with their mip levels, and which object each
    triangle belongs to.
    """

    vertices: NDArray[np.float32]  # (V, 3) world [m]
    colors: NDArray[np.float32]  # (V, 3) RGB in [0, 1]: vertex colour times base colour
    faces: NDArray[np.int32]  # (F, 3)
    corners: NDArray[np.float32]  # (F, 6) texture coordinates of the corners, right and down
    face_texture: NDArray[np.int32]  # (F,) -1: none
    face_object: NDArray[np.int32]  # (F,)
    object_names: tuple[str, ...]
    textures: tuple[NDArray[np.uint8], ...]  # (h, w, 3) RGB each
    warnings: tuple[str, ...] = ()  # what of its look could not be read

    def mesh(self) -> Mesh:
        """The exact surface, hidden parts included."""
        return Mesh(self.vertices, self.faces)

    def render(self, camera: PinholeCamera, T_world_camera: NDArray) -> SceneImages:
        """Depth, colour and objects that `camera` sees from T_world_camera; PoseError if that is no
        rigid transform.
        """
        on_device = self._on_device
        from .kernels.texturing import SAMPLES, shade_textured

        finer = camera.resized(camera.width * SAMPLES, camera.height * SAMPLES)
        drawn = self._depth_buffer(finer, T_world_camera)
        color = np.empty((camera.height, camera.width, 3), np.uint8)
        light = np.array(LIGHT) / np.linalg.norm(LIGHT)
        shade_textured(
            on_device.vertices,
            on_device.colors,
            on_device.faces,
            on_device.corners,
            on_device.face_texture,
            on_device.textures,
            on_device.levels,
            on_device.texels,
            drawn.projection,
            light,
            BACKGROUND,
            drawn.nearest,
            color,
        )
        return SceneImages(color=color, **self._surfaces(camera, T_world_camera))

    def render_depth(self, camera: PinholeCamera, T_world_camera: NDArray) -> NDArray[np.float32]:
        """Depth (H, W) [m] alone, 0 where nothing is hit."""
        return self._surfaces(camera, T_world_camera)["depth"]

    def render_objects(self, camera: PinholeCamera, T_world_camera: NDArray) -> NDArray[np.int32]:
        """Object (H, W) alone, row of object_names, -1 where nothing is hit."""
        return self._surfaces(camera, T_world_camera)["object"]

    def _depth_buffer(self, camera: PinholeCamera, T_world_camera: NDArray) -> DepthBuffer:
        """Both sides of every triangle, as `camera` sees them."""
        on_device = self._on_device
        return draw_depth_buffer(
            on_device.vertices,
            on_device.faces,
            camera,
            check_rigid(T_world_camera),
            NEAR_PLANE,
            two_sided=True,
        )

    def _surfaces(self, camera: PinholeCamera, T_world_camera: NDArray) -> dict[str, NDArray]:
        """Depth, cosine and object of every pixel."""
        nearest = self._depth_buffer(camera, T_world_camera).nearest

        from .kernels.texturing import read_surfaces

        depth, cosine = (np.empty(nearest.shape, np.float32) for _ in range(2))
        objects = np.empty(nearest.shape, np.int32)
        read_surfaces(
            self._on_device.vertices,
            self._on_device.faces,
            self._on_device.face_object,
            np.asarray(T_world_camera)[:3],
            camera.intrinsics,
            nearest,
            depth,
            cosine,
            objects,
        )
        return {"depth": depth, "cosine": cosine, "object": objects}

    @cached_property
    def _on_device(self) -> SimpleNamespace:
        """The arrays that kernels take, textures with all their mip levels, moved to the device
        once.
        """
        runtime.current()  # before Taichi is imported: it says what it starts
        import taichi as ti

        def move(array: NDArray, dtype):
            kept = ti.ndarray(dtype, array.shape)
            kept.from_numpy(array)
            return kept

        levels, texels, rows = [], [], []
        offset = 0
        # kernels take no empty arrays
        for texture in self.textures or (np.zeros((1, 1, 3), np.uint8),):
            pyramid = mip_levels(texture)
            rows.append((len(levels), len(pyramid)))
            for level in pyramid:
                levels.append((offset, level.shape[1], level.shape[0]))
                texels.append(level.reshape(-1, 3))
                offset += len(texels[-1])
        if offset > MAX_TEXELS:
            raise CapacityError(
                f"the scene's textures have {offset:,} texels, more than {MAX_TEXELS:,}; make them smaller"
            )
        return SimpleNamespace(
            **{
                name: move(getattr(self, name), ti.f32)
                for name in ("vertices", "colors", "corners")
            },
            **{
                name: move(getattr(self, name), ti.i32)
                for name in ("faces", "face_texture", "face_object")
            },
            textures=move(np.array(rows, np.int32), ti.i32),
            levels=move(np.array(levels, np.int32), ti.i32),
            texels=move(np.concatenate(texels), ti.u8),
        )


def mip_levels(texture: NDArray[np.uint8]) -> list[NDArray[np.uint8]]:
    """The texture and its means at half the size, a quarter, ... down to one texel."""
    levels = [texture]
    while max(levels[-1].shape[:2]) > 1:
        height, width = (max(1, size // 2) for size in levels[-1].shape[:2])
        smaller = cv2.resize(levels[-1], (width, height), interpolation=cv2.INTER_AREA)
        levels.append(np.asarray(smaller, np.uint8))
    return levels


# Reading


def load_scene(path: str | Path) -> TexturedScene:
    """The scene in a GLB, glTF, OBJ or PLY file, one object a placed mesh; DatasetError where it
    holds no triangle.
    """
    try:
        import trimesh
    except ImportError:
        raise MissingDependency(
            f"{path}: reading a scene needs trimesh: pip install trimesh"
        ) from None
    try:
        own = parse_own_glb(read_bytes(path)) if Path(path).suffix.lower() == ".glb" else None
        if own is not None and "color" in own[0].attributes:
            return _colored(own[0])
        files = _files_of(Path(path))
        scene: Any = trimesh.load(str(path), force="scene", process=False, resolver=files)
        # sorted: the same order in every run
        placed = [(name, *scene.graph[name]) for name in sorted(scene.graph.nodes_geometry)]
        parts = [
            (name, T, scene.geometry[key])
            for name, T, key in placed
            if hasattr(scene.geometry[key], "faces")
        ]
        if own is not None:  # upright for viewers only
            parts = [(name, np.eye(4), mesh) for name, _, mesh in parts]
        return replace(_assemble(path, parts, linear=_is_gltf(path)), warnings=files.warnings)
    except UniFusionError:
        raise
    except Exception as error:  # a damaged file fails anywhere in its parser
        raise DatasetError(
            f"{path}: not a scene that can be read ({type(error).__name__}: {error})"
        ) from error


def _files_of(path: Path) -> Any:
    """What gives trimesh the files that a scene names, and keeps sentences on those that are
    missing, where trimesh would be silent.
    """
    from trimesh.resolvers import FilePathResolver

    materials = read_obj_materials(path) if path.suffix.lower() == ".obj" else None

    class Files(FilePathResolver):
        warnings: tuple[str, ...] = materials.warnings if materials else ()

        def get(self, name: str) -> bytes:
            if materials:
                return read_bytes(name) if name in materials.textures else materials.text.encode()
            try:
                return super().get(name)
            except (OSError, ValueError):
                self.warnings += (f"{path}: its file {name} is not there; what it covers is plain",)
                raise

    return Files(str(path))


def _is_gltf(path: str | Path) -> bool:
    return Path(path).suffix.lower() in (".glb", ".gltf")


def _colored(mesh: Mesh) -> TexturedScene:
    """A scene of one mesh with colours at its vertices."""
    faces = len(mesh.faces)
    return TexturedScene(
        mesh.vertices,
        mesh.attributes["color"],
        mesh.faces,
        np.zeros((faces, 6), np.float32),
        np.full(faces, -1, np.int32),
        np.zeros(faces, np.int32),
        ("map",),
        (),
    )


def _assemble(
    path: str | Path, parts: Sequence[tuple[str, NDArray, Any]], *, linear: bool
) -> TexturedScene:
    """One scene of (name, T_world_mesh, trimesh.Trimesh), whose vertex colours may be linear
    light.
    """
    parts = [part for part in parts if len(part[2].faces)]
    if not parts:
        raise DatasetError(f"{path}: there are no triangles in it")
    textures: dict[bytes, int] = {}
    images: list[NDArray[np.uint8]] = []
    arrays: dict[str, list[NDArray]] = {
        name: [] for name in ("vertices", "colors", "faces", "corners", "face_texture")
    }
    base = 0
    for _, T_world_mesh, mesh in parts:
        vertices = mesh.vertices @ T_world_mesh[:3, :3].T + T_world_mesh[:3, 3]
        if not np.isfinite(vertices).all():
            raise DatasetError(f"{path}: a vertex is not finite")
        faces = np.asarray(mesh.faces)
        look = _look_of(mesh, linear)
        texture = -1
        if look.image is not None and look.uv is not None:
            key = hashlib.sha256(look.image.tobytes()).digest() + bytes(
                str(look.image.shape), "ascii"
            )
            texture = textures.setdefault(key, len(textures))
            if texture == len(images):
                images.append(look.image)
        uv = np.zeros((len(vertices), 2)) if look.uv is None else look.uv
        arrays["vertices"].append(vertices.astype(np.float32))
        arrays["colors"].append(look.colors)
        arrays["faces"].append((faces + base).astype(np.int32))
        arrays["corners"].append(uv[faces].reshape(-1, 6).astype(np.float32))
        arrays["face_texture"].append(np.full(len(faces), texture, np.int32))
        base += len(vertices)
    owner = np.repeat(
        np.arange(len(parts), dtype=np.int32), [len(mesh.faces) for _, _, mesh in parts]
    )
    joined: dict[str, Any] = {
        name: np.ascontiguousarray(np.concatenate(list_)) for name, list_ in arrays.items()
    }
    return TexturedScene(
        **joined,
        face_object=owner,
        object_names=tuple(name for name, _, _ in parts),
        textures=tuple(images),
    )


@dataclass(frozen=True)
class _Look:
    """How a mesh looks: colour factors (V, 3) and, if it has one, a texture with coordinates that run
    right and down.
    """

    colors: NDArray[np.float32]
    image: NDArray[np.uint8] | None = None
    uv: NDArray[np.float64] | None = None


def _look_of(mesh: Any, linear: bool) -> _Look:
    visual = mesh.visual
    if visual.kind != "texture":
        if not visual.kind:
            colors = np.full((len(mesh.vertices), 3), GREY)
        else:
            colors = np.asarray(visual.vertex_colors)[:, :3]
            colors = 255 * linear_to_srgb(colors / 255) if linear else colors
        return _Look(np.ascontiguousarray(colors / 255.0, np.float32))
    material = visual.material
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    if factor is None and image is None:
        factor = getattr(material, "main_color", None)
    factor = np.full(3, 255) if factor is None else np.asarray(factor)[:3]
    colors = np.tile((factor / 255.0).astype(np.float32), (len(mesh.vertices), 1))
    # trimesh's v runs up
    uv = None if visual.uv is None else np.asarray(visual.uv, float)[:, :2] * (1, -1) + (0, 1)
    return _Look(colors, None if image is None else np.asarray(image.convert("RGB")), uv)
