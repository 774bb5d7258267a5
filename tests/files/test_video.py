"""Videos: what is written plays back, and nothing is left of one that fails."""

from __future__ import annotations

import os
import sys

import numpy as np
import pytest

from taichi_unifusion.errors import DatasetError, FileError, InputError, MissingDependency
from taichi_unifusion.files.video import check_video, video_writer
from taichi_unifusion.files.video_reading import VideoPictures

av = pytest.importorskip("av")
LOSSY = 12  # of 255, in the mean, that coding may change


def pictures(count: int = 5) -> list[np.ndarray]:
    """A bright square that moves over a gradient."""
    ramp = np.linspace(0, 150, 64).astype(np.uint8)[None, :, None].repeat(48, axis=0)
    frames = []
    for i in range(count):
        frame = ramp.repeat(3, axis=2).copy()
        frame[10:30, 8 * i : 8 * i + 16] = (250, 200, 60)
        frames.append(frame)
    return frames


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "mov"])
def test_what_is_written_plays_back(tmp_path, suffix):
    path, shown = tmp_path / f"v.{suffix}", pictures()
    with video_writer(path, (64, 48), 12.5) as add:
        for picture in shown:
            add(picture)
    with av.open(str(path)) as container:
        assert float(container.streams.video[0].average_rate) == 12.5
        frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(frames) == len(shown) and os.listdir(tmp_path) == [path.name]
    for frame, picture in zip(frames, shown, strict=True):
        assert np.abs(frame.astype(int) - picture).mean() < LOSSY


def test_a_video_that_fails_leaves_the_old_one(tmp_path):
    path = tmp_path / "v.mp4"
    path.write_bytes(b"old")
    with pytest.raises(RuntimeError), video_writer(path, (64, 48), 10) as add:
        add(pictures(1)[0])
        raise RuntimeError("stop")
    assert path.read_bytes() == b"old" and os.listdir(tmp_path) == ["v.mp4"]
    with pytest.raises(FileError), video_writer(tmp_path / "none" / "v.mp4", (64, 48), 10):
        pass


def test_what_cannot_be_a_video_is_told_before(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="is written as .mp4, .mkv, .mov, not as '.gif'"):
        check_video(tmp_path / "v.gif", (64, 48))
    with pytest.raises(InputError, match="even numbers of pixels, got 63x48"):
        check_video(tmp_path / "v.mp4", (63, 48))
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(MissingDependency, match=r"pip install 'taichi-unifusion\[video\]'"):
        check_video(tmp_path / "v.mp4", (64, 48))


def test_a_video_of_an_unknown_codec_is_refused(tmp_path):
    path = tmp_path / "v.mp4"
    with video_writer(path, (64, 48), 10) as add:
        add(pictures(1)[0])
    content = path.read_bytes()
    at = content.index(b"stsd") + 16  # the name of the first sample entry
    path.write_bytes(content[:at] + b"zz" + content[at + 2 :])
    with pytest.raises(DatasetError, match="of a codec that is not known here"):
        VideoPictures(path)
