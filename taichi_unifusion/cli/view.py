"""`unifusion view`: results -> a page in the browser, to look at, touch, ask and share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, UseAppendAction, arg

from ..errors import InputError
from .interrupts import stop_on_signal
from .options import ONE_EACH, OPTIONAL, EncoderOptions
from .results_source import results_source
from .terminal import DONE
from .viewing import PageOptions

if TYPE_CHECKING:
    from ..viewer.answers import ShownAnswer
    from ..viewer.scene import Scene
    from ..viewer.source import ResultsSource


NOTHING_TO_ASK = (
    "{}: there are no features to ask, or no text encoder; `unifusion understand` makes features, "
    "--text names an encoder"
)


@dataclass(frozen=True)
class View:
    """Show results on a page in the browser, or in a window: every layer, questions, points,
    distances, parts, cameras.

    Example: unifusion view results/kitchen

    Side by side: unifusion view results/kitchen results/kitchen_fine

    On a machine behind ssh: ssh -L 8080:127.0.0.1:8080 MACHINE, then open http://127.0.0.1:8080
    here.
    """

    dirs: Annotated[
        Positional[tuple[Path, ...]], arg(metavar="DIR...", help_behavior_hint="(one or more)")
    ]
    """Results folders of `unifusion`, or mesh files."""
    overlay: FlagCreatePairsOff[bool] = False
    """Lay several results over one another instead of side by side."""
    compare: Annotated[Path | None, arg(metavar="MESH", help_behavior_hint=OPTIONAL)] = None
    """A mesh in the same world: its distance to each result becomes a layer."""
    cameras: Annotated[int, arg(metavar="N")] = 60
    """At most so many cameras are drawn, evenly over the trajectory."""
    window: FlagCreatePairsOff[bool] = False
    """Show a window on the screen instead of a page in the browser."""
    query: Annotated[
        UseAppendAction[tuple[str, ...]],
        arg(metavar="TEXT", help_behavior_hint=ONE_EACH),
    ] = ()
    """What to look for; more can be typed into the page, or into the terminal of a window."""
    page: Annotated[PageOptions, arg(name="")] = field(default_factory=PageOptions)
    encoder: Annotated[EncoderOptions, arg(name="")] = field(default_factory=EncoderOptions)


def view(options: View) -> int:
    """Results -> a page, until Ctrl-C."""
    if not options.dirs:
        raise InputError("view: say what to show, for example: unifusion view results/demo")
    from .. import runtime
    from ..viewer.results_scene import SceneOptions

    if not options.window:
        from ..viewer.web import check_viser

        check_viser()  # before any work
    shown = SceneOptions(options.compare, options.cameras)
    sources = [results_source(path, shown, options.encoder) for path in options.dirs]
    scene = _scene_of(sources, options.overlay)
    runtime.init(options.encoder.device)
    if options.window:
        return _show_window(scene, sources, options.query)
    return _show_page(scene, sources, options)


def _show_page(scene: Scene, sources: list[ResultsSource], options: View) -> int:
    """Results on a page, until Ctrl-C."""
    from ..viewer.web import WebViewer
    from ..viewer.web_page import ResultsPage

    with stop_on_signal(clean_up=lambda: _remove_temporaries(sources), viewer=True) as stop:
        viewer = WebViewer(options.page.host, options.page.port, scene.name)
        try:
            page = ResultsPage(viewer, scene, sources)
            for text in options.query:
                if page.ask is None:
                    raise InputError(NOTHING_TO_ASK.format(scene.name))
                page.ask.put(text)
            viewer.announce(open_browser=not options.page.no_open)
            viewer.serve(stop)
        finally:
            viewer.close()
    return DONE


def _remove_temporaries(sources: list[ResultsSource]) -> None:
    """Remove what a process that ends at once leaves of the files that a page writes."""
    from ..results.safe_point import remove_temporaries

    for source in sources:
        if source.folder is not None:
            remove_temporaries(source.folder)


def _show_window(scene: Scene, sources: list[ResultsSource], texts: tuple[str, ...]) -> int:
    """Results in a window, until it is closed or Ctrl-C."""
    from ..viewer.window import SceneWindow

    asked = next((source for source in sources if source.has_features), None)

    def ask(text: str) -> ShownAnswer:
        if asked is None:
            raise InputError(NOTHING_TO_ASK.format(scene.name))
        return asked.ask(scene.meshes[sources.index(asked)], text)

    with stop_on_signal(clean_up=lambda: None, viewer=True) as stop:
        window = SceneWindow(scene.name)
        try:
            window.put(scene)
            for text in texts:
                found = ask(text)
                print("\n".join([found.sentence, *found.rows]), flush=True)
                window.answer(found)
            window.serve(ask if asked is not None else None, stop)
        finally:
            window.close()
    return DONE


def _scene_of(sources: list[ResultsSource], overlay: bool) -> Scene:
    """One scene of all of them; folders of equal names are told apart by their paths."""
    from ..viewer.several import beside, overlaid

    scenes = [source.open() for source in sources]
    if len(scenes) == 1:
        return scenes[0]
    names = [scene.name for scene in scenes]
    if len(set(names)) < len(names):
        scenes = [scene.named(str(each.path)) for scene, each in zip(scenes, sources, strict=True)]
    return (overlaid if overlay else beside)(scenes)
