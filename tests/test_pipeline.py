"""The pipeline: frames in order, bad ones skipped and said, results as values."""

from __future__ import annotations

import gc
import logging
import sys
import threading
from dataclasses import replace

import numpy as np
import pytest
from map_kinds import content
from tiny_recording import CONFIG, make_frames, write_folder

from taichi_unifusion.datasets import open_dataset
from taichi_unifusion.datasets.loading import load_ahead
from taichi_unifusion.datasets.synthetic import SyntheticRoom
from taichi_unifusion.errors import DatasetError, FrameError, OutOfRange, PoseError
from taichi_unifusion.maps import PropertyMap
from taichi_unifusion.pipeline import Pipeline, extract_mesh, warm_up
from taichi_unifusion.preprocessing import PreprocessSettings
from taichi_unifusion.results.measure import frames_without
from taichi_unifusion.run_log import SKIP_REASONS, EmptyFrame

STAGES = ["load", "preprocess", "sum"]
FUSING = ["surface", "color"]  # of the frames that fuse a window


@pytest.fixture(scope="module")
def frames():
    return make_frames(3)


def with_one_reading(frame):
    depth = np.zeros_like(frame.depth)
    depth[60, 80] = 2.0
    return replace(frame, depth=depth)


@pytest.fixture
def pipeline():
    return Pipeline(CONFIG)


@pytest.fixture(scope="module")
def fused(frames):
    """A real pipeline and its run over all frames."""
    pipeline = Pipeline(CONFIG)
    return pipeline, pipeline.run(frames)


def test_maps_that_take_every_point_need_no_window(frames):
    """As published: nothing is summed up, whether the window is of one frame or of several."""
    published = replace(
        CONFIG,
        surface=replace(CONFIG.surface, sampling="points"),
        color=replace(CONFIG.color, sampling="points"),
    )
    few = np.zeros_like(frames[0].depth)
    few[40:80, 60:100] = frames[0].depth[40:80, 60:100]
    for window in (1, 2):
        pipeline = Pipeline(replace(published, window=window))
        run = pipeline.run([replace(frames[0], depth=few)] * 2)
        assert len(run.steps) == 2 and run.failure is None
        assert len(pipeline.surface) and len(pipeline.properties["color"])


class Sequence:
    """Frames, or errors raised in their place, that note when and where they are loaded."""

    name = "test sequence"

    def __init__(self, *items):
        self.items, self.loaded = items, []

    def __len__(self):
        return len(self.items)

    def __getitem__(self, i):
        self.loaded.append((i, threading.current_thread()))
        if isinstance(self.items[i], Exception):
            raise self.items[i]
        return self.items[i]


def without_depth(frame):
    return replace(frame, depth=np.zeros_like(frame.depth))


def contents(pipeline) -> list[tuple[bytes, ...]]:
    """What every map holds."""
    return [content(each) for each in pipeline.maps.values()]


def test_S5_one_frame_gives_a_coloured_mesh(frames):
    pipeline = Pipeline(CONFIG)
    step = pipeline.step(frames[0])
    assert 0 < step.points <= frames[0].depth.size
    assert list(step.integrations) == list(pipeline.maps)
    assert all(
        done.points == step.points and done.voxels > 0 and done.total_voxels == 0  # not fused yet
        for done in step.integrations.values()
    )
    # nothing is fused yet, but what fuses is compiled
    assert list(step.milliseconds) == [*STAGES[1:], *FUSING]
    assert min(step.milliseconds.values()) > 0
    assert min(map(len, pipeline.maps.values())) > 0
    mesh = pipeline.extract_mesh()
    assert len(mesh.faces) > 0 and mesh.attributes["color"].shape == (len(mesh.vertices), 3)
    assert len(pipeline.extract_mesh(8).faces) > len(mesh.faces)


def test_with_windows_of_one_frame_each_step_fuses_its_frame(frames):
    pipeline = Pipeline(replace(CONFIG, window=1))
    for frame in frames:
        step = pipeline.step(frame)
        assert list(step.milliseconds) == [*STAGES[1:], *FUSING]
        for name, done in step.integrations.items():
            assert done.points == step.points and done.voxels > 0
            assert pipeline.maps[name].waiting is None
            assert done.total_voxels == len(pipeline.maps[name]) > 0


def test_a_run_fuses_all_frames(fused, frames):
    pipeline, result = fused
    assert [step.index for step in result.steps] == [0, 1, 2]
    assert len(pipeline.surface) > 0 and all(
        each.waiting is None for each in pipeline.maps.values()
    )
    mesh = pipeline.extract_mesh()
    values, valid = pipeline.surface.sdf(mesh.vertices)
    assert (
        valid.mean() > 0.99
        and np.abs(values[valid]).max() < CONFIG.surface.voxel_size / CONFIG.mesh.resolution
    )


def test_a_run_tells_of_every_frame_what_became_of_it(pipeline, frames):
    bad = replace(frames[1], T_world_camera=None)
    fused, skipped = [], []
    result = pipeline.run(
        [frames[0], bad, frames[2]],
        on_step=lambda frame, step, told: fused.append((frame, step.index, told)),
        on_skip=skipped.append,
    )
    assert [(frame.index, index) for frame, index, _ in fused] == [(0, 0), (2, 2)]
    assert np.array_equal(fused[1][0].depth, frames[2].depth)
    assert all(told is pipeline for *_, told in fused)
    assert tuple(skipped) == result.skipped and skipped[0].reason == "no usable pose"


def test_a_run_is_its_steps_in_order(pipeline, frames):
    told = []
    result = pipeline.run(frames, on_frame=lambda done, total: told.append((done, total)))
    by_hand = Pipeline(CONFIG)
    for frame in frames:
        by_hand.step(frame)
    assert contents(pipeline) == contents(by_hand) and min(map(len, by_hand.maps.values())) > 0
    assert [step.index for step in result.steps] == [0, 1, 2] and told == [(1, 3), (2, 3), (3, 3)]
    first, *between, last = (list(step.milliseconds) for step in result.steps)
    assert all(stages == STAGES for stages in between)
    # with the first frame, kernels are compiled; with the last one, what waits is fused
    assert first == last == [*STAGES, *FUSING]
    assert (result.skipped, result.warnings, result.interrupted, result.failure) == (
        (),
        (),
        False,
        None,
    )
    np.testing.assert_array_equal(
        result.trajectory.T_world_camera, [frame.T_world_camera for frame in frames]
    )
    np.testing.assert_array_equal(
        result.trajectory.timestamps, [frame.timestamp for frame in frames]
    )


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (without_depth, "the depth image holds no reading at all"),  # F1
        (
            lambda frame: replace(frame, depth=np.full_like(frame.depth, np.nan)),
            "no reading at all",
        ),  # F2
        (
            lambda frame: replace(frame, depth=frame.depth + np.float32(20)),
            "lie outside 0.1..5 m",
        ),  # F10
        (with_one_reading, "all 1 depth readings"),  # F4
    ],
    ids=["F1", "F2", "F10", "F4"],
)
def test_F1_F2_F4_F10_a_frame_without_usable_depth_is_skipped_counted_and_said(
    pipeline, frames, spoil, reason, caplog
):
    result = pipeline.run([frames[0], spoil(frames[1]), frames[2]])
    others = Pipeline(CONFIG)
    others.run([frames[0], frames[2]])
    assert contents(pipeline) == contents(others)
    (skipped,) = result.skipped
    assert (skipped.index, skipped.reason, len(result.steps)) == (1, SKIP_REASONS[EmptyFrame], 2)
    assert reason in skipped.message and frames[1].name in skipped.message
    assert [
        skipped.message in record.message
        for record in caplog.records
        if record.levelno == logging.WARNING
    ] == [True]


def test_the_first_frame_compiles_what_fuses_its_window(frames):
    pipeline = Pipeline(CONFIG)
    pipeline.step(frames[0])
    before = compiled()
    for frame in [*frames[1:], *frames]:  # the others are farther from the last frame than usual
        pipeline.step(frame)
    pipeline.flush()
    assert compiled() == before and len(pipeline.surface) > 0


def test_a_frame_without_pose_is_skipped(pipeline, frames):
    result = pipeline.run([replace(frames[0], T_world_camera=None), frames[1]])
    assert [(frame.index, frame.reason) for frame in result.skipped] == [(0, "no usable pose")]


def test_a_pose_beyond_the_index_range_is_skipped(fused, frames):
    pipeline, _ = fused
    before = len(pipeline.surface)
    T_world_camera = frames[0].T_world_camera.copy()
    T_world_camera[0, 3] = 1e9
    far = replace(frames[0], T_world_camera=T_world_camera)
    with pytest.raises(OutOfRange):
        pipeline.step(far)
    assert len(pipeline.surface) == before
    result = pipeline.run([far, frames[1]])
    assert [frame.reason for frame in result.skipped] == ["outside the range of the map"] and len(
        result.steps
    ) == 1


def test_F7_every_kind_of_trouble_is_warned_of_once(pipeline, frames, caplog):
    bad = [FrameError(f"frame {i}.png: truncated") for i in range(3)]
    result = pipeline.run(Sequence(bad[0], PoseError("p.txt: NaN"), frames[0], bad[1], bad[2]))
    assert [frame.message for frame in result.skipped] == [
        "frame 0.png: truncated",
        "p.txt: NaN",
        "frame 1.png: truncated",
        "frame 2.png: truncated",
    ]
    assert result.warnings == tuple(
        record.message for record in caplog.records if record.levelno == logging.WARNING
    )
    assert [warning.partition(": ")[0] for warning in result.warnings] == [
        "frame skipped, unreadable image",
        "frame skipped, no usable pose",
    ]


def test_S1_a_missing_file_in_the_middle_costs_one_frame(pipeline, frames, tmp_path):
    folder = write_folder(tmp_path / "recording", frames)
    (folder / "depth" / "1.png").unlink()
    result = pipeline.run(open_dataset("folder", folder))
    assert [step.index for step in result.steps] == [0, 2]
    assert [frame.index for frame in result.skipped] == [1] and "1.png" in result.skipped[0].message


def test_indices_are_those_of_the_recording_behind_views(pipeline, frames, tmp_path):
    folder = write_folder(tmp_path / "recording", [*frames, *frames])
    (folder / "depth" / "3.png").write_bytes(b"no image")
    result = pipeline.run(open_dataset("folder", folder)[1:][::2])
    assert [step.index for step in result.steps] == [1, 5] and [
        frame.index for frame in result.skipped
    ] == [3]
    # no time stamps in this recording: frame numbers
    np.testing.assert_array_equal(result.trajectory.timestamps, [1, 5])


def test_no_usable_frame_is_an_error_with_the_most_common_reason(pipeline, frames):
    empty = without_depth(frames[0])
    with pytest.raises(
        DatasetError,
        match=r"test sequence: none of 3 frames could be used, 2 for 'no usable depth' \(first: ",
    ):
        pipeline.run(Sequence(PoseError("p.txt: NaN"), empty, empty))
    with pytest.raises(DatasetError, match="no frames"):
        pipeline.run([])


def test_strict_ends_at_the_first_bad_frame_with_what_was_done(pipeline, frames):
    bad = FrameError("1.png: truncated")
    result = pipeline.run(Sequence(frames[0], bad, frames[2]), strict=True)
    assert result.failure is bad and len(result.steps) == 1 and not result.interrupted
    with pytest.raises(FrameError, match="truncated"):
        Pipeline(CONFIG).run(Sequence(bad, frames[0]), strict=True)


def test_R3_a_stop_ends_after_the_current_frame(pipeline, frames):
    done = []
    result = pipeline.run(
        frames, stop=lambda: len(done) == 2, on_frame=lambda count, total: done.append(count)
    )
    assert result.interrupted and len(result.steps) == len(result.trajectory) == 2
    nothing = Pipeline(CONFIG).run(frames, stop=lambda: True)
    assert nothing.interrupted and not nothing.steps and len(nothing.trajectory) == 0


def test_F9_a_wrong_depth_scale_is_warned_of(frames, tmp_path):
    frames = open_dataset("folder", write_folder(tmp_path / "recording", frames), depth_scale=25.0)
    pipeline = Pipeline(replace(CONFIG, preprocess=PreprocessSettings(depth_max=1000)))
    result = pipeline.run(frames)
    assert [("depth_scale 1000" in warning, "0.png" in warning) for warning in result.warnings] == [
        (True, True)
    ]
    with pytest.raises(DatasetError, match=r"lie outside 0.1..5 m \(median"):
        Pipeline(CONFIG).run(frames)


def test_frames_without_colour_add_to_the_surface_only(pipeline, frames):
    result = pipeline.run([replace(frame, color=None) for frame in frames])
    assert len(result.warnings) == 1 and "no colour image" in result.warnings[0]
    assert frames_without(result.steps)["color"].frames == tuple(frame.index for frame in frames)
    assert len(pipeline.surface) > 0 and len(pipeline.properties["color"]) == 0


def test_a_mesh_without_colour_data_has_no_colour(fused):
    pipeline, _ = fused
    mesh = extract_mesh(pipeline.surface, {"color": PropertyMap("color", 3, CONFIG.color)}, 2)
    assert len(mesh.faces) > 0 and "color" not in mesh.attributes


def test_loading_is_one_ahead_in_order_and_carries_errors():
    error = FrameError("1.png: truncated")
    sequence, frames = Sequence("a", error, "b", "c"), []
    for i, load in enumerate(load_ahead(sequence)):
        try:
            frames.append(load())
        except FrameError as caught:
            frames.append(caught)
        assert len(sequence.loaded) <= i + 2  # never more than the next one
    assert frames == ["a", error, "b", "c"]
    assert [i for i, _ in sequence.loaded] == [0, 1, 2, 3]
    assert all(thread is not threading.main_thread() for _, thread in sequence.loaded)


def test_the_next_frame_loads_while_this_one_is_used():
    begun = threading.Event()

    class Second(Sequence):
        def __getitem__(self, i):
            if i == 1:
                begun.set()
            return super().__getitem__(i)

    loads = load_ahead(Second("a", "b"))
    next(loads)()
    assert begun.wait(timeout=10)
    loads.close()


def test_what_renders_with_kernels_is_loaded_by_the_caller(monkeypatch):
    threads = []
    monkeypatch.setattr(
        SyntheticRoom, "load", lambda self, index: threads.append(threading.current_thread())
    )
    for load in load_ahead(SyntheticRoom(frames=4, width=16, height=12)[::2][:2]):
        load()
    assert threads == [threading.main_thread()] * 2


def compiled() -> int:
    """Kernels that were traced in this process so far."""
    names = [f"{room}kernels" for room in ("", "rendering.")]
    modules = [m for name, m in sys.modules.items() if any(n in name for n in names)]
    kernels = {id(k): k for m in modules for k in vars(m).values() if hasattr(k, "_primal")}
    return sum(len(kernel._primal.compiled_kernels) for kernel in kernels.values())


def test_after_warming_up_the_first_frame_compiles_nothing(frames):
    gc.collect()  # what other tests left gives its index trees back now, not in between
    warm_up(CONFIG)
    warm = Pipeline(CONFIG)
    before = compiled()
    assert before > 20
    warm.step(frames[0])
    warm.extract_mesh()
    assert compiled() == before


def test_readings_out_of_range_are_said_where_they_are_many(frames):
    def said(**limits) -> list[str]:
        settings = PreprocessSettings(**limits)
        run = Pipeline(replace(CONFIG, preprocess=settings)).run(frames)
        return [warning for warning in run.warnings if "depth readings lie" in warning]

    depth = np.stack([frame.depth for frame in frames])
    middle = float(np.median(depth[depth > 0]))
    assert said() == []
    (far,) = said(depth_max=middle)
    share = int(far.partition("%")[0])
    assert 40 <= share <= 60 and f"beyond {middle:g} m (preprocess.depth_max)" in far
    (near,) = said(depth_min=middle)
    assert f"nearer than {middle:g} m (preprocess.depth_min)" in near and "beyond" not in near
