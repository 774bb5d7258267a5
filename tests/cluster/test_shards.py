"""A recording on many workers gives what one process would, and survives that workers do not."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from direct_engine import Direct
from tiny_recording import CONFIG, FLAGS, make_frames, write_folder
from windows import CONFIG as WALK_CONFIG
from windows import place_of, seen_from, windows

from taichi_unifusion.cli import on_workers
from taichi_unifusion.cli.main import main
from taichi_unifusion.cluster import work
from taichi_unifusion.cluster.run import Progress, fuse_on_workers, plan
from taichi_unifusion.cluster.shards import Job, Shard, cut, read_done, window_starts
from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.errors import FileError, MapCorrupt
from taichi_unifusion.geometry.triangles import areas
from taichi_unifusion.language import EncoderChoice
from taichi_unifusion.maps import load_map
from taichi_unifusion.maps.stored import read_stored
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results.record import Source, read_record
from taichi_unifusion.results.run_folder import RunFolder
from taichi_unifusion.tracking.base import TrackedFrame, Verdict

FRAMES = 12
# latents of frames that were fused in other groups of windows: sums of floats in another order
ROUNDING = 1e-5
HALF = 0.01  # of features kept in half precision and 255 levels, added in another order


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return write_folder(tmp_path_factory.mktemp("recording") / "tiny", make_frames(FRAMES))


def job_of(recording: Path, folder: Path, **changes) -> Job:
    config = replace(CONFIG, window=3)
    source = Source(format="folder", path=str(recording), start=0, end=None, every=1, frames=FRAMES)
    return replace(Job(source, None, config, str(folder / "shards")), **changes)


@pytest.fixture(scope="module")
def whole(recording) -> Pipeline:
    pipeline = Pipeline(replace(CONFIG, window=3))
    pipeline.run(open_dataset("folder", recording))
    return pipeline


@pytest.fixture(scope="module")
def sharded(recording, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return folder, *fuse_on_workers(
        job_of(recording, folder), folder / "maps", Direct(), Progress()
    )


def test_shards_give_the_map_of_one_process(whole, sharded):
    folder, pipeline, run = sharded
    assert [step.index for step in run.steps] == list(range(FRAMES))
    for name, each in whole.maps.items():
        expected, (_, found) = each.voxels(), read_stored(folder / "maps" / name)
        for part in ("keys", "weights", "masks"):
            np.testing.assert_array_equal(getattr(found, part), getattr(expected, part))
        largest = np.abs(expected.latents).max()
        np.testing.assert_allclose(found.latents, expected.latents, atol=ROUNDING * largest)


def test_all_rays_vote_in_the_surface_of_all_shards(recording, sharded, tmp_path):
    """However the frames are cut, the votes are the same; and many."""
    folder, _, _ = sharded
    one = Direct()
    one.workers = 0  # one shard
    job = job_of(recording, tmp_path)
    assert len(plan(job, 0)) == 1 and len(plan(job, 2)) == 4
    fuse_on_workers(job, tmp_path / "maps", one, Progress())
    (_, a), (_, b) = (read_stored(each / "maps" / "surface") for each in (folder, tmp_path))
    np.testing.assert_array_equal(a.keys, b.keys)
    differ = a.evidence != b.evidence  # latents differ in the last bit, and so may what a ray meets
    assert (a.evidence > 0).sum() > 1000 and differ.mean() < 1e-3


def test_the_mesh_is_nearly_that_of_one_process(whole, sharded):
    """Votes of a second pass know the whole surface; the meshes differ at its rims alone."""
    _, pipeline, _ = sharded
    meshes = [each.extract_mesh(2) for each in (whole, pipeline)]
    a, b = (areas(mesh.vertices, mesh.faces).sum() for mesh in meshes)
    assert abs(a / b - 1) < 0.02


def test_what_was_done_is_not_done_again(recording, tmp_path, monkeypatch):
    job, shard = job_of(recording, tmp_path), Shard(0, 0, 6)
    first = work.fuse_shard(job, shard)

    def never(*_, **__):
        raise AssertionError("fused again")

    monkeypatch.setattr(work, "Pipeline", never)
    again = work.fuse_shard(job, shard)
    assert again.bytes == first.bytes > 0
    assert again.run.steps == first.run.steps and again.run.skipped == first.run.skipped
    np.testing.assert_array_equal(
        again.run.trajectory.T_world_camera, first.run.trajectory.T_world_camera
    )
    other = replace(job, config=replace(job.config, window=2))
    assert read_done(shard.folder(job) / work.DONE, other, shard) is None


def test_the_command_goes_on_with_the_shards_that_are_done(
    recording, tmp_path, monkeypatch, capsys
):
    """Cut as before, however many workers there are."""

    def full(task, arguments) -> None:
        if task is work.merge_group:
            raise FileError("maps: cannot write: the disk is full")

    engines = [Direct(full), Direct()]
    engines[1].workers = 5
    monkeypatch.setattr(on_workers, "open_engine", lambda _: nullcontext(engines.pop(0)))
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, "--window", "3", "--workers", "2"]
    arguments += ["--mesh.formats", "ply", "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    said = capsys.readouterr().err
    assert "the disk is full" in said and "4 shards are done: the same command with" in said
    with monkeypatch.context() as patch:
        patch.setattr(work, "Pipeline", None)  # nothing is fused again
        assert main([*arguments, "--resume"]) == 0
    assert "4 of 4 shards are done already" in capsys.readouterr().err
    out = RunFolder(tmp_path / "out")
    assert read_record(out.record).frames.used == FRAMES and not out.shards.exists()
    assert main([*arguments, "--resume"]) == 0
    assert "holds the whole run already" in capsys.readouterr().err


def test_a_worker_that_is_lost_leaves_nothing_that_counts(recording, whole, tmp_path):
    """Its half-written shard is made again from the start."""
    job, lost = job_of(recording, tmp_path), []

    def spoil(task, arguments) -> None:
        if task is work.fuse_shard and not lost:
            shard = arguments[1]
            lost.append(shard)
            maps = shard.folder(job) / work.MAPS / "surface"
            maps.mkdir(parents=True)
            (maps / "0_0_0.7.safetensors").write_bytes(b"half a til")
            (maps / "index.json").write_text('{"format"')

    fuse_on_workers(job, tmp_path / "maps", Direct(spoil), Progress())
    _, found = read_stored(tmp_path / "maps" / "surface")
    assert lost and len(found) == len(whole.surface)


def test_a_damaged_partial_tile_is_never_added_up(recording, tmp_path):
    job, spoiled = job_of(recording, tmp_path), []

    def spoil(task, arguments) -> None:
        if task is work.merge_group and not spoiled:
            file = next(Path(arguments[2][0]).glob("*.safetensors"))
            data = bytearray(file.read_bytes())
            data[-5] ^= 1
            file.write_bytes(data)
            spoiled.append(file)

    with pytest.raises(MapCorrupt, match="checksum"):
        fuse_on_workers(job, tmp_path / "maps", Direct(spoil), Progress())


def test_tracked_poses_go_to_the_workers(recording, tmp_path):
    frames = make_frames(FRAMES)
    poses = [frame.T_world_camera.copy() for frame in frames]
    for T in poses:
        T[0, 3] += 20
    tracked = tuple(TrackedFrame(i, Verdict.TRACKED, T) for i, T in enumerate(poses))
    tracked = (
        *tracked[:5],
        replace(tracked[5], T_world_camera=None, verdict=Verdict.LOST),
        *tracked[6:],
    )
    job = job_of(recording, tmp_path, tracked=tracked)
    _, run = fuse_on_workers(job, tmp_path / "maps", Direct(), Progress())
    assert [frame.index for frame in run.skipped] == [5] and len(run.steps) == FRAMES - 1
    _, found = read_stored(tmp_path / "maps" / "surface")
    assert found.keys[:, 0].min() > 100


def test_features_are_mapped_by_workers_too(recording, tmp_path):
    rng, made = np.random.default_rng(0), tmp_path / "features"
    made.mkdir()
    for i in range(FRAMES):
        np.save(made / f"{i}.npy", rng.standard_normal((9, 12, 16)).astype(np.float32))
    encoder = EncoderChoice(f"folder:{made}")
    whole = Pipeline(replace(CONFIG, window=3), encoder=encoder.make())
    whole.run(open_dataset("folder", recording))
    job = job_of(recording, tmp_path, encoder=encoder)
    pipeline, _ = fuse_on_workers(job, tmp_path / "maps", Direct(), Progress())
    assert pipeline.maps.keys() == whole.maps.keys()
    expected, found = whole.maps["features"], load_map(tmp_path / "maps" / "features")
    points = whole.extract_mesh(1).vertices[::20]
    a, b = (each.query(points) for each in (expected, found))
    assert len(found) == len(expected) > 100 and np.abs(a).mean() > 0.05
    assert np.abs(a - b).mean() < HALF * np.abs(a).mean()


def test_windows_start_where_a_pipeline_starts_them():
    """Full windows, a jump, a turn, a gap in the numbers, a frame without a pose."""
    numbers = [1, 2, 3, 4, 5, 6, 7, 8, 9, 20, 21, 22]
    places = [0, 1, 2, 3, 4, 5, 70, 71, 72, 73, 74, 75]
    frames = [seen_from(place_of(p), n) for p, n in zip(places, numbers, strict=True)]
    config = replace(WALK_CONFIG, window=4)
    lengths = windows(frames, config)
    expected = [
        i for i, n in enumerate(lengths) if n == 1 or (n == 0 and (i == 0 or lengths[i - 1] == 0))
    ]
    poses = [frame.T_world_camera for frame in frames]
    assert window_starts(poses, numbers, config.window) == expected
    assert window_starts([None, *poses], [0, *numbers], config.window) == [i + 1 for i in expected]


def test_shards_cover_all_frames_once():
    shards = cut(100, list(range(0, 100, 7)), 4)
    assert [each.number for each in shards] == [0, 1, 2, 3]
    assert [each.first for each in shards[1:]] == [each.last for each in shards[:-1]]
    assert shards[0].first == 0 and shards[-1].last == 100
    assert all(each.first % 7 == 0 for each in shards)
    assert cut(3, [0], 8) == [Shard(0, 0, 3)]


def test_a_shard_without_a_usable_frame_is_no_failure(recording, tmp_path):
    frames = make_frames(FRAMES)
    lost = tuple(
        TrackedFrame(
            i, Verdict.LOST if i < 6 else Verdict.TRACKED, None if i < 6 else frame.T_world_camera
        )
        for i, frame in enumerate(frames)
    )
    job = job_of(recording, tmp_path, tracked=lost)
    done = work.fuse_shard(job, Shard(0, 0, 6))
    assert not done.run.steps and len(done.run.skipped) == 6


def test_votes_need_their_shard(recording, tmp_path):
    with pytest.raises(FileError, match="no longer there"):
        work.vote(job_of(recording, tmp_path), Shard(0, 0, 6), str(tmp_path))
