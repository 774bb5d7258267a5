"""`unifusion`: one function per subcommand, and the only place that catches UniFusionError.

Exit codes: 0 done; 2 bad input, or an output that could not be written; 130 stopped by Ctrl-C or SIGTERM; 1 a bug. What needs
Taichi is imported where it is used, so that `--help` is there at once. UNIFUSION_DEBUG=1 shows tracebacks.
"""

from __future__ import annotations

import argparse
import json
import logging
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal, Union

import tyro
from tyro.conf import FlagCreatePairsOff, Positional, arg, subcommand

from .config import Config, MeshSettings, dump_config, load_config
from .datasets import FORMATS, Dataset, open_dataset
from .errors import DatasetError, FileError, InputError, UniFusionError
from .interrupts import INTERRUPTED, stop_on_signal
from .terminal import format_bytes, frame_progress, log_to_stderr, summarize

logger = logging.getLogger(__name__)

FORMAT_DEFAULT = "(default: the format's)"
DONE, FAILED = 0, 2
DESCRIPTION = ("RGB-D frames with camera poses in, a coloured surface out.\n\n"
               "unifusion COMMAND --help: explains a command\n\nunifusion --version: prints the version")


@dataclass(frozen=True)
class ReconstructOptions:
    """Turn a recording of RGB-D frames with camera poses into a coloured mesh.

    Example: unifusion reconstruct 7scenes my/redkitchen --every 10 --out results/kitchen

    Settings that `unifusion config --help` explains are options here too,

    for example --device cpu, --surface.voxel-size 0.03 or --mesh.resolution 8.
    """

    format: Annotated[Positional[str], arg(metavar="FORMAT", help=f"The kind of recording: {', '.join(FORMATS)}.")]
    path: Annotated[Positional[Path | None], arg(metavar="[PATH]", help_behavior_hint="(synthetic needs none)")] = None
    """Where the recording lies."""
    out: Annotated[Path, arg(metavar="DIR")] = field(kw_only=True)
    """Folder for the results; made where it does not exist."""
    start: Annotated[int, arg(metavar="A")] = field(default=0, kw_only=True)
    """First frame, counted from 0."""
    end: Annotated[int | None, arg(metavar="B", help_behavior_hint="(default: all)")] = field(default=None, kw_only=True)
    """Frame to stop before."""
    every: Annotated[int, arg(metavar="N")] = field(default=1, kw_only=True)
    """Use every N-th frame."""
    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")] = field(default=None, kw_only=True)
    """YAML file of settings that differ from the defaults; options given here count more."""
    depth_scale: Annotated[float | None, arg(metavar="S", help_behavior_hint=FORMAT_DEFAULT)] = field(
        default=None, kw_only=True)
    """Units of the depth images that make a metre."""
    drop_alpha: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Accept colour images with a fourth channel and ignore it."""
    max_difference: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint=FORMAT_DEFAULT)] = field(
        default=None, kw_only=True)
    """How far time stamps of depth, colour and pose may be apart (tum, folder)."""
    strict: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Stop at the first frame that cannot be used, instead of skipping it."""
    json: FlagCreatePairsOff[bool] = field(default=False, kw_only=True)
    """Print the metrics as JSON instead of tables."""

    @property
    def reading(self) -> dict[str, object]:
        """Options for `open_dataset`: those that were given."""
        options = {"depth_scale": self.depth_scale, "max_difference": self.max_difference,
                   "drop_alpha": self.drop_alpha or None}
        return {name: value for name, value in options.items() if value is not None}


@dataclass(frozen=True)
class Reconstruct(ReconstructOptions):
    __doc__ = ReconstructOptions.__doc__

    settings: Annotated[Config, arg(name="")] = field(default_factory=Config, kw_only=True)


@dataclass(frozen=True)
class ExtractMesh:
    """Extract the coloured mesh again from the saved maps of a results folder, finer or coarser."""

    dir: Annotated[Positional[Path], arg(metavar="DIR")]
    """Results folder of `unifusion reconstruct`."""
    resolution: Annotated[int, arg(metavar="N")] = 4
    """Cells along the edge of a surface voxel; 8 gives 4 times the triangles of 4."""
    min_area: Annotated[float, arg(metavar="M2")] = MeshSettings.min_area
    """Connected parts of less than this area, in square metres, are left out; 0 keeps all."""
    out: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(default: DIR/mesh.ply and DIR/mesh.glb)")] = None
    """Where to write it: .ply, .glb or .obj."""
    device: Literal["auto", "cuda", "cpu"] = "auto"
    """Where to compute."""


@dataclass(frozen=True)
class Info:
    """Show what a results folder, a map file or a PLY mesh holds, and whether it is sound."""

    path: Annotated[Positional[Path], arg(metavar="DIR|FILE")]
    """Results folder, map (.safetensors) or mesh (.ply)."""


@dataclass(frozen=True)
class ShowConfig:
    """Print every setting, as it would be used, in YAML that --config reads back.

    Settings come from the defaults, then from --config FILE, then from options. A file needs to hold only what differs.
    """

    config: Annotated[Path | None, arg(metavar="FILE", help_behavior_hint="(optional)")] = None
    """YAML file of settings that differ from the defaults."""
    settings: Annotated[Config, arg(name="")] = field(default_factory=Config)


def reconstruct(options: Reconstruct) -> int:
    """Frames -> maps -> mesh -> results folder."""
    recording = open_dataset(options.format, options.path, **options.reading)
    frames = _select(recording, options)
    from .results import prepare_results, remove_temporaries

    directory = prepare_results(options.out)
    with stop_on_signal(clean_up=lambda: remove_temporaries(directory)) as stop:
        return _run_and_write(options, frames, directory, stop)


def _run_and_write(options: Reconstruct, frames: Dataset, directory: Path, stop: Callable[[], bool]) -> int:
    from .pipeline import Pipeline
    from .results import write_results

    pipeline = Pipeline(options.settings)
    with frame_progress(len(frames)) as on_frame:
        run = pipeline.run(frames, strict=options.strict, stop=stop, on_frame=on_frame)
    if not run.steps:
        logger.warning("stopped before the first frame was done; nothing was written")
        return INTERRUPTED
    done = len(run.steps) + len(run.skipped)
    if done < len(frames):
        logger.warning("%s after %d of %d frames; writing what they gave", "stopped" if run.interrupted else "ended early",
                       done, len(frames))
    about = {"format": options.format, "path": str(options.path or ""), "start": options.start, "end": options.end,
             "every": options.every, "frames": len(frames)}
    results = write_results(directory, pipeline, run, {"recording": about})
    print(json.dumps(results.metrics, indent=2) if options.json else summarize(results.metrics, results.files, directory))
    code = _report([error for error in (run.failure, *results.failures) if error])
    return INTERRUPTED if stop() else code


def _select(recording: Dataset, options: ReconstructOptions) -> Dataset:
    """The frames asked for, or DatasetError if there are none."""
    if options.start < 0 or options.every < 1 or (options.end is not None and options.end <= options.start):
        raise InputError(f"frames: need 0 <= start < end and every >= 1, got start {options.start}, end {options.end}, "
                         f"every {options.every}")
    frames = recording[options.start:options.end:options.every]
    if not len(frames):
        raise DatasetError(f"{recording.name}: there is no frame {options.start}, it has {len(recording)} (0 is the first)")
    return frames


def extract_mesh(options: ExtractMesh) -> int:
    """Saved maps -> mesh files."""
    from .io import MESH_SUFFIXES, check_writable, write_mesh

    files = [options.out] if options.out else [options.dir / "mesh.ply", options.dir / "mesh.glb"]
    if files[0].suffix.lower() not in MESH_SUFFIXES:
        raise InputError(f"{files[0]}: a mesh is written as {', '.join(MESH_SUFFIXES)}, not as '{files[0].suffix}'")
    maps = {path.stem: path for path in sorted((options.dir / "maps").glob("*.safetensors"))}
    if "surface" not in maps:
        raise FileError(f"{options.dir}: no maps/surface.safetensors here; give the results folder of `unifusion reconstruct`")
    check_writable(files[0].parent)
    from . import pipeline, runtime
    from .maps import PropertyMap, SurfaceMap

    runtime.init(options.device)
    surface = SurfaceMap.load(maps.pop("surface"))
    properties = {name: PropertyMap.load(path) for name, path in maps.items()}
    mesh = pipeline.extract_mesh(surface, properties, options.resolution, options.min_area)
    failures = []
    for file in files:
        try:
            write_mesh(file, mesh)
            print(f"{file}: {len(mesh.vertices):,} vertices, {len(mesh.faces):,} triangles, "
                  f"{format_bytes(file.stat().st_size)}")
        except UniFusionError as error:  # the other file may still be written
            failures.append(error)
    return _report(failures)


def info(options: Info) -> int:
    """Files -> tables."""
    from .inspection import inspect

    inspection = inspect(options.path)
    if inspection.text:
        print(inspection.text)
    return _report(inspection.problems)


def show_config(options: ShowConfig) -> int:
    """Settings -> YAML."""
    print(dump_config(options.settings), end="")
    return DONE


COMMANDS: dict[str, tuple[type, Callable[..., int]]] = {
    "reconstruct": (Reconstruct, reconstruct),
    "mesh": (ExtractMesh, extract_mesh),
    "info": (Info, info),
    "config": (ShowConfig, show_config),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    argv, debug = list(sys.argv[1:] if argv is None else argv), bool(os.environ.get("UNIFUSION_DEBUG"))
    with log_to_stderr(debug):
        try:
            code = _dispatch(argv)
            sys.stdout.flush()
            return code
        except SystemExit as exit:  # of tyro, after it said what is wrong or printed help
            return exit.code if isinstance(exit.code, int) else FAILED
        except KeyboardInterrupt:
            logger.error("stopped")
            return INTERRUPTED
        except BrokenPipeError:  # whoever reads our output has left, as `head` does
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return DONE
        except UniFusionError as error:
            if debug:
                raise
            return _report([error])
        except OSError as error:  # our own files are FileErrors; this is standard output, on a full disk
            if debug:
                raise
            return _report([FileError(f"output could not be written: {error.strerror or error}")])


def _dispatch(argv: list[str]) -> int:
    if argv == ["--version"]:
        from . import __version__

        print(f"unifusion {__version__}")
        return DONE
    name, arguments = (argv[0], argv[1:]) if argv and argv[0] in COMMANDS else (None, argv)
    if name is None:  # help, or no such command: tyro says it
        every = Union[tuple(Annotated[_short(options), subcommand(name, description=options.__doc__.splitlines()[0])]
                            for name, (options, _) in COMMANDS.items())]
        tyro.cli(every, prog="unifusion", description=DESCRIPTION, args=arguments)
        return FAILED
    options, command = COMMANDS[name]
    return command(_parse(name, options, arguments))


def _parse(name: str, options: type, arguments: list[str]):
    """The options of a command; the file that --config names gives the defaults of the settings."""
    prog = f"unifusion {name}"
    if {"-h", "--help"} & set(arguments):
        options = _short(options)
    if "settings" not in options.__dataclass_fields__:
        return tyro.cli(options, prog=prog, args=arguments)
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--config", nargs="?")
    file = finder.parse_known_args(arguments)[0].config
    settings = load_config(file) if file else Config()
    required = {field: tyro.MISSING for field in ("format", "out") if field in options.__dataclass_fields__}
    return tyro.cli(options, prog=prog, args=arguments, default=options(**required, settings=settings))


def _short(options: type) -> type:
    """The options that a command's help shows."""
    return ReconstructOptions if options is Reconstruct else options


def _report(errors: Sequence[Exception]) -> int:
    for error in errors:
        logger.error("%s", error)
    return FAILED if errors else DONE
