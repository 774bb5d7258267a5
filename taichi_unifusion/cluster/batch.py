"""Many recordings, each a scene of its own: what is missing is run, and one table tells of all."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from ..errors import FileError, InputError, UniFusionError
from ..files.atomic import read_bytes, write_text
from ..files.strict_yaml import read_yaml
from ..results.record import RunRecord, read_record
from ..results.run_folder import RunFolder
from .engine import own_kernels

COMMANDS = ("reconstruct", "transfer", "understand")
SCENE_KEYS = ("name", "command", "format", "path", "options")
COLUMNS = ("scene", "frames", "skipped", "seconds", "ms a frame", "triangles", "memory MB")
SAID = "unifusion: error: "  # how an error begins in a log


@dataclass(frozen=True)
class Scene:
    """A recording, and how it is run."""

    name: str
    arguments: tuple[str, ...]  # of `unifusion`, without --out

    def folder(self, out: Path) -> RunFolder:
        """Where its results go."""
        return RunFolder(out / self.name)

    def log(self, out: Path) -> Path:
        """What its run said."""
        return out / f"{self.name}.log"


def read_scenes(path: Path) -> list[Scene]:
    """The scenes of a YAML file: `scenes`, a list with name, format, path and options each, and
    `common` with what they share. Raises FileError or InputError, with the place in the file.
    """
    values = read_yaml(path)
    if not isinstance(values, Mapping) or not isinstance(values.get("scenes"), list):
        raise InputError(f"{path}: expected a list of recordings under 'scenes'")
    if unknown := set(values) - {"scenes", "common"}:
        raise InputError(f"{path}: unknown key '{min(map(str, unknown))}'; keys: scenes, common")
    common = _mapping(values.get("common") or {}, f"{path}: common")
    scenes = [
        _scene(_mapping(each, f"{path}: scenes[{n}]"), common, path, f"{path}: scenes[{n}]")
        for n, each in enumerate(values["scenes"])
    ]
    names = [each.name for each in scenes]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise InputError(f"{path}: two scenes are called '{twice[0]}'")
    if not scenes:
        raise InputError(f"{path}: there are no scenes")
    return scenes


def _scene(values: Mapping[str, Any], common: Mapping[str, Any], file: Path, at: str) -> Scene:
    for key in (*values, *common):
        if key not in SCENE_KEYS:
            raise InputError(f"{at}: unknown key '{key}'; keys: {', '.join(SCENE_KEYS)}")
    both = {**common, **values}
    options = {
        **_mapping(common.get("options") or {}, f"{file}: common: options"),
        **_mapping(values.get("options") or {}, f"{at}: options"),
    }
    command, kind = both.get("command", COMMANDS[0]), both.get("format", "auto")
    if command not in COMMANDS:
        raise InputError(f"{at}: command: must be one of {', '.join(COMMANDS)}, got {command!r}")
    words = [str(command), str(kind)]
    if (path := both.get("path")) is not None:
        words.append(str(file.parent / str(path)))
    name = str(both.get("name") or Path(words[-1]).name)
    if Path(name).name != name or name in (".", ".."):
        raise InputError(f"{at}: name: '{name}' cannot be the name of a folder")
    for key, value in options.items():
        words += _flag(str(key), value, at)
    return Scene(name, tuple(words))


def _flag(key: str, value: Any, at: str) -> list[str]:
    """An option as the command line has it."""
    flag = f"--{key.replace('_', '-')}"
    if flag == "--out":
        raise InputError(f"{at}: options: the folder of results follows from the scene's name")
    if isinstance(value, bool):
        return [flag] if value else []
    values = value if isinstance(value, list) else [value]
    return [word for each in values for word in (flag, str(each))]


def _mapping(value: Any, at: str) -> Mapping[str, Any]:
    if not isinstance(value, Mapping):
        raise InputError(f"{at}: expected keys and values, got {value!r:.80}")
    return value


def last_error(log: Path) -> str:
    """The last error that a scene's run has written into its log; "" where there is none."""
    try:
        lines = log.read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    return next((each[len(SAID) :] for each in reversed(lines) if each.startswith(SAID)), "")


def run_scene(scene: Scene, out: str) -> int:
    """Run a scene in a process of its own, what it says goes to a file; returns its exit code."""
    program = "import sys; from taichi_unifusion.cli.main import main; sys.exit(main())"
    folder, environment = scene.folder(Path(out)), {**os.environ, **own_kernels()}
    words = [sys.executable, "-c", program, *scene.arguments, "--out", str(folder.path)]
    with open(scene.log(Path(out)), "wb") as log:
        code = subprocess.run(
            words, stdout=log, stderr=log, env=environment, check=False
        ).returncode
    if code == 0:
        note_done(scene, Path(out))
    return code


def note_done(scene: Scene, out: Path) -> None:
    """Keep with which arguments a scene was run to its end; raises FileError."""
    write_text(_ticket(scene.folder(out)), json.dumps(list(scene.arguments)) + "\n")


def is_done(scene: Scene, out: Path) -> bool:
    """Whether a scene was run with the same arguments, to its end."""
    folder = scene.folder(out)
    try:
        read_record(folder.record)
        return json.loads(read_bytes(_ticket(folder))) == list(scene.arguments)
    except (UniFusionError, ValueError):
        return False


def _ticket(folder: RunFolder) -> Path:
    """Says with which arguments a scene was run."""
    return folder.path / "batch.json"


def tabulate(scenes: Sequence[Scene], out: Path) -> tuple[list[list[str]], dict[str, Any]]:
    """A row of COLUMNS for each scene and their means, as texts and as JSON values."""
    found: dict[str, list[float] | None] = {}
    for scene in scenes:
        try:
            found[scene.name] = _numbers(read_record(scene.folder(out).record))
        except FileError:
            found[scene.name] = None
    there = [numbers for numbers in found.values() if numbers]
    means = [fmean(column) for column in zip(*there, strict=True)] if there else []
    rows = [[name, *_texts(numbers)] for name, numbers in found.items()]
    rows.append([f"mean of {len(there)}", *_texts(means)])
    values = {
        name: dict(zip(COLUMNS[1:], numbers, strict=True)) if numbers else None
        for name, numbers in (*found.items(), ("mean", means))
    }
    return [list(COLUMNS), *rows], values


def _numbers(record: RunRecord) -> list[float]:
    spent = record.seconds
    frame = record.milliseconds.get("frame")
    return [
        record.frames.used,
        record.frames.skipped,
        spent.frames + spent.mesh + spent.write,
        frame.mean if frame else 0.0,
        record.mesh.triangles if record.mesh else 0,
        record.peak_memory_bytes / 1e6,
    ]


def _texts(numbers: Sequence[float] | None) -> list[str]:
    if not numbers:
        return ["missing", *[""] * (len(COLUMNS) - 2)]
    return [f"{number:,.1f}" if number % 1 else f"{number:,.0f}" for number in numbers]
