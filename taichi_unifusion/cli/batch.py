"""`unifusion batch`: many recordings, each into a folder of its own, and a table of all."""

from __future__ import annotations

import json
import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, Positional, arg

from ..cluster.engine import ClusterSettings
from .options import FOLDER
from .terminal import DONE, FAILED, frame_progress

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Batch:
    """Run many recordings, those that are missing, and tell of all in one table.

    Example: unifusion batch scenes.yaml --out results --workers 4

    The file lists them: scenes: [{name: flat, format: scannet, path: scans/scene0000_00, options: {every: 10}}];
    what all share stands under common:.
    """

    scenes: Annotated[Positional[Path], arg(metavar="SCENES.yaml")]
    """YAML file of recordings; their paths begin at its folder."""
    out: Annotated[Path, FOLDER]
    """Folder for the results, in a folder each, with table.json; what is there of the same run is not run
    again.
    """
    json: FlagCreatePairsOff[bool] = False
    """Print the numbers as JSON instead of a table."""
    cluster: Annotated[ClusterSettings, arg(name="")] = field(default_factory=ClusterSettings)


def batch(options: Batch) -> int:
    """Recordings -> results folders -> a table."""
    from ..cluster.batch import is_done, last_error, read_scenes, run_scene, tabulate
    from ..cluster.engine import open_engine
    from ..files.atomic import check_writable, write_text
    from ..results.tables import format_table

    scenes = read_scenes(options.scenes)
    out = check_writable(options.out)
    missing = [scene for scene in scenes if not is_done(scene, out)]
    if len(missing) < len(scenes):
        logger.info("%d of %d scenes are done already", len(scenes) - len(missing), len(scenes))
    settings = options.cluster if options.cluster.wanted else ClusterSettings(workers=1)
    failed: list[str] = []
    if missing:
        with open_engine(settings) as engine, frame_progress(len(missing), "scene") as on_scene:
            done = 0

            def count() -> None:
                nonlocal done
                done += 1
                on_scene(done, len(missing))

            found = engine.map(run_scene, [(each, str(out)) for each in missing], count)
        for scene, result in zip(missing, found, strict=True):
            if result != DONE:
                failed.append(scene.name)
                log = scene.log(out)
                why = result
                if isinstance(result, int):
                    why = last_error(log) or f"exit code {result}"
                logger.error("%s: %s; see %s", scene.name, why, log)
    rows, values = tabulate(scenes, out)
    write_text(out / "table.json", json.dumps(values, indent=2) + "\n")
    print(json.dumps(values, indent=2) if options.json else format_table(rows))
    if failed:
        logger.error("%d of %d scenes failed: %s", len(failed), len(scenes), ", ".join(failed))
    return FAILED if failed else DONE
