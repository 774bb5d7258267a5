"""Which way is up in the world of a run, and where its pictures are drawn from: found once, kept in
the record, so that pictures before and after a change have the same camera.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import cast, get_args

import numpy as np

from ..errors import FileError, PoseError
from ..files.trajectories import read_trajectory
from ..geometry.gravity import How, Up, find_up, up_of_transform
from ..rendering.drawing import Viewpoint
from ..rendering.preview import choose_views
from ..types import Mesh, PinholeCamera, Trajectory, check_rigid
from .record import RunRecord, ViewRecord, read_record
from .run_folder import RunFolder


@dataclass(frozen=True)
class Outlook:
    """Up, and the viewpoints of a run's pictures."""

    up: Up
    views: tuple[Viewpoint, ...]

    def kept_in(self, record: RunRecord) -> RunRecord:
        """The record with this in it."""
        T_up_world, before = _rows(self.up.T_up_world), record.T_up_world
        if before is not None and np.allclose(T_up_world, before, rtol=0, atol=1e-9):
            T_up_world = before  # to the last digit
        return replace(
            record,
            T_up_world=T_up_world,
            up=self.up.how,
            views=tuple(map(_record_of, self.views)),
        )


def look_at_mesh(mesh: Mesh, trajectory: Trajectory | None, up: Up | None = None) -> Outlook:
    """The outlook on a mesh that was seen from a trajectory; `up` is found where it is not given.
    Raises InputError for a mesh without a finite triangle.
    """
    up = up or find_mesh_up(mesh, trajectory)
    return Outlook(up, choose_views(mesh, trajectory=trajectory, up=up.direction))


def find_mesh_up(mesh: Mesh, trajectory: Trajectory | None) -> Up:
    """Up of a mesh that was seen from a trajectory, if there is one."""
    poses = np.empty((0, 4, 4)) if trajectory is None else trajectory.T_world_camera
    return find_up(mesh.vertices, mesh.faces, poses)


def read_up(folder: RunFolder, mesh: Mesh) -> Up:
    """Up of a results folder whose mesh this is: as its record says, or found where it does not, as
    in folders of older versions. Raises FileError for a damaged trajectory.
    """
    return _recorded_up(_record(folder)) or find_mesh_up(mesh, read_poses(folder))


def read_outlook(folder: RunFolder, mesh: Mesh, up: Up | None = None) -> Outlook:
    """The outlook of a results folder on its mesh, as its record says; what that lacks is found, and
    another `up` than the record's gives other views. Raises FileError for a damaged trajectory.
    """
    record = _record(folder)
    recorded = _recorded_up(record)
    if up is None and recorded is not None and record is not None and record.views:
        return Outlook(recorded, tuple(map(_viewpoint_of, record.views)))
    return look_at_mesh(mesh, read_poses(folder), up or recorded)


def read_poses(folder: RunFolder) -> Trajectory | None:
    """The trajectory of a results folder, if it has one; raises FileError where it is damaged."""
    return read_trajectory(folder.trajectory) if folder.trajectory.exists() else None


def _record(folder: RunFolder) -> RunRecord | None:
    try:
        return read_record(folder.record)
    except FileError:  # none, or damaged: up is found as in a folder of an older version
        return None


def _recorded_up(record: RunRecord | None) -> Up | None:
    if record is None or record.T_up_world is None or record.up not in get_args(How):
        return None
    try:
        T_up_world = check_rigid(np.array(record.T_up_world), "T_up_world")
    except (PoseError, ValueError):  # edited by hand
        return None
    return up_of_transform(T_up_world, cast(How, record.up))


def _rows(T: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(row) for row in T.tolist())


def _record_of(view: Viewpoint) -> ViewRecord:
    camera = view.camera
    return ViewRecord(camera.size, camera.intrinsics, _rows(view.T_world_camera), float(view.near))


def _viewpoint_of(view: ViewRecord) -> Viewpoint:
    camera = PinholeCamera(*view.size, *view.intrinsics)
    return Viewpoint(camera, np.array(view.T_world_camera), view.near)
