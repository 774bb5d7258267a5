"""What is measured of a run, from what its frames say."""

from __future__ import annotations

from taichi_unifusion.results.measure import first_frame_seconds, stage_milliseconds
from taichi_unifusion.run_log import StepResult


def step(**milliseconds: float) -> StepResult:
    return StepResult(0, "", 1, {}, milliseconds)


def test_stage_times_leave_out_the_frames_that_compiled():
    steps = [
        step(surface=9000.0),
        step(surface=10.0, color=5000.0),  # the first with colour
        step(surface=12.0, color=6.0),
        step(surface=20.0, color=8.0),
    ]
    times = stage_milliseconds(steps)
    assert (times["surface"].median, times["surface"].mean) == (12.0, 14.0)
    assert (times["color"].median, times["color"].mean) == (7.0, 7.0)
    assert (times["frame"].median, times["frame"].mean) == (23.0, 23.0)
    assert list(times) == ["surface", "color", "frame"]
    assert first_frame_seconds(steps) == 9.0


def test_a_single_frame_is_all_there_is():
    times = stage_milliseconds([step(surface=9000.0, color=1000.0)])
    assert (times["surface"].mean, times["color"].mean, times["frame"].mean) == (9e3, 1e3, 1e4)
    assert first_frame_seconds([]) == 0.0
