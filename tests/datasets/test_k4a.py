"""Azure Kinect recordings: written small with a scene that is known exactly, and the real one where
it is at hand.
"""

from __future__ import annotations

import builtins
import json

import cv2
import k4a_writer as scene
import numpy as np
import pytest

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import (
    DatasetError,
    FrameError,
    InputError,
    MissingDependency,
    PoseError,
)
from taichi_unifusion.files.k4a_container import read_images

pytest.importorskip("av", reason="recordings of an Azure Kinect are read with PyAV, extra 'k4a'")

# [m] half a pixel on planes tilted by 0.08 to the colour camera, and millimetres in the file
EXACT = 2e-3
JPEG = 8  # of 255: one colour in a block, and its edge a block away
EDGE = 9  # pixels: a block of JPEG, beside which colours mix
ALIGNMENTS = ("depth", "color")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return scene.write_k4a(tmp_path_factory.mktemp("k4a") / "recording.mkv")


def points_in_depth_camera(frame, align: str) -> np.ndarray:
    """(N, 3) [m] of all readings, in the frame of the depth camera."""
    v, u = np.nonzero(frame.depth)
    z = frame.depth[v, u].astype(float)
    points = np.column_stack(
        [
            (u - frame.camera.cx) / frame.camera.fx * z,
            (v - frame.camera.cy) / frame.camera.fy * z,
            z,
        ]
    )
    if align == "color":
        T = np.linalg.inv(scene.T_COLOR_DEPTH)
        points = points @ T[:3, :3].T + T[:3, 3]
    return points


@pytest.mark.parametrize("align", ALIGNMENTS)
def test_depth_lies_where_the_scene_is(recording, align):
    """Calibration, distortion and registration together: every reading is on the wall or on the
    board.
    """
    frame = open_dataset("k4a", recording, align=align)[0]
    points = points_in_depth_camera(frame, align)
    on_board = np.abs(points[:, 2] - scene.BOARD) < EXACT
    assert len(points) > 0.3 * frame.depth.size
    assert (on_board | (np.abs(points[:, 2] - scene.WALL) < EXACT)).all()
    low, high = points[on_board, :2].min(axis=0), points[on_board, :2].max(axis=0)
    pixel = 2 * scene.BOARD / frame.camera.fx
    assert np.abs(np.array([low, high]) - scene.BOARD_CORNERS).max() < pixel


@pytest.mark.parametrize("align", ALIGNMENTS)
def test_colour_and_infrared_are_registered_to_depth(recording, align):
    """What lies on the board has the board's colour and infrared, but for a rim where JPEG and
    resampling mix.
    """
    frame = open_dataset("k4a", recording, align=align)[1]
    board = (frame.depth > 0) & (frame.depth < (scene.BOARD + scene.WALL) / 2)
    inner = cv2.erode(np.uint8(board), np.ones((2 * EDGE + 1,) * 2)) > 0
    outer = (frame.depth > 0) & (cv2.dilate(np.uint8(board), np.ones((2 * EDGE + 1,) * 2)) == 0)
    assert inner.sum() > 1000 and outer.sum() > 10_000
    assert np.abs(frame.color[inner].astype(int) - scene.BOARD_COLOR).max() <= JPEG
    assert np.abs(frame.color[outer].astype(int) - scene.WALL_COLOR).max() <= JPEG
    infrared = frame.images["infrared"][..., 0]
    assert infrared.dtype == np.float32 and frame.images["infrared"].shape == (
        *frame.depth.shape,
        1,
    )
    # frame 1 is one unit brighter
    np.testing.assert_allclose(infrared[inner], scene.BOARD_INFRARED + 1, rtol=1e-3)
    np.testing.assert_allclose(infrared[outer], scene.WALL_INFRARED + 1, rtol=1e-3)


def test_what_the_colour_camera_does_not_see_has_no_depth(recording):
    """The colour camera stands to the right of the depth camera's: the board hides a strip of wall
    from it, on the board's other side, that the depth camera sees."""
    frame = open_dataset("k4a", recording)[0]
    row = int(frame.camera.cy)
    board = np.flatnonzero((frame.depth[row] > 0) & (frame.depth[row] < 1.6))
    hidden = 0.032 * (1 / scene.BOARD - 1 / scene.WALL) * frame.camera.fx  # pixels
    sides = [
        np.argmax(frame.depth[row, edge::step] > 1.6)
        for edge, step in ((board[0], -1), (board[-1], 1))
    ]
    assert abs(max(sides) - hidden) < 3 and min(sides) <= 2
    assert (frame.color[row, board[0] - 20 : board[-1] + 20] > 0).any(axis=1).all(), (
        "the picture itself has no holes"
    )


def test_frames_have_times_and_the_first_has_a_pose(recording):
    dataset = open_dataset("k4a", recording)
    assert len(dataset) == 3 and dataset.sizes["DEPTH"] == scene.DEPTH_SIZE
    assert dataset.warnings == (
        "there is no recording.txt with poses beside recording.mkv: the first frame's camera is the "
        "world, and the other frames have no pose (--tracking rgbd finds them)",
    )
    frames = list(dataset)
    np.testing.assert_allclose(
        [frame.timestamp for frame in frames], 0.463 + 0.2 * np.arange(3), atol=1e-9
    )
    np.testing.assert_array_equal(frames[0].T_world_camera, np.eye(4))
    assert frames[1].T_world_camera is None
    np.testing.assert_array_equal(dataset[1].depth, frames[1].depth)  # in any order


def test_poses_come_from_a_file_beside_it(tmp_path):
    recording = scene.write_k4a(tmp_path / "walk.mkv")
    (tmp_path / "walk.txt").write_text(
        "# timestamp tx ty tz qx qy qz qw\n0.464 1 2 3 0 0 0 1\n0.66 1.1 2 3 0 0 0 1\n"
    )
    dataset = open_dataset("k4a", recording)
    np.testing.assert_array_equal([dataset[i].T_world_camera[0, 3] for i in (0, 1)], [1, 1.1])
    with pytest.raises(PoseError, match=r"walk.txt: no pose within 0.02 s of the frame"):
        dataset[2]
    assert "1 of 3 frames have no usable pose" in dataset.warnings[0]


@pytest.mark.parametrize(
    ("tracks", "color", "infrared"),
    [(("DEPTH",), False, False), (("DEPTH", "IR"), False, True), (("COLOR", "DEPTH"), True, False)],
)
def test_a_recording_may_lack_colour_or_infrared(tmp_path, tracks, color, infrared):
    dataset = open_dataset("k4a", scene.write_k4a(tmp_path / "some.mkv", 1, tracks=tracks))
    frame = dataset[0]
    assert (frame.color is not None, "infrared" in frame.images) == (color, infrared)
    np.testing.assert_allclose(np.unique(frame.depth)[-2:], [scene.BOARD, scene.WALL], atol=1e-6)
    if not color:
        with pytest.raises(DatasetError, match="align 'color' needs a colour track"):
            open_dataset("k4a", tmp_path / "some.mkv", align="color")


def test_a_recording_that_is_none_is_said(tmp_path, recording):
    def told(match, path):
        with pytest.raises(DatasetError, match=match):
            open_dataset("k4a", path)

    (tmp_path / "text.mkv").write_text("not a recording")
    told("text.mkv: not a readable Matroska recording", tmp_path / "text.mkv")
    told(
        r"has no track DEPTH \(it has COLOR\); give",
        scene.write_k4a(tmp_path / "color.mkv", 1, tracks=("COLOR",)),
    )
    told(
        "track DEPTH is rgb555le, not 16-bit big-endian",
        scene.write_k4a(tmp_path / "little.mkv", 1, big_endian=False),
    )
    told(
        "no calibration.json is attached", scene.write_k4a(tmp_path / "none.mkv", 1, attached=None)
    )
    told(
        r"calibration.json: not the factory calibration .*JSONDecodeError",
        scene.write_k4a(tmp_path / "bad.mkv", 1, attached=b"{"),
    )
    spoiled = scene.calibration()
    spoiled["CalibrationInformation"]["Cameras"][1]["Rt"]["Rotation"][0] = 2.0
    told(
        r"not the factory calibration .*T_color_depth: not a rotation",
        scene.write_k4a(tmp_path / "skew.mkv", 1, attached=json.dumps(spoiled).encode()),
    )
    with pytest.raises(
        InputError,
        match="'align': 'colour' is unknown .did you mean 'color'..; choose one of depth, color",
    ):
        open_dataset("k4a", recording, align="colour")


def test_I4_a_recording_that_is_cut_off_gives_the_frames_before_the_cut(tmp_path, recording):
    data = recording.read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(data[: int(0.72 * len(data))])
    dataset = open_dataset("k4a", cut)
    assert 2 <= len(dataset) <= 3
    np.testing.assert_array_equal(dataset[0].depth, open_dataset("k4a", recording)[0].depth)
    if len(dataset) == 3:
        with pytest.raises(FrameError, match="cut.mkv frame 2"):
            dataset[2]


def test_I1_tags_that_are_no_text_harm_nothing(tmp_path, recording):
    data = recording.read_bytes()
    odd = tmp_path / "odd.mkv"
    odd.write_bytes(data.replace(b"Lavf", b"La\xfff"))
    assert odd.read_bytes() != data
    np.testing.assert_array_equal(
        open_dataset("k4a", odd)[0].depth, open_dataset("k4a", recording)[0].depth
    )


def test_I1_a_track_of_an_unknown_codec_is_one_sentence(tmp_path, recording):
    data = recording.read_bytes()
    odd = tmp_path / "odd.mkv"
    odd.write_bytes(data.replace(b"V_MJPEG", b"V_NJPEG"))
    assert odd.read_bytes() != data
    with pytest.raises(DatasetError, match="odd.mkv: track COLOR is of a codec that is not known"):
        open_dataset("k4a", odd)


def test_without_pyav_one_sentence_says_what_to_install(recording, monkeypatch):
    real = builtins.__import__

    def without(name, *args, **kwargs):
        if name == "av":
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependency, match=r"pip install .taichi-unifusion\[k4a\]"):
        open_dataset("k4a", recording)


def test_the_real_recording(data):
    folder = data("k4a-infrared")
    dataset = open_dataset("k4a", folder / "recording.mkv")
    assert len(dataset) == 1
    camera = dataset.camera
    np.testing.assert_allclose(
        [camera.fx, camera.fy, camera.cx, camera.cy], [504.61, 504.73, 332.78, 348.83], atol=0.01
    )
    color = dataset.calibration.color.pinhole
    np.testing.assert_allclose(
        [color.fx, color.fy, color.cx, color.cy], [611.80, 611.93, 639.30, 365.85], atol=0.01
    )
    raw = read_images(dataset.path, dataset.captures[0].stamps, "frame")
    for title, name in (("DEPTH", "depth.png"), ("IR", "ir.png")):
        np.testing.assert_array_equal(
            raw[title], cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED)
        )
    frame = dataset[0]
    mug = frame.images["infrared"][..., 0] > 20_000  # white china near the camera
    assert (
        np.median(frame.depth[mug & (frame.depth > 0)])
        < 0.3
        < np.median(frame.depth[~mug & (frame.depth > 0)])
    )
