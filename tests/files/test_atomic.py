"""Files: atomic writing and trajectories (meshes: test_mesh_files.py)."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest

from taichi_unifusion.errors import DatasetError, FileError, PoseError
from taichi_unifusion.files.atomic import atomic_write, check_writable
from taichi_unifusion.files.trajectories import read_trajectory, write_trajectory
from taichi_unifusion.geometry.quaternions import quaternion_to_rotation, rotation_to_quaternion
from taichi_unifusion.types import Trajectory

REPO = Path(__file__).resolve().parents[2]
POSE_TOLERANCE = 2e-9  # files hold 9 digits
ROTATION_TOLERANCE = 1e-12  # float64 rounding of a few products


def run_python(code: str, *arguments: object) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code), *map(str, arguments)],
        cwd=REPO,
        text=True,
        capture_output=True,
        timeout=60,
    )


# Atomic writing


def test_atomic_write_replaces_and_leaves_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    for text in ("first", "second"):
        with atomic_write(path) as temporary:
            assert temporary.parent == tmp_path
            temporary.write_text(text)
            assert not path.exists() or path.read_text() == "first"
        assert path.read_text() == text
    assert os.listdir(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt(), SystemExit(1)])
def test_R3_exception_keeps_the_old_file_and_no_temporary(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(type(error)), atomic_write(path) as temporary:
        temporary.write_text("half")
        raise error
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["a.txt"]


def test_atomic_write_follows_links_and_spares_what_is_no_file(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with atomic_write(tmp_path / "link.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
    with pytest.raises(FileError, match="not a regular file"), atomic_write(tmp_path):
        pass
    with (
        pytest.raises(FileError, match="folder does not exist"),
        atomic_write(tmp_path / "none" / "a") as temporary,
    ):
        temporary.write_text("x")


@pytest.mark.parametrize("name", ["mesh.ply", "map.safetensors"])
def test_R5_file_size_limit_leaves_the_old_file_and_says_why(tmp_path, name):
    code = """
        import resource, sys
        import numpy as np
        from taichi_unifusion.errors import FileError
        from taichi_unifusion.files.maps import write_map
        from taichi_unifusion.files.meshes import write_mesh
        from taichi_unifusion.types import Mesh

        def write(count):
            if sys.argv[1].endswith("ply"):
                write_mesh(sys.argv[1], Mesh(np.zeros((count, 3), np.float32), np.zeros((0, 3), np.int32)))
            else:
                write_map(sys.argv[1], {"F": np.zeros((count, 3), np.float32)}, {})
        write(100)
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
        try:
            write(100_000)
        except FileError as error:
            print(error)
        """
    result = run_python(code, tmp_path / name)
    assert result.returncode == 0, result.stderr
    assert name in result.stdout and "file-size limit" in result.stdout
    assert os.listdir(tmp_path) == [name]
    assert 1200 < (tmp_path / name).stat().st_size < 50_000  # the first 100 rows


def test_R6_unwritable_folder_is_an_error_and_a_writable_one_is_made(tmp_path):
    assert check_writable(tmp_path / "a" / "b") == tmp_path / "a" / "b"
    assert os.listdir(tmp_path / "a" / "b") == []
    (tmp_path / "file").write_text("")
    for folder, reason in (
        (tmp_path / "file" / "out", "is a file, not a folder"),
        (tmp_path / "file", "stands in the way"),
    ):
        with pytest.raises(FileError, match=reason):
            check_writable(folder)
    if Path("/proc").is_dir():  # nobody may write there, root included
        with pytest.raises(FileError, match="cannot write results there"):
            check_writable("/proc/results")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_R6_read_only_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(FileError, match="permission is denied"):
        check_writable(tmp_path / "out")


def test_K2_io_needs_no_heavy_package():
    result = run_python("""
        import sys
        import taichi_unifusion.files.maps, taichi_unifusion.files.meshes
        print([m for m in ("taichi", "trimesh", "open3d", "torch", "cv2") if m in sys.modules])
        """)
    assert result.stdout.strip() == "[]", result.stderr


# Trajectories


def random_rotations(count: int, seed: int = 0) -> np.ndarray:
    q = np.random.default_rng(seed).normal(size=(count, 4))
    return quaternion_to_rotation(q)


def half_turns() -> np.ndarray:
    """180 degrees about the axes, the face diagonals and some other axes, where trace-based
    formulas divide by zero.
    """
    axes = np.array(
        [
            [1, 0, 0],
            [0, 1, 0],
            [0, 0, 1],
            [1, 1, 0],
            [1, 0, -1],
            [0, -1, 1],
            [1, 1, 1],
            [1, -2, 3],
            [1e-9, 1, 0],
        ]
    )
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    return 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)


@pytest.mark.parametrize(
    "R",
    [random_rotations(200), half_turns(), np.eye(3)[None]],
    ids=["random", "half turns", "identity"],
)
def test_quaternions_round_trip(R):
    q = rotation_to_quaternion(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1, atol=ROTATION_TOLERANCE)
    assert (q[:, 3] >= 0).all()
    np.testing.assert_allclose(quaternion_to_rotation(q), R, atol=ROTATION_TOLERANCE)


def test_quaternion_convention():
    s = np.sqrt(0.5)
    quarter_turn_about_z = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])
    np.testing.assert_allclose(
        rotation_to_quaternion(quarter_turn_about_z[None]), [[0, 0, s, s]], atol=ROTATION_TOLERANCE
    )
    unnormalised = quaternion_to_rotation([[0, 0, 2 * s, 2 * s]])
    np.testing.assert_allclose(unnormalised, quarter_turn_about_z[None], atol=ROTATION_TOLERANCE)


def make_trajectory(R: np.ndarray) -> Trajectory:
    poses = np.tile(np.eye(4), (len(R), 1, 1))
    poses[:, :3, :3] = R
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(len(R), 3))
    return Trajectory(1305031102.175304 + np.arange(len(R)) / 30, poses)


def test_trajectory_round_trip(tmp_path):
    trajectory = make_trajectory(np.concatenate([random_rotations(20), half_turns()]))
    write_trajectory(tmp_path / "t.txt", trajectory)
    read = read_trajectory(tmp_path / "t.txt")
    assert np.array_equal(read.timestamps, trajectory.timestamps)
    np.testing.assert_allclose(read.T_world_camera, trajectory.T_world_camera, atol=POSE_TOLERANCE)
    assert (
        (tmp_path / "t.txt")
        .read_text()
        .startswith("# timestamp tx ty tz qx qy qz qw\n1305031102.175304 ")
    )


def test_P7_trajectory_comments_bom_crlf_and_order(tmp_path):
    (tmp_path / "t.txt").write_bytes(
        b"\xef\xbb\xbf# a comment\r\n\r\n 2.5  1 2 3  0 0 0 1\r\n1.5\t4 5 6 0 0 0 -1.0005\r\n"
    )
    read = read_trajectory(tmp_path / "t.txt")
    assert read.timestamps.tolist() == [1.5, 2.5]
    np.testing.assert_allclose(read.T_world_camera[:, :3, 3], [[4, 5, 6], [1, 2, 3]])
    np.testing.assert_allclose(
        read.T_world_camera[:, :3, :3], np.tile(np.eye(3), (2, 1, 1)), atol=ROTATION_TOLERANCE
    )


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 2 3", "line 2: expected 8"),
        ("1 0 0 0 0 0 0 one", "line 2: 'one' is not a number"),
        ("1 0 0 nan 0 0 0 1", "line 2: holds NaN or infinite"),
        ("0 0 0 0 0 0 0 1 9", "line 2: expected 8"),
        ("1 0 0 0 0 0 0 1.1", "line 2: the quaternion's length is 1.1"),
        ("1 0 0 0 0 0 0 0", "line 2: the quaternion's length is 0.0"),
    ],
)
def test_P6_P7_bad_trajectory_line_is_named(tmp_path, line, message):
    (tmp_path / "t.txt").write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(DatasetError, match=message):
        read_trajectory(tmp_path / "t.txt")


def test_trajectory_files_that_are_none(tmp_path):
    (tmp_path / "empty.txt").write_text("# nothing\n")
    (tmp_path / "binary.txt").write_bytes(b"\xff\xfe\x00\x80")
    with pytest.raises(DatasetError, match="holds no poses"):
        read_trajectory(tmp_path / "empty.txt")
    with pytest.raises(DatasetError, match="not a text file"):
        read_trajectory(tmp_path / "binary.txt")
    with pytest.raises(FileError, match="no such file"):
        read_trajectory(tmp_path / "none.txt")
    bad = make_trajectory(np.eye(3)[None])
    bad.T_world_camera[0, :3, :3] *= 1.3
    with pytest.raises(PoseError, match="pose 0"):
        write_trajectory(tmp_path / "t.txt", bad)
    assert not (tmp_path / "t.txt").exists()
