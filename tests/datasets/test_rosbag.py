"""Bags of ROS 1 and 2: written small, read back exactly; cut off, ambiguous, and without what they need."""

from __future__ import annotations

import builtins
import tempfile
from pathlib import Path

import bag_writer as bags
import cv2
import numpy as np
import pytest
from dataset_writers import CAMERA, PERIOD, START, make_pose, make_samples

from taichi_unifusion.datasets import known_format, open_dataset
from taichi_unifusion.errors import DatasetError, FrameError, MissingDependency, PoseError
from taichi_unifusion.files import packed_files
from taichi_unifusion.types import PinholeCamera

pytest.importorskip("rosbags", reason="bags are read with rosbags, extra 'ros'")
STEP = 1e-9  # of a pose: a stamp counts nanoseconds


@pytest.fixture(scope="module")
def samples():
    return make_samples(4)


def check_frames(dataset, samples):
    assert len(dataset) == len(samples)
    for frame, sample in zip(dataset, samples, strict=True):
        np.testing.assert_array_equal(frame.depth, sample.metres(1000))
        np.testing.assert_array_equal(frame.color, sample.color)
        np.testing.assert_allclose(frame.T_world_camera, sample.T_world_camera, atol=STEP)
        assert frame.timestamp == pytest.approx(sample.timestamp, abs=1e-9)
        assert frame.camera == CAMERA


@pytest.mark.parametrize("container", [*bags.CONTAINERS, "db3-message"])
def test_every_container_gives_the_same_frames(container, samples, tmp_path):
    path = bags.write_bag(tmp_path / "recording", bags.recording(samples), container)
    dataset = open_dataset("rosbag", path)
    check_frames(dataset, samples)
    assert dataset.registered and not dataset.warnings
    if path.is_dir() and container != "db3-message":  # the file alone does as well
        check_frames(open_dataset("rosbag", next(path.glob("recording*.*"))), samples)


def depth_messages(units: np.ndarray, kind: str) -> bags.Message:
    metres = units.astype(np.float32) / np.float32(1000)
    metres[units == 65535], metres[units == 0] = np.nan, 0
    topic = f"{bags.DEPTH}/compressedDepth"
    return {
        "16UC1": lambda: bags.image(bags.DEPTH, units, "16UC1", START),
        "mono16": lambda: bags.image(bags.DEPTH, units, "mono16", START),
        "32FC1": lambda: bags.image(bags.DEPTH, metres, "32FC1", START),
        "16UC1 big-endian": lambda: bags.image(bags.DEPTH, units, "16UC1", START, big_endian=True),
        "32FC1 big-endian": lambda: bags.image(bags.DEPTH, metres, "32FC1", START, big_endian=True),
        "16UC1 padded": lambda: bags.image(bags.DEPTH, units, "16UC1", START, padding=7),
        "32FC1 padded": lambda: bags.image(bags.DEPTH, metres, "32FC1", START, padding=5),
        "png": lambda: bags.compressed(
            topic, bags.depth_png(units), "16UC1; compressedDepth png", START
        ),
        "png, as it was said before": lambda: bags.compressed(
            topic, bags.depth_png(units), "16UC1; compressedDepth", START
        ),
        "png, unsaid": lambda: bags.compressed(topic, bags.depth_png(units), "16UC1", START),
        "rvl": lambda: bags.compressed(
            topic, bags.depth_rvl(units), "16UC1; compressedDepth rvl", START
        ),
    }[kind]()


ENCODINGS = ["16UC1", "mono16", "32FC1", "16UC1 big-endian", "32FC1 big-endian", "16UC1 padded"] + [
    "32FC1 padded",
    "png",
    "png, as it was said before",
    "png, unsaid",
    "rvl",
]


@pytest.mark.parametrize("kind", ENCODINGS)
@pytest.mark.parametrize("container", ["bag", "db3"])
def test_i3_every_encoding_of_depth_gives_the_same_array(kind, container, samples, tmp_path):
    messages = [bags.camera_info("/camera/depth/camera_info", START)]
    messages.append(depth_messages(samples[0].units, kind))
    frame = open_dataset("rosbag", bags.write_bag(tmp_path / "b", messages, container))[0]
    np.testing.assert_array_equal(frame.depth, samples[0].metres(1000))


def test_floats_that_the_transport_quantises_come_back(tmp_path):
    """It keeps A / z + B as 16 bits, finer for what is near."""
    metres = np.linspace(0.5, 5, CAMERA.width * CAMERA.height).reshape(CAMERA.height, CAMERA.width)
    a, b = 100.0 * 101.0, 1 - 100.0 * 101.0 / 10.0
    units = np.rint(a / metres + b).astype(np.uint16)
    units[0, :2] = 0
    topic, form = f"{bags.DEPTH}/compressedDepth", "32FC1; compressedDepth png"
    messages = [
        bags.camera_info("/camera/depth/camera_info", START),
        bags.compressed(topic, bags.depth_png(units, a, b), form, START),
    ]
    depth = open_dataset("rosbag", bags.write_bag(tmp_path / "b", messages))[0].depth
    assert (depth[0, :2] == 0).all()
    step = metres**2 / a  # of one unit
    assert (np.abs(depth - metres) <= 0.51 * step)[1:].all()


@pytest.mark.parametrize(
    ("encoding", "make"),
    [
        ("bgr8", lambda color: color[..., ::-1].copy()),
        ("rgba8", lambda color: np.dstack([color, color[..., 0]])),
        ("bgra8", lambda color: np.dstack([color[..., ::-1], color[..., 0]])),
    ],
)
def test_colours_come_back(encoding, make, samples, tmp_path):
    messages = bags.recording(samples[:1])
    messages[-1] = bags.image(bags.COLOR, make(samples[0].color), encoding, START)
    frame = open_dataset("rosbag", bags.write_bag(tmp_path / "b", messages))[0]
    np.testing.assert_array_equal(frame.color, samples[0].color)


def test_grey_and_compressed_colour(samples, tmp_path):
    grey = samples[0].color[..., 0].copy()
    png = cv2.imencode(".png", samples[1].color[..., ::-1])[1].tobytes()
    messages = [
        *bags.recording(samples[:1])[:3],
        bags.image(bags.COLOR, grey, "mono8", START),
    ]
    frame = open_dataset("rosbag", bags.write_bag(tmp_path / "grey", messages))[0]
    np.testing.assert_array_equal(frame.color, np.dstack([grey] * 3))
    topic = f"{bags.COLOR}/compressed"
    messages[-1] = bags.compressed(topic, png, "rgb8; png compressed bgr8", START)
    frame = open_dataset("rosbag", bags.write_bag(tmp_path / "png", messages, "mcap"))[0]
    np.testing.assert_array_equal(frame.color, samples[1].color)


def test_poses_are_interpolated_at_the_stamp_along_the_chain(samples, tmp_path):
    """Half way between two transforms the camera is turned by half; fixed ones lead on to it."""
    first, last = np.eye(4), np.eye(4)
    last[:3, :3] = cv2.Rodrigues(np.array([0.2, 0.4, -0.1]))[0]
    last[:3, 3] = 0.4, -0.2, 0.1
    half = np.eye(4)
    half[:3, :3] = cv2.Rodrigues(np.array([0.1, 0.2, -0.05]))[0]
    half[:3, 3] = 0.2, -0.1, 0.05
    mount = make_pose(3)
    messages = [
        bags.transform(first, START, "/map", "base"),
        bags.transform(mount, START, "base", bags.OPTICAL, static=True),
        bags.transform(last, START + 0.5, "map", "/base"),
        bags.camera_info("/camera/depth/camera_info", START),
        bags.image(bags.DEPTH, samples[0].units, "16UC1", START + 0.25, f"/{bags.OPTICAL}"),
        bags.image(bags.DEPTH, samples[1].units, "16UC1", START + 0.9, bags.OPTICAL),
    ]
    dataset = open_dataset("rosbag", bags.write_bag(tmp_path / "b", messages))
    # float64 seconds of a time stamp are 2e-7 fine, of half a second
    np.testing.assert_allclose(dataset[0].T_world_camera, half @ mount, atol=1e-6)
    with pytest.raises(PoseError, match="no pose near"):
        dataset[1]
    assert "1 of 2 frames have no usable pose" in dataset.warnings[0]
    assert dataset.without_poses()[1].T_world_camera is None


def test_poses_of_a_topic(samples, tmp_path):
    mount, images = make_pose(2), bags.recording(samples)
    images = [message for message in images if message.topic != "/tf"]
    moves = [bags.odometry(sample.T_world_camera, sample.timestamp, "base") for sample in samples]
    fixed = bags.transform(mount, START, "base", static=True)
    dataset = open_dataset("rosbag", bags.write_bag(tmp_path / "a", [*images, fixed, *moves]))
    for frame, sample in zip(dataset, samples, strict=True):
        np.testing.assert_allclose(frame.T_world_camera, sample.T_world_camera @ mount, atol=STEP)
    with pytest.raises(DatasetError, match="no transforms lead from there to the camera's frame"):
        open_dataset("rosbag", bags.write_bag(tmp_path / "b", [*images, *moves]))
    stamped = [bags.pose_stamped(s.T_world_camera, s.timestamp) for s in samples]
    path = bags.write_bag(tmp_path / "c", [*images, *stamped], "mcap")
    check_frames(open_dataset("rosbag", path), samples)
    path = bags.write_bag(tmp_path / "d", [*images, fixed, *stamped, *moves], "db3")
    with pytest.raises(DatasetError, match=r"2 topics hold poses; .*pose_topic=, of /odom, /pose"):
        open_dataset("rosbag", path)
    check_frames(open_dataset("rosbag", path, pose_topic="/pose"), samples)
    with pytest.raises(DatasetError, match="no transforms that change lead"):
        open_dataset("rosbag", path, pose_topic="tf")
    bare = open_dataset("rosbag", bags.write_bag(tmp_path / "e", images))
    assert bare[0].T_world_camera is None and "no transforms (tf)" in bare.no_poses


def test_a_world_can_be_chosen(samples, tmp_path):
    messages = bags.recording(samples)
    up = make_pose(1)
    for sample in samples:  # the map drifts against the odometry
        messages.append(bags.transform(up, sample.timestamp, "earth", "map"))
        up = up @ make_pose(1)
    path = bags.write_bag(tmp_path / "b", messages)
    check_frames(open_dataset("rosbag", path, world_frame="map"), samples)
    first = open_dataset("rosbag", path)[0].T_world_camera
    np.testing.assert_allclose(first, make_pose(1) @ samples[0].T_world_camera, atol=STEP)
    with pytest.raises(DatasetError, match=r"no transforms lead from 'mapp' .*only from 'earth'"):
        open_dataset("rosbag", path, world_frame="mapp")


def test_topics_that_could_be_meant_are_listed(samples, tmp_path):
    messages = bags.recording(samples)
    for sample in samples:
        messages += [
            bags.image("/left/depth", sample.units, "16UC1", sample.timestamp, "left"),
            bags.image("/infra1/image_raw", sample.units, "mono16", sample.timestamp, "infra"),
            bags.camera_info("/left/camera_info", sample.timestamp, "left"),
        ]
    path = bags.write_bag(tmp_path / "b", messages)
    told = r"2 topics hold depth images; .*depth_topic=, of /camera/depth/image_raw \(16x12, 4 images\), /left"
    with pytest.raises(DatasetError, match=told):
        open_dataset("rosbag", path)
    check_frames(open_dataset("rosbag", path, depth_topic=bags.DEPTH), samples)
    with pytest.raises(DatasetError, match="depth_topic '/dept' is none of"):
        open_dataset("rosbag", path, depth_topic="/dept")
    bare = open_dataset("rosbag", path, depth_topic=bags.DEPTH, color_topic="none")
    assert bare[0].color is None
    with pytest.raises(DatasetError, match="no CameraInfo under '/x'; there are /camera/depth"):
        open_dataset("rosbag", path, depth_topic=bags.DEPTH, camera_topic="/x")


def test_depth_that_is_registered_to_colour_comes_first(samples, tmp_path):
    messages = bags.recording(samples)
    for sample in samples:
        messages.append(
            bags.image(
                "/camera/aligned_depth_to_color/image_raw",
                sample.units + np.uint16(1),
                "16UC1",
                sample.timestamp,
            )
        )
    messages.append(bags.camera_info("/camera/color/camera_info", START))
    path = bags.write_bag(tmp_path / "b", messages)
    dataset = open_dataset("rosbag", path)
    assert "aligned" in dataset.depth_topic.name and dataset.registered


def test_colour_of_another_camera_is_registered_by_tf(tmp_path):
    """A wall at 2 m: the colour camera, 10 cm to the right, sees a mark further to the left."""
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    finer = PinholeCamera(128, 96, 120.0, 120.0, 63.5, 47.5)
    units = np.full((48, 64), 2000, np.uint16)
    color = np.full((96, 128, 3), 50, np.uint8)
    color[40:56, 60:76] = 200  # [pixels] of the colour camera
    T_color_depth = np.eye(4)
    T_color_depth[0, 3] = -0.1
    messages = [
        bags.transform(np.linalg.inv(T_color_depth), START, "depth", "color", static=True),
        bags.transform(np.eye(4), START, "map", "depth"),
        bags.transform(make_pose(1), START + PERIOD, "map", "depth"),
        bags.camera_info("/camera/depth/camera_info", START, "depth", camera),
        bags.camera_info("/camera/color/camera_info", START, "color", finer),
        bags.image(bags.DEPTH, units, "16UC1", START, "depth"),
        bags.image(bags.COLOR, color, "rgb8", START, "color"),
    ]
    dataset = open_dataset("rosbag", bags.write_bag(tmp_path / "b", messages))
    assert dataset.registered and dataset.color_camera.pinhole == finer
    bright = np.argwhere(dataset[0].color[..., 0] > 125)
    # column 60..75 of the colour image is x = 2 (c - 63.5) / 120 there, 0.1 m more in the depth camera
    left = (2 * (60 - 63.5) / 120 + 0.1) * 60 / 2 + 31.5
    assert abs(bright[:, 1].min() - left) <= 1 and abs(bright[:, 0].min() - 20) <= 1
    untold = [message for message in messages if message.topic != "/tf_static"]
    path = bags.write_bag(tmp_path / "c", untold)
    assert (
        "is not in the bag; colour is taken as it is" in open_dataset("rosbag", path).warnings[-1]
    )


def test_distortion_is_taken_out(samples, tmp_path):
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    units = np.tile(np.arange(1000, 1064, dtype=np.uint16), (48, 1))
    D = (0.2, -0.1, 0.001, 0.002, 0.01)
    messages = [
        bags.camera_info("/camera/depth/camera_info", START, camera=camera, distortion=D),
        bags.image(bags.DEPTH, units, "16UC1", START),
    ]
    depth = open_dataset("rosbag", bags.write_bag(tmp_path / "b", messages))[0].depth
    rays = np.array([[-0.3, 0.2, 1.0]])
    seen = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.matrix, np.array(D))[0].ravel()
    straight = camera.project(rays)[0]
    found = depth[round(straight[1]), round(straight[0])]
    assert abs(found - (1.0 + 0.001 * seen[0])) < 2e-3 and abs(seen[0] - straight[0]) > 0.3
    messages[0] = bags.camera_info(
        "/camera/depth/camera_info", START, camera=camera, distortion=D[:4], model="equidistant"
    )
    with pytest.raises(DatasetError, match="the lens is 'equidistant'"):
        open_dataset("rosbag", bags.write_bag(tmp_path / "c", messages))


def test_sizes_that_change_are_said_and_intrinsics_follow(samples, tmp_path):
    small = samples[1].units[::2, ::2].copy()
    messages = [
        bags.camera_info("/camera/depth/camera_info", START),
        bags.image(bags.DEPTH, samples[0].units, "16UC1", START),
        bags.image(bags.DEPTH, small, "16UC1", START + PERIOD),
        bags.image(bags.DEPTH, samples[2].units[:4].copy(), "16UC1", START + 2 * PERIOD),
    ]
    dataset = open_dataset("rosbag", bags.write_bag(tmp_path / "b", messages))
    assert any("the size of the depth images" in sentence for sentence in dataset.warnings)
    assert dataset[1].camera == CAMERA.resized(8, 6)
    with pytest.raises(FrameError, match="16x4 but its camera 16x12, another shape"):
        dataset[2]


def test_a_bag_without_what_is_needed_says_so(samples, tmp_path):
    def opened(name, messages):
        return open_dataset("rosbag", bags.write_bag(tmp_path / name, messages))

    with pytest.raises(DatasetError, match=r"no topic of depth images .*; it has /tf"):
        opened("a", [bags.transform(np.eye(4), START, "map")])
    with pytest.raises(DatasetError, match="no CameraInfo for /camera/depth/image_raw"):
        opened("b", [bags.image(bags.DEPTH, samples[0].units, "16UC1", START)])
    with pytest.raises(DatasetError, match=r"a bag is a \.bag, \.db3 or \.mcap file"):
        (tmp_path / "x.txt").write_text("no bag")
        open_dataset("rosbag", tmp_path / "x.txt")
    with pytest.raises(DatasetError, match=r"no \.bag, \.db3 or \.mcap file here"):
        (tmp_path / "empty").mkdir()
        open_dataset("rosbag", tmp_path / "empty")
    camera = PinholeCamera(16, 12, 20.0, 20.0, 7.5, 5.5)
    path = bags.write_bag(
        tmp_path / "d", [bags.image(bags.DEPTH, samples[0].units, "16UC1", START)]
    )
    assert open_dataset("rosbag", path, camera=camera)[0].camera == camera


def test_without_rosbags_one_sentence_says_what_to_install(samples, tmp_path, monkeypatch):
    path = bags.write_bag(tmp_path / "b", bags.recording(samples))
    real = builtins.__import__

    def without(name, *arguments, **more):
        if name.startswith("rosbags"):
            raise ImportError(name)
        return real(name, *arguments, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependency, match=r"pip install 'taichi-unifusion\[ros\]'"):
        open_dataset("rosbag", path)


def pack(folder: Path, container: str, cut: int | None = None) -> Path:
    """As `ros2 bag record --compression-mode file` leaves it."""
    from backports import zstd

    (file,) = folder.glob(f"*.{container}")
    file.with_name(f"{file.name}.zstd").write_bytes(zstd.compress(file.read_bytes())[:cut])
    file.unlink()
    (folder / "metadata.yaml").write_text("compression_mode: FILE\ncompression_format: zstd\n")
    return folder


@pytest.mark.parametrize("container", ["db3", "mcap"])
def test_bags_that_are_packed_as_a_whole(container, samples, tmp_path, monkeypatch):
    """Unpacked into a temporary folder, which is gone when the bag is closed."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    folder = bags.write_bag(tmp_path / "recording", bags.recording(samples), container)
    pack(folder, container)
    for path in (folder, next(folder.glob("*.zstd"))):
        assert known_format("auto", path) == "rosbag"
        dataset = open_dataset("rosbag", path)
        check_frames(dataset, samples)
        assert len(list(tmp_path.glob("unifusion-*"))) == 1
        dataset.bag.close()
        assert not list(tmp_path.glob("unifusion-*"))


def test_a_packed_bag_that_is_damaged_or_a_bomb_is_refused(samples, tmp_path, monkeypatch):
    folder = bags.write_bag(tmp_path / "recording", bags.recording(samples), "db3")
    with pytest.raises(DatasetError, match="damaged or cut off"):
        open_dataset("rosbag", pack(folder, "db3", cut=20))
    monkeypatch.setattr(packed_files, "MOST_TIMES", 0)
    monkeypatch.setattr(packed_files, "MOST_MORE", 1000)
    folder = bags.write_bag(tmp_path / "other", bags.recording(samples), "db3")
    with pytest.raises(DatasetError, match="taken for damaged"):
        open_dataset("rosbag", pack(folder, "db3"))


@pytest.mark.parametrize("container", bags.CONTAINERS)
def test_i4_a_bag_that_is_cut_off_gives_the_frames_before_the_cut(container, tmp_path):
    samples = make_samples(60)
    first, last = bags.recording(samples[:30]), bags.recording(samples[30:])
    noise = np.random.default_rng(1).bytes(600_000).hex()  # ends the first chunk
    filler = bags.text("/noise", noise, samples[30].timestamp)
    path = bags.write_bag(tmp_path / "whole", [*first, filler, *last], container)
    file = path if path.is_file() else next(path.glob("whole*.*"))
    data, before = file.read_bytes(), 0
    for share in (0.02, 0.4, 0.7, 0.95):
        cut = tmp_path / f"cut{share}{file.suffix}"
        cut.write_bytes(data[: int(share * len(data))])
        try:
            dataset = open_dataset("rosbag", cut)
        except DatasetError as error:
            assert before == 0 and len(str(error)) < 500
            continue
        assert any("cut off" in sentence for sentence in dataset.warnings)
        by_time = {sample.timestamp: sample for sample in samples}
        whole = 0
        for i in range(len(dataset)):
            try:
                frame = dataset[i]
            except FrameError:
                continue
            sample = by_time[min(by_time, key=lambda time: abs(time - dataset.times[i]))]
            np.testing.assert_array_equal(frame.depth, sample.metres(1000))
            whole += 1
        assert whole >= before
        before = whole
    assert before >= 30  # compressed, a chunk that is cut gives less of itself, or nothing


@pytest.mark.parametrize("name", ["ros1-bag/tum3.bag", "ros2-mcap/tum3", "ros2-db3/tum3"])
def test_real_pixels_in_bags(name, data):
    dataset = open_dataset("rosbag", data("formats") / name)
    assert len(dataset) == 3 and dataset.registered and not dataset.no_poses
    for frame in dataset:
        valid = frame.depth[frame.depth > 0]
        assert len(valid) > 0.75 * frame.depth.size and 1.0 < valid.mean() < 1.3
        assert frame.color.shape[:2] == frame.depth.shape and frame.T_world_camera is not None
    assert any("changes" in sentence for sentence in dataset.warnings) == ("ros1" in name)
