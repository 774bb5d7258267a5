"""`unifusion view`: results -> a page in the browser, to look at, touch, ask and share."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..errors import InputError
from .options import OPTIONAL, EncoderOptions
from .results_source import results_source
from .terminal import DONE
from .viewing import PageOptions, open_page

if TYPE_CHECKING:
    from ..viewer.scene import Scene
    from ..viewer.source import ResultsSource


@dataclass(frozen=True)
class View:
    """Show results on a page in the browser: every layer, questions, points, distances, parts,
    cameras.

    Example: unifusion view results/kitchen

    Side by side: unifusion view results/kitchen results/kitchen_fine

    On a machine behind ssh: ssh -L 8080:127.0.0.1:8080 MACHINE, then open http://127.0.0.1:8080
    here.
    """

    dirs: Annotated[Positional[tuple[Path, ...]], arg(metavar="DIR...")]
    """Results folders of `unifusion`, or mesh files."""
    overlay: FlagCreatePairsOff[bool] = False
    """Lay several results over one another instead of side by side."""
    compare: Annotated[Path | None, arg(metavar="MESH", help_behavior_hint=OPTIONAL)] = None
    """A mesh in the same world: its distance to each result becomes a layer."""
    cameras: Annotated[int, arg(metavar="N")] = 60
    """At most so many cameras are drawn, evenly over the trajectory."""
    page: Annotated[PageOptions, arg(name="")] = field(default_factory=PageOptions)
    encoder: Annotated[EncoderOptions, arg(name="")] = field(default_factory=EncoderOptions)


def view(options: View) -> int:
    """Results -> a page, until Ctrl-C."""
    if not options.dirs:
        raise InputError("view: say what to show, for example: unifusion view results/demo")
    from .. import runtime
    from ..viewer.results_scene import SceneOptions

    shown = SceneOptions(options.compare, options.cameras)
    sources = [results_source(path, shown, options.encoder) for path in options.dirs]
    scene = _scene_of(sources, options.overlay)
    runtime.init(options.encoder.device)
    viewer = open_page(options.page, scene.name)
    try:
        from ..viewer.web_panels import ResultsPage

        ResultsPage(viewer, scene, sources)
        viewer.serve()
    finally:
        viewer.close()
    return DONE


def _scene_of(sources: list[ResultsSource], overlay: bool) -> Scene:
    """One scene of all of them; equal names are told apart by their paths."""
    from ..viewer.scene import beside, overlaid

    scenes = [source.open() for source in sources]
    if len(scenes) == 1:
        return scenes[0]
    return (overlaid if overlay else beside)(scenes)
