"""A results folder as questions need it: its mesh, its map of features, where its cameras were."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from .. import runtime
from ..errors import FileError, InputError
from ..files.mesh_reading import read_mesh
from ..files.trajectories import read_trajectory
from ..maps.by_tiles import Features, open_features
from ..maps.stored import MapDescription, read_description
from ..types import Mesh, Trajectory
from .outlook import Outlook, read_outlook
from .run_folder import RunFolder


@dataclass(frozen=True)
class Understood:
    """What a results folder holds for questions."""

    mesh: Mesh
    features: Features
    trajectory: Trajectory | None
    outlook: Outlook


def describe_features(directory: Path) -> MapDescription:
    """What the map of features of a results folder says about itself, without reading the map; raises
    FileError where there is none, MapCorrupt where it makes no sense.
    """
    return read_description(_find_features(RunFolder(directory)))


def _find_features(folder: RunFolder) -> Path:
    if not folder.features.exists():
        raise FileError(
            f"{folder.path}: no {folder.relative(folder.features)} here; give the results folder of "
            "`unifusion understand`"
        )
    return folder.features


def read_understood(directory: Path, device: str) -> Understood:
    """Mesh, map of features and trajectory of a results folder; raises FileError where one is
    missing or damaged.
    """
    folder = RunFolder(directory)
    features = _find_features(folder)
    if not folder.mesh.exists():
        raise FileError(
            f"{directory}: no {folder.mesh.name} here; `unifusion mesh {directory}` makes it again"
        )
    mesh = read_mesh(folder.mesh)
    if not len(mesh.vertices) or not len(mesh.faces):
        raise InputError(f"{folder.mesh}: the mesh is empty, there is nothing to ask")
    runtime.init(device)
    poses = folder.trajectory
    return Understood(
        mesh,
        open_features(features),
        read_trajectory(poses) if poses.exists() else None,
        read_outlook(folder, mesh),
    )
