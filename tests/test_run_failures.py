"""A run that something ends early: what was fused until then is kept, whatever it was."""

from __future__ import annotations

import zlib

import pytest
from map_kinds import content
from tiny_recording import CONFIG, FLAGS, make_frames, write_folder

from taichi_unifusion import pipeline as pipelines
from taichi_unifusion.cli import main as cli
from taichi_unifusion.errors import CapacityError, InputError, as_known
from taichi_unifusion.maps.local_lim import LocalLim
from taichi_unifusion.maps.property_group import Part
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results import read_record, read_run


@pytest.fixture(scope="module")
def frames():
    return make_frames(4)


@pytest.fixture(scope="module")
def of_two(frames):
    """The maps of the first two frames."""
    pipeline = Pipeline(CONFIG)
    pipeline.run(frames[:2])
    return contents(pipeline)


def contents(pipeline: Pipeline) -> list[tuple[bytes, ...]]:
    return [content(each) for each in pipeline.maps.values()]


def fail_at(monkeypatch, error: Exception, number: int) -> None:
    """Let the patches of a frame, counted from 1, fail with an error."""
    find, done = pipelines.find_patches, []

    def failing(frame, *arguments, **options):
        if frame.index not in done:
            done.append(frame.index)
        if len(done) == number:
            raise error
        return find(frame, *arguments, **options)

    monkeypatch.setattr(pipelines, "find_patches", failing)


NO_MEMORY = [
    MemoryError("Unable to allocate 9.0 GiB"),
    MemoryError(),
    RuntimeError("[memory_pool.cpp] Virtual memory allocation (1073741824 B) failed."),
    RuntimeError("CUDA_ERROR_OUT_OF_MEMORY: out of memory while calling mem_alloc"),
]


@pytest.mark.parametrize("error", [zlib.error("bad stream"), *NO_MEMORY], ids=repr)
def test_c5_R2_an_error_that_is_not_ours_ends_the_run_and_keeps_the_frames_before(
    error, frames, of_two, monkeypatch
):
    fail_at(monkeypatch, error, 3)
    pipeline = Pipeline(CONFIG)
    run = pipeline.run(frames)
    assert len(run.steps) == 2 and not run.interrupted and contents(pipeline) == of_two
    if error in NO_MEMORY:
        assert isinstance(run.failure, CapacityError) and run.failure.__cause__ is error
    else:
        assert run.failure is error


def test_R2_only_what_says_so_is_a_lack_of_memory():
    for error in (RuntimeError("of another kind"), ValueError("out of memory"), InputError("x")):
        assert as_known(error) is error


@pytest.mark.parametrize("times", [1, 100])
def test_R2_a_window_that_cannot_be_fused_is_tried_once_more_and_then_left_out(
    times, frames, of_two, monkeypatch
):
    fuse, tried = Part.fuse, []

    def failing(self: Part, local: LocalLim) -> None:
        if self.names == ("color",) and len(tried) < times and local.count:
            tried.append(local.count)
            raise MemoryError
        return fuse(self, local)

    monkeypatch.setattr(Part, "fuse", failing)
    pipeline = Pipeline(CONFIG)
    run = pipeline.run(frames[:2])
    assert isinstance(run.failure, CapacityError) and len(run.steps) == 2
    surface, color = contents(pipeline)
    assert surface == of_two[0] and len(pipeline.extract_mesh().faces)
    assert (color == of_two[1]) is False and len(tried) == 1  # the flush that failed is the last


def test_R2_a_piece_that_failed_among_frames_is_done_again_at_the_end(frames, monkeypatch):
    walk = [*frames, *frames, *frames]  # a window is ten frames
    fuse, tried = Part.fuse, []

    def failing(self: Part, local: LocalLim) -> None:
        if self.names == ("surface",) and local.count and not tried:
            tried.append(local.count)
            raise MemoryError
        return fuse(self, local)

    monkeypatch.setattr(Part, "fuse", failing)
    pipeline = Pipeline(CONFIG)
    run = pipeline.run(walk)
    assert isinstance(run.failure, CapacityError) and tried
    assert len(run.steps) < len(walk)
    again = Pipeline(CONFIG)
    again.run(walk[: len(run.steps) + 1])  # the frame whose step failed had been summed up
    assert contents(pipeline) == contents(again)


def test_R2_the_command_writes_what_was_fused_and_says_what_ended_it(
    frames, tmp_path, monkeypatch, capsys
):
    recording = write_folder(tmp_path / "recording", frames)
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, "--out"]
    for error, code, told in (
        (MemoryError("Unable to allocate"), 2, "memory has run out (Unable to allocate)"),
        (ZeroDivisionError("of somebody"), 1, "nobody foresaw, ZeroDivisionError: of somebody"),
    ):
        out = tmp_path / type(error).__name__
        with monkeypatch.context() as patch:
            fail_at(patch, error, 4)
            assert cli.main([*arguments, str(out)]) == code
        said = capsys.readouterr().err
        assert "ended early after 3 of 4 frames; writing what they gave" in said
        *_, ended, last = said.splitlines()
        assert told in ended and "Traceback" not in said
        assert "1 of 4 frames are not in the map: 1 not reached" in last
        assert read_record(out / "metrics.json").frames.used == 3
        assert len(read_run(out).mesh().faces) > 0
