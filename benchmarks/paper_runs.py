"""Running an experiment over scenes: one JSON file a scene, so that a scene that is done is not run
again; a scene that fails is named, and the others go on.
"""

from __future__ import annotations

import json
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from paper_experiments import Command, Experiment, Settings
from paper_methods import Method
from paper_scenes import Scene

from taichi_unifusion.errors import UniFusionError
from taichi_unifusion.files.atomic import write_text
from taichi_unifusion.results.run_folder import RunFolder

UNIFUSION = "import sys; from taichi_unifusion.cli.main import main; sys.exit(main())"
STOPPED = 130  # exit code of a command that Ctrl-C ended
LOG = "log.txt"
UNKNOWN = "which frames were mapped at which poses was not kept"


class SceneFailed(UniFusionError):
    """A command for a scene did not end well."""


@dataclass
class Results:
    """What is known of an experiment under one method, by scene."""

    done: dict[str, dict[str, Any]] = field(default_factory=dict)  # name -> numbers
    failed: dict[str, str] = field(default_factory=dict)  # name -> why
    missing: tuple[str, ...] = ()  # on the list but not in the root
    said: tuple[str, ...] = ()  # what was done, in words; several where earlier calls differ
    kept: bool = False  # of earlier calls alone: how many there should be is not known


def run_scenes(
    experiment: Experiment,
    scenes: Sequence[Scene],
    out: Path,
    method: Method,
    settings: Settings,
    keep_maps: bool = False,
) -> Results:
    """Run what is not done yet; `out` is the experiment's folder under a method.

    A scene is done if its file says that the same commands and configuration gave its numbers.
    """
    said = experiment.said(settings)
    results = Results(said=(said,))
    for number, scene in enumerate(scenes, start=1):
        folder, file = out / scene.key, out / f"{scene.key}.json"
        head = f"[{number}/{len(scenes)}] {scene.name}"
        try:
            commands = experiment.commands(scene, folder, method.config, settings)
            kept = _read_done(file, commands, method.digest)
            if kept is None:
                kept = _run(experiment, scene, folder, commands, head)
                kept |= {"configuration": method.digest, "said": said}
                write_text(file, json.dumps(kept, indent=1) + "\n")
                if not keep_maps:
                    shutil.rmtree(RunFolder(folder).map_folder, ignore_errors=True)
        except (UniFusionError, OSError, ValueError, KeyError) as error:
            results.failed[scene.name] = str(error)
            print(f"{head}: failed: {error}", flush=True)
            continue
        results.done[scene.name] = kept["numbers"]
    return results


def read_results(out: Path) -> Results:
    """What earlier calls left in an experiment's folder under a method, whatever their settings."""
    results = Results(kept=True)
    for file in sorted(out.glob("*.json")):
        values = json.loads(file.read_text())
        results.done[values["scene"]] = values["numbers"]
        said = values.get("said", UNKNOWN)
        results.said += (said,) * (said not in results.said)
    return results


def _read_done(
    file: Path, commands: Sequence[Command], configuration: str | None
) -> dict[str, Any] | None:
    """The results of a scene; None where there are none of these commands and configuration."""
    try:
        values = json.loads(file.read_text())
        made_by = values["commands"], values.get("configuration")
        return values if made_by == (list(map(_shown, commands)), configuration) else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _run(
    experiment: Experiment, scene: Scene, folder: Path, commands: Sequence[Command], head: str
) -> dict[str, Any]:
    """Everything for one scene: numbers, what gave them, and how long that took."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / LOG).unlink(missing_ok=True)
    start = time.perf_counter()
    experiment.prepare(scene, folder)
    for command in commands:
        print(f"{head}: {_shown(command)}", flush=True)
        unifusion(command, folder / LOG)
    numbers = experiment.numbers(folder)
    return {
        "scene": scene.name,
        "numbers": numbers,
        "commands": list(map(_shown, commands)),
        "seconds": round(time.perf_counter() - start, 1),
    }


def unifusion(command: Command, log: Path) -> None:
    """Run a command of `unifusion` in a process of its own, which may die without harm to others.

    Raises SceneFailed with the last line that it wrote where it did not end well.
    """
    with open(log, "ab") as file:
        file.write(f"$ {_shown(command)}\n".encode())
        file.flush()
        words = [sys.executable, "-c", UNIFUSION, *command]
        code = subprocess.run(words, stdout=file, stderr=file, check=False).returncode
    if code == STOPPED:
        raise KeyboardInterrupt
    if code:
        said = log.read_text(errors="replace").strip().splitlines()[-1]
        how = f"was ended by signal {-code}" if code < 0 else f"ended with {code}"
        raise SceneFailed(f"unifusion {command[0]} {how}: {said} (see {log})")


def _shown(command: Command) -> str:
    return shlex.join(["unifusion", *command])


def mean(values: Sequence[float | None]) -> float | None:
    """Of those that there are."""
    present = [value for value in values if value is not None]
    return sum(present) / len(present) if present else None


def column(results: Results, name: str) -> list[float | None]:
    """A number of every scene that is done."""
    return [numbers.get(name) for numbers in results.done.values()]
