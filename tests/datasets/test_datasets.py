"""Every format written small and loaded back exactly: pixels, metres, poses; and what all data sets
have in common.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from dataset_writers import (
    CAMERA,
    CAMERA_YAML,
    enlarged,
    make_samples,
    numbers,
    tum_row,
    write_folder,
    write_image,
    write_replica,
    write_scannet,
    write_scannet_flat,
    write_sens,
    write_seven_scenes,
    write_stanford,
    write_tum,
)

from taichi_unifusion.datasets import FORMATS, open_dataset
from taichi_unifusion.types import PinholeCamera

TEXT_POSE = 1e-12  # poses written with all digits; quaternions cost a few roundings
FLOAT32_POSE = 1e-6  # .sens keeps 32-bit poses
JPEG_CONSTANT = 2  # [grey levels] a constant colour through JPEG

ROUND_TRIPS = {  # name -> format, writer, options, units a metre, pose tolerance
    "7scenes": ("7scenes", write_seven_scenes, {}, 1000.0, TEXT_POSE),
    "replica": ("replica", write_replica, {}, 6553.5, TEXT_POSE),
    "replica-flat": ("replica", partial(write_replica, images="."), {}, 6553.5, TEXT_POSE),
    "tum": ("tum", write_tum, {"camera": CAMERA}, 5000.0, TEXT_POSE),
    "scannet": ("scannet", write_scannet, {}, 1000.0, TEXT_POSE),
    "scannet-flat": ("scannet", write_scannet_flat, {}, 1000.0, TEXT_POSE),
    "scannet-sens": ("scannet", write_sens, {}, 1000.0, FLOAT32_POSE),
    "2d3ds": ("2d3ds", write_stanford, {}, 512.0, TEXT_POSE),
    "folder-poses": ("folder", partial(write_folder, poses="folder"), {}, 1000.0, TEXT_POSE),
    "folder-rows": ("folder", partial(write_folder, poses="rows"), {}, 1000.0, TEXT_POSE),
    "folder-named": ("folder", partial(write_folder, poses="named"), {}, 1000.0, TEXT_POSE),
    "folder-npy": ("folder", partial(write_folder, depth="npy"), {}, 1000.0, TEXT_POSE),
}
ELSEWHERE = {
    *("synthetic", "scene"),  # rendered
    "k4a",  # test_k4a.py
    *("record3d", "strayscanner", "polycam", "nerfstudio"),  # test_phones.py
    *("arkitscenes", "scannetpp", "hypersim", "matterport"),  # test_phones.py
    *("open3d", "realsense", "rosbag"),  # test_open3d_system.py, test_realsense.py, test_rosbag.py
}


@pytest.fixture(params=list(ROUND_TRIPS))
def recording(request, tmp_path):
    name, write, options, scale, tolerance = ROUND_TRIPS[request.param]
    samples = make_samples()
    return (
        open_dataset(name, write(tmp_path / "scene", samples), **options),
        samples,
        scale,
        tolerance,
    )


def test_every_file_format_is_under_test():
    assert {row[0] for row in ROUND_TRIPS.values()} == set(FORMATS) - ELSEWHERE


def test_round_trip_is_exact(recording):
    dataset, samples, scale, tolerance = recording
    assert len(dataset) == len(samples)
    for i, sample in enumerate(samples):
        frame = dataset[i]
        assert frame.depth.dtype == np.float32 and frame.color.dtype == np.uint8
        np.testing.assert_array_equal(frame.depth, sample.metres(scale))
        np.testing.assert_array_equal(frame.color, sample.color)
        np.testing.assert_allclose(
            frame.T_world_camera, sample.T_world_camera, rtol=0, atol=tolerance
        )
        assert frame.camera == CAMERA
        assert frame.index == i


def test_no_warning_without_a_reason(recording):
    dataset, *_ = recording
    assert not dataset.warnings


def test_slices_are_views_of_the_same_frames(recording):
    dataset, *_ = recording
    assert len(dataset[1:4:2]) == 2
    np.testing.assert_array_equal(dataset[1:4:2][1].depth, dataset[3].depth)
    np.testing.assert_array_equal(dataset[-1].color, dataset[len(dataset) - 1].color)
    with pytest.raises(IndexError):
        dataset[len(dataset)]


def test_depth_alone_is_the_same_depth(recording):
    dataset, *_ = recording
    for i, bare in enumerate(dataset.depth_only()):
        np.testing.assert_array_equal(bare.depth, dataset[i].depth)
        np.testing.assert_array_equal(bare.T_world_camera, dataset[i].T_world_camera)
        assert (bare.index, bare.timestamp) == (dataset[i].index, dataset[i].timestamp)


def test_depth_alone_does_not_read_colour(tmp_path):
    write_seven_scenes(tmp_path, make_samples(1))
    (tmp_path / "frame-000000.color.png").write_bytes(b"no image")
    bare = open_dataset("7scenes", tmp_path).depth_only()[0]
    assert bare.color is None and bare.depth.any()


def test_common_options_reach_every_format(recording, tmp_path, request):
    _, samples, scale, _ = recording
    name, _, options, _, _ = ROUND_TRIPS[request.node.callspec.params["recording"]]
    camera = PinholeCamera(16, 12, 10.0, 10.0, 8.0, 6.0)
    frame = open_dataset(name, tmp_path / "scene", depth_scale=2 * scale, camera=camera)[0]
    assert frame.camera == camera
    if request.node.callspec.params["recording"] == "folder-npy":
        # its floats are metres unless a scale is given, which then holds for them too
        np.testing.assert_allclose(frame.depth, samples[0].metres(scale) / (2 * scale))
    else:
        np.testing.assert_array_equal(frame.depth, samples[0].metres(2 * scale))


def test_time_stamps_where_the_format_has_them(tmp_path):
    samples = make_samples()
    for name, write in (("tum", write_tum), ("scannet", write_sens)):
        dataset = open_dataset(name, write(tmp_path / name, samples), camera=CAMERA)
        assert [frame.timestamp for frame in dataset] == pytest.approx(
            [s.timestamp for s in samples], abs=1e-6
        )


def test_seven_scenes_scene_folder_with_one_sequence_and_jpeg(tmp_path):
    folder = write_seven_scenes(tmp_path / "heads" / "seq-01", make_samples(1))
    # as 3DMatch has it
    (folder / "camera-intrinsics.txt").rename(tmp_path / "heads" / "camera-intrinsics.txt")
    (folder / "frame-000000.color.png").unlink()
    write_image(folder / "frame-000000.color.jpg", np.full((12, 16, 3), (200, 100, 50), np.uint8))
    frame = open_dataset("7scenes", tmp_path / "heads")[0]
    assert frame.camera == CAMERA
    assert np.abs(frame.color.astype(int) - (200, 100, 50)).max() <= JPEG_CONSTANT  # RGB, not BGR


def test_seven_scenes_own_intrinsics_without_a_file(tmp_path):
    folder = write_seven_scenes(tmp_path, make_samples(1))
    (folder / "camera-intrinsics.txt").unlink()
    write_image(folder / "frame-000000.depth.png", np.full((480, 640), 1000, np.uint16))
    assert open_dataset("7scenes", folder).camera == PinholeCamera(
        640, 480, 585.0, 585.0, 320.0, 240.0
    )


def test_replica_row_belongs_to_the_frame_number(tmp_path):
    samples = make_samples(6)
    folder = write_replica(tmp_path, samples)
    for i in (0, 1, 2, 4):
        for name in ("frame", "depth"):
            (folder / "results" / f"{name}{i:06d}.png").unlink()
    # the folder of the images is accepted too
    dataset = open_dataset("replica", folder / "results")
    assert len(dataset) == 2
    np.testing.assert_array_equal(dataset[0].T_world_camera, samples[3].T_world_camera)
    np.testing.assert_array_equal(dataset[1].T_world_camera, samples[5].T_world_camera)


def test_replica_usual_camera_without_a_file(tmp_path):
    folder = write_replica(tmp_path / "Replica" / "office0", make_samples(1))
    # as the rendered release has it
    (folder / "cam_params.json").rename(folder.parent / "cam_params.json")
    assert open_dataset("replica", folder).camera == CAMERA
    (folder.parent / "cam_params.json").unlink()
    write_image(folder / "results" / "depth000000.png", np.full((680, 1200), 6553, np.uint16))
    dataset = open_dataset("replica", folder)
    assert dataset.camera == PinholeCamera(1200, 680, 600.0, 600.0, 599.5, 339.5)
    assert dataset.depth_scale == 6553.5


@pytest.mark.parametrize(
    "name, focal, said",
    [
        ("rgbd_dataset_freiburg1_desk", 517.3, "freiburg1"),
        ("rgbd_dataset_freiburg2_xyz", 520.9, "freiburg2"),
        ("rgbd_dataset_freiburg3_office", 535.4, "freiburg3"),
        ("my_fridge1", 525.0, "ROS default"),
    ],
)
def test_tum_says_which_intrinsics_it_assumed(tmp_path, name, focal, said):
    folder = write_tum(tmp_path / name, make_samples(1))
    for file in (folder / "depth").iterdir():
        write_image(file, np.full((480, 640), 5000, np.uint16))
    dataset = open_dataset("tum", folder)
    assert dataset.camera.fx == focal
    assert any(said in warning for warning in dataset.warnings)


def test_folder_without_colour_and_poses(tmp_path):
    folder = write_folder(tmp_path, make_samples(2), poses="none")
    for file in (folder / "color").iterdir():
        file.unlink()
    (folder / "color").rmdir()
    frame = open_dataset("folder", folder)[1]
    assert frame.color is None and frame.T_world_camera is None


def test_folder_settings_are_used(tmp_path):
    samples = make_samples(1)
    folder = write_folder(tmp_path, samples, poses="none")
    (folder / "camera.yaml").write_text(
        CAMERA_YAML + "depth_scale: 5e3\ndepth_invalid: [0, 7]\nposes: vicon.txt\n"
    )
    (folder / "vicon.txt").write_text(numbers(samples[0].T_world_camera))
    units = np.full((12, 16), 10000, np.uint16)
    units[3, 4] = 7
    write_image(folder / "depth" / "000000.png", units)
    frame = open_dataset("folder", folder)[0]
    assert frame.depth[3, 4] == 0 and frame.depth[0, 0] == 2.0
    np.testing.assert_array_equal(frame.T_world_camera, samples[0].T_world_camera)


def test_folder_poses_by_time_stamp(tmp_path):
    samples = make_samples(3)
    folder = tmp_path
    (folder / "camera.yaml").write_text(CAMERA_YAML)
    for sample in samples:
        write_image(folder / "depth" / f"{sample.timestamp:.6f}.png", sample.units)
    rows = [tum_row(sample.T_world_camera, f"{sample.timestamp + 0.003:.4f}") for sample in samples]
    (folder / "poses.txt").write_text("# time tx ty tz qx qy qz qw\n" + "\n".join(reversed(rows)))
    for frame, sample in zip(open_dataset("folder", folder), samples, strict=True):
        np.testing.assert_allclose(
            frame.T_world_camera, sample.T_world_camera, rtol=0, atol=TEXT_POSE
        )
        assert frame.timestamp == pytest.approx(sample.timestamp, abs=1e-6)


def test_folder_counts_like_people(tmp_path):
    samples = make_samples(11)
    (tmp_path / "camera.yaml").write_text(CAMERA_YAML)
    for i, sample in enumerate(samples):
        # shot10 follows shot9, not shot1
        write_image(tmp_path / "depth" / f"shot{i}.png", sample.units)
    (tmp_path / "poses.txt").write_text(
        "\n".join(numbers(sample.T_world_camera) for sample in samples)
    )
    dataset = open_dataset("folder", tmp_path)
    np.testing.assert_array_equal(dataset[10].depth, samples[10].metres(1000.0))
    np.testing.assert_array_equal(dataset[2].T_world_camera, samples[2].T_world_camera)


def test_folder_resizes_colour_of_the_same_shape(tmp_path):
    samples = make_samples(1)
    folder = write_folder(tmp_path, samples)
    write_image(folder / "color" / "000000.png", enlarged(samples[0].color))
    np.testing.assert_array_equal(open_dataset("folder", folder)[0].color, samples[0].color)
