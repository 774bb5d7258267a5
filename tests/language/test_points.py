"""Features at points as OpenScene distributes them: files, and what frames see of the points."""

from __future__ import annotations

import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from paper_roots import band, room, seen_points

from taichi_unifusion import Frame, Mesh
from taichi_unifusion.errors import FileError, FrameError, InputError
from taichi_unifusion.files.arrays import read_point_features
from taichi_unifusion.language import make_image_encoder
from taichi_unifusion.language import points as point_room

HALF = 1e-3  # half precision of stored features
CHANNELS = 4  # one a band of heights


@pytest.fixture(scope="module")
def frame() -> Frame:
    return room(1)[0]


@pytest.fixture
def scan(frame, tmp_path):
    """All that the frame sees as points, of which two thirds have features of their band."""
    points = seen_points(frame).reshape(-1, 3).astype(np.float32)
    Mesh(points, np.empty((0, 3), np.int32)).save(tmp_path / "scan.ply")
    mask = np.arange(len(points)) % 3 > 0
    features = 7 * np.eye(CHANNELS, dtype=np.float16)[band(points[:, 2])][mask]
    np.savez(tmp_path / "scan_0.npz", feat=features, mask_full=mask)
    return tmp_path / "scan_0.npz", tmp_path / "scan.ply", features, mask


def test_a_pixel_takes_the_feature_of_the_point_that_it_sees(scan, frame):
    file, cloud, _, _ = scan
    values = make_image_encoder(f"points:{file},{cloud}").image_features(frame)
    assert values.shape == (60, 80, CHANNELS)
    heights = seen_points(frame)[..., 2]
    wanted = band(heights)
    # neighbours stand in for points without a feature: only at the border of a band is that another
    inside = np.abs(heights[..., None] - (0.4, 1.0, 1.6)).min(axis=2) > 2 * point_room.REACH
    # in the distance a pixel is wider than the reach
    has = np.isfinite(values).all(axis=2)
    assert inside.mean() > 0.5 and has.mean() > 0.9
    inside &= has
    np.testing.assert_allclose(values[inside], np.eye(CHANNELS)[wanted][inside], atol=HALF)


def test_pixels_far_from_any_point_have_none(scan, frame, monkeypatch):
    file, cloud, _, _ = scan
    encoder = make_image_encoder(f"points:{file},{cloud}")
    monkeypatch.setattr(point_room, "LONGEST_SIDE", 20)
    depth = frame.depth.copy()
    depth[:, :40] += 1.0  # there the frame does not fit the points
    depth[:4] = 0
    values = encoder.image_features(Frame(depth, frame.camera, None, frame.T_world_camera))
    assert values.shape == (15, 20, CHANNELS)
    has = np.isfinite(values).all(axis=2)
    assert has[2:, 11:].mean() > 0.9 and has[:, :9].mean() < 0.1 and not has[0].any()
    with pytest.raises(FrameError, match="within 5 cm.*world of the poses"):
        moved = frame.T_world_camera + [[0, 0, 0, 50], [0] * 4, [0] * 4, [0] * 4]
        encoder.image_features(Frame(frame.depth, frame.camera, None, moved))
    with pytest.raises(FrameError, match="no pose"):
        encoder.image_features(Frame(frame.depth, frame.camera))


def test_features_of_all_points_need_no_mask(scan, tmp_path):
    _, cloud, _, mask = scan
    np.save(tmp_path / "all.npy", np.ones((len(mask), CHANNELS), np.float32))
    encoder = make_image_encoder(f"points:{tmp_path / 'all.npy'},{cloud}")
    assert len(encoder.points) == len(mask)


def test_files_that_do_not_fit_are_said(scan, tmp_path):
    file, cloud, features, mask = scan
    with pytest.raises(InputError, match="needs two files"):
        make_image_encoder(f"points:{file}")
    with pytest.raises(FileError, match="no such file"):
        make_image_encoder(f"points:{tmp_path / 'absent.npz'},{cloud}")
    np.save(tmp_path / "few.npy", features[:9])
    with pytest.raises(InputError, match="of 9 points, but .*scan.ply has 4800"):
        make_image_encoder(f"points:{tmp_path / 'few.npy'},{cloud}")
    for name, arrays, said in (
        ("names", {"other": features}, "feat and mask_full"),
        ("mask", {"feat": features, "mask_full": ~mask}, "which points"),
        ("kind", {"feat": features.astype(int), "mask_full": mask}, "floating-point"),
        ("shape", {"feat": features[0], "mask_full": mask}, r"must be \(M, c\)"),
    ):
        np.savez(tmp_path / f"{name}.npz", **arrays)
        with pytest.raises(InputError, match=said):
            read_point_features(tmp_path / f"{name}.npz")
    objects = np.array([features], object)
    np.savez(tmp_path / "objects.npz", feat=objects, mask_full=mask)
    with pytest.raises(FileError, match="Python objects"):
        read_point_features(tmp_path / "objects.npz")


class Tensor:
    """As much of a tensor as is used."""

    dtype = "torch.float32"

    def __init__(self, array: np.ndarray) -> None:
        self.array = array

    def numpy(self) -> np.ndarray:
        return self.array


def test_X2_files_of_torch_are_read_without_running_code(scan, tmp_path, monkeypatch):
    _, _, features, mask = scan
    asked = {}

    def load(path, **options):
        asked.update(options)
        return stored

    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(load=load))
    (tmp_path / "scan_0.pt").write_bytes(b"")
    for feat in (features, features[..., None]):
        stored = {"feat": Tensor(feat), "mask_full": Tensor(mask)}
        found, which = read_point_features(tmp_path / "scan_0.pt")
        assert (found == features).all() and (which == mask).all()
    assert asked["weights_only"] is True
    stored = {"feat": Tensor(features)}
    with pytest.raises(InputError, match="feat and mask_full in it, found .feat"):
        read_point_features(tmp_path / "scan_0.pt")


class Half(Tensor):
    """Of a type that NumPy has not."""

    dtype = "torch.bfloat16"

    def float(self) -> Tensor:
        return Tensor(self.array)

    def numpy(self) -> np.ndarray:
        raise TypeError("Got unsupported ScalarType BFloat16")


def test_what_torch_refuses_is_one_sentence_of_ours(scan, tmp_path, monkeypatch):
    _, _, features, mask = scan

    def load(path, **options):
        if zipfile.is_zipfile(path):
            return {"feat": Half(features), "mask_full": Tensor(mask)}
        raise RuntimeError("PytorchStreamReader failed: \x1b[1mmore of torch's words")

    monkeypatch.setitem(sys.modules, "torch", SimpleNamespace(load=load))
    file = tmp_path / "scan_0.pt"
    file.write_bytes(b"cut")
    with pytest.raises(FileError, match="damaged, or from before torch 1.6; save") as raised:
        read_point_features(file)
    assert "\x1b" not in str(raised.value)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("data.pkl", b"")
    assert (read_point_features(file)[0] == features).all()


class Payload:
    """Writes a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def test_real_files_of_torch(scan, tmp_path):
    torch = pytest.importorskip("torch", reason=".pt files need torch")
    _, _, features, mask = scan
    stored = {"feat": torch.from_numpy(features), "mask_full": torch.from_numpy(mask)}
    torch.save(stored, tmp_path / "scan_0.pt")
    found, which = read_point_features(tmp_path / "scan_0.pt")
    assert (found == features).all() and (which == mask).all()
    stored["feat"] = stored["feat"].to(torch.bfloat16)
    torch.save(stored, tmp_path / "scan_0.pt")
    assert np.abs(read_point_features(tmp_path / "scan_0.pt")[0] - features).max() < 0.01
    marker = tmp_path / "was-run"
    for stem, told, save in (
        ("payload", "could run code", lambda file: torch.save(Payload(marker), file)),
        ("cut", "damaged", lambda file: file.write_bytes(b"PK" + bytes(100))),
        (
            "old",
            "before torch 1.6",
            lambda file: torch.save(stored, file, _use_new_zipfile_serialization=False),
        ),
    ):
        save(tmp_path / f"{stem}.pt")
        with pytest.raises(FileError, match=told):
            read_point_features(tmp_path / f"{stem}.pt")
    assert not marker.exists()
