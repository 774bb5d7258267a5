"""Which row of a trajectory belongs to which image: names, numbers, times in any unit, order."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from dataset_writers import (
    CAMERA,
    make_samples,
    tum_row,
    write_folder,
    write_tum,
)

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import DatasetError
from taichi_unifusion.geometry.time_stamps import since, to_nanoseconds, unit_of
from taichi_unifusion.tracking import track

COUNT = 12


@pytest.fixture(scope="module")
def samples():
    return make_samples(COUNT)


def recording(folder: Path, samples, stamps) -> Path:
    """A folder with images 000000 ... and rows that begin with the given stamps."""
    write_folder(folder, samples, poses="none")
    rows = [tum_row(s.T_world_camera, t) for s, t in zip(samples, stamps, strict=False)]
    (folder / "poses.txt").write_text("\n".join(rows))
    return folder


def assert_own_poses(dataset, samples) -> None:
    for i, sample in enumerate(samples):
        np.testing.assert_allclose(dataset[i].T_world_camera, sample.T_world_camera, atol=1e-9)


@pytest.mark.parametrize(
    "stamps",
    [
        [f"{i / 5:.6f}" for i in range(COUNT)],
        [f"{i / 5:g}" for i in range(COUNT)],  # some are whole, and equal an image's number
        [f"{10 * i}" for i in range(COUNT)],
        [f"{1305031453 + i / 30:.4f}" for i in range(COUNT)],
        [str(1305031453 * 10**9 + i * 33_333_333) for i in range(COUNT)],
        [f"{33 * i}" for i in range(COUNT)],
    ],
    ids=["fifths", "short", "tens", "epoch", "nanoseconds", "milliseconds"],
)
def test_B_numbered_images_get_as_many_timed_rows_in_order_and_that_is_said(
    tmp_path, samples, stamps
):
    dataset = open_dataset("folder", recording(tmp_path / "r", samples, stamps))
    assert_own_poses(dataset, samples)
    assert any("paired in their order" in sentence for sentence in dataset.warnings)


@pytest.mark.parametrize("count", [COUNT - 1, COUNT - 4])
def test_B_numbered_images_and_another_number_of_timed_rows_are_refused(tmp_path, samples, count):
    stamps = [f"{i / 5:.6f}" for i in range(count)]
    folder = recording(tmp_path / "r", samples, stamps)
    with pytest.raises(DatasetError) as caught:
        open_dataset("folder", folder)
    told = str(caught.value)
    assert f"0 to {float(stamps[-1]):g}," in told and "'000000' to '000011'" in told


@pytest.mark.parametrize("form", ["{}", "{:06d}", "{}.000000"])
def test_rows_named_by_number_go_to_the_image_of_that_number(tmp_path, samples, form):
    folder = recording(tmp_path / "r", samples, [form.format(i) for i in range(COUNT)])
    assert_own_poses(open_dataset("folder", folder), samples)
    lines = (folder / "poses.txt").read_text().splitlines()
    (folder / "poses.txt").write_text("\n".join(reversed(lines[::3])))  # every third is known
    dataset = open_dataset("folder", folder)
    np.testing.assert_allclose(dataset[3].T_world_camera, samples[3].T_world_camera, atol=1e-9)
    with pytest.raises(DatasetError, match="no row for it"):
        dataset[4]


def test_B_numbered_images_of_tum(tmp_path, samples):
    folder = write_tum(tmp_path / "tum", samples)
    for name, kind in (("rgb.txt", "rgb"), ("depth.txt", "depth")):
        files = sorted((folder / kind).iterdir())
        lines = [f"{i} {kind}/{file.name}" for i, file in enumerate(files)]
        (folder / name).write_text("\n".join(lines))
    rows = [tum_row(s.T_world_camera, f"{i / 4:.2f}") for i, s in enumerate(samples)]
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    dataset = open_dataset("tum", folder, camera=CAMERA)
    assert_own_poses(dataset, samples)
    assert any("paired in their order" in sentence for sentence in dataset.warnings)
    (folder / "groundtruth.txt").write_text("\n".join(rows[:-2]))
    with pytest.raises(DatasetError, match="images are numbered"):
        open_dataset("tum", folder, camera=CAMERA)


def test_B_frames_without_time_never_take_the_pose_at_their_number_in_seconds(tmp_path, samples):
    folder = recording(tmp_path / "r", samples, [])
    (folder / "poses.txt").unlink()
    rows = [tum_row(s.T_world_camera, f"{i / 5:g}") for i, s in enumerate(samples)]
    (tmp_path / "poses.txt").write_text("\n".join(rows))
    frames = open_dataset("folder", folder)
    with pytest.raises(DatasetError, match="run from 0 to 2.2, those of the frames from 0 to 11"):
        track(frames, mode="external", trajectory=tmp_path / "poses.txt")


@pytest.mark.parametrize(
    ("unit", "per_second"),
    [("nanoseconds", 10**9), ("microseconds", 10**6), ("milliseconds", 10**3)],
)
@pytest.mark.parametrize("start", [1_305_031_453, 1_763_000_000, 400_000])
def test_C_units_are_known_by_size_and_step(unit, per_second, start):
    if start < 10**6 and unit == "milliseconds":
        return  # a device's clock in milliseconds looks like seconds by its size; its steps tell
    words = [str((start * 30 + i) * per_second // 30) for i in range(20)]
    assert unit_of(words) == unit
    seconds = [str(start + i / 30) for i in range(20)]
    assert unit_of(seconds) == unit_of([str(i) for i in range(300)]) == "seconds"


def test_C_no_digit_of_a_long_stamp_is_lost():
    words = ["1763000000123456789", "1763000000123456790"]
    first, second = (to_nanoseconds(word, "nanoseconds") for word in words)
    assert since([first, second], first)[1] == 1e-9
    assert to_nanoseconds("1305031453.359684") == 1305031453359684000


@pytest.mark.parametrize(
    ("unit", "per_second"),
    [("nanoseconds", 10**9), ("microseconds", 10**6), ("milliseconds", 10**3)],
)
@pytest.mark.parametrize("truth_too", [True, False])
def test_C_tum_lists_in_another_unit(tmp_path, samples, unit, per_second, truth_too):
    folder = write_tum(tmp_path / "tum", samples)
    plain = open_dataset("tum", folder, camera=CAMERA)
    names = ["rgb.txt", "depth.txt", *(["groundtruth.txt"] if truth_too else [])]
    for name in names:
        text = (folder / name).read_text()
        whole = re.sub(
            r"^(\d+\.\d+)", lambda m: str(round(float(m[1]) * per_second)), text, flags=re.MULTILINE
        )
        (folder / name).write_text(whole)
    dataset = open_dataset("tum", folder, camera=CAMERA)
    assert len(dataset) == len(plain) == COUNT
    assert_own_poses(dataset, samples)
    assert [f.timestamp for f in dataset] == pytest.approx(
        [f.timestamp for f in plain], abs=max(1 / per_second, 1e-6)
    )
    for name in names:
        assert any(f"{name}: its time stamps are {unit}" in told for told in dataset.warnings)


def test_C_a_gap_that_no_option_closes_is_not_answered_with_one(tmp_path, samples):
    folder = write_tum(tmp_path / "tum", samples)
    text = (folder / "rgb.txt").read_text().replace("1305031453", "1305039453")
    (folder / "rgb.txt").write_text(text)
    with pytest.raises(DatasetError, match="colour is of .* depth of .*recordings") as caught:
        open_dataset("tum", folder, camera=CAMERA)
    assert "raise max_difference" not in str(caught.value)


def test_C_images_named_in_nanoseconds(tmp_path, samples):
    folder = write_folder(tmp_path / "r", samples, poses="none")
    stamps = [1_763_000_000_000_000_000 + 33_333_333 * i for i in range(COUNT)]
    for i, stamp in enumerate(stamps):
        for kind in ("depth", "color"):
            (folder / kind / f"{i:06d}.png").rename(folder / kind / f"{stamp}.png")
    rows = [
        tum_row(s.T_world_camera, f"{(t + 5_000_000) / 1e9:.6f}")
        for s, t in zip(samples, stamps, strict=True)
    ]
    (folder / "poses.txt").write_text("\n".join(rows))
    dataset = open_dataset("folder", folder)
    assert_own_poses(dataset, samples)
    assert dataset[1].timestamp - dataset[0].timestamp == pytest.approx(1 / 30, abs=1e-6)
    assert any("nanoseconds" in sentence for sentence in dataset.warnings)
