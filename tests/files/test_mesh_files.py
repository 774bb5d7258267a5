"""Mesh files: PLY, written and read, and OBJ, written."""

from __future__ import annotations

import os
import struct
import time

import numpy as np
import pytest
from meshes import scattered

from taichi_unifusion.errors import FileError, InputError
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.meshes import write_mesh
from taichi_unifusion.types import Mesh

COLOR_STEP = 0.5 / 255 + 1e-6  # half a step of 8 bits, and float32 rounding


@pytest.fixture
def mesh() -> Mesh:
    return scattered(color=3, heat=1, clip_0=4)


def assert_equal_meshes(a: Mesh, b: Mesh) -> None:
    assert np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces)
    assert (a.normals is None) == (b.normals is None) and (
        a.normals is None or np.array_equal(a.normals, b.normals)
    )
    assert a.attributes.keys() == b.attributes.keys()
    for name, values in a.attributes.items():
        assert b.attributes[name].dtype == np.float32 and b.attributes[name].shape == values.shape
        np.testing.assert_allclose(
            b.attributes[name], values, rtol=0, atol=COLOR_STEP if name == "color" else 0
        )


def test_ply_round_trip(tmp_path, mesh):
    for i, m in enumerate(
        (
            mesh,
            Mesh(mesh.vertices, mesh.faces),
            Mesh(mesh.vertices, mesh.faces[:0]),
            Mesh(mesh.vertices[:0], mesh.faces[:0], mesh.normals[:0]),
        )
    ):
        write_mesh(tmp_path / f"{i}.ply", m)
        assert_equal_meshes(m, read_mesh(tmp_path / f"{i}.ply"))


def test_colors_are_clipped_and_nan_is_black(tmp_path, mesh):
    color = np.full((50, 3), 0.5, np.float32)
    color[:3] = [[-1, 2, np.nan], [np.inf, -np.inf, 1], [0, 1, 0.25]]
    write_mesh(tmp_path / "a.ply", mesh.with_attribute("color", color))
    read = read_mesh(tmp_path / "a.ply").attributes["color"]
    np.testing.assert_allclose(read[:3], [[0, 1, 0], [1, 0, 1], [0, 1, 64 / 255]], atol=1e-6)


def test_other_programs_read_our_ply(tmp_path, mesh):
    trimesh = pytest.importorskip("trimesh")
    write_mesh(tmp_path / "a.ply", mesh)
    loaded = trimesh.load(tmp_path / "a.ply", process=False)
    assert np.array_equal(loaded.vertices, mesh.vertices) and np.array_equal(
        loaded.faces, mesh.faces
    )
    np.testing.assert_allclose(
        loaded.visual.vertex_colors[:, :3] / 255, mesh.attributes["color"], atol=COLOR_STEP
    )


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian"])
def test_we_read_other_programs_ply(tmp_path, mesh, encoding):
    trimesh = pytest.importorskip("trimesh")
    exported = trimesh.Trimesh(
        mesh.vertices,
        mesh.faces,
        vertex_normals=mesh.normals,
        process=False,
        vertex_colors=(mesh.attributes["color"] * 255).round().astype(np.uint8),
    )
    text = exported.export(
        file_type="ply", encoding="ascii" if encoding == "ascii" else "binary", vertex_normal=True
    )
    (tmp_path / "a.ply").write_bytes(text.encode() if isinstance(text, str) else text)
    read = read_mesh(tmp_path / "a.ply")
    assert np.array_equal(read.faces, mesh.faces)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-6)  # ascii digits
    np.testing.assert_allclose(read.normals, mesh.normals, atol=1e-6)
    np.testing.assert_allclose(read.attributes["color"], mesh.attributes["color"], atol=COLOR_STEP)


def test_ply_big_endian_polygons_and_other_elements(tmp_path):
    header = """ply\r\nformat binary_big_endian 1.0\r\ncomment made by hand
        element camera 1\r\nproperty list uchar float K
        element vertex 5\r\nproperty double x\r\nproperty double y\r\nproperty double z\r\nproperty ushort red
        property ushort green\r\nproperty ushort blue\r\nproperty float quality
        element face 3\r\nproperty uchar flag\r\nproperty list uchar uint vertex_index\r\nend_header\r\n"""
    vertices = np.arange(15.0).reshape(5, 3)
    body = b"\x02" + np.array([1.5, 2.5], ">f4").tobytes()
    for row in vertices:
        body += (
            row.astype(">f8").tobytes()
            + np.array([0, 13107, 65535], ">u2").tobytes()
            + np.array([row[0]], ">f4").tobytes()
        )
    for polygon in ([0, 1, 2], [0, 1, 2, 3], [4, 3]):
        body += b"\x07" + bytes([len(polygon)]) + np.array(polygon, ">u4").tobytes()
    (tmp_path / "a.ply").write_bytes(
        "\r\n".join(line.strip() for line in header.splitlines()).encode() + b"\r\n" + body
    )
    mesh = read_mesh(tmp_path / "a.ply")
    assert np.array_equal(mesh.vertices, vertices) and mesh.vertices.dtype == np.float32
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]
    np.testing.assert_allclose(mesh.attributes["color"], np.tile([[0, 0.2, 1]], (5, 1)), atol=1e-6)
    assert mesh.attributes["quality"].ravel().tolist() == [0, 3, 6, 9, 12]


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_ply_truncated_anywhere_is_an_error(tmp_path, mesh, encoding):
    path = tmp_path / "a.ply"
    write_mesh(path, mesh)
    data = path.read_bytes()
    if encoding == "ascii":
        rows = [*mesh.vertices.tolist(), *([3, *face] for face in mesh.faces.tolist())]
        body = "\n".join(" ".join(map(str, row)) for row in rows)
        data = (
            f"ply\nformat ascii 1.0\nelement vertex 50\nproperty float x\nproperty float y\nproperty float z\n"
            f"element face 16\nproperty list uchar int vertex_indices\nend_header\n{body}"
        ).encode()
    path.write_bytes(data)
    assert len(read_mesh(path).faces) == 16
    # in ascii, a cut within the last number leaves a shorter number: no reader can tell
    for cut in range(0, len(data) - (3 if encoding == "ascii" else 1), 7):
        path.write_bytes(data[:cut])
        with pytest.raises(FileError, match="a.ply"):
            read_mesh(path)
    path.write_bytes(data + (b" 7" if encoding == "ascii" else b"\0"))
    with pytest.raises(FileError, match="more data"):
        read_mesh(path)


VERTEX = "element vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACE = "element face 1\nproperty list uchar int vertex_indices\n"
CORNERS = "0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "not a PLY"),
        ("solid cube", "not a PLY"),
        ("ply\nformat ascii 1.0\n", "no end"),
        (f"ply\nformat text 1.0\n{VERTEX}end_header\n{CORNERS}", "makes no sense: 'format text"),
        (f"ply\n{VERTEX}end_header\n{CORNERS}", "names no format"),
        (
            f"ply\nformat ascii 1.0\n{VERTEX.replace('3', '-3')}end_header\n{CORNERS}",
            "element vertex -3",
        ),
        (
            f"ply\nformat ascii 1.0\n{VERTEX.replace('3', '9' * 5000)}end_header\n{CORNERS}",
            "makes no sense",
        ),
        (
            f"ply\nformat ascii 1.0\n{VERTEX.replace('3', str(2**58))}end_header\n{CORNERS}",
            "truncated",
        ),
        (
            f"ply\nformat binary_little_endian 1.0\n{VERTEX.replace('3', str(2**58))}end_header\n{CORNERS}",
            "truncated",
        ),
        (
            f"ply\nformat ascii 1.0\n{VERTEX.replace('float y', 'float x')}end_header\n{CORNERS}",
            "'x' twice",
        ),
        (
            f"ply\nformat ascii 1.0\n{VERTEX.replace('float y', 'number y')}end_header\n{CORNERS}",
            "property number y",
        ),
        (
            f"ply\nformat ascii 1.0\n{VERTEX.replace('float y', 'float q')}end_header\n{CORNERS}",
            "x, y and z",
        ),
        (f"ply\nformat ascii 1.0\n{FACE}end_header\n3 0 1 2\n", "x, y and z"),
        (
            f"ply\nformat ascii 1.0\n{VERTEX}end_header\n0 0 0\n1 zero 0\n0 1 0\n",
            "else than numbers",
        ),
        (f"ply\nformat ascii 1.0\n{VERTEX}{FACE}end_header\n{CORNERS}3 0 1 3\n", "outside 0..2"),
        (f"ply\nformat ascii 1.0\n{VERTEX}{FACE}end_header\n{CORNERS}3 0 1 -1\n", "outside 0..2"),
        (f"ply\nformat ascii 1.0\n{VERTEX}{FACE}end_header\n{CORNERS}3 0 1 nan\n", "outside 0..2"),
        (f"ply\nformat ascii 1.0\n{VERTEX}{FACE}end_header\n{CORNERS}3 0 1 1.5\n", "not whole"),
        (f"ply\nformat ascii 1.0\n{VERTEX}{FACE}end_header\n{CORNERS}-3 0 1 2\n", "length -3"),
        (f"ply\nformat ascii 1.0\n{VERTEX}{FACE}end_header\n{CORNERS}nan 0 1 2\n", "length nan"),
    ],
)
def test_ply_that_lies_is_an_error(tmp_path, text, message):
    (tmp_path / "a.ply").write_text(text)
    with pytest.raises(FileError, match="a.ply: .*" + message):
        read_mesh(tmp_path / "a.ply")


def test_M2_ply_with_any_header_byte_changed_reads_or_is_a_clear_error(tmp_path, mesh):
    path = tmp_path / "a.ply"
    write_mesh(path, mesh)
    data = bytearray(path.read_bytes())
    errors = 0
    for i in range(data.index(b"end_header") + 12):
        for change in (1, 16, 128):
            data[i] ^= change
            path.write_bytes(data)
            try:
                read_mesh(path)
            except FileError:
                errors += 1
            data[i] ^= change
    assert errors > 100  # most bytes matter; a name or a comment may change


def test_mesh_errors_say_what_to_do(tmp_path, mesh):
    with pytest.raises(InputError, match=r"\.ply, \.glb, \.obj, not as '\.stl'"):
        write_mesh(tmp_path / "a.stl", mesh)
    with pytest.raises(InputError, match=r"read from \.ply"):
        read_mesh(tmp_path / "a.glb")
    with pytest.raises(FileError, match="no such file"):
        read_mesh(tmp_path / "a.ply")
    with pytest.raises(InputError, match=r"0\.\.50, but the mesh has 50"):
        write_mesh(tmp_path / "a.ply", Mesh(mesh.vertices, np.array([[0, 1, 50]], np.int32)))
    with pytest.raises(InputError, match="'color' must be"):
        write_mesh(tmp_path / "a.ply", mesh.with_attribute("color", np.zeros((50, 4))))
    for name in ("two words", "x", "schön"):
        with pytest.raises(InputError, match="name"):
            write_mesh(tmp_path / "a.ply", mesh.with_attribute(name, np.zeros(50)))
    assert os.listdir(tmp_path) == []


def test_obj_keeps_order_colors_and_normals(tmp_path, mesh):
    pytest.importorskip("trimesh")
    mesh.save(tmp_path / "a.obj")
    rows = {"v": [], "vn": [], "f": []}
    for line in (tmp_path / "a.obj").read_text().splitlines():
        if line.split()[:1] and line.split()[0] in rows:
            rows[line.split()[0]].append(line.split()[1:])
    v = np.array(rows["v"], float)
    np.testing.assert_allclose(v[:, :3], mesh.vertices, atol=1e-7)  # OBJ holds 8 digits
    np.testing.assert_allclose(v[:, 3:], mesh.attributes["color"], atol=COLOR_STEP)
    np.testing.assert_allclose(np.array(rows["vn"], float), mesh.normals, atol=1e-7)
    assert [[corner.split("/")[0] for corner in face] for face in rows["f"]] == (
        mesh.faces + 1
    ).astype(str).tolist()


@pytest.mark.parametrize("suffix", [".glb", ".obj"])
def test_empty_mesh_is_written_as_ply_only(tmp_path, mesh, suffix):
    with pytest.raises(InputError, match="empty.*write a .ply"):
        write_mesh(tmp_path / f"a{suffix}", Mesh(mesh.vertices[:0], mesh.faces[:0]))


def test_c15_polygons_of_several_sizes_are_read_fast_and_in_order(tmp_path):
    """A million faces took a minute, one Python step each."""
    rng = np.random.default_rng(0)
    count, sizes = 200_000, rng.choice([3, 4, 5, 0, 2], 200_000)
    corners = [rng.integers(0, 9, size) for size in sizes]
    header = f"""ply
format binary_little_endian 1.0
element vertex 9
property float x
property float y
property float z
element face {count}
property uchar flag
property list uchar int vertex_indices
property float area
end_header
"""
    rows = b"".join(struct.pack(f"<BB{len(c)}if", 7, len(c), *c.tolist(), 0.5) for c in corners)
    path = tmp_path / "mixed.ply"
    path.write_bytes(header.encode() + np.arange(27, dtype="<f4").tobytes() + rows)
    start = time.perf_counter()
    faces = read_mesh(path).faces
    assert time.perf_counter() - start < 4
    fans = [(c[0], c[i], c[i + 1]) for c in corners for i in range(1, len(c) - 1)]
    assert np.array_equal(faces, np.array(fans))
    path.write_bytes(path.read_bytes()[:-3])
    with pytest.raises(FileError, match="truncated"):
        read_mesh(path)
