"""`unifusion repose`: a finished map at the poses of another program, without its images."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from ..errors import FileError
from ..results.run_folder import RunFolder
from .mesh import ExtractMesh, extract_mesh
from .options import Device
from .terminal import DONE

if TYPE_CHECKING:
    from ..results.reposing import NewPoses, Reposed


@dataclass(frozen=True)
class Repose:
    """Move a finished map to other poses, as those of your own pose graph, without the images.

    Needs windows.log in the results folder, which runs with --keep-windows leave there, and those
    with --tracking-passes 1.

    Example: unifusion repose results/kitchen --trajectory optimised.txt --out results/optimised
    """

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """Results folder of `unifusion reconstruct`."""
    trajectory: Annotated[Path, arg(metavar="FILE")]
    """The new poses, camera to world: TUM, KITTI or Replica file, or a folder of one matrix a frame. Frames that
    it lacks move as the nearest one that it has, so keyframes are enough.
    """
    out: Annotated[
        Path | None, arg(metavar="OTHER", help_behavior_hint="(default: DIR itself)")
    ] = None
    """Write the moved map to this new folder, and leave DIR as it is."""
    device: Device = "auto"
    """Where to compute."""


def repose(options: Repose) -> int:
    """Windows -> maps at other poses -> mesh."""
    from ..results.lock import lock_folder
    from ..results.reposing import read_new_poses, read_windows

    folder = RunFolder(options.dir)
    windows = read_windows(folder)
    poses = read_new_poses(folder, options.trajectory)
    target = folder
    if options.out is not None and options.out.resolve() != options.dir.resolve():
        target = copied(folder, options.out)
    with lock_folder(target):
        moved = _move(target, windows, poses, options.device)
    resolution, min_area = mesh_settings(target)
    print(
        f"{target.path}: {moved.moved} of {moved.windows} windows moved, by {100 * moved.median:.1f} cm in the "
        f"median and up to {100 * moved.farthest:.1f} cm; {poses.given} of {len(poses.by_frame)} frames have a "
        "pose in the file"
    )
    return (
        extract_mesh(ExtractMesh(target.path, resolution, min_area, device=options.device)) or DONE
    )


def _move(folder: RunFolder, windows, poses: NewPoses, device: Device) -> Reposed:
    """Write maps, windows and trajectory anew."""
    from .. import runtime
    from ..files.trajectories import write_trajectory
    from ..results.keyframes import repose_keyframes
    from ..results.ownership import answer_files
    from ..results.reposing import record_reposed
    from ..results.reposing import repose as reposed

    runtime.init(device)
    answers = answer_files(folder)
    try:
        maps, moved = reposed(folder, windows, poses)
        for name, each in maps.maps.items():
            each.save(folder.map(name))
        write_trajectory(folder.trajectory, poses.trajectory)
        repose_keyframes(folder, poses)
        record_reposed(folder, poses)
        folder.new_windows.replace(folder.windows)
    finally:
        folder.new_windows.unlink(missing_ok=True)
    for file in answers:  # they lie where the map was
        file.unlink()
    return moved


def copied(folder: RunFolder, out: Path) -> RunFolder:
    """A copy of a results folder; raises FileError where something is there already."""
    if out.exists() and any(out.iterdir()):
        raise FileError(f"{out}: is there already; give --out a folder that is new")
    try:
        shutil.copytree(
            folder.path, out, dirs_exist_ok=True, ignore=shutil.ignore_patterns(".*", "windows.log")
        )
    except (OSError, shutil.Error) as error:
        raise FileError(f"{out}: cannot be written: {error}") from None
    return RunFolder(out)


def mesh_settings(folder: RunFolder) -> tuple[int, float]:
    """Resolution and smallest part of the mesh, as the run had them."""
    from ..config import load_config

    mesh = load_config(folder.config).mesh
    return mesh.resolution, mesh.min_area
