"""Files that the project writes and reads: atomic writing, meshes (PLY, GLB, OBJ) and trajectories in TUM's format."""

from __future__ import annotations

import errno
import math
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FileError, InputError, MissingDependency, UniFusionError
from .ply import color_to_uint8, parse_ply, write_ply
from ..types import Mesh, Trajectory, check_rigid

UNIT_TOLERANCE = 1e-3  # | |q| - 1 | of a quaternion in a file: 4 printed digits pass, a wrong column does not

_REASONS = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another folder",
    errno.EFBIG: "the file would pass the file-size limit of this process; raise it with ulimit -f",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.EACCES: "permission is denied; choose another folder or ask for access",
    errno.EPERM: "permission is denied; choose another folder or ask for access",
    errno.ENOENT: "the folder does not exist; create it first",
    errno.ENOTDIR: "a part of the path is a file, not a folder",
    errno.EEXIST: "a file of that name stands in the way",
    errno.EISDIR: "this is a folder, not a file",
    errno.ENAMETOOLONG: "the name is too long",
}


def file_error(verb: str, path: str | os.PathLike, error: OSError) -> FileError:
    """The FileError that says what could not be done where, and why."""
    reason = _REASONS.get(error.errno) or error.strerror or str(error) or type(error).__name__
    return FileError(f"{path}: cannot {verb}: {reason}")


def read_bytes(path: str | os.PathLike) -> bytes:
    """The whole content of a file; raises FileError where it is missing or cannot be read."""
    path = Path(path)
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise FileError(f"{path}: no such file") from None
    except OSError as error:
        raise file_error("read", path, error) from error


def check_writable(folder: str | os.PathLike) -> Path:
    """Create `folder` where needed and write a test file in it; raises FileError that says why it cannot hold results."""
    folder = Path(folder)
    probe = folder / f".{secrets.token_hex(4)}.tmp"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.write_bytes(b"test")
    except OSError as error:
        raise file_error("write results there", folder, error) from error
    finally:
        with suppress(OSError):
            probe.unlink()
    return folder


@contextmanager
def atomic_write(path: str | os.PathLike) -> Iterator[Path]:
    """Give a temporary path in the folder of `path`; what was written there replaces `path` when the block ends well.

    On any exception, Ctrl-C included, the temporary file is removed and an older file at `path` stays as it was.
    An OSError of the block (disk full, no permission) becomes a FileError that names `path` and the reason.
    """
    path = Path(os.path.realpath(path))  # a link keeps pointing where it does
    if path.exists() and not path.is_file():
        raise FileError(f"{path}: cannot write: this is not a regular file; choose another name")
    temporary = path.with_name(f".{path.name[:200]}.{secrets.token_hex(4)}.tmp")
    try:
        yield temporary
        _flush_to_disk(temporary)
        os.replace(temporary, path)
        with suppress(OSError):  # the file is in place; some file systems cannot sync a folder
            _flush_to_disk(path.parent)
    except UniFusionError:
        raise
    except OSError as error:
        raise file_error("write", path, error) from error
    finally:
        with suppress(OSError):  # it is gone when all went well, and was never there when the folder is none
            temporary.unlink()


def write_text(path: str | os.PathLike, text: str) -> None:
    """Write a text file atomically; raises FileError."""
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _flush_to_disk(path: Path) -> None:
    """Wait until a file's content, or a folder's list of names, is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# Meshes

MESH_SUFFIXES = (".ply", ".glb", ".obj")


def write_mesh(path: str | os.PathLike, mesh: Mesh) -> None:
    """Write `mesh` atomically; the suffix of `path` chooses PLY (binary), GLB or OBJ.

    Attribute "color" becomes 8-bit RGB. PLY holds all other attributes as float properties, GLB and OBJ leave them out.
    Raises InputError for another suffix, bad face indices or an empty GLB/OBJ, FileError where the file cannot be written.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise InputError(f"{path}: a mesh is written as {', '.join(MESH_SUFFIXES)}, not as '{path.suffix}'")
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise InputError(f"{path}: the faces name vertices {mesh.faces.min()}..{mesh.faces.max()}, "
                         f"but the mesh has {len(mesh.vertices)}")
    if suffix == ".ply":
        with atomic_write(path) as temporary, open(temporary, "wb") as file:
            write_ply(file, mesh)
    else:
        content = _encode_with_trimesh(path, mesh)
        with atomic_write(path) as temporary:
            temporary.write_bytes(content)


def read_mesh(path: str | os.PathLike) -> Mesh:
    """Read a PLY mesh, ours or another program's; raises FileError where it is missing, truncated or inconsistent."""
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise InputError(f"{path}: meshes are read from .ply, not from '{path.suffix}'")
    return parse_ply(read_bytes(path), name=str(path))


def _encode_with_trimesh(path: Path, mesh: Mesh) -> bytes:
    """The bytes of a GLB or OBJ file, vertices and faces in their order."""
    if not len(mesh.faces):
        raise InputError(f"{path}: the mesh is empty, which {path.suffix} cannot hold; write a .ply")
    try:
        import trimesh
    except ImportError:
        raise MissingDependency(f"{path}: writing {path.suffix} needs trimesh: pip install trimesh") from None
    color = mesh.attributes.get("color")
    has_normals = mesh.normals is not None
    exported = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.normals, process=False,
                               vertex_colors=None if color is None else color_to_uint8(color))
    content = exported.export(file_type=path.suffix.lower()[1:], include_normals=has_normals)
    return content.encode() if isinstance(content, str) else content


# Trajectories


def write_trajectory(path: str | os.PathLike, trajectory: Trajectory) -> None:
    """Write camera-to-world poses atomically in TUM's format: `timestamp tx ty tz qx qy qz qw`, seconds and metres.

    Raises PoseError for a matrix that is no rigid transform, FileError where the file cannot be written.
    """
    poses = np.empty((len(trajectory), 4, 4))
    for i, T_world_camera in enumerate(trajectory.T_world_camera):
        poses[i] = check_rigid(T_world_camera, f"{path}: pose {i}")
    rows = np.hstack([poses[:, :3, 3], rotation_to_quaternion(poses[:, :3, :3])])
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for timestamp, row in zip(trajectory.timestamps, rows, strict=True):  # 9 digits: a nanometre; time stamps without loss
        lines.append(" ".join([repr(float(timestamp)), *(f"{value:.9f}" for value in row)]))
    with atomic_write(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def read_trajectory(path: str | os.PathLike) -> Trajectory:
    """Read camera-to-world poses in TUM's format, in time order; comments, BOM and CRLF are fine.

    Raises FileError where the file is missing, DatasetError, with the line, where it does not hold poses.
    """
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a text file; expected lines 'timestamp tx ty tz qx qy qz qw'") from None
    rows = [_parse_pose(line, f"{path}, line {number}") for number, line in enumerate(text.splitlines(), start=1)
            if line.strip() and not line.lstrip().startswith("#")]
    if not rows:
        raise DatasetError(f"{path}: holds no poses; expected lines 'timestamp tx ty tz qx qy qz qw'")
    table = np.array(rows)
    table = table[np.argsort(table[:, 0], kind="stable")]
    T_world_camera = np.tile(np.eye(4), (len(table), 1, 1))
    T_world_camera[:, :3, :3] = quaternion_to_rotation(table[:, 4:])
    T_world_camera[:, :3, 3] = table[:, 1:4]
    return Trajectory(table[:, 0].copy(), T_world_camera)


def _parse_pose(line: str, at: str) -> list[float]:
    """The 8 numbers of one line, or DatasetError."""
    words = line.split()
    try:
        row = [float(word) for word in words]
    except ValueError:
        raise DatasetError(f"{at}: expected 8 numbers, got '{line.strip()[:80]}'") from None
    if len(row) != 8 or not all(map(math.isfinite, row)):
        raise DatasetError(f"{at}: expected 8 finite numbers 'timestamp tx ty tz qx qy qz qw', got '{line.strip()[:80]}'")
    length = math.hypot(*row[4:])
    if abs(length - 1) > UNIT_TOLERANCE:
        raise DatasetError(f"{at}: the quaternion has length {length:.4f}, not 1; are the columns qx qy qz qw?")
    return row


def rotation_to_quaternion(R: NDArray) -> NDArray[np.float64]:
    """Unit quaternions (N, 4), in the order x y z w with w >= 0, of rotation matrices (N, 3, 3).

    The quaternion is the dominant eigenvector of a symmetric matrix that is linear in R (Bar-Itzhack 2000): no special case
    at half turns, and the nearest rotation where R is rounded.
    """
    R = np.asarray(R, np.float64)
    K = np.empty((len(R), 4, 4))
    trace = np.trace(R, axis1=1, axis2=2)
    K[:, :3, :3] = R + R.transpose(0, 2, 1) - trace[:, None, None] * np.eye(3)
    K[:, 3, :3] = K[:, :3, 3] = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    K[:, 3, 3] = trace
    q = np.linalg.eigh(K)[1][:, :, -1]  # eigenvalues come in ascending order
    return np.where(q[:, 3:] < 0, -q, q)


def quaternion_to_rotation(q: NDArray) -> NDArray[np.float64]:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4) in the order x y z w, normalised first."""
    q = np.asarray(q, np.float64)
    x, y, z, w = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
                     2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
                     2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1).reshape(-1, 3, 3)
