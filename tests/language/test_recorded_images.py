"""Features of colour images as they were recorded, where colour is registered to depth; and how their
files are laid out.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from two_cameras import TwoCameras, rig_beside

from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.language import make_image_encoder
from taichi_unifusion.language.source import FeatureSource
from taichi_unifusion.properties import make_property
from taichi_unifusion.types import Frame

SIZE = 160, 120
PLAIN = TwoCameras(
    rig_beside(SyntheticRoom(frames=8, width=SIZE[0], height=SIZE[1]).camera), frames=8
)
RIG = rig_beside(PLAIN.camera, turn=(1.0, 2.0, 0.5), move=(0.05, 0.01, 0.0))


def bent(image: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """The image as a lens with distortion shows it."""
    pinhole, rows = RIG.pinhole.matrix, np.mgrid[: SIZE[1], : SIZE[0]][::-1].reshape(2, -1).T
    straight = cv2.undistortPoints(
        rows[:, None].astype(np.float32), pinhole, np.array([*distortion, 0, 0]), P=pinhole
    )
    columns, rows = straight.reshape(SIZE[1], SIZE[0], 2).transpose(2, 0, 1)
    return cv2.remap(image, columns, rows, cv2.INTER_LINEAR)


@pytest.fixture(scope="module", params=[(), (0.3, -0.1)], ids=["pinhole", "distorted"])
def rig(request):
    """A frame with colour registered, and its image as recorded."""
    recording = TwoCameras(RIG, frames=8, noise=False)
    image = recording.color_of(0)
    image = bent(image, request.param) if request.param else image
    camera = replace(RIG, distortion=request.param)
    frame = replace(recording.room[0], color=None, name="0.png")
    return camera.register(frame, image, None, "colour"), image


def save_colors(folder: Path, recorded: np.ndarray) -> None:
    colors = recorded[::2, ::2].astype(np.float32) + 1
    np.save(folder / "0.npy", colors / np.linalg.norm(colors, axis=2, keepdims=True))


def colors_placed(frame: Frame, encoder) -> float:
    """Mean distance between a reading's registered colour and the feature that it falls upon."""
    view = FeatureSource(encoder).add_to(frame).features["features"]
    points = frame.camera.rays() * frame.depth[..., None]
    seen = np.isfinite(frame.images["color"]).all(axis=2) & (frame.depth > 0)
    at = points[seen] @ view.T_camera_cloud[:3, :3].T + view.T_camera_cloud[:3, 3]
    pixels = np.rint(at @ view.camera.matrix.T / at[:, 2:])[:, :2].astype(int)
    inside = ((pixels >= 0) & (pixels < view.camera.size)).all(axis=1)
    found = view.values[pixels[inside, 1], pixels[inside, 0]]
    colors = frame.color[seen][inside].astype(np.float32) + 1
    colors /= np.linalg.norm(colors, axis=1, keepdims=True)
    return float(np.nanmean(np.linalg.norm(found - colors, axis=1)))


def test_features_of_recorded_images_lie_where_their_colours_do(rig, tmp_path):
    frame, recorded = rig
    save_colors(tmp_path, recorded)
    as_recorded = colors_placed(frame, make_image_encoder(f"folder:{tmp_path}"))
    as_registered = colors_placed(
        frame, make_image_encoder(f"folder:{tmp_path}", images="registered")
    )
    assert as_recorded < 0.3 * as_registered


def test_property_images_of_recorded_colour_are_registered_as_it_is(rig, tmp_path):
    frame, recorded = rig
    np.save(tmp_path / "0.npy", recorded.astype(np.float32) / 255)
    placed = make_property(f"images={tmp_path},of=color").image(frame)
    known = np.isfinite(frame.images["color"]).all(axis=2)
    assert (np.isfinite(placed).all(axis=2) == known).all()
    assert np.abs(placed - frame.images["color"])[known].max() < 0.01  # of 8 bits
    as_depth = make_property(f"images={tmp_path}").image(frame)
    assert np.abs(as_depth - frame.images["color"])[known].max() > 0.3


@pytest.mark.parametrize(
    ("shape", "wanted"),
    [
        ((7, 60, 80), (60, 80, 7)),
        ((60, 80, 7), (60, 80, 7)),
        ((60, 80, 60), (60, 80, 60)),
        ((80, 60, 80), (60, 80, 80)),
        ((7, 24, 24), (24, 24, 7)),  # a network's square
        ((24, 24, 7), (24, 24, 7)),
        ((512, 15, 21), (15, 21, 512)),  # patches, a rim of the image left out
        ((30, 30, 512), (30, 30, 512)),
    ],
)
def test_the_shape_of_the_image_tells_the_layout(tmp_path, shape, wanted):
    np.save(tmp_path / "0.npy", np.ones(shape, np.float32))
    frame = Frame(np.ones((120, 160), np.float32), PLAIN.camera, name="0.png")
    assert make_image_encoder(f"folder:{tmp_path}").image_features(frame).shape == wanted
