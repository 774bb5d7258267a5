"""Results folder, or mesh file -> Scene: the mesh with every layer that its files hold, and the
cameras.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, UniFusionError
from ..files.atomic import read_bytes
from ..files.json_text import parse_json
from ..files.mesh_reading import read_any_mesh, read_mesh
from ..files.ply import color_to_uint8
from ..files.tiles import TileFolder
from ..files.trajectories import read_trajectory
from ..geometry.triangles import SurfaceDistance
from ..maps.stored import read_description, read_stored, read_tile
from ..maps.tile_places import key_codes, rows_by_tile, tile_of
from ..maps.voxel_data import VoxelData
from ..rendering.look import MOST, Look
from ..rendering.mesh_checks import check_mesh
from ..results.outlook import find_mesh_up, read_up
from ..results.property_files import recorded_looks
from ..results.reader import Run, read_run
from ..results.run_folder import RunFolder, why_no_mesh
from ..results.safe_point import mesh_of_safe_point
from ..types import Mesh, PinholeCamera
from .answers import relevance_layer
from .scene import Layer, Scene, SceneCamera, SceneMesh

logger = logging.getLogger(__name__)

SHORTEST = 0.001  # [m] that the colours of distances reach at least
CELLS = 4  # of a voxel along an edge, in which evidence is counted
COLOR, NORMALS, HEIGHT = "color", "normals", "height"
GREY = 200  # of a mesh that has no colours
# where the recording cannot be asked: a camera of 60 degrees, to draw its outline
SOME_CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)


@dataclass(frozen=True)
class SceneOptions:
    """What to put into a scene beside what a results folder holds."""

    compare: Path | None = None  # a mesh in the same world, to which distances are shown
    cameras: int = 60  # at most so many, evenly over the trajectory
    image_width: int = 320  # [pixels] of what those cameras saw, at most


def open_scene(path: str | Path, options: SceneOptions | None = None) -> Scene:
    """The scene of a results folder, or of a mesh file; raises FileError where there is no mesh, or
    InputError where it is empty. What else is missing or damaged is left out, with a warning.
    """
    path, options = Path(path), options or SceneOptions()
    if not path.exists():
        raise FileError(f"{path}: no such file or folder")
    folder = RunFolder(path) if path.is_dir() else None
    source = path if folder is None else folder.mesh
    if folder is None or folder.mesh.exists():
        mesh = read_any_mesh(source)
    elif (unfinished := mesh_of_safe_point(folder)) is not None:
        mesh = unfinished
    else:
        raise FileError(why_no_mesh(folder))
    mesh = check_mesh(mesh, str(source))
    bare = Scene(path.name or str(path), (), T_up_world=up_of(folder, mesh))
    layers = layers_of(mesh, folder, bare, options.compare)
    cameras = () if folder is None else _cameras(folder, options)
    return replace(bare, meshes=(SceneMesh(bare.name, mesh, layers),), cameras=cameras)


def layers_of(
    mesh: Mesh, folder: RunFolder | None, scene: Scene, compare: Path | None = None
) -> tuple[Layer, ...]:
    """Every layer that a mesh carries, that its shape gives in the upright frame of `scene`, that the
    files of a results folder hold, and its distances to the mesh `compare`.
    """
    layers = [*_own_layers(mesh, {} if folder is None else recorded_looks(folder))]
    layers += _shape_layers(mesh, scene)
    if folder is not None:
        layers += _map_layers(mesh, folder)
        layers += _answer_layers(mesh, folder)
    if compare is not None:
        layers.append(distance_layer(mesh, compare))
    return tuple(layers)


def up_of(folder: RunFolder | None, mesh: Mesh) -> NDArray[np.float64]:
    """T_up_world (4, 4) of a results folder, or of a mesh alone."""
    try:
        up = find_mesh_up(mesh, None) if folder is None else read_up(folder, mesh)
    except FileError as error:  # of its trajectory
        logger.warning("%s", error)
        up = find_mesh_up(mesh, None)
    return up.T_up_world


def _own_layers(mesh: Mesh, looks: Mapping[str, Look]) -> Iterator[Layer]:
    """Colour, and every property that the mesh carries."""
    color = mesh.attributes.get(COLOR)
    if color is not None and color.shape[1] == 3:
        yield Layer(COLOR, color_to_uint8(color))
    else:
        yield Layer(COLOR, np.full((len(mesh.vertices), 3), GREY, np.uint8))
    for name, values in mesh.attributes.items():
        if name != COLOR and values.shape[1] in (1, 3):
            yield Layer.of_values(name, values, looks.get(name, Look(range=None)))


def _shape_layers(mesh: Mesh, scene: Scene) -> list[Layer]:
    """Normals and heights, seen in the upright frame of the scene."""
    normals = SceneMesh("", mesh, (_blank(mesh),)).normals @ scene.T_up_world[:3, :3].T
    look = Look(range=(-1.0, 1.0), label="normal in x, y and up")
    heights = scene.heights_of(mesh.vertices)
    return [
        Layer.of_values(NORMALS, normals, look),
        Layer.of_values(HEIGHT, heights, Look("viridis", None, "height [m]")),
    ]


def _blank(mesh: Mesh) -> Layer:
    return Layer("", np.zeros((len(mesh.vertices), 3), np.uint8))


def _map_layers(mesh: Mesh, folder: RunFolder) -> list[Layer]:
    """Weight and evidence of the surface map at the vertices, from the voxel and the cell that a
    vertex lies in.
    """
    file = folder.maps.get("surface")
    if file is None:
        return []
    try:
        size = read_description(file).settings.voxel_size
        weight, votes = np.full((2, len(mesh.vertices)), np.nan, np.float32)
        for rows, data in _voxels_at(file, np.floor(mesh.vertices / size).astype(np.int32)):
            row = _rows_of(data.keys, np.floor(mesh.vertices[rows] / size).astype(np.int64))
            weight[rows] = _known(data.weights, row)
            if data.evidence is not None:
                votes[rows] = _votes(data.evidence, mesh.vertices[rows] / size, row)
    except UniFusionError as error:
        logger.warning("%s: no weights to show (%s)", file, error)
        return []
    layers = [Layer.of_values("weight", weight, Look("magma", None, "weight of the voxel"))]
    if not np.isnan(votes).all():
        look = Look("diverging", None, "evidence: views that saw it less those that saw through it")
        layers.append(Layer.of_values("evidence", votes, look))
    return layers


def _voxels_at(file: Path, keys: NDArray[np.int32]) -> Iterator[tuple[NDArray[np.intp], VoxelData]]:
    """Rows among voxels (N, 3), and what a saved map holds around them: all of it, or of one in tiles
    one tile after the other.
    """
    if not TileFolder.is_one(file):
        yield np.arange(len(keys)), read_stored(file)[1]
        return
    folder = TileFolder.open(file)
    for code, rows in rows_by_tile(key_codes(keys)):
        if tile_of(code) in folder.tiles:
            yield rows, read_tile(folder, tile_of(code))


def _votes(evidence: NDArray, places: NDArray, row: NDArray) -> NDArray[np.float32]:
    """The votes (N,) of the cells that places (N, 3) in voxels lie in, NaN where there is no row."""
    cells = np.floor(places * CELLS).astype(np.int64) % CELLS
    cell = (cells[:, 0] * CELLS + cells[:, 1]) * CELLS + cells[:, 2]
    votes = evidence[np.maximum(row, 0), cell].astype(np.float32)
    votes[row < 0] = np.nan
    return votes


def _rows_of(keys: NDArray, wanted: NDArray) -> NDArray[np.int64]:
    """Rows of `keys` (N, 3) that equal the `wanted` (M, 3), -1 where there is none."""
    low = np.minimum(keys.min(axis=0), wanted.min(axis=0))
    span = np.maximum(keys.max(axis=0), wanted.max(axis=0)) - low + 1
    order = np.array([span[1] * span[2], span[2], 1], np.int64)
    codes, asked = (keys - low) @ order, (wanted - low) @ order
    sorting = np.argsort(codes, kind="stable")
    place = np.minimum(np.searchsorted(codes, asked, sorter=sorting), len(codes) - 1)
    row = sorting[place]
    return np.where(codes[row] == asked, row, -1)


def _known(values: NDArray, row: NDArray) -> NDArray[np.float32]:
    return np.where(row >= 0, values[np.maximum(row, 0)], np.nan).astype(np.float32)


def _answer_layers(mesh: Mesh, folder: RunFolder) -> list[Layer]:
    """Answers and segmentation that lie in the folder, where they are of this very mesh."""
    layers: list[Layer] = []
    for entry in _read_json(folder.answers) or []:
        try:
            text, answer = (
                str(entry["text"]),
                _same_mesh(mesh, folder.path / Path(entry["mesh"]).name),
            )
        except (TypeError, KeyError):
            continue
        if answer is not None and "relevance" in answer.attributes:
            layers.append(relevance_layer(mesh, text, answer.attributes["relevance"][:, 0]))
    listed = _read_json(folder.segmentation) or {}
    segmented = _same_mesh(mesh, folder.segmentation_mesh) if listed else None
    if segmented is not None and "label" in segmented.attributes:
        classes = {int(each["label"]): each for each in listed.get("labels", ())}
        numbers = np.array(sorted(classes))
        label = segmented.attributes["label"][:, 0].astype(int)
        rows = np.searchsorted(numbers, label).clip(0, len(numbers) - 1)
        rows = np.where(numbers[rows] == label, rows, -1)
        names = [classes[number]["name"] for number in numbers]
        colors = np.array([classes[number]["color"] for number in numbers], np.uint8)
        layers.append(Layer.of_labels("segmentation", rows, names, colors))
    return layers


def _read_json(file: Path):
    """The JSON values of a file, None where it is missing or damaged."""
    if not file.exists():
        return None
    try:
        return parse_json(read_bytes(file))
    except (FileError, ValueError) as error:
        logger.warning("%s: cannot be read (%s)", file, error)
        return None


def _same_mesh(mesh: Mesh, file: Path) -> Mesh | None:
    """The mesh in a file, if its vertices are those of `mesh`."""
    if not file.exists():
        return None
    try:
        other = read_mesh(file)
    except UniFusionError as error:
        logger.warning("%s", error)
        return None
    if not np.array_equal(other.vertices, mesh.vertices):
        logger.warning("%s: is of another mesh than the folder's now; ask again to see it", file)
        return None
    return other


def distance_layer(mesh: Mesh, other: Path) -> Layer:
    """Distance [m] of every vertex to the surface of another mesh, which is in the same world."""
    truth = check_mesh(read_any_mesh(other), str(other))
    distances = SurfaceDistance(truth.vertices, truth.faces)(mesh.vertices)
    finite = distances[np.isfinite(distances)]
    most = float(np.percentile(finite, MOST[1])) if len(finite) else 0.0
    look = Look("inferno", (0.0, max(most, SHORTEST)), f"distance to {other.name} [m]")
    return Layer.of_values(f"distance to {other.name}", distances, look)


def _cameras(folder: RunFolder, options: SceneOptions) -> tuple[SceneCamera, ...]:
    """Cameras of the trajectory, evenly over it."""
    if not folder.trajectory.exists() or options.cameras < 1:
        return ()
    try:
        poses = read_trajectory(folder.trajectory)
    except UniFusionError as error:
        logger.warning("%s", error)
        return ()
    run = find_recorded_run(folder)
    if run is not None and len(run.used) != len(poses):  # of another run
        run = None
    chosen = np.unique(np.linspace(0, len(poses) - 1, min(len(poses), options.cameras)).astype(int))
    camera = SOME_CAMERA if run is None else _camera_of(run)
    numbers = range(len(poses)) if run is None else run.used
    return tuple(
        SceneCamera(
            f"frame {numbers[place]}",
            camera,
            poses.T_world_camera[place],
            frame=None if run is None else run.used[place],
        )
        for place in chosen
    )


def with_images(scene: Scene, run: Run, width: int) -> Scene:
    """The scene with what its cameras saw, at most `width` pixels wide, as far as the recording of
    the run is still there.
    """
    cameras = tuple(
        camera if camera.frame is None else replace(camera, image=_image(run, camera.frame, width))
        for camera in scene.cameras
    )
    return replace(scene, cameras=cameras)


def find_recorded_run(folder: RunFolder) -> Run | None:
    """The run of a folder that says which recording it was made from, else None."""
    try:
        return read_run(folder.path)
    except (FileError, InputError):
        return None


def _camera_of(run: Run) -> PinholeCamera:
    """The camera of the recording; one that is usual where that is gone."""
    try:
        return run.recording[run.used[0]].camera
    except (UniFusionError, IndexError):
        return SOME_CAMERA


def _image(run: Run, index: int, width: int) -> NDArray[np.uint8] | None:
    """The colour image (h, w, 3) RGB of a frame, at most `width` wide; None where there is none."""
    try:
        color = run.recording[index].color
    except (UniFusionError, IndexError):
        return None
    if color is None or color.shape[1] <= width:
        return color
    height = max(1, round(color.shape[0] * width / color.shape[1]))
    small = cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)
