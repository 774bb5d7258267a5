"""One rule for rows of poses, whoever reads them: dialects of text, units of length, bad rows."""

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
from taichi_unifusion.errors import DatasetError, PoseError
from taichi_unifusion.files.trajectories import (
    KITTI,
    REPLICA,
    read_pose_file,
    read_pose_rows,
    read_stamped_poses,
    read_trajectory,
)
from taichi_unifusion.tracking.trajectory_files import read_poses

EXACT = 1e-12  # double arithmetic on numbers near one
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
    assert "2 poses left out" in poses.warnings[0] and "line 2: the quat" in poses.warnings[0]


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
