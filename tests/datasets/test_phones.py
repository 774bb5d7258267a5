"""Recordings of phones: written as their apps lay them out, read back, and held against the truth."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import phone_writers
import pytest
from phone_writers import View, color_at, views

from taichi_unifusion import PinholeCamera
from taichi_unifusion.cli.options import RecordingOptions, for_mapping, open_recording
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.depth_registration import LensCamera
from taichi_unifusion.datasets.shared_view import SharedView, Shot
from taichi_unifusion.errors import DatasetError, FrameError, InputError

# [m] of depth that is stored in millimetres, halfway between two, and of poses in text
ROUNDED = 0.00055
# of 255: JPEG, HEVC, and the mean over a pixel of depth instead of its centre
COLOR_ERROR = 6.0
LENS_ERROR = 0.002  # [m] of depth that is interpolated between the pixels of a distorted image
HALF_FLOAT = 0.001  # [m] of distances up to 2 m with 11 bits


def check(frames, truth: list[View], error: float = ROUNDED) -> None:
    """Readings lie on the wall, where the truth has them, and have the colour of that place."""
    assert len(frames) == len(truth)
    for frame, true in zip(frames, truth, strict=True):
        np.testing.assert_allclose(frame.T_world_camera, true.T_world_camera, atol=1e-6)
        height, width = true.depth.shape
        expected = true.camera.resized(width, height)
        assert frame.camera.size == expected.size
        np.testing.assert_allclose(frame.camera.intrinsics, expected.intrinsics, atol=1e-6)
        exact = phone_writers.depth_of(frame.camera, frame.T_world_camera)
        known = frame.depth > 0
        assert known.mean() > 0.7
        assert np.abs(frame.depth - exact)[known].max() < error
        T = frame.T_world_camera
        points = frame.camera.rays() * exact[..., None] @ T[:3, :3].T + T[:3, 3]
        wrong = np.abs(frame.color - color_at(points))[known]
        assert wrong.mean() < COLOR_ERROR and np.median(wrong) < COLOR_ERROR / 2


def one_camera(shots: list[View]) -> list[View]:
    """Views of the first one's camera: a video has one for all."""
    return [view_of(shots[0].camera, shot) for shot in shots]


def view_of(camera, shot: View) -> View:
    T = shot.T_world_camera
    exact = phone_writers.depth_of(camera, T)
    points = camera.rays() * exact[..., None] @ T[:3, :3].T + T[:3, 3]
    height, width = shot.depth.shape
    depth = phone_writers.depth_of(camera.resized(width, height), T).astype(np.float32)
    return View(depth, np.rint(color_at(points)).astype(np.uint8), camera, T)


@pytest.mark.parametrize("portrait", [True, False])
def test_record3d_archive(tmp_path, portrait):
    shots = views(portrait)
    recording = open_dataset("record3d", phone_writers.write_r3d(tmp_path, shots))
    check(list(recording), shots)
    assert [frame.timestamp for frame in recording] == [i / 30 for i in range(len(shots))]
    assert recording.up == (0.0, 1.0, 0.0) and recording.registered


def test_record3d_export_gives_the_same_frames(tmp_path):
    pytest.importorskip("OpenEXR")
    shots = views(portrait=True)
    archive = open_dataset("record3d", phone_writers.write_r3d(tmp_path, shots))
    export = open_dataset("record3d", phone_writers.write_record3d_export(tmp_path, shots))
    check(list(export), shots)
    for a, b in zip(archive, export, strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_array_equal(a.color, b.color)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
        assert (a.camera, a.timestamp) == (b.camera, b.timestamp)


def test_record3d_with_more_poses_than_images(tmp_path):
    shots = views()
    path = phone_writers.write_r3d(tmp_path, shots[:2])
    metadata = phone_writers._metadata(shots)
    with zipfile.ZipFile(path) as archive:
        others = {name: archive.read(name) for name in archive.namelist() if name != "metadata"}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(metadata))
        for name, data in others.items():
            archive.writestr(name, data)
    check(list(open_dataset("record3d", path)), shots[:2])


@pytest.mark.parametrize("corrected", [False, True])
def test_polycam(tmp_path, corrected):
    shots = views()
    if corrected:  # what Polycam has optimised counts
        phone_writers.write_polycam(tmp_path, [shots[0]] * len(shots))
    phone_writers.write_polycam(tmp_path, shots, corrected=corrected)
    recording = open_dataset("polycam", tmp_path)
    check(list(recording), shots)
    assert recording[1].timestamp - recording[0].timestamp == pytest.approx(0.033333, abs=1e-6)


def test_black_borders_of_corrected_images_give_no_color(tmp_path):
    shots = views()
    for shot in shots:
        shot.color[:12] = 0  # three rows of depth
    phone_writers.write_polycam(tmp_path, shots, corrected=True)
    frame = open_dataset("polycam", tmp_path)[0]
    unknown = np.isnan(frame.images["color"]).all(axis=2)
    assert unknown[:2].all() and not unknown[4:].any()
    np.testing.assert_allclose(frame.images["color"][5], frame.color[5] / 255, atol=1e-6)


@pytest.mark.parametrize("old", [False, True])
def test_strayscanner(tmp_path, old):
    pytest.importorskip("av")
    shots = one_camera(views())
    phone_writers.write_strayscanner(tmp_path, shots, old=old)
    recording = open_dataset("strayscanner", tmp_path)
    check(list(recording), shots)
    # whatever the order in which they are asked for
    frames = [recording[i] for i in (3, 0, 2, 1)]
    check(frames, [shots[i] for i in (3, 0, 2, 1)])
    assert recording[2].timestamp == (None if old else pytest.approx(100 + 2 / 60))


@pytest.mark.parametrize("kind", ["nerfstudio", "instant-ngp"])
def test_transforms_json(tmp_path, kind):
    shots = views(portrait=True)
    phone_writers.write_transforms(tmp_path, shots, kind)
    for path in (tmp_path, tmp_path / "transforms.json"):
        check(list(open_dataset("nerfstudio", path)), shots)


@pytest.mark.parametrize("kind", ["fisheye", "brown"])
def test_transforms_json_of_a_lens(tmp_path, kind):
    shots = views()
    seen = [phone_writers.through_lens(shot, kind) for shot in shots]
    phone_writers.write_transforms(tmp_path, seen, kind)
    check(list(open_dataset("nerfstudio", tmp_path)), shots, LENS_ERROR)


def test_arkitscenes(tmp_path):
    shots = views(count=5)
    phone_writers.write_arkitscenes(tmp_path, shots, every=2)
    recording = open_dataset("arkitscenes", tmp_path)
    check(list(recording), shots[::2])
    assert "2 of 5 depth images have no pose within 0.005 s" in recording.warnings[0]


@pytest.mark.parametrize("packing", ["stream", "lz4", "deflate"])
def test_scannetpp(tmp_path, packing):
    pytest.importorskip("av"), pytest.importorskip("lz4")
    shots = phone_writers.iphone_views()
    recording = open_dataset("scannetpp", phone_writers.write_scannetpp(tmp_path, shots, packing))
    check(list(recording), shots)
    check([recording[i] for i in (2, 0, 1)], [shots[i] for i in (2, 0, 1)])


def test_matterport(tmp_path):
    shots = views(count=3)
    seen = [view_of(shots[0].camera, shot) for shot in shots]  # a camera has one file
    write_seen = [phone_writers.through_lens(shot, "brown") for shot in seen]
    recording = open_dataset("matterport", phone_writers.write_matterport(tmp_path, write_seen))
    check(list(recording), seen, LENS_ERROR)


def test_hypersim(tmp_path):
    pytest.importorskip("h5py")
    shots = phone_writers.hypersim_views()
    recording = open_dataset("hypersim", phone_writers.write_hypersim(tmp_path, shots))
    check(list(recording), shots, HALF_FLOAT)
    assert recording.up == (0, 0, 1)


def test_depth_of_an_unknown_unit_is_refused(tmp_path):
    phone_writers.write_transforms(tmp_path, views(), "instant-ngp")
    file = tmp_path / "transforms.json"
    values = json.loads(file.read_text())
    del values["integer_depth_scale"]
    file.write_text(json.dumps(values))
    with pytest.raises(DatasetError, match="give depth_scale"):
        open_dataset("nerfstudio", tmp_path)
    assert 1 < np.median(open_dataset("nerfstudio", tmp_path, depth_scale=6553.5)[0].depth) < 2


WRITERS = {
    "record3d": phone_writers.write_r3d,
    "polycam": phone_writers.write_polycam,
    "strayscanner": phone_writers.write_strayscanner,
    "arkitscenes": phone_writers.write_arkitscenes,
}


@pytest.mark.parametrize("format", WRITERS)
def test_confidence(tmp_path, format):
    shots = one_camera(views(count=1))
    confidence = np.zeros(shots[0].depth.shape, np.uint8)
    confidence[:, 10:], confidence[:, 20:] = 1, 2
    path = WRITERS[format](tmp_path, shots, confidence)
    known = {
        least: open_dataset(format, path, min_confidence=least)[0].depth > 0 for least in (0, 1, 2)
    }
    for least in known:
        np.testing.assert_array_equal(known[least], confidence >= least)
    np.testing.assert_array_equal(open_dataset(format, path)[0].depth > 0, known[1])
    weighed = open_dataset(format, path, weigh_confidence=True)[0]
    np.testing.assert_array_equal(weighed.depth > 0, known[1])
    np.testing.assert_array_equal(weighed.weights[known[1]], confidence[known[1]])
    assert open_dataset(format, path)[0].weights is None
    fine = open_dataset(format, path, weigh_confidence=True, color_detail=2)[0]
    seen = fine.depth > 0
    sure = np.repeat(np.repeat(confidence, 2, 0), 2, 1)
    inner = seen & ~np.isin(np.arange(seen.shape[1]), (19, 20, 39, 40))  # between two of them
    np.testing.assert_array_equal(fine.weights[inner], np.maximum(sure, 1)[inner])
    with pytest.raises(InputError, match="min_confidence"):
        open_dataset(format, path, min_confidence=3)


def test_more_colors_than_depth(tmp_path):
    shots = views()
    recording = open_dataset("record3d", phone_writers.write_r3d(tmp_path, shots), color_detail=2)
    for frame, shot in zip(recording, shots, strict=True):
        assert frame.camera == shot.camera.resized(96, 72)
        exact = phone_writers.depth_of(frame.camera, frame.T_world_camera)
        known = frame.depth > 0
        assert known.mean() > 0.9 and np.abs(frame.depth - exact)[known].max() < 0.001


def shot(distance: float, camera: PinholeCamera, color=lambda: np.zeros((4, 4, 3), np.uint8)):
    """A wall so far away, 256x192 pixels of depth."""
    depth = np.full((192, 256), distance, np.float32)
    return Shot("s", lambda: LensCamera(camera, ()), lambda: depth, color)


def test_pixels_are_divided_where_they_are_coarse():
    """Asked for what fits, of a colour image that is larger: where they span over 6 mm, which is 1.2 m away."""
    phone = PinholeCamera(1920, 1440, 1450, 1450, 960, 720)
    small = phone.resized(256, 192)

    def chosen(*shots: Shot, detail: int = 0) -> int:
        return SharedView("phone", shots, detail=detail).detail

    def unreadable():
        raise FrameError("gone")

    assert [chosen(shot(z, phone)) for z in (0.3, 1.1, 1.3, 4.0)] == [1, 1, 2, 2]
    assert chosen(shot(4.0, small)) == 1 and chosen(shot(4.0, phone, None)) == 1
    broken = replace(shot(0.3, phone), depth=unreadable)
    assert chosen(broken, shot(0.0, phone), shot(4.0, phone), shot(0.3, phone)) == 2
    assert chosen(shot(0.0, phone)) == 1 and chosen(shot(4.0, phone), detail=1) == 1


def test_who_maps_asks_for_what_fits(tmp_path):
    path = phone_writers.write_r3d(tmp_path, views())
    asked = for_mapping(RecordingOptions("auto", path))
    assert open_recording(asked)[0].camera.size == (96, 72)
    for option in ("color_detail=1", "colour_detail=1"):
        given = RecordingOptions("record3d", path, option=(option,))
        assert for_mapping(given) == given and open_recording(given)[0].camera.size == (48, 36)
    other = RecordingOptions("synthetic")
    assert for_mapping(other) == other


def test_a_frame_that_is_damaged_costs_itself_only(tmp_path):
    shots = views()
    phone_writers.write_polycam(tmp_path, shots)
    cameras = sorted((tmp_path / "keyframes" / "cameras").iterdir())
    cameras[1].write_text("{")
    recording = open_dataset("polycam", tmp_path)
    assert "1 of 4 frames have no usable pose" in recording.warnings[0]
    with pytest.raises(FrameError, match=cameras[1].name):
        recording[1]
    check([recording[i] for i in (0, 2, 3)], [shots[i] for i in (0, 2, 3)])


def test_images_that_are_turned_against_their_camera_are_said(tmp_path):
    shots = views(portrait=True)
    turned = [View(s.depth.T.copy(), s.color, s.camera, s.T_world_camera) for s in shots]
    path = phone_writers.write_polycam(tmp_path, turned)
    with pytest.raises(FrameError, match="turned by a quarter"):
        open_dataset("polycam", path)[0]


SAMPLES = {
    "record3d": ("record3d-exr", "record3d-r3d/doorhandle8.r3d"),
    "nerfstudio": ("nerfstudio-depth",),
    "polycam": ("polycam-raw",),
    "strayscanner": ("stray-scanner",),
}
# [cm, share] what an independent check of the poses found between frames of the iPhone's recording
AGREEMENT, WITHIN_2_CM = 0.38, 0.92


@pytest.mark.parametrize(
    ("format", "name"), [(format, name) for format, names in SAMPLES.items() for name in names]
)
def test_frames_of_an_iphone_agree(data, format, name):
    frames = list(open_dataset(format, data("formats") / Path(name)))
    assert len(frames) == 8
    apart = [disagreement(a, b) for a, b in pairwise(frames)]
    medians, shares = zip(*apart, strict=True)
    assert 100 * np.median(medians) <= AGREEMENT and np.mean(shares) > WITHIN_2_CM


def disagreement(a, b) -> tuple[float, float]:
    """How far the readings of one frame lie from those of the next [m], and how many within 2 cm."""
    v, u = np.nonzero(a.depth)
    points = a.camera.rays(u, v) * a.depth[v, u][:, None]
    T_b_a = np.linalg.inv(b.T_world_camera) @ a.T_world_camera
    points = points @ T_b_a[:3, :3].T + T_b_a[:3, 3]
    seen, inside = b.camera.look_up(b.depth, points)
    apart = np.abs(seen - points[inside, 2])[seen > 0]
    return float(np.median(apart)), float((apart < 0.02).mean())


def test_record3d_sample_is_the_same_in_both_layouts(data):
    export, archive = (
        open_dataset("record3d", data("formats") / name) for name in SAMPLES["record3d"]
    )
    for a, b in zip(export, archive, strict=True):
        np.testing.assert_array_equal(a.depth, b.depth)
        np.testing.assert_array_equal(a.color, b.color)
        np.testing.assert_array_equal(a.T_world_camera, b.T_world_camera)
        assert (a.camera, a.timestamp) == (b.camera, b.timestamp)
        assert a.camera.size == (192, 256)  # portrait
