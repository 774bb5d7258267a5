"""Frames that come as they are taken: none is invented or repeated, those that are dropped are counted."""

from __future__ import annotations

import json
import sys
import threading
import time

import numpy as np
import pytest
from dataset_writers import CAMERA, make_pose

import taichi_unifusion as uf
from taichi_unifusion.cli.main import main
from taichi_unifusion.datasets import Dataset
from taichi_unifusion.datasets.folder_writing import write_folder
from taichi_unifusion.datasets.live import LiveFrames, Replay
from taichi_unifusion.errors import DatasetError, FrameError, InputError, MissingDependency
from taichi_unifusion.tracking import make_tracker
from taichi_unifusion.tracking.live import TrackedFrames
from taichi_unifusion.types import Frame, PinholeCamera

SOON = 10.0  # [s] by which a busy machine has done what takes milliseconds


def frame(index: int, timestamp: float | None = None, pose: bool = True) -> Frame:
    depth = np.full((CAMERA.height, CAMERA.width), 1.0 + 0.01 * index, np.float32)
    color = np.full((CAMERA.height, CAMERA.width, 3), 100, np.uint8)
    T = make_pose(0) if pose else None
    return Frame(depth, CAMERA, color, T, index, timestamp, f"frame {index}")


def wait_for(condition) -> None:
    due = time.perf_counter() + SOON
    while not condition():
        assert time.perf_counter() < due, "it never came"
        time.sleep(0.002)


class Hand:
    """A source that gives what a test hands over."""

    def __init__(self):
        self.items, self.ended = [], False
        self.change = threading.Condition()

    def give(self, *items):
        with self.change:
            self.items += items
            self.change.notify_all()

    def __iter__(self):
        while True:
            with self.change:
                while not self.items and not self.ended:
                    self.change.wait(0.01)
                if not self.items:
                    return
                item = self.items.pop(0)
            if isinstance(item, Exception) and not isinstance(item, FrameError):
                raise item
            yield item


def test_the_oldest_frames_are_dropped_and_counted():
    source = Hand()
    with LiveFrames(source, "hand", capacity=2) as live:
        source.give(*(frame(i) for i in range(7)))
        wait_for(lambda: live.received == 7)
        frames = iter(live)
        assert [next(frames).index for _ in range(2)] == [5, 6] and live.dropped == 5
        source.give(frame(7))
        assert next(frames).index == 7 and live.dropped == 5 and len(live) == 8
        source.ended = True
        assert list(frames) == []


def test_who_keeps_pace_gets_every_frame_and_waits_for_it():
    source = Hand()
    with LiveFrames(source, "hand", capacity=1) as live:
        frames, got = iter(live), []
        for i in range(20):
            threading.Timer(0.001, source.give, [frame(i)]).start()
            got.append(next(frames).index)
        assert got == list(range(20)) and live.dropped == 0


def test_an_end_a_stop_and_a_count_end_it():
    stopped = threading.Event()
    live = LiveFrames(Hand(), "hand", stop=stopped.is_set)
    threading.Timer(0.05, stopped.set).start()
    assert list(live) == []
    live = LiveFrames(Hand(), "hand")
    threading.Timer(0.05, live.close).start()
    assert list(live) == []
    source = Hand()
    source.give(*(frame(i) for i in range(5)))
    assert [f.index for f in LiveFrames(source, "hand", capacity=9, most=3)] == [0, 1, 2]


def test_a_bad_frame_costs_itself_and_an_error_ends_it_after_the_frames_before():
    source = Hand()
    source.give(frame(0), FrameError("broken"), frame(2), DatasetError("unplugged"))
    live, got = LiveFrames(source, "hand", capacity=9), []
    with pytest.raises(DatasetError, match="unplugged"):
        for each in live:
            got.append(each.index)
    assert got == [0, 2]
    with pytest.raises(InputError, match="come once and in order"):
        live[0]
    with pytest.raises(InputError, match="capacity must be at least 1"):
        LiveFrames(Hand(), "hand", capacity=0)


class Recorded(Dataset):
    """Frames at given times; None: one that cannot be read."""

    def __init__(self, times):
        self.name, self.times = "recorded", times

    def __len__(self):
        return len(self.times)

    def load(self, index):
        if self.times[index] is None:
            raise FrameError(f"frame {index} is broken")
        return frame(index, self.times[index])


@pytest.mark.parametrize("speed", [1, 4])
def test_a_replay_keeps_the_pace_of_its_recording(speed):
    started, arrived = time.perf_counter(), []
    for item in Replay(Recorded([5.0, 5.1, None, 5.4]), speed):
        arrived.append((item, time.perf_counter() - started))
    assert isinstance(arrived[2][0], FrameError)
    assert [item.index for item, _ in arrived if isinstance(item, Frame)] == [0, 1, 3]
    # never too early; how late a busy machine is, nobody knows
    assert arrived[1][1] >= 0.1 / speed and arrived[3][1] >= 0.4 / speed
    with pytest.raises(InputError, match="speed must be positive"):
        Replay(Recorded([]), 0)


def test_a_recording_that_is_rendered_is_so_where_frames_are_taken():
    room = uf.open_dataset("synthetic", frames=4, width=32, height=24)
    frames = list(LiveFrames(Replay(room[::2], 100), "room", capacity=9))
    assert [each.index for each in frames] == [0, 2]
    np.testing.assert_array_equal(frames[1].depth, room[2].depth)


def test_a_map_from_live_frames_is_that_of_the_recording():
    """What is not dropped is fused as ever, bad frames skipped and said."""
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    tilted = 1 / (1 + 0.2 * camera.rays()[..., 1]).astype(np.float32)
    color = np.full((48, 64, 3), 100, np.uint8)
    frames = [Frame(tilted, camera, color, make_pose(i % 2), i, 0.01 * i) for i in range(6)]
    source = Hand()
    source.give(*frames[:3], FrameError("broken"), *frames[3:])
    source.ended = True
    maps = []
    for sequence in (frames, LiveFrames(source, "hand", capacity=20)):
        pipeline = uf.Pipeline(uf.Config(detail="auto"))
        if sequence is not frames:
            sequence = TrackedFrames(sequence, make_tracker("given"))
        run = pipeline.run(sequence)
        maps.append((len(run.steps), pipeline.surface.voxels(), len(run.skipped)))
    (whole, voxels, _), (live, live_voxels, skipped) = maps
    assert (whole, live, skipped) == (6, 6, 1)
    np.testing.assert_array_equal(voxels.keys, live_voxels.keys)


def test_live_at_the_command_line(tmp_path, capsys):
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    tilted = (1 / (1 + 0.2 * camera.rays()[..., 1])).astype(np.float32)
    color = np.full((48, 64, 3), 100, np.uint8)
    write_folder([Frame(tilted, camera, color, make_pose(0), i) for i in range(4)], tmp_path / "r")
    out = tmp_path / "out"
    arguments = ["reconstruct", "folder", str(tmp_path / "r"), "--live", "--out", str(out)]
    assert main(arguments) == 0
    assert "4 frames came" in capsys.readouterr().err
    record = json.loads((out / "metrics.json").read_text())
    live = record["tracking"]["live"]
    assert live["received"] == 4 == record["frames"]["used"] + live["dropped"]
    assert (out / "mesh.ply").exists()
    assert main(["reconstruct", "realsense", "--live", "--start", "3", "--out", str(out)]) == 2
    assert "a camera has no frames to start from" in capsys.readouterr().err
    wrong = ["reconstruct", "realsense", "--live", "--tracking", "external", "--out", str(out)]
    assert main(wrong) == 2 and "use rgbd" in capsys.readouterr().err
    assert (
        main(["reconstruct", "realsense", "--live", "--option", "depth_scale=1", "--out", "x"]) == 2
    )
    assert "a camera has no option 'depth_scale', only align" in capsys.readouterr().err


def sdk():
    """pyrealsense2, or a skip that says what is missing."""
    try:
        import pyrealsense2
    except ImportError as error:
        pytest.skip(f"no pyrealsense2, extra 'realsense' ({error})")
    return pyrealsense2


class SoftwareCamera:
    """The SDK's software device: a wall at 1 m, colour 15 mm to the right."""

    WIDTH, HEIGHT = 64, 48

    def __init__(self, rs):
        self.rs, self.device = rs, rs.software_device()
        self.depth = self.device.add_sensor("Stereo Module")
        self.color = self.device.add_sensor("RGB Camera")
        self.depth.add_read_only_option(rs.option.depth_units, 0.001)
        streams = ((rs.stream.depth, rs.format.z16, 2, 1), (rs.stream.color, rs.format.rgb8, 3, 2))
        self.profiles = [
            sensor.add_video_stream(self.stream(*numbers))
            for sensor, numbers in zip((self.depth, self.color), streams, strict=True)
        ]
        extrinsics = rs.extrinsics()
        extrinsics.rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1]
        extrinsics.translation = [-0.015, 0, 0]
        self.profiles[0].register_extrinsics_to(self.profiles[1], extrinsics)

    def stream(self, kind, form, bytes_per_pixel, unique):
        made, own = self.rs.video_stream(), self.rs.intrinsics()
        own.width, own.height, own.fx, own.fy = self.WIDTH, self.HEIGHT, 60, 60
        own.ppx, own.ppy, own.model, own.coeffs = (
            31.5,
            23.5,
            self.rs.distortion.brown_conrady,
            [0] * 5,
        )
        made.type, made.index, made.uid, made.fmt = kind, 0, unique, form
        made.width, made.height, made.fps = self.WIDTH, self.HEIGHT, 30
        made.bpp, made.intrinsics = bytes_per_pixel, own
        return made

    def send(self, n: int, color: bool = True) -> None:
        """Frame n; its colour tells its number."""
        units = np.full((self.HEIGHT, self.WIDTH), 1000 + n, np.uint16)
        picture = np.full((self.HEIGHT, self.WIDTH, 3), 10 * n, np.uint8)
        images = [
            (self.depth, self.profiles[0], units, 2),
            (self.color, self.profiles[1], picture, 3),
        ]
        for sensor, profile, pixels, size in images[: 1 + color]:
            image = self.rs.software_video_frame()
            image.pixels, image.stride, image.bpp = pixels, size * self.WIDTH, size
            image.timestamp, image.frame_number = 1000 + 100 / 3 * n, n + 1
            image.domain = self.rs.timestamp_domain.hardware_clock
            image.profile, image.depth_units = profile.as_video_stream_profile(), 0.001
            sensor.on_video_frame(image)


def test_a_realsense_gives_frames_as_they_come():
    from taichi_unifusion.datasets.realsense_camera import RealsenseCamera

    software = SoftwareCamera(sdk())
    camera = RealsenseCamera(software.device)
    assert camera.rig.camera == PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    with LiveFrames(camera, "camera", capacity=4) as live:
        frames = iter(live)
        for n in range(3):
            software.send(n)
            each = next(frames)
            assert each.depth.max() == pytest.approx(1 + 0.001 * n) and each.index == n
            inner = each.depth > 0
            assert (each.color[inner] == 10 * n).all() and 0.9 < inner.mean() < 1
            assert each.timestamp == pytest.approx(1 + n / 30) and each.T_world_camera is None
        software.send(3, color=False)  # its partner is lost: it comes with the next
        software.send(4)
        third = next(frames)
        assert third.depth.max() == pytest.approx(1.003) and next(frames).color.max() == 40
        assert third.color is None or third.color.max() in (20, 40)


def test_a_realsense_that_falls_silent_is_said():
    from taichi_unifusion.datasets.realsense_camera import RealsenseCamera

    software = SoftwareCamera(sdk())
    with LiveFrames(RealsenseCamera(software.device, timeout=0.2), "camera") as live:
        software.send(0)
        with pytest.raises(DatasetError, match="no image for 0.2 s"):
            list(live)


def test_without_a_camera_one_sentence_says_so(tmp_path):
    from taichi_unifusion.datasets.realsense_camera import RealsenseCamera

    with pytest.raises(
        (DatasetError, MissingDependency), match="no camera is connected|needs the SDK"
    ):
        RealsenseCamera()


@pytest.mark.parametrize(
    ("error", "told"),
    [
        ("libusb-1.0.so.0: cannot open shared object file", "apt-get install -y libusb-1.0-0"),
        ("No module named 'pyrealsense2'", r"pip install 'taichi-unifusion\[realsense\]'"),
    ],
)
def test_what_the_sdk_of_a_realsense_lacks_is_said(monkeypatch, error, told):
    from taichi_unifusion.datasets.realsense_camera import RealsenseCamera

    class Lacking:
        def find_spec(self, name, path=None, target=None):
            if name == "pyrealsense2":
                raise ImportError(error)

    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.setattr(sys, "meta_path", [Lacking(), *sys.meta_path])
    with pytest.raises(MissingDependency, match=told):
        RealsenseCamera()
