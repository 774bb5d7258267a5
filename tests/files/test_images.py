"""Damaged, wrong and hostile image files cost one frame and say which file; depth units and their
scale.
"""

from __future__ import annotations

import io
import pickle
import struct
import tracemalloc
import zlib

import cv2
import numpy as np
import pytest
from dataset_writers import (
    make_samples,
    write_folder,
    write_image,
    write_replica,
    write_seven_scenes,
)
from memory import peak_memory

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.plausibility import guess_depth_scale
from taichi_unifusion.errors import FileError, FrameError, InputError, SizeMismatch
from taichi_unifusion.files.arrays import read_array
from taichi_unifusion.files.atomic import check_writable, read_bytes, write_text
from taichi_unifusion.files.images import depth_file_size, read_color, read_depth, read_values
from taichi_unifusion.files.maps import read_map

# [bytes] allocated while refusing a hostile header; its image would take gigabytes
REFUSED_COST = 2 << 20
FLIPS = 200  # single-bit damages tried


@pytest.fixture
def scene(tmp_path):
    return write_seven_scenes(tmp_path, make_samples(3))


def encoded(suffix: str, image: np.ndarray) -> bytes:
    return cv2.imencode(suffix, image)[1].tobytes()


def png_header(width: int, height: int) -> bytes:
    chunks = [
        (b"IHDR", struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)),
        (b"IDAT", zlib.compress(bytes(64))),
        (b"IEND", b""),
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in chunks
    )


@pytest.mark.parametrize(
    "write, name", [(write_seven_scenes, "7scenes"), (write_replica, "replica")]
)
def test_F5_colour_of_another_size_is_refused_with_both_sizes(tmp_path, write, name):
    folder = write(tmp_path, make_samples(1))
    file = next(file for file in sorted(folder.rglob("*.png")) if "depth" not in file.name)
    write_image(file, np.zeros((6, 8, 3), np.uint8))
    with pytest.raises(SizeMismatch, match="8x6.*16x12"):
        open_dataset(name, folder)[0]


def test_F5_folder_resizes_the_same_shape_only(tmp_path):
    folder = write_folder(tmp_path, make_samples(1))
    write_image(folder / "color" / "000000.png", np.full((24, 32, 3), 9, np.uint8))
    assert open_dataset("folder", folder)[0].color.shape == (12, 16, 3)
    write_image(folder / "color" / "000000.png", np.full((18, 32, 3), 9, np.uint8))
    with pytest.raises(SizeMismatch, match="000000.png.*32x18.*16x12"):
        open_dataset("folder", folder)[0]


@pytest.mark.parametrize(
    "image, said",
    [
        (np.zeros((12, 16, 4), np.uint8), "drop_alpha"),
        (np.zeros((12, 16, 3), np.uint16), "8 bits a channel, got uint16"),
        (np.zeros((12, 16), np.uint16), "is this a depth image"),
    ],
)
def test_F6_colour_of_another_kind_is_refused(scene, image, said):
    file = scene / "frame-000001.color.png"
    file.write_bytes(encoded(".png", image))
    with pytest.raises(FrameError, match=said) as caught:
        open_dataset("7scenes", scene)[1]
    assert str(file) in str(caught.value)


def test_K_grey_colour_is_r_equal_to_g_equal_to_b(scene):
    grey = make_samples(2)[1].color[..., 0]
    (scene / "frame-000001.color.png").write_bytes(encoded(".png", grey))
    color = open_dataset("7scenes", scene)[1].color
    np.testing.assert_array_equal(color, np.repeat(grey[..., None], 3, axis=2))
    (scene / "frame-000001.color.png").write_bytes(encoded(".jpg", np.full_like(grey, 90)))
    assert (open_dataset("7scenes", scene)[1].color == 90).all()


def test_F6_alpha_is_dropped_by_option(scene):
    rgb = make_samples(2)[1].color
    bgra = np.dstack([rgb[..., ::-1], np.full((12, 16), 77, np.uint8)])
    (scene / "frame-000001.color.png").write_bytes(encoded(".png", bgra))
    np.testing.assert_array_equal(open_dataset("7scenes", scene, drop_alpha=True)[1].color, rgb)


def test_F6_alpha_that_is_opaque_says_nothing(scene):
    rgb = make_samples(2)[1].color
    bgra = np.dstack([rgb[..., ::-1], np.full((12, 16), 255, np.uint8)])
    (scene / "frame-000001.color.png").write_bytes(encoded(".png", bgra))
    np.testing.assert_array_equal(open_dataset("7scenes", scene)[1].color, rgb)


def test_F6_coloured_depth_is_refused(scene):
    write_image(scene / "frame-000001.depth.png", np.zeros((12, 16, 3), np.uint16))
    with pytest.raises(
        FrameError, match="frame-000001.depth.png: depth must be one channel of 16 bits, got 3"
    ):
        open_dataset("7scenes", scene)[1]


@pytest.mark.parametrize("kind", ["color", "depth"])
@pytest.mark.parametrize(
    "damage",
    [
        lambda data: b"",
        lambda data: b"not an image at all\n",
        lambda data: data[:20],
        lambda data: data[: len(data) // 2],
        lambda data: data[:-13],
    ],
)
def test_F7_broken_png_costs_its_frame_and_names_the_file(scene, kind, damage):
    file = scene / f"frame-000001.{kind}.png"
    file.write_bytes(damage(file.read_bytes()))
    dataset = open_dataset("7scenes", scene)
    with pytest.raises(FrameError) as caught:
        dataset[1]
    assert str(file) in str(caught.value) and "\n" not in str(caught.value)
    assert dataset[0].depth.any() and dataset[2].depth.any()


@pytest.mark.parametrize("kept", [0.02, 0.3, 0.7, 0.99])
def test_F7_cut_jpeg_is_never_filled_with_grey(tmp_path, kept):
    image = cv2.resize(
        np.random.default_rng(3).integers(0, 256, (12, 16, 3), dtype=np.uint8), (160, 120)
    )
    data = encoded(".jpg", image)
    file = tmp_path / "cut.jpg"
    file.write_bytes(data[: int(len(data) * kept)])
    with pytest.raises(
        FrameError, match="cut.jpg: the (JPEG file is cut off|image header is damaged)"
    ):
        read_color(file)


def test_F7_every_flipped_bit_of_a_png_is_found(tmp_path):
    rng, file = np.random.default_rng(0), tmp_path / "flipped.png"
    data = encoded(".png", rng.integers(0, 65535, (12, 16), dtype=np.uint16))
    for _ in range(FLIPS):
        at, bit = rng.integers(len(data)), rng.integers(8)
        file.write_bytes(data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :])
        with pytest.raises(FrameError, match="flipped.png"):
            read_depth(file, 1000.0)


def test_F7_flipped_bits_of_a_jpeg_never_escape_as_another_error(tmp_path):
    rng, file = np.random.default_rng(0), tmp_path / "flipped.jpg"
    data, decoded = encoded(".jpg", rng.integers(0, 256, (12, 16, 3), dtype=np.uint8)), 0
    # JPEG has no checksums: what still decodes must at least be a colour image
    for _ in range(FLIPS):
        at, bit = rng.integers(len(data)), rng.integers(8)
        file.write_bytes(data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :])
        try:
            image = read_color(file)
        except FrameError as error:
            assert "flipped.jpg" in str(error)
        else:
            decoded += 1
            assert image.dtype == np.uint8 and image.ndim == 3
    assert 0 < decoded < FLIPS


def test_F3_65535_and_0_are_no_reading(scene):
    units = np.full((12, 16), 2500, np.uint16)
    units[2, 2], units[3, 3] = 65535, 0
    write_image(scene / "frame-000000.depth.png", units)
    depth = open_dataset("7scenes", scene)[0].depth
    assert (
        depth[2, 2] == 0 and depth[3, 3] == 0 and np.count_nonzero(depth == 2.5) == depth.size - 2
    )


def test_F8_sixteen_bits_stay_sixteen(scene):
    units = np.arange(12 * 16, dtype=np.uint16).reshape(12, 16) * 331 + 1
    write_image(scene / "frame-000000.depth.png", units)
    depth = open_dataset("7scenes", scene)[0].depth
    assert len(np.unique(depth)) == units.size
    np.testing.assert_array_equal(np.rint(depth * 1000).astype(np.uint16), units)


def test_F8_eight_bit_depth_is_refused(scene):
    write_image(scene / "frame-000000.depth.png", np.full((12, 16), 200, np.uint8))
    with pytest.raises(FrameError, match="one channel of 16 bits, got 1 of uint8"):
        open_dataset("7scenes", scene)[0]


@pytest.mark.parametrize("true_scale", [1000.0, 5000.0, 6553.5])
@pytest.mark.parametrize("factor", [1000.0, 1 / 1000.0, 100.0])
def test_F9_a_scale_far_off_is_noticed_and_the_right_one_named(true_scale, factor):
    metres = np.random.default_rng(1).uniform(1.0, 3.0, (12, 16)).astype(np.float32)
    used = true_scale * factor
    said = guess_depth_scale(metres * np.float32(true_scale / used), used)
    assert f"{true_scale:g} (median" in said and f"depth_scale {used:g}" in said


def test_F9_a_plausible_scale_is_left_alone():
    assert guess_depth_scale(np.full((4, 4), 2.0, np.float32), 1000.0) is None
    assert guess_depth_scale(np.full((4, 4), 0.4, np.float32), 5000.0) is None
    assert guess_depth_scale(np.zeros((4, 4), np.float32), 1000.0) is None
    far = np.linspace(1e8, 1e9, 64, dtype=np.float32).reshape(8, 8)
    assert "look up" in guess_depth_scale(far, 1000.0)


@pytest.mark.parametrize("scale", [0, -1000.0, float("nan"), float("inf"), "1000"])
def test_F9_an_impossible_scale_is_refused(scene, scale):
    with pytest.raises(InputError, match="depth_scale.*(must be a positive|expected a) number"):
        open_dataset("7scenes", scene, depth_scale=scale)


def jpeg_header(width: int, height: int) -> bytes:
    frame = struct.pack(">BHHB", 8, height, width, 1) + b"\x01\x11\x00"
    scan = b"\xff\xda\x00\x08\x01\x01\x00\x00\x3f\x00\x00"
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", 2 + len(frame)) + frame + scan + b"\xff\xd9"


@pytest.mark.parametrize(
    "name, data",
    [
        ("bomb.png", png_header(65000, 65000)),
        ("bomb.jpg", jpeg_header(65000, 65000)),
        ("bomb.pgm", b"P5\n65000 65000\n65535\n" + bytes(64)),
        ("flat.png", png_header(0, 480)),
    ],
)
def test_F11_header_bombs_are_refused_before_decoding(tmp_path, name, data):
    file = tmp_path / name
    file.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(FrameError, match=f"{name}: the header says .* refused"):
            read_color(file)
        with pytest.raises(FrameError, match=f"{name}: the header says .* refused"):
            read_depth(file, 1000.0)
        assert tracemalloc.get_traced_memory()[1] < REFUSED_COST
    finally:
        tracemalloc.stop()


def npy_header(rows: int) -> bytes:
    file = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        file, {"descr": "<f4", "fortran_order": False, "shape": (rows, 16)}
    )
    return file.getvalue() + bytes(64)


@pytest.mark.filterwarnings("ignore:overflow encountered")  # NumPy multiplies the promised shape
def test_F11_npy_headers_are_judged_too(tmp_path):
    file = tmp_path / "bomb.npy"
    np.save(file, np.ones((12, 16), np.float32))
    good = file.read_bytes()
    for damaged in (
        npy_header(1 << 40),
        npy_header(1 << 62),
        good[:-1],
        good[:40],
        b"",
        b"\x80\x04N.",
        b"PK\x03\x04",
    ):
        file.write_bytes(damaged)
        with pytest.raises(FrameError, match="bomb.npy"):
            read_depth(file, 1000.0)


class Payload:
    """Unpickling it writes a file."""

    def __init__(self, target):
        self.target = target

    def __reduce__(self):
        return open, (str(self.target), "w")


def test_M6_a_pickle_named_npy_is_not_run(tmp_path):
    target, file = tmp_path / "was-here", tmp_path / "depth.npy"
    file.write_bytes(pickle.dumps(Payload(target)))
    with pytest.raises(FrameError, match="depth.npy"):
        read_depth(file, 1000.0)
    np.save(file, np.array([Payload(target)], dtype=object), allow_pickle=True)
    with pytest.raises(FrameError, match="depth.npy"):
        read_depth(file, 1000.0)
    assert not target.exists()


def test_npy_depth_of_every_usual_type(tmp_path):
    metres = np.array([[1.5, 0.0], [np.nan, -np.inf]])
    for dtype in (np.float16, np.float32, np.float64):
        np.save(tmp_path / "depth.npy", metres.astype(dtype))
        np.testing.assert_array_equal(
            read_depth(tmp_path / "depth.npy", 1000.0), np.array([[1.5, 0], [0, 0]], np.float32)
        )
    np.save(tmp_path / "depth.npy", np.array([[1500, 65535]], np.uint16))
    np.testing.assert_array_equal(
        read_depth(tmp_path / "depth.npy", 1000.0), np.array([[1.5, 0]], np.float32)
    )
    assert depth_file_size(tmp_path / "depth.npy") == (2, 1)
    np.save(tmp_path / "depth.npy", np.array([[150, 7]], np.uint8))
    with pytest.raises(FrameError, match="16 bits"):
        read_depth(tmp_path / "depth.npy", 1000.0)


def _png_saying(width: int, height: int, bits: int, kind: int) -> bytes:
    """A whole PNG file whose header says so and whose data are a few zeros."""

    def chunk(name: bytes, content: bytes) -> bytes:
        return (
            struct.pack(">I", len(content))
            + name
            + content
            + struct.pack(">I", zlib.crc32(name + content))
        )

    header = struct.pack(">IIBBBBB", width, height, bits, kind, 0, 0, 0)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(b"\0" * 99)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def test_c14_decoders_are_not_asked_for_more_than_a_camera_has(tmp_path):
    """F11 too: bits, channels, bytes and the camera's size are judged by the header alone."""
    path = tmp_path / "a.png"
    with peak_memory() as peak:
        path.write_bytes(_png_saying(10_000, 10_000, 16, 6))
        for read in (read_color, read_values, lambda file: read_depth(file, 1000)):
            with pytest.raises(FrameError, match="4 times 16 bits, 800 MB, refused"):
                read(path)
        path.write_bytes(_png_saying(9000, 9000, 16, 0))
        with pytest.raises(FrameError, match="colour must be 8 bits a channel, got uint16"):
            read_color(path)
        with pytest.raises(SizeMismatch, match="depth is 9000x9000 but the camera is 640x480"):
            read_depth(path, 1000, size=(640, 480))
        path.write_bytes(_png_saying(9000, 9000, 8, 2))
        with pytest.raises(FrameError, match="one channel of 16 bits, got 3 of uint8"):
            read_depth(path, 1000)
    assert peak.megabytes < 50


def test_c15_a_zero_byte_in_a_name_is_a_sentence(tmp_path):
    for use in (
        lambda name: check_writable(name),
        lambda name: read_bytes(name),
        lambda name: write_text(name, "a"),
        lambda name: read_map(name),
        lambda name: read_array(name),
    ):
        with pytest.raises(FileError, match="zero byte"):
            use(str(tmp_path / "a\0b"))


@pytest.mark.parametrize("dtype", ["f2", "f4", ">f4", "f8", "i2", "u2", "i4", "u4", "i8"])
@pytest.mark.parametrize("shape", [(2, 3), (2, 3, 1), (1, 2, 3)])
def test_D_a_given_scale_holds_for_arrays_of_every_number_type(tmp_path, dtype, shape):
    file, metres = tmp_path / "depth.npy", [[1.5, 0.0, 0.25], [2.0, 0.5, 1.0]]
    np.save(file, (1000 * np.array(metres)).astype(dtype).reshape(shape))
    np.testing.assert_array_equal(
        read_depth(file, 1000.0, float_scale=1000.0), np.array(metres, np.float32)
    )
    assert depth_file_size(file) == (3, 2)
