"""The pictures of a video by their numbers, through PyAV."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, FrameError, MissingDependency
from .image_headers import MAX_PIXELS

AHEAD = 32  # pictures that are decoded to come to one, rather than looked for from a key picture


class VideoPictures:
    """Pictures 0, 1, 2 ... of the first video track; reading them in order is what costs least.

    Raises MissingDependency without PyAV, DatasetError for a file that holds no video.
    """

    def __init__(self, path: Path) -> None:
        self.path, self._lock = path, Lock()
        self._container: Any = None
        self._pictures: Iterator[Any] = iter(())
        self._next = 0
        try:
            import av
            from av.error import FFmpegError
        except ImportError:
            raise MissingDependency(
                f"{path}: a video is read with PyAV; run: pip install 'taichi-unifusion[phone]'"
            ) from None
        try:
            with av.open(str(path), metadata_errors="replace") as container:
                if not container.streams.video:
                    raise DatasetError(f"{path}: holds no video track")
                stream: Any = container.streams.video[0]
                if stream.codec_context is None:
                    raise DatasetError(f"{path}: its video is of a codec that is not known here")
                self.size: tuple[int, int] = stream.codec_context.width, stream.codec_context.height
                stamps = {
                    packet.pts for packet in container.demux(stream) if packet.pts is not None
                }
        except DatasetError:  # which is a ValueError too
            raise
        except (FFmpegError, OSError, ValueError) as error:
            raise DatasetError(
                f"{path}: not a video that can be read ({str(error)[:80]})"
            ) from None
        if not stamps or min(self.size) < 1 or self.size[0] * self.size[1] > MAX_PIXELS:
            raise DatasetError(
                f"{path}: holds no pictures, or of {self.size[0]}x{self.size[1]} pixels"
            )
        self.stamps = sorted(stamps)  # of the pictures, in the track's unit

    def __len__(self) -> int:
        return len(self.stamps)

    def read(self, number: int) -> NDArray[np.uint8]:
        """Picture `number` as (H, W, 3) RGB; FrameError where it cannot be decoded."""
        where = f"{self.path} picture {number}"
        if not 0 <= number < len(self.stamps):
            raise FrameError(f"{where}: the video has {len(self.stamps)} pictures only")
        from av.error import FFmpegError

        with self._lock:
            try:
                if self._container is None or not 0 <= number - self._next < AHEAD:
                    self._seek(number)
                return self._decode(number, where)
            except FrameError:
                self._container = None
                raise
            except (FFmpegError, OSError, ValueError) as error:
                self._container = None
                raise FrameError(f"{where}: cannot be decoded ({str(error)[:80]})") from None

    def _seek(self, number: int) -> None:
        """Start decoding at the key picture before one."""
        import av

        if self._container is None:
            self._container = av.open(str(self.path), metadata_errors="replace")
            self._container.streams.video[0].thread_type = "AUTO"
        stream = self._container.streams.video[0]
        self._container.seek(self.stamps[number], stream=stream, backward=True)
        self._pictures = self._container.decode(stream)

    def _decode(self, number: int, where: str) -> NDArray[np.uint8]:
        """Go on to a picture; those before it are decoded and dropped."""
        wanted = self.stamps[number]
        for picture in self._pictures:
            if picture.pts is None or picture.pts < wanted:
                continue
            self._next = bisect_left(self.stamps, picture.pts) + 1
            if picture.pts == wanted:
                return np.ascontiguousarray(picture.to_ndarray(format="rgb24"))
            break
        raise FrameError(f"{where}: it is missing or damaged")
