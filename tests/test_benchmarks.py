"""What the benchmarks measure on: paths through the house, which frames are held out, and the
pictures of what is worst.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from places import DEVICE
from tiny_recording import make_frames, write_folder

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import gpu_checks  # noqa: E402
import house  # noqa: E402
import properties_flicker  # noqa: E402
import quality  # noqa: E402
import quality_pictures  # noqa: E402
import quality_shared  # noqa: E402
import rendering  # noqa: E402
import speed  # noqa: E402
import speed_profile  # noqa: E402
import speed_tables  # noqa: E402
import tracking  # noqa: E402
from quality_methods import METHODS, method  # noqa: E402
from quality_scenes import split  # noqa: E402
from speed_sides import ByHand, OpenTsdf, Ours, Times  # noqa: E402

from taichi_unifusion import Config, Frame, PinholeCamera  # noqa: E402
from taichi_unifusion.cli import main as cli  # noqa: E402
from taichi_unifusion.datasets.synthetic import SyntheticRoom  # noqa: E402
from taichi_unifusion.errors import InputError, RuntimeStateError  # noqa: E402
from taichi_unifusion.kernels.layout import Layout  # noqa: E402
from taichi_unifusion.maps.encoder import window_masks  # noqa: E402

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


def test_methods_are_compared_where_all_of_them_have_a_surface():
    depth, color = np.full((24, 32), 2.0, np.float32), np.full((24, 32, 3), 51, np.uint8)
    depth[:, 30:] = 0  # no reading
    frame = Frame(
        depth, PinholeCamera(32, 24, 30, 30, 16, 12), color=color, T_world_camera=np.eye(4)
    )

    def rendered(off, hole, shade):
        seen = np.where(np.arange(32) < hole, np.inf, 2.0 + off).astype(np.float32)
        image = np.full((24, 32, 3), shade, np.float16)
        seen = np.tile(seen, (24, 1))
        seen[:, 10] += 10 * off  # what only one method has to answer for counts for none
        return [quality_shared.RenderedFrame(seen, image)]

    scores = quality_shared.score_shared(
        {"whole": rendered(0.01, 0, 0.2), "holes": rendered(0.02, 15, 0.3)}, [frame], 0.4
    )
    assert scores["whole"]["shared_coverage"] == scores["holes"]["shared_coverage"] == 0.5
    assert scores["whole"]["shared_l1_cm"] == pytest.approx(1, rel=1e-4)  # without column 10
    assert scores["holes"]["shared_l1_cm"] == pytest.approx(2, rel=1e-4)
    assert scores["holes"]["shared_psnr_db"] == pytest.approx(20, abs=0.05)
    assert scores["whole"]["shared_psnr_db"] > 60 and scores["whole"]["shared_ssim"] > 0.99


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


def test_the_table_of_trackers_has_a_row_a_method_and_tells_good_poses_from_bad_ones(caplog):
    frames = SyntheticRoom(frames=240, width=160, height=120)[:11]
    ours, given = tracking.compare(["ours"], frames)
    assert ours[:2] == ["ours", "11 of 11"] and given[:2] == ["given poses", "11 of 11"]
    assert 0 < float(ours[2]) < 1 and len(ours) == len(given) == len(tracking.HEADER)
    assert "colour image" not in caplog.text  # there are some
    truth = {frame.index: frame.T_world_camera for frame in frames}
    pyramids = {index: tracking.pyramid(frames[index]) for index in (0, 10)}
    still = dict.fromkeys(truth, truth[0])
    assert (
        float(tracking.agreement(pyramids, truth)) > float(tracking.agreement(pyramids, still)) + 20
    )


@pytest.fixture(scope="module")
def small_room() -> SyntheticRoom:
    return SyntheticRoom(frames=60, width=160, height=120)


def test_times_of_a_side_are_means_that_hold_what_was_put_off():
    times = Times(np.array([[1.0, 2], [1, 2], [4, 2]]), np.array([6.0, 0]), np.array([5.0, 5]))
    assert times.mean.tolist() == [4, 2] and times.worst.tolist() == [1, 1]


def test_speed_has_a_row_a_side_and_sampling(small_room, monkeypatch, capsys):
    monkeypatch.setattr(speed, "REST", 0)
    monkeypatch.setattr(speed, "TURN", 4)
    # one after the other, so that they share index trees, for which kernels are compiled
    for side in (Ours, ByHand):
        monkeypatch.setattr(speed, "all_sides", lambda config, side=side: [side(config)])
        if side is ByHand:
            monkeypatch.setattr(speed, "Ours", ByHand)
        speed.compare(small_room[:12], [1, 2], Config())
        rows = [
            [cell.strip() for cell in line.strip("|").split("|")]
            for line in capsys.readouterr().out.splitlines()
            if line.startswith("|")
        ][2:]
        assert [row[:3] for row in rows] == [["1", "8", side.name], ["2", "2", side.name]]
        assert all(float(row[3]) > 0 and float(row[7]) > 0 for row in rows)
    with pytest.raises(InputError, match="more than 4 are needed"):
        speed.compare(small_room[:12], [3], Config())


def test_ratios_are_to_the_peer():
    one = Times(np.full((2, 2), 3.0), np.zeros(2), np.array([8.0, 4]))
    peer = Times(np.full((2, 2), 2.0), np.zeros(2), np.array([4.0, 4]))
    row, other = speed_tables.rows_of(5, {Ours.name: one, OpenTsdf.name: peer})
    assert row[5:7] == ["1.50", "1.50"] and row[11:] == ["2.00", "1.00"]
    assert other[5:7] == ["1.00", "1.00"]
    assert speed_tables.rows_of(5, {Ours.name: one})[0][5:7] == ["-", "-"]


def test_growth_compares_the_same_views_by_round(small_room, capsys):
    speed.grow(list(small_room[:8:2]), Config(), rounds=3)
    text = capsys.readouterr().out
    assert "| 0 to 3 |" in text and "| 8 to 11 |" in text and "last round / second" in text


def test_encoding_is_counted_as_what_every_voxel_sees(small_room):
    """Bytes and operations that the profile sets beside the time are those of the samples."""
    with speed_profile.counted_launches() as counted:
        ours = Ours(Config())
        ours.step(small_room[0])
        ours.finish()
    assert {"make_patches", "compact_cells", "encode_cells", "vote_cells"} <= counted.keys()
    # the first frame launches what fuses, for no voxel, so that it is compiled
    assert all(sum(moved for moved, _ in launches) > 0 for launches in counted.values())
    # of one map: 20 + 4 rows, in patches of 4 x 4
    blocks, layout = 2, Layout(20, 1)
    of = {
        "layout": layout,
        "begin": 0,
        "end": blocks,
        "masks": np.array([[0xFF, 0], [0, 1]], np.uint32),
        "neighbors": np.where(np.arange(27) == 13, [[0], [1]], -1),
        "rows": np.array([[0, 8, 1], [8, 1, 1]]),
        "minimum": 2,
        "window": window_masks(4),
    }
    of["neighbors"][0, 14] = 1
    patches, samples = 1 + 2 + 3 + 4 + 5 + 5, 8 + 1
    solve = 20**3 / 3 + 20**2 * (4 + 2)
    assert speed_profile.COUNTS["encode_cells"].of(of)[1] == 32 * patches * samples + solve


def test_profile_runs_the_frames_and_says_how_it_counts(small_room, monkeypatch):
    # of a process that Taichi was started in with its profiler on
    monkeypatch.setattr(speed_profile, "kernel_times", lambda: {"vote_cells": (6.0, 2)})
    text = speed_profile.profile(list(small_room[:4]), Config(), 2)
    assert "2 frames, Pipeline.step" in text and "| vote_cells | 3.00 | 100 | 1.0 | " in text
    assert "| vote_cells | 3.00 | 100 | 1.0 | - |" not in text
    for name in ("make_patches", "compact_cells", "encode_cells", "vote_cells"):
        assert f"| {name} | {speed_profile.COUNTS[name].how} |" in text


def test_profile_sets_the_least_time_beside_a_kernels():
    machine = speed_profile.Machine(bytes_per_ms=1e6, flops_per_ms=1e7)
    times = {"encode_cells": (40.0, 4), "fuse": (10.0, 2), "tiny": (0.01, 2)}
    text = speed_profile.kernel_table(times, {"encode_cells": [(2e6, 1e6)] * 4}, machine, 2)
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]
    assert rows[0] == ["encode_cells", "20.00", "80", "2.0", "4.0", "2.0", "4.00", "5"]
    assert rows[1] == ["fuse", "5.00", "20", "1.0", "-", "-", "-", "-"]
    assert [row[:2] for row in rows[2:]] == [["others", "0.01"], ["all kernels", "25.00"]]


def test_kernels_are_timed_by_name_over_all_their_forms():
    code = """
import taichi_unifusion as uf, speed_profile
from taichi_unifusion.datasets.synthetic import SyntheticRoom
uf.init("cpu")
frame = SyntheticRoom(60, width=160, height=120)[0]
uf.preprocess(frame)
uf.preprocess(frame)
ms, calls = speed_profile.kernel_times()["make_patches"]
print(calls, ms > 0)
"""
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"TI_KERNEL_PROFILER": "1", "PYTHONPATH": str(BENCHMARKS)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.split() == ["2", "True"]


def test_tables_align_numbers():
    assert speed_tables.markdown(["a", "b"], [["x", "1.5"], ["y", "-"]]).splitlines() == [
        "| a | b |",
        "| --- | ---: |",
        "| x | 1.5 |",
        "| y | - |",
    ]


def test_a_machine_without_cuda_is_told_so_in_a_sentence(monkeypatch, capsys):
    def absent(device: str) -> None:
        raise RuntimeStateError(f"device: {device} was asked for but is not there")

    monkeypatch.setattr(gpu_checks.uf, "init", absent)
    monkeypatch.setattr(sys, "argv", ["gpu_checks.py", "cuda"])
    assert gpu_checks.main() == 2
    assert capsys.readouterr().out == "device: cuda was asked for but is not there\n"


def test_a_step_that_dies_is_a_failure_and_not_the_end(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["gpu_checks.py", "pool", "--device", "cpu"])
    monkeypatch.setattr(gpu_checks, "__file__", str(BENCHMARKS / "no_such_file.py"))
    assert gpu_checks.main() == 1
    assert "exhaust on cpu ended with" in capsys.readouterr().out


def test_paper_maps_are_timed_one_by_one_and_together(monkeypatch, capsys):
    monkeypatch.setattr(gpu_checks, "FEATURES", (6, 8))
    monkeypatch.setattr(gpu_checks, "CHANNELS", 32)
    verdict = gpu_checks.table(DEVICE, 3, (160, 120))
    assert all(name in verdict for name in ("surface", "color", "infrared", "latent", "all"))
    assert "| latent |" in capsys.readouterr().out


def test_rendering_measures_what_the_commands_make(tmp_path, monkeypatch, capsys):
    recording = write_folder(tmp_path / "recording", make_frames(3))
    results = str(tmp_path / "results")
    said = ["folder", str(recording), "--mesh.formats", "ply", "--out", results, "--device", DEVICE]
    assert cli.main(["reconstruct", *said]) == 0
    capsys.readouterr()
    assert cli.main(["evaluate", "rendering", results, "--all", "--json"]) == 0
    known = json.loads(capsys.readouterr().out)
    monkeypatch.setattr(sys, "argv", ["rendering.py", "folder", str(recording)])
    rendering.main()
    line = capsys.readouterr().out.splitlines()[0]
    found = [float(number) for number in re.findall(r"\d+\.\d+", line)]
    names = ("depth_l1_cm", "depth_median_cm", "coverage", "psnr_db", "ssim")
    assert found == pytest.approx([known[name] for name in names], abs=2e-3)
