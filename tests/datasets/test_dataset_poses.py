"""Trajectories: bad poses cost one frame and are said; text in every dialect; association by time
stamp.
"""

from __future__ import annotations

import shutil

import numpy as np
import pytest
from dataset_writers import (
    CAMERA,
    make_pose,
    make_samples,
    matrix_text,
    numbers,
    quaternion,
    tum_row,
    write_folder,
    write_replica,
    write_scannet,
    write_scannet_flat,
    write_sens,
    write_seven_scenes,
    write_tum,
)

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import DatasetError, FrameError, InputError, PoseError

EXACT = 1e-12  # double arithmetic on numbers near one
TEXT = 1e-6  # poses as text have that many digits


SHEAR = np.array([[1, 0.2, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])


@pytest.fixture
def scene(tmp_path):
    return write_seven_scenes(tmp_path, make_samples(3))


@pytest.mark.parametrize(
    "text, said",
    [
        (matrix_text(np.full((4, 4), np.nan)), "NaN or infinite"),
        (matrix_text(np.full((4, 4), -np.inf)), "NaN or infinite"),
        (matrix_text(np.zeros((4, 4))), "last row"),
        (matrix_text(make_pose(1)[:3]), "expected a 4x4 matrix, found 12 numbers"),
        (matrix_text(make_pose(1).T), "transposed"),
        ("-1.#INF " * 16, "not a pose file"),
        ("", "found 0 numbers"),
    ],
)
def test_P1_a_bad_pose_costs_its_frame_and_names_the_file(scene, text, said):
    (scene / "frame-000001.pose.txt").write_text(text)
    dataset = open_dataset("7scenes", scene)
    with pytest.raises(PoseError, match=said) as caught:
        dataset[1]
    assert "frame-000001.pose.txt" in str(caught.value)
    assert dataset[0].T_world_camera is not None and dataset[2].T_world_camera is not None


@pytest.mark.parametrize(
    "T, said",
    [
        (make_pose(1) @ np.diag([1.0, 1, -1, 1]), "det R = -1.0000"),
        (make_pose(1) @ np.diag([1.3, 1.3, 1.3, 1]), "det R = 2.1970"),
        (make_pose(1) @ SHEAR, "max |R^T R - I| = 0.2000"),
    ],
)
def test_P2_what_is_no_rotation_is_refused_with_numbers(scene, T, said):
    (scene / "frame-000001.pose.txt").write_text(matrix_text(T))
    with pytest.raises(PoseError, match="not a rotation") as caught:
        open_dataset("7scenes", scene)[1]
    assert said in str(caught.value)


@pytest.mark.parametrize("stretch", [np.diag([1.3, 1.3, 1.3, 1]), SHEAR @ SHEAR.T, np.eye(4)])
def test_P2_poses_become_the_nearest_rotation_where_that_is_asked_for(scene, stretch):
    """A rotation times a positive definite matrix is its polar decomposition: the nearest rotation."""
    T = make_pose(1)
    (scene / "frame-000001.pose.txt").write_text(matrix_text(T @ stretch))
    dataset = open_dataset("7scenes", scene, project_poses=True)
    np.testing.assert_allclose(dataset[1].T_world_camera, T, atol=TEXT)
    np.testing.assert_allclose(dataset.pose_at(1)[1], T, atol=TEXT)
    plain = open_dataset("7scenes", scene)
    np.testing.assert_array_equal(dataset[0].T_world_camera, plain[0].T_world_camera)
    np.testing.assert_array_equal(dataset[1].color, plain.without_poses()[1].color)
    # what else is asked for is done to the nearest rotation
    half = open_dataset("7scenes", scene, project_poses=True, pose_scale=0.5)
    np.testing.assert_allclose(half[1].T_world_camera[:3, 3], T[:3, 3] / 2, atol=TEXT)


@pytest.mark.parametrize("R", [np.diag([1.0, 1, -1, 1]), np.diag([1.0, 1, 0, 1])])
def test_P2_what_mirrors_or_flattens_has_no_nearest_rotation(scene, R):
    (scene / "frame-000001.pose.txt").write_text(matrix_text(make_pose(1) @ R))
    with pytest.raises(PoseError, match="frame-000001.pose.txt.*no nearest rotation"):
        open_dataset("7scenes", scene, project_poses=True)[1]


@pytest.mark.parametrize("write", [write_scannet, write_sens])
def test_P1_scannet_lost_tracking(tmp_path, write):
    samples = make_samples(3)
    samples[1].T_world_camera[:] = -np.inf
    dataset = open_dataset("scannet", write(tmp_path, samples))
    # and no jump to it
    assert len(dataset.warnings) == 1 and "1 of 3 frames have no usable pose" in dataset.warnings[0]
    with pytest.raises(PoseError, match="NaN or infinite"):
        dataset[1]
    assert dataset[2].depth.any()


def test_P1_replica_row_with_nan_costs_its_frame(tmp_path):
    samples = make_samples(3)
    samples[1].T_world_camera[0, 0] = np.nan
    dataset = open_dataset("replica", write_replica(tmp_path, samples))
    with pytest.raises(PoseError, match="traj.txt, line 2"):
        dataset[1]
    assert dataset[2].depth.any()


def test_P3_repeated_identity_is_said(tmp_path):
    samples = make_samples(6)
    for sample in samples[2:5]:
        sample.T_world_camera[:] = np.eye(4)
    samples[1].T_world_camera[:3, 3] = samples[5].T_world_camera[:3, 3] = 0.1
    dataset = open_dataset("7scenes", write_seven_scenes(tmp_path, samples))
    assert any(
        "3 of 6 frames have exactly the identity" in said and "frame-000002" in said
        for said in dataset.warnings
    )


def test_P8_jump_is_said(tmp_path):
    samples = make_samples(5)
    samples[3].T_world_camera[:3, 3] += 2.0
    dataset = open_dataset("7scenes", write_seven_scenes(tmp_path, samples))
    said = next(warning for warning in dataset.warnings if "jumps" in warning)
    assert "2 times" in said and "frame-000003" in said


def test_P6_quaternion_is_normalised_within_tolerance_only(tmp_path):
    samples = make_samples(3)
    folder = write_tum(tmp_path, samples)
    rows = [
        f"{s.timestamp:.6f} {numbers(s.T_world_camera[:3, 3])} {numbers(factor * quaternion(s.T_world_camera[:3, :3]))}"
        for s, factor in zip(samples, (1.0005, 1.3, 0.0), strict=True)
    ]
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    dataset = open_dataset("tum", folder, camera=CAMERA)
    np.testing.assert_allclose(
        dataset[0].T_world_camera, samples[0].T_world_camera, rtol=0, atol=EXACT
    )
    with pytest.raises(
        PoseError, match="groundtruth.txt, line 2: the quaternion's length is 1.3000"
    ):
        dataset[1]
    with pytest.raises(PoseError, match="length is 0.0000"):
        dataset[2]


def test_P7_dialects_of_text_mean_the_same(tmp_path):
    samples = make_samples(4)
    folder = write_tum(tmp_path, samples)
    plain = [frame.T_world_camera for frame in open_dataset("tum", folder, camera=CAMERA)]
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (folder / name).read_text().splitlines()
        lines = ["", "# later", *reversed(lines), "   ", "# end"]
        (folder / name).write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    text = (folder / "groundtruth.txt").read_text(encoding="utf-8-sig").replace("   \n", "\n")
    (folder / "groundtruth.txt").write_text(text.replace(" ", ", ").replace("#,", "#"))
    dataset = open_dataset("tum", folder, camera=CAMERA)
    np.testing.assert_array_equal([frame.T_world_camera for frame in dataset], plain)
    np.testing.assert_array_equal(dataset[1].color, samples[1].color)


def test_P7_a_stamp_that_appears_again_is_left_out_and_said(tmp_path):
    samples = make_samples(3)
    folder = write_tum(tmp_path, samples)
    with open(folder / "depth.txt", "a") as file:
        file.write(f"{samples[1].timestamp:.6f} depth/{samples[2].timestamp:.6f}.png\n")
    dataset = open_dataset("tum", folder, camera=CAMERA)
    assert len(dataset) == 3
    np.testing.assert_array_equal(dataset[1].depth, samples[1].metres(5000.0))
    assert any(
        "depth.txt, line 5" in warning and "appears again" in warning
        for warning in dataset.warnings
    )


@pytest.mark.parametrize(
    "name, line, said",
    [
        ("groundtruth.txt", "1305031453.2 1 2 3 0 0 1", "line 6: expected 8 columns .* found 7"),
        ("groundtruth.txt", "1305031453.2 1 2 3 0 0 0 one", "line 6: 'one' is not a number"),
        ("groundtruth.txt", "later 1 2 3 0 0 0 1", "line 6: 'later' is not a time stamp"),
        ("groundtruth.txt", "nan 1 2 3 0 0 0 1", "line 6: 'nan' is not a time stamp"),
        ("rgb.txt", "1305031453.2", "line 6: expected 'timestamp filename'"),
        ("depth.txt", "soon depth/x.png", "line 6: expected 'timestamp filename'"),
    ],
)
def test_P7_a_row_that_cannot_be_read_is_named(tmp_path, name, line, said):
    folder = write_tum(tmp_path, make_samples(4))
    with open(folder / name, "a") as file:
        file.write(line)
    with pytest.raises(DatasetError, match=f"{name}, {said}"):
        open_dataset("tum", folder, camera=CAMERA)


def test_P7_a_file_name_that_cannot_be_costs_its_frame(tmp_path):
    folder = write_tum(tmp_path, make_samples(3))
    lines = (folder / "depth.txt").read_text().splitlines()
    for wrong in ("nul\0.png", "long" * 100, "nowhere.png"):
        (folder / "depth.txt").write_text(
            "\n".join([lines[0], f"{lines[1].split()[0]} {wrong}", *lines[2:]])
        )
        dataset = open_dataset("tum", folder, camera=CAMERA)
        with pytest.raises(FrameError, match="cannot be read|no such file"):
            dataset[0]
        assert dataset[1].depth.any()


def test_P7_replica_row_of_another_length_is_named(tmp_path):
    folder = write_replica(tmp_path, make_samples(3))
    with open(folder / "traj.txt", "a") as file:
        file.write("1 0 0 0\n")
    with pytest.raises(DatasetError, match="traj.txt, line 4: expected 16 columns .* found 4"):
        open_dataset("replica", folder)


def test_P7_binary_trajectory_is_refused(tmp_path):
    folder = write_replica(tmp_path, make_samples(1))
    (folder / "traj.txt").write_bytes(bytes(range(256)))
    with pytest.raises(DatasetError, match="traj.txt: not a text file"):
        open_dataset("replica", folder)


def test_S1_missing_images_cost_their_frame_only(scene):
    (scene / "frame-000001.depth.png").unlink()
    (scene / "frame-000002.color.png").unlink()
    dataset = open_dataset("7scenes", scene)
    assert len(dataset) == 3
    for index, name in ((1, "frame-000001.depth.png"), (2, "frame-000002.color.png")):
        with pytest.raises(FrameError, match=f"{name}: no such file"):
            dataset[index]
    assert dataset[0].index == 0


def test_S2_fewer_poses_than_frames_are_said_and_cost_the_rest(tmp_path):
    samples = make_samples(4)
    folder = write_replica(tmp_path, samples)
    (folder / "traj.txt").write_text(
        "\n".join(numbers(sample.T_world_camera) for sample in samples[:3])
    )
    dataset = open_dataset("replica", folder)
    assert any("1 of 4 frames have no usable pose" in warning for warning in dataset.warnings)
    assert dataset[2].depth.any()
    with pytest.raises(PoseError, match="traj.txt: holds 3 rows, none for frame number 3"):
        dataset[3]


def test_S2_more_poses_than_frames_are_said(tmp_path):
    folder = write_replica(tmp_path, make_samples(2))
    with open(folder / "traj.txt", "a") as file:
        file.write(numbers(make_pose(2)) + "\n")
    dataset = open_dataset("replica", folder)
    assert len(dataset) == 2 and any(
        "3 poses but the last frame is number 1" in warning for warning in dataset.warnings
    )


def test_S2_a_missing_pose_file_costs_its_frame(tmp_path):
    for name, write, file in (
        ("7scenes", write_seven_scenes, "frame-000001.pose.txt"),
        ("folder", write_folder, "poses/000001.txt"),
        ("scannet", write_scannet, "pose/1.txt"),
    ):
        folder = write(tmp_path / name, make_samples(3))
        (folder / file).unlink()
        dataset = open_dataset(name, folder)
        assert any(
            "1 of 3 frames have no usable pose" in warning and file in warning
            for warning in dataset.warnings
        )
        with pytest.raises(PoseError, match=f"{file}: no such file"):
            dataset[1]


def test_S2_folder_rows_without_names_must_fit_the_frames(tmp_path):
    folder = write_folder(tmp_path, make_samples(3), poses="rows")
    (folder / "depth" / "000001.png").unlink()
    (folder / "color" / "000001.png").unlink()
    with pytest.raises(DatasetError, match="3 rows for 2 frames"):
        open_dataset("folder", folder)


def test_S2_folder_named_rows_may_be_fewer(tmp_path):
    samples = make_samples(3)
    folder = write_folder(tmp_path, samples, poses="none")
    (folder / "poses.txt").write_text(tum_row(samples[2].T_world_camera, "000002"))
    dataset = open_dataset("folder", folder)
    np.testing.assert_allclose(
        dataset[2].T_world_camera, samples[2].T_world_camera, rtol=0, atol=EXACT
    )
    with pytest.raises(PoseError, match="frame 000001: no row for it"):
        dataset[1]


def test_S3_a_gap_in_the_ground_truth_costs_its_frames(tmp_path):
    samples = make_samples(4)
    folder = write_tum(tmp_path, samples)
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    (folder / "groundtruth.txt").write_text("\n".join(lines[:2] + lines[3:]))
    dataset = open_dataset("tum", folder, camera=CAMERA)
    with pytest.raises(PoseError, match="nearest pose .* is 0.029 s off, more than 0.02 s"):
        dataset[1]
    assert dataset[0].depth.any() and dataset[2].depth.any()
    assert len(open_dataset("tum", folder, camera=CAMERA, max_difference=0.05)[1].depth)


def test_S3_images_without_partner_are_left_out_and_said(tmp_path):
    samples = make_samples(4)
    folder = write_tum(tmp_path, samples)
    lines = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join(lines[:2] + lines[3:]))
    dataset = open_dataset("tum", folder, camera=CAMERA)
    assert len(dataset) == 3
    assert any(
        "0 colour and 1 depth images have no partner" in warning for warning in dataset.warnings
    )
    np.testing.assert_array_equal(dataset[1].depth, samples[2].metres(5000.0))


def test_S3_clocks_that_never_meet_are_a_dataset_error(tmp_path):
    folder = write_tum(tmp_path, make_samples(2))
    (folder / "rgb.txt").write_text("12.5 rgb/a.png\n")
    with pytest.raises(DatasetError, match="none of 1 colour and 2 depth images"):
        open_dataset("tum", folder, camera=CAMERA)


@pytest.mark.parametrize("gap", [0.0, -1.0, float("nan"), 100.0])
def test_S3_max_difference_must_be_usable(tmp_path, gap):
    folder = write_tum(tmp_path, make_samples(2))
    with pytest.raises(InputError, match="max_difference"):
        open_dataset("tum", folder, camera=CAMERA, max_difference=gap)


@pytest.mark.parametrize(
    ("format", "write", "poses", "camera"),
    [
        ("replica", write_replica, "traj.txt", None),
        ("7scenes", write_seven_scenes, "frame-*.pose.txt", None),
        ("scannet", write_scannet, "pose", None),
        ("scannet", write_scannet_flat, "frame-*.pose.txt", None),
        ("tum", write_tum, "groundtruth.txt", CAMERA),
        ("folder", write_folder, "poses", None),
    ],
)
def test_S2_without_any_pose_the_frames_are_there_and_what_is_missing_is_said(
    format, write, poses, camera, tmp_path
):
    folder = write(tmp_path / "recording", make_samples(2))
    for path in folder.glob(poses):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    dataset = open_dataset(format, folder, camera=camera)
    assert [frame.T_world_camera for frame in dataset] == [None, None]
    assert poses.replace("*", "XXXXXX") in dataset.no_poses and str(folder) in dataset[:1].no_poses
    assert sum("the frames have no poses" in warning for warning in dataset.warnings) == 1
    # nobody asked for them
    assert not any("pose" in warning for warning in dataset.without_poses().warnings)


def test_replica_images_without_a_trajectory_beside_their_camera(tmp_path):
    folder = write_replica(tmp_path, make_samples(2))
    (folder / "traj.txt").unlink()
    dataset = open_dataset("replica", folder / "results")
    assert dataset.camera == CAMERA and dataset.no_poses == f"{folder / 'traj.txt'}: no such file"
