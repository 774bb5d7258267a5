"""One rule for rows of poses, whoever reads them: dialects of text, quaternions, bad rows; and our own
files read back.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from dataset_writers import (
    CAMERA,
    make_samples,
    matrix_text,
    numbers,
    tum_row,
    write_folder,
    write_tum,
)

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import DatasetError, FileError, PoseError
from taichi_unifusion.files.trajectories import (
    KITTI,
    REPLICA,
    read_pose_file,
    read_pose_rows,
    read_stamped_poses,
    read_trajectory,
    write_trajectory,
)
from taichi_unifusion.geometry.quaternions import quaternion_to_rotation
from taichi_unifusion.tracking.trajectory_files import read_poses
from taichi_unifusion.types import Trajectory

EXACT = 1e-12  # double arithmetic on numbers near one
POSE_TOLERANCE = 2e-9  # files hold 9 digits
SAMPLES = make_samples(3)
ROWS = [tum_row(sample.T_world_camera, f"{sample.timestamp:.6f}") for sample in SAMPLES]


def by_tum(folder: Path, content: bytes) -> list[np.ndarray]:
    write_tum(folder, SAMPLES)
    (folder / "groundtruth.txt").write_bytes(content)
    return [frame.T_world_camera for frame in open_dataset("tum", folder, camera=CAMERA)]


def by_folder(folder: Path, content: bytes) -> list[np.ndarray]:
    write_folder(folder, SAMPLES, poses="none")
    for kind in ("depth", "color"):
        for sample, path in zip(SAMPLES, sorted((folder / kind).iterdir()), strict=True):
            path.rename(path.with_name(f"{sample.timestamp:.6f}{path.suffix}"))
    (folder / "poses.txt").write_bytes(content)
    return [frame.T_world_camera for frame in open_dataset("folder", folder)]


def by_external_tracker(folder: Path, content: bytes) -> list[np.ndarray]:
    (folder / "poses.txt").write_bytes(content)
    return list(read_poses(folder / "poses.txt").T_world_camera)


def by_trajectory(folder: Path, content: bytes) -> list[np.ndarray]:
    (folder / "poses.txt").write_bytes(content)
    return list(read_trajectory(folder / "poses.txt").T_world_camera)


def by_stamped(folder: Path, content: bytes) -> list[np.ndarray]:
    """As recordings of an Azure Kinect take them."""
    (folder / "poses.txt").write_bytes(content)
    rows = sorted(read_stamped_poses(folder / "poses.txt"), key=lambda row: row.timestamp)
    return [row.pose.checked() for row in rows]


READERS = pytest.mark.parametrize(
    "read", [by_tum, by_folder, by_external_tracker, by_trajectory, by_stamped]
)


@READERS
@pytest.mark.parametrize(
    "content",
    [
        "\n".join(ROWS).encode(),
        "\n".join(row.replace(" ", ",") for row in ROWS).encode(),
        "\n".join(row.replace(" ", ", ") for row in ROWS).encode(),
        "\n".join(row.replace(" ", "\t") for row in ROWS).encode(),
        b"\xef\xbb\xbf# header\r\n\r\n" + "\r\n".join(ROWS).encode() + b"\r\n  # end\r\n",
        "\r".join(ROWS).encode(),
        "\n".join(reversed(ROWS)).encode(),
    ],
    ids=["plain", "commas", "commas and blanks", "tabs", "BOM, CRLF, comments", "CR", "reversed"],
)
def test_P7_every_reader_takes_every_dialect(tmp_path, read, content):
    for T, sample in zip(read(tmp_path, content), SAMPLES, strict=True):
        np.testing.assert_allclose(T, sample.T_world_camera, rtol=0, atol=EXACT)


def with_length(row: str, factor: float) -> str:
    words = row.split()
    return " ".join([*words[:4], *(repr(float(word) * factor) for word in words[4:])])


@READERS
def test_P6_every_reader_normalises_a_quaternion_of_four_digits(tmp_path, read):
    content = "\n".join(with_length(row, 1.0009) for row in ROWS).encode()
    for T, sample in zip(read(tmp_path, content), SAMPLES, strict=True):
        np.testing.assert_allclose(T, sample.T_world_camera, rtol=0, atol=EXACT)


@READERS
@pytest.mark.parametrize(
    ("row", "told"),
    [
        ("1 2 3", "poses.txt|groundtruth.txt, line 3: expected 8 columns .* found 3"),
        (ROWS[2].replace(" ", " x", 1), "line 3: 'x.*' is not a number"),
    ],
)
def test_P7_every_reader_names_a_row_that_is_none(tmp_path, read, row, told):
    with pytest.raises(DatasetError, match=told):
        read(tmp_path, "\n".join([*ROWS[:2], row]).encode())


@READERS
@pytest.mark.parametrize("content", [b"", b"# nothing\n\n"])
def test_P7_every_reader_says_that_there_is_nothing(tmp_path, read, content):
    with pytest.raises(DatasetError, match=r"holds no poses; expected rows of 8 columns \(timest"):
        read(tmp_path, content)


@pytest.mark.parametrize("read", [by_tum, by_folder, by_trajectory, by_stamped])
@pytest.mark.parametrize(
    ("row", "told"),
    [
        (with_length(ROWS[1], 1.1), "line 2: the quaternion's length is 1.1"),
        (with_length(ROWS[1], 0), "line 2: the quaternion's length is 0"),
        (with_length(ROWS[1], float("nan")), "line 2: holds NaN or infinite numbers"),
        (" ".join([*ROWS[1].split()[:3], "inf", *ROWS[1].split()[4:]]), "line 2: holds NaN or inf"),
    ],
    ids=["length 1.1", "length 0", "NaN", "infinite"],
)
def test_P6_a_pose_that_cannot_be_used_names_its_line(tmp_path, read, row, told):
    with pytest.raises(PoseError, match=told):
        read(tmp_path, "\n".join([ROWS[0], row, ROWS[2]]).encode())


def test_P6_the_external_tracker_leaves_such_a_pose_out_and_says_so(tmp_path):
    path = tmp_path / "poses.txt"
    path.write_text("\n".join([ROWS[0], with_length(ROWS[1], 1.1), ROWS[2], ROWS[2]]))
    poses = read_poses(path)
    assert len(poses.keys) == 2
    assert "2 of 4 poses left out" in poses.warnings[0] and "line 2: the quat" in poses.warnings[0]


@pytest.mark.parametrize("columns", [KITTI, REPLICA])
@pytest.mark.parametrize("separator", [" ", ",", ", ", "\t"])
def test_rows_of_matrices(tmp_path, columns, separator):
    path = tmp_path / "poses.txt"
    path.write_text(
        "\n".join(
            separator.join(numbers(sample.T_world_camera).split()[:columns]) for sample in SAMPLES
        )
    )
    rows = read_pose_rows(path)
    for row, sample in zip(rows, SAMPLES, strict=True):
        np.testing.assert_allclose(row.pose.checked(), sample.T_world_camera, rtol=0, atol=EXACT)
        assert row.name == "" and row.timestamp is None
    with pytest.raises(DatasetError, match="line 1: expected 8 columns"):
        read_stamped_poses(path)
    with open(path, "a") as file:
        file.write("\n1 2 3")
    with pytest.raises(DatasetError, match=f"line 4: expected {columns} columns .* found 3"):
        read_pose_rows(path)


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text,
        lambda text: text.replace(" ", ", "),
        lambda text: "\ufeff# T_world_camera\n" + text,
        lambda text: text.replace("\n", "\r\n"),
        lambda text: " ".join(text.split()),
    ],
)
def test_a_matrix_that_fills_a_file_in_every_dialect(tmp_path, change):
    path = tmp_path / "pose.txt"
    path.write_bytes(change(matrix_text(SAMPLES[1].T_world_camera)).encode())
    T = read_pose_file(path).checked()
    np.testing.assert_allclose(T, SAMPLES[1].T_world_camera, rtol=0, atol=EXACT)


def make_trajectory(R: np.ndarray) -> Trajectory:
    poses = np.tile(np.eye(4), (len(R), 1, 1))
    poses[:, :3, :3] = R
    poses[:, :3, 3] = np.random.default_rng(1).normal(size=(len(R), 3))
    return Trajectory(1305031102.175304 + np.arange(len(R)) / 30, poses)


def test_trajectory_round_trip(tmp_path):
    q = np.random.default_rng(0).normal(size=(40, 4))
    q[:20, 3] = 0  # half turns, where formulas by the trace divide by zero
    q[:3, :3] = np.eye(3)
    rotations = quaternion_to_rotation(q)
    trajectory = make_trajectory(rotations)
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
        read.T_world_camera[:, :3, :3], np.tile(np.eye(3), (2, 1, 1)), atol=EXACT
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
