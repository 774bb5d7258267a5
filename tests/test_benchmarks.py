"""What the benchmarks measure on: paths through the house, which frames are held out, and the
pictures of what is worst.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import house  # noqa: E402
import properties_flicker  # noqa: E402
import quality  # noqa: E402
import quality_pictures  # noqa: E402
import tracking  # noqa: E402
from quality_methods import METHODS, method  # noqa: E402
from quality_scenes import split  # noqa: E402

from taichi_unifusion import Frame, PinholeCamera  # noqa: E402
from taichi_unifusion.datasets.synthetic import SyntheticRoom  # noqa: E402
from taichi_unifusion.errors import InputError  # noqa: E402

SMOOTH = 0.5  # share by which the motion may change from one frame to the next
CLEARANCE = 0.35  # [m] of a camera centre to what it sees: no hand passes nearer
ROUNDING = 1e-12
RESAMPLED = 2e-3  # of colours that change slowly over a wall, between pixels


@pytest.mark.parametrize("name", house.PATHS)
def test_paths_are_rigid_smooth_closed_and_at_a_hands_speed(name):
    trajectory = house.trajectory(name)
    T = trajectory.T_world_camera
    closed = np.concatenate([T, T[:2]])
    step, turn = house.steps(closed), house.turns(closed)
    assert len(trajectory) >= 100
    # arcs against their chords, measured and resampled
    assert step.max() < 1.02 * house.STEP and turn.max() < 1.02 * house.TURN
    speed = np.hypot(step / house.STEP, turn / house.TURN)
    assert np.abs(np.diff(speed)).max() < SMOOTH * speed.mean() and speed.min() > 0.5 * speed.mean()
    R = T[:, :3, :3]
    np.testing.assert_allclose(
        R @ R.swapaxes(1, 2), np.broadcast_to(np.eye(3), R.shape), atol=ROUNDING
    )
    assert np.linalg.det(R).min() > 0.999
    assert (R[:, 2, 1] < -0.5).all()  # upright: image y points down


def test_an_unknown_path_is_told():
    with pytest.raises(InputError, match="living"):
        house.trajectory("garden")


def test_house_is_seen_from_within_with_its_labels(data):
    frames = house.load_house(data("aws-small-house"), "bedroom")
    assert {"Bed", "ChairA", "SofaC", "RoomWall"} <= set(frames.class_names) and len(
        frames.class_names
    ) == 49
    for index in (60, 219):  # before the bed; in the narrowest place
        depth = frames.exact_depth(index)
        assert depth[depth > 0].min() > CLEARANCE and (depth > 0).mean() > 0.85
    classes, objects = frames.labels(60)
    assert (classes == frames.class_names.index("Bed")).mean() > 0.05
    assert ((classes >= 0) == (objects >= 0)).all()


@pytest.mark.parametrize(("count", "every"), [(300, 10), (445, 5), (120, 2), (9, 4), (3, 3)])
def test_no_frame_is_both_fused_and_held_out(count, every):
    fused, between = split(count, every, 8)
    assert fused == list(range(0, count, every))
    assert len(set(between)) == len(between) <= 8 and between == sorted(between)
    assert not set(fused) & set(between) and all(0 < i < count for i in between)


def test_worst_windows_hold_the_error():
    blank = np.zeros((480, 640, 3), np.uint8)
    frames = []
    for index, (y, x, size) in enumerate([(100, 200, 30), (300, 400, 60), (10, 20, 10)]):
        error = np.zeros((480, 640), np.float32)
        error[y : y + size, x : x + size] = 0.1
        frames.append(quality_pictures.Comparison(index, blank, blank, blank, error))
    worst = quality_pictures.worst_windows(frames)
    assert [c.index for c, _, _ in worst] == [1, 0, 2]
    for c, y, x in worst:
        height, width = quality_pictures.WINDOW
        assert c.error[y : y + height, x : x + width].sum() == pytest.approx(c.error.sum())


def test_table_has_a_dash_where_nothing_was_measured():
    text = quality.table(
        {"room": {"ours": {"numbers": {"f1_1cm": 0.985, "psnr_db": None, "coverage": 0.5}}}}
    )
    titles, rule, line = (
        [cell.strip() for cell in row.strip("|").split("|")] for row in text.splitlines()
    )
    cells = dict(zip(titles, line, strict=True))
    assert (cells["F1 1 cm"], cells["PSNR dB"], cells["coverage"], cells["method"]) == (
        "98.5",
        "-",
        "0.500",
        "ours",
    )
    assert len(rule) == len(titles)


def test_methods_are_named_or_files(tmp_path):
    assert all(callable(method(name)) for name in METHODS)
    (tmp_path / "mine.yaml").write_text("surface: {voxel_size: 0.04}\n")
    assert callable(method(str(tmp_path / "mine.yaml")))
    assert method("tsdf-1.5cm-t8-w3").keywords == {
        "voxel_size": 0.015,
        "truncation": 8,
        "min_weight": 3,
    }
    for unknown in ("tsdf", "tsdf-1cm-t8", "TSDF-1cm"):
        with pytest.raises(InputError, match="tsdf-1cm"):
            method(unknown)


def wall_seen_from(x: float, tint: float) -> properties_flicker.HeldOut:
    """A wall 2 m ahead whose colour runs with the place, from `x` metres to the right; its style
    images are off by `tint`.
    """
    camera, T = PinholeCamera(64, 48, 60, 60, 31.5, 23.5), np.eye(4)
    T[0, 3] = x
    depth = np.full((48, 64), 2.0, np.float32)
    v, u = np.indices(depth.shape)
    place = np.dstack(
        [(u - camera.cx) / 60 * 2 + x, (v - camera.cy) / 60 * 2, np.zeros(depth.shape)]
    )
    color = np.float32(0.5 + 0.2 * np.sin(place))
    covered = np.ones(depth.shape, bool)
    covered[:, 20:30] = False  # as seen from here
    return properties_flicker.HeldOut(
        Frame(depth, camera, None, T),
        depth,
        {"color": color, "style": color + np.float32(tint)},
        {"color": color, "style": color},
        covered,
    )


def test_flicker_is_the_change_at_the_same_points(tmp_path):
    """A camera that moves past a wall sees no change of its colour; a tint that comes and goes is
    one, of its size.
    """
    views = [wall_seen_from(0.13 * n, 0.1 * (n % 2)) for n in range(4)]
    found = properties_flicker.mean_changes(views)
    assert max(found["color"]) < 100 * RESAMPLED and found["style"][1] < 100 * RESAMPLED
    assert found["style"][0] == pytest.approx(10, abs=100 * RESAMPLED)
    change = properties_flicker.changes(views[0], views[1])[0]["color"]
    assert (
        np.isnan(change[:, 20:30]).all()
        and np.isnan(change[:, :3]).all()
        and np.isfinite(change[:, 40:60]).all()
    )
    properties_flicker.write_sheet(tmp_path / "sheet.jpg", views, "style")
    assert cv2.imread(str(tmp_path / "sheet.jpg")).shape == (3 * 216, 5 * 288, 3)


def test_the_table_of_trackers_has_a_row_a_method_and_tells_good_poses_from_bad_ones():
    frames = SyntheticRoom(frames=240, width=160, height=120)[:11]
    ours, given = tracking.compare(["ours"], frames)
    assert ours[:2] == ["ours", "11 of 11"] and given[:2] == ["given poses", "11 of 11"]
    assert 0 < float(ours[2]) < 1 and len(ours) == len(given) == len(tracking.HEADER)
    truth = {frame.index: frame.T_world_camera for frame in frames}
    pyramids = {index: tracking.pyramid(frames[index]) for index in (0, 10)}
    still = dict.fromkeys(truth, truth[0])
    assert (
        float(tracking.agreement(pyramids, truth)) > float(tracking.agreement(pyramids, still)) + 20
    )
