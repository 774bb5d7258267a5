"""Options of commands that can be watched, and the viewer that they ask for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, arg

from ..errors import InputError
from .interrupts import INTERRUPTED, stop_on_signal
from .options import EncoderOptions
from .results_source import results_source
from .terminal import frame_progress

if TYPE_CHECKING:
    from ..pipeline import OnBorder, Pipeline
    from ..results import RunFolder
    from ..run_log import RunResult, RunSoFar
    from ..types import Frame
    from ..viewer.null import Watcher
    from ..viewer.source import ResultsSource
    from ..viewer.web import WebViewer


@dataclass(frozen=True)
class PageOptions:
    """Where a page is shown."""

    host: Annotated[str, arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on: by default only this machine can open the page; 0.0.0.0 lets everybody
    who reaches this machine.
    """
    port: Annotated[int, arg(metavar="N")] = 8080
    """Port of the page, or the next one that is free."""
    no_open: FlagCreatePairsOff[bool] = False
    """Do not open a browser."""


@dataclass(frozen=True)
class WatchOptions:
    """Whether and where a run is shown while it goes on."""

    view: FlagCreatePairsOff[bool] = False
    """Show the map on a page in the browser while it grows; the page stays until Ctrl-C."""
    page: Annotated[PageOptions, arg(name="view")] = field(default_factory=PageOptions)
    # not --window, which is the setting of how many frames are fused at once
    view_window: FlagCreatePairsOff[bool] = False
    """Show the map in a window while it grows; where there is no screen the run goes on without."""


def open_page(options: PageOptions, title: str) -> WebViewer:
    """A page that is there, with its address said."""
    from ..viewer.web import WebViewer

    viewer = WebViewer(options.host, options.port, title)
    viewer.announce(open_browser=not options.no_open)
    return viewer


def open_watcher(
    options: WatchOptions, title: str, frames: int, stop: Callable[[], bool]
) -> Watcher:
    """What watches a run of so many frames, which ends early when `stop` says so."""
    if options.view and options.view_window:
        raise InputError("view and view-window: choose one of them")
    if options.view_window:
        from ..viewer.window_live import watch_in_window

        return watch_in_window(title, frames, stop)
    if not options.view:
        from ..viewer.null import NullViewer

        return NullViewer()
    viewer = open_page(options.page, title)
    from ..viewer.results_scene import SceneOptions
    from ..viewer.web_live import WebLive

    def open_results(path: Path) -> ResultsSource:
        return results_source(path, SceneOptions(), EncoderOptions())

    return WebLive(viewer, frames, stop, open_results)


def map_frames(
    pipeline: Pipeline,
    frames: Sequence[Frame],
    expected: int,
    *,
    strict: bool,
    stop: Callable[[], bool],
    watcher: Watcher,
    on_border: OnBorder | None = None,
    before: RunSoFar | None = None,
) -> RunResult:
    """Run frames through a pipeline, with a bar for so many that are expected (0: nobody knows), and
    with what watches them; `on_border` and `before` are those of `Pipeline.run`.
    """
    with frame_progress(expected) as on_frame:
        return pipeline.run(
            frames,
            strict=strict,
            stop=stop,
            on_frame=on_frame,
            on_step=watcher.on_step,
            on_skip=watcher.on_skip,
            on_border=on_border,
            before=before,
        )


def run_watched(
    options: WatchOptions,
    folder: RunFolder,
    frames: int,
    run: Callable[[Watcher, Callable[[], bool]], int],
) -> int:
    """The exit code of `run`, which is given what watches its frames and what says that it is to stop;
    what watches stays and shows the results, unless the run was stopped or failed.
    """
    from ..results.safe_point import remove_temporaries

    with stop_on_signal(clean_up=lambda: remove_temporaries(folder)) as stop:
        watcher = open_watcher(options, folder.path.name, frames, stop)
        try:
            code = run(watcher, stop)
        except BaseException:
            watcher.close()
            raise
    if code == INTERRUPTED:
        watcher.close()
    else:
        with stop_on_signal(clean_up=lambda: remove_temporaries(folder), viewer=True) as stop:
            watcher.finish(folder.path, stop)
    return code
