"""What a person gets who names the wrong format, folder, option or camera: one sentence with what,
where and what to do.
"""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from dataset_writers import (
    CAMERA,
    CAMERA_YAML,
    make_samples,
    matrix_text,
    write_folder,
    write_image,
    write_replica,
    write_scannet,
    write_scannet_flat,
    write_sens,
    write_seven_scenes,
    write_tum,
)

from taichi_unifusion.datasets import FORMATS, open_dataset
from taichi_unifusion.errors import DatasetError, InputError
from taichi_unifusion.types import PinholeCamera

FILE_FORMATS = sorted(set(FORMATS) - {"synthetic", "scene"})


@pytest.mark.parametrize(
    "wrong, right",
    [("7-scenes", "7scenes"), ("TUM", "tum"), ("replika", "replica"), ("scan-net", "scannet")],
)
def test_wrong_format_prints_the_right_ones(tmp_path, wrong, right):
    with pytest.raises(DatasetError, match=f"did you mean '{right}'") as caught:
        open_dataset(wrong, tmp_path)
    assert all(name in str(caught.value) for name in FORMATS)


def test_wrong_option_prints_the_right_ones(tmp_path):
    folder = write_seven_scenes(tmp_path, make_samples(1))
    with pytest.raises(
        InputError, match="option 'depthscale' is unknown.*did you mean 'depth_scale'.*camera"
    ):
        open_dataset("7scenes", folder, depthscale=1000)


@pytest.mark.parametrize("name", FILE_FORMATS)
def test_missing_path(tmp_path, name):
    for wrong in ("nowhere", "long" * 100, "NUL\0"):
        with pytest.raises(DatasetError, match="no such file or folder"):
            open_dataset(name, tmp_path / wrong)
    with pytest.raises(DatasetError, match="needs the path"):
        open_dataset(name)


@pytest.mark.parametrize(
    "name, searched",
    [
        ("7scenes", "frame-XXXXXX"),
        ("replica", "depthXXXXXX.png"),
        ("tum", "depth.txt"),
        ("scannet", "depth/N.png"),
        ("folder", "camera.yaml"),
        ("2d3ds", "camera_UUID_ROOM_frame_N_domain_depth.png"),
    ],
)
def test_S4_empty_folder_names_the_pattern_searched(tmp_path, name, searched):
    with pytest.raises(DatasetError) as caught:
        open_dataset(name, tmp_path)
    assert searched in str(caught.value) and str(tmp_path) in str(caught.value)


@pytest.mark.parametrize("name", FILE_FORMATS)
def test_S4_a_file_where_a_folder_belongs(tmp_path, name):
    (tmp_path / "file").write_text("hello")
    with pytest.raises(DatasetError, match="file"):
        open_dataset(name, tmp_path / "file")


def test_S4_nothing_can_be_read(tmp_path):
    folder = write_seven_scenes(tmp_path, make_samples(2))
    for file in folder.glob("*.depth.png"):
        file.write_bytes(b"")
    with pytest.raises(
        DatasetError,
        match="none of 2 depth images can be read .first: .*000000.depth.png: the file is empty",
    ):
        open_dataset("7scenes", folder)


def test_S4_scene_of_several_sequences_names_them(tmp_path):
    for sequence in ("seq-01", "seq-03"):
        write_seven_scenes(tmp_path / sequence, make_samples(1))
    with pytest.raises(DatasetError, match="open one of them: seq-01, seq-03"):
        open_dataset("7scenes", tmp_path)


def test_S4_several_containers_are_named(tmp_path):
    file = write_sens(tmp_path, make_samples(1)) / "scene0000_00.sens"
    (tmp_path / "scene0000_01.sens").write_bytes(file.read_bytes())
    with pytest.raises(DatasetError, match="scene0000_00.sens, scene0000_01.sens"):
        open_dataset("scannet", tmp_path)


@pytest.mark.parametrize(
    "K, said",
    [
        (np.diag([0.0, 14, 1]), "must be positive"),
        (np.diag([-15.0, 14, 1]), "must be positive"),
        (np.diag([np.nan, 14, 1]), "finite"),
        (np.array([[15.0, 0, 400], [0, 14, 6], [0, 0, 1]]), "intrinsics of another resolution"),
        (np.eye(2), "expected a 3x3 or 4x4 intrinsic matrix, found 4 numbers"),
    ],
)
@pytest.mark.parametrize(
    "name, write, file",
    [
        ("7scenes", write_seven_scenes, "camera-intrinsics.txt"),
        ("scannet", write_scannet, "intrinsic/intrinsic_depth.txt"),
    ],
)
def test_C1_impossible_intrinsics_name_their_file(tmp_path, name, write, file, K, said):
    folder = write(tmp_path, make_samples(1))
    (folder / file).write_text(matrix_text(K))
    with pytest.raises(DatasetError, match=said) as caught:
        open_dataset(name, folder)
    assert file in str(caught.value)


@pytest.mark.parametrize(
    "change, said",
    [
        (("fx: 15.0", "fx: 0"), "must be positive"),
        (("cx: 7.5", "cx: 99"), "another resolution"),
        (("width: 16", "width: 640"), "for 640x12 images but the depth images are 16x12"),
    ],
)
def test_C1_camera_yaml(tmp_path, change, said):
    folder = write_folder(tmp_path, make_samples(1))
    (folder / "camera.yaml").write_text(CAMERA_YAML.replace(*change))
    with pytest.raises(DatasetError, match=f"camera.yaml: .*{said}"):
        open_dataset("folder", folder)


def test_C1_replica_parameters(tmp_path):
    folder = write_replica(tmp_path, make_samples(1))
    good = (folder / "cam_params.json").read_text()
    for text, said in (
        (good.replace('"fx": 15.0', '"fx": -1'), "must be positive"),
        (good.replace('"fx"', '"f"'), "no 'fx' in it"),
        (good[:30], "not the camera"),
        ("[1, 2]", "not the camera"),
        (good.replace("6553.5", "0"), "depth_scale must be"),
        (good.replace('"w": 16', '"w": 1200'), "1200x12 images but the depth images are 16x12"),
    ):
        (folder / "cam_params.json").write_text(text)
        with pytest.raises((DatasetError, InputError), match=said) as caught:
            open_dataset("replica", folder)
        assert str(tmp_path) in str(caught.value)


def test_C1_scannet_flat_info(tmp_path):
    folder = write_scannet_flat(tmp_path, make_samples(1))
    (folder / "_info.txt").write_text("m_calibrationDepthIntrinsic = 0 0 7.5 0 0 14 5.5\n")
    with pytest.raises(DatasetError, match="_info.txt: camera: fx, fy must be positive"):
        open_dataset("scannet", folder)
    (folder / "_info.txt").unlink()
    with pytest.raises(DatasetError, match="_info.txt: no m_calibrationDepthIntrinsic there"):
        open_dataset("scannet", folder)
    assert open_dataset("scannet", folder, camera=CAMERA)[0].depth.any()


def test_C1_scannet_without_intrinsics(tmp_path):
    folder = write_scannet(tmp_path, make_samples(1))
    (folder / "intrinsic" / "intrinsic_depth.txt").unlink()
    with pytest.raises(DatasetError, match="no intrinsic/intrinsic_depth.txt"):
        open_dataset("scannet", folder)


@pytest.mark.parametrize(
    "name, write",
    [
        ("7scenes", write_seven_scenes),
        ("replica", write_replica),
        ("tum", write_tum),
        ("scannet", write_scannet),
        ("scannet", write_sens),
        ("folder", write_folder),
    ],
)
def test_C1_a_camera_of_another_resolution_is_refused(tmp_path, name, write):
    folder = write(tmp_path, make_samples(1))
    with pytest.raises(DatasetError, match="640x480.*16x12"):
        open_dataset(name, folder, camera=PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5))


def test_C1_an_odd_principal_point_is_said(tmp_path):
    folder = write_seven_scenes(tmp_path, make_samples(1))
    (folder / "camera-intrinsics.txt").write_text(
        matrix_text(np.array([[15.0, 0, 2], [0, 14, 5.5], [0, 0, 1]]))
    )
    assert any(
        "far from the centre" in warning for warning in open_dataset("7scenes", folder).warnings
    )


@pytest.mark.parametrize(
    "text, said",
    [
        (
            CAMERA_YAML + "depth_scael: 5000\n",
            "unknown key 'depth_scael' .did you mean 'depth_scale'",
        ),
        (CAMERA_YAML.replace("fx: 15.0\n", ""), "no fx in it"),
        (CAMERA_YAML.replace("15.0", "wide"), "camera.yaml: fx: expected a number, got 'wide'"),
        (CAMERA_YAML.replace("15.0", "true"), "fx: expected a number, got True"),
        (CAMERA_YAML.replace("15.0", "[1, 2]"), r"fx: expected a number, got \[1, 2\]"),
        (CAMERA_YAML.replace("16", "16.5"), "width: expected a whole number, got 16.5"),
        (CAMERA_YAML + "depth_invalid: 0\n", "depth_invalid: expected a list"),
        (
            CAMERA_YAML + "depth_invalid: [0, x]\n",
            r"depth_invalid\[1\]: expected a whole number, got 'x'",
        ),
        (CAMERA_YAML + "depth_scale: -1\n", "depth_scale must be a positive number"),
        (CAMERA_YAML + "poses: vicon.txt\n", "vicon.txt: no such file"),
        (CAMERA_YAML + f"poses: {'long' * 100}\n", "longlong: cannot be read"),
        (CAMERA_YAML + 'poses: "a\\0b"\n', "cannot be read"),
        (CAMERA_YAML + "poses: 5\n", "poses: expected text, got 5"),
        ("- 1\n- 2\n", "expected lines of the form"),
        ("", "expected lines of the form"),
        ("fx: [1\n", "line 2: not valid YAML"),
        ("fx: 2001-99-99\n", "not valid YAML"),
        (f"fx: {'9' * 5000}\n", "not valid YAML"),
        (CAMERA_YAML.replace("15.0", "9" * 400), "fx: expected a number"),
        ("fx: !!python/object/apply:os.system ['true']\n", "line 1: not valid YAML"),
        ("a: &a [x, x]\nb: &b [*a, *a]\nfx: *b\n", "aliases"),
        ("x" * 70_000, "is it another file"),
        (CAMERA_YAML + "fx: 16\n", "line [0-9]+: not valid YAML .key 'fx' is given twice"),
        ("[" * 10_000, "nested values"),
        ("a:\n" + "- " * 5_000, "nested values"),
    ],
)
def test_camera_yaml_is_strict_and_names_the_key(tmp_path, text, said):
    folder = write_folder(tmp_path, make_samples(1))
    (folder / "camera.yaml").write_text(text)
    with pytest.raises((DatasetError, InputError), match=said):
        open_dataset("folder", folder)


def test_folder_ambiguities_are_refused(tmp_path):
    folder = write_folder(tmp_path, make_samples(2))
    (folder / "poses.txt").write_text("1 2 3\n")
    with pytest.raises(DatasetError, match="both poses.txt and poses/"):
        open_dataset("folder", folder)
    (folder / "camera.yaml").write_text(CAMERA_YAML + "poses: poses.txt\n")
    with pytest.raises(
        DatasetError, match="poses.txt, line 1: expected 8 columns .* or 12 .* or 16 .* found 3"
    ):
        open_dataset("folder", folder)
    (folder / "poses.txt").write_text("img1 0 0 0 0 0 0 1\nimg1 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match="line 2: 'img1' appears again"):
        open_dataset("folder", folder)
    (folder / "poses.txt").write_text("img1 0 0 0 0 0 0 1\n")
    with pytest.raises(DatasetError, match="frame's name like '000000', but is 'img1'"):
        open_dataset("folder", folder)
    (folder / "camera.yaml").write_text(CAMERA_YAML + "poses: poses\n")
    write_image(folder / "color" / "000000.jpg", np.zeros((12, 16, 3), np.uint8))
    with pytest.raises(DatasetError, match="000000.* two files of one name"):
        open_dataset("folder", folder)


def test_folder_with_a_camera_of_the_caller_needs_no_file(tmp_path):
    folder = write_folder(tmp_path, make_samples(1))
    (folder / "camera.yaml").unlink()
    assert open_dataset("folder", folder, camera=CAMERA)[0].depth.any()


def test_formats_are_imported_only_when_asked_for():
    code = (
        "import sys, taichi_unifusion.datasets\n"
        "print([name for name in ('cv2', 'yaml', 'taichi', 'open3d', 'torch') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
