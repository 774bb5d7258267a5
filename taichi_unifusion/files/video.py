"""Pictures -> a video file, through PyAV."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, InputError, MissingDependency
from .atomic import atomic_write

VIDEO_SUFFIXES = (".mp4", ".mkv", ".mov")
CODECS = ("libx264", "libopenh264", "mpeg4")  # the best that the installed FFmpeg has
QUALITY = {"crf": "20", "preset": "veryfast"}  # of libx264


@contextmanager
def video_writer(
    path: Path, size: tuple[int, int], frames_per_second: float
) -> Iterator[Callable[[NDArray[np.uint8]], None]]:
    """Gives a function that adds a picture (H, W, 3) RGB of `size` (width, height) to the video at
    `path`, which shows so many pictures a second. The file is there once the block ends; of a block
    that fails nothing is left. Raises InputError for a size or suffix that no video has,
    MissingDependency without PyAV, FileError.
    """
    check_video(path, size)
    import av
    from av.error import FFmpegError

    with atomic_write(path) as temporary:
        # `av.open` goes by the suffix, which the temporary file lacks
        kind = {".mkv": "matroska"}.get(path.suffix.lower(), path.suffix.lower()[1:])
        with av.open(str(temporary), "w", format=kind) as container:
            codec = next(name for name in CODECS if name in av.codecs_available)
            rate = Fraction(frames_per_second).limit_denominator(1000)
            # a stream of pictures; PyAV's types also allow sound and subtitles
            stream: Any = container.add_stream(codec, rate=rate)
            stream.width, stream.height = size
            stream.pix_fmt = "yuv420p"  # what every player shows
            if codec == "libx264":
                stream.options = QUALITY
            else:
                stream.bit_rate = 8_000_000

            def add(picture: NDArray[np.uint8]) -> None:
                frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                container.mux(stream.encode(frame))

            try:
                yield add
                container.mux(stream.encode(None))
            except FFmpegError as error:
                raise FileError(f"{path}: the video could not be written ({error})") from error


def check_video(path: Path, size: tuple[int, int]) -> None:
    """Raise before any work is done where `video_writer` would."""
    if path.suffix.lower() not in VIDEO_SUFFIXES:
        raise InputError(
            f"{path}: a video is written as {', '.join(VIDEO_SUFFIXES)}, not as '{path.suffix}'"
        )
    if size[0] % 2 or size[1] % 2:
        raise InputError(f"size: a video needs even numbers of pixels, got {size[0]}x{size[1]}")
    try:
        import av  # noqa: F401
    except ImportError:
        raise MissingDependency(
            "a video is written with PyAV; run: pip install 'taichi-unifusion[video]', or give a folder for "
            "pictures"
        ) from None
