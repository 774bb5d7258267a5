"""What an image file says about itself before it is decoded: its kind, its size, and whether it is
whole.

A decoder allocates what the header asks for, so the header is judged first; and decoders differ in
what they do with a cut or damaged file (some fill the rest with grey), so the file's own marks are
checked: PNG checksums, JPEG's end marker.
"""

from __future__ import annotations

import re
import zlib
from dataclasses import dataclass

from ..errors import FrameError

# three times an 8k image; a larger size means a damaged or hostile header
MAX_PIXELS = 100_000_000
MAX_BYTES = 268_435_456  # of a decoded image
PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 4, 6: 4}  # as they are decoded, by colour type

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_START, JPEG_END = b"\xff\xd8", b"\xff\xd9"
# start-of-frame markers; the three left out are tables
JPEG_START_OF_FRAME = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
JPEG_START_OF_SCAN = 0xDA
JPEG_WITHOUT_LENGTH = frozenset({0x01, *range(0xD0, 0xD9)})
PGM_HEADER = re.compile(
    rb"P5(?:\s+#[^\n]*)*\s+(\d{1,9})(?:\s+#[^\n]*)*\s+(\d{1,9})(?:\s+#[^\n]*)*\s+(\d{1,5})\s"
)


@dataclass(frozen=True)
class ImageHeader:
    """Kind ("PNG", "JPEG", "PGM"), size [pixels], and bits and channels of a pixel once it is decoded,
    as the header states them; the pixel data begin after `data_offset`.
    """

    kind: str
    width: int
    height: int
    data_offset: int
    bits: int = 8  # of a channel, 8 or 16
    channels: int = 1
    data_bytes: int = 0  # known for PGM only

    @property
    def decoded_bytes(self) -> int:
        """Bytes of the decoded image."""
        return self.width * self.height * self.channels * self.bits // 8


def read_header(data: bytes, where: str) -> ImageHeader:
    """The header at the start of `data`; `where` names the file in a FrameError (not an image, cut,
    or absurdly large).
    """
    if not data:
        raise FrameError(f"{where}: the file is empty")
    if data.startswith(PNG_SIGNATURE):
        header = _png_header(data)
    elif data.startswith(JPEG_START):
        header = _jpeg_header(data)
    elif data.startswith(b"P5"):
        header = _pgm_header(data)
    else:
        raise FrameError(
            f"{where}: not a PNG, JPEG or binary PGM image (it starts with {data[:8]!r})"
        )
    if header is None:
        raise FrameError(f"{where}: the image header is damaged or cut off")
    if header.width < 1 or header.height < 1 or header.width * header.height > MAX_PIXELS:
        raise FrameError(
            f"{where}: the header says {header.width}x{header.height} pixels, refused (at most {MAX_PIXELS})"
        )
    if header.decoded_bytes > MAX_BYTES:
        raise FrameError(
            f"{where}: the header says {header.width}x{header.height} pixels of {header.channels} times "
            f"{header.bits} bits, {header.decoded_bytes / 1e6:.0f} MB, refused (at most {MAX_BYTES / 1e6:.0f})"
        )
    return header


def check_whole(data: bytes, header: ImageHeader, where: str) -> None:
    """Raise FrameError if the file is cut off, or (PNG only) if a checksum does not match."""
    whole = {"PNG": _png_is_whole, "JPEG": _jpeg_is_whole, "PGM": _pgm_is_whole}[header.kind]
    problem = whole(data, header)
    if problem:
        raise FrameError(f"{where}: the {header.kind} file is {problem}")


def _png_header(data: bytes) -> ImageHeader | None:
    if len(data) < 33 or data[12:16] != b"IHDR":
        return None
    width, height = int.from_bytes(data[16:20], "big"), int.from_bytes(data[20:24], "big")
    bits, channels = 16 if data[24] == 16 else 8, PNG_CHANNELS.get(data[25])
    return None if channels is None else ImageHeader("PNG", width, height, 8, bits, channels)


def _png_is_whole(data: bytes, header: ImageHeader) -> str | None:
    at, view = header.data_offset, memoryview(data)
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 12 + length  # length, type, payload, checksum
        if end > len(data):
            break
        if zlib.crc32(view[at + 4 : end - 4]) != int.from_bytes(data[end - 4 : end], "big"):
            return "damaged (a checksum does not match)"
        if data[at + 4 : at + 8] == b"IEND":
            return None
        at = end
    return f"cut off after {len(data)} bytes"


def _jpeg_header(data: bytes) -> ImageHeader | None:
    size, channels, at = None, 3, 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker in JPEG_WITHOUT_LENGTH:
            at += 2
            continue
        if marker in JPEG_START_OF_FRAME and at + 9 < len(data):
            size = (
                int.from_bytes(data[at + 7 : at + 9], "big"),
                int.from_bytes(data[at + 5 : at + 7], "big"),
            )
            channels = 1 if data[at + 9] == 1 else 3
        if marker == JPEG_START_OF_SCAN:
            return ImageHeader("JPEG", *size, at, 8, channels) if size else None
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


def _jpeg_is_whole(data: bytes, header: ImageHeader) -> str | None:
    # inside a scan 0xFF is always escaped, so the end marker cannot occur by chance; that of an
    # embedded thumbnail lies before the scan
    return None if data.rfind(JPEG_END) > header.data_offset else f"cut off after {len(data)} bytes"


def _pgm_header(data: bytes) -> ImageHeader | None:
    match = PGM_HEADER.match(data)
    if not match:
        return None
    width, height, maximum = map(int, match.groups())
    bits = 16 if maximum > 255 else 8
    return ImageHeader(
        "PGM", width, height, match.end(), bits, data_bytes=width * height * bits // 8
    )


def _pgm_is_whole(data: bytes, header: ImageHeader) -> str | None:
    return (
        None
        if len(data) >= header.data_offset + header.data_bytes
        else f"cut off after {len(data)} bytes"
    )
