"""`unifusion`: finds the subcommand, and is the only place that catches UniFusionError.

Exit codes: 0 done; 2 bad input, for `check` also a recording with something wrong, or an output that
could not be written; 130 stopped by Ctrl-C or SIGTERM; 1 a bug. What needs Taichi is imported where
it is used, so that `--help` is there at once. UNIFUSION_DEBUG=1 shows tracebacks.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import inspect
import logging
import os
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from functools import reduce
from operator import or_
from typing import Annotated, Any

import tyro
from tyro.conf import subcommand

from ..config import Config, config_of, load_config
from ..datasets.doctor.fix import read_fix
from ..errors import FileError, UniFusionError, as_known, check_choice
from .batch import Batch, batch
from .check import Check, check
from .config import ShowConfig, show_config
from .convert import Convert, convert
from .evaluate import METRICS, Evaluate
from .export import Export, export
from .formats import ShowFormats, show_formats
from .help_texts import few_settings, no_settings, whole_sentences, with_long_names
from .info import Info, info
from .interrupts import INTERRUPTED
from .into import settings_of
from .merge import Merge, merge
from .mesh import ExtractMesh, extract_mesh
from .query import Query, query
from .reconstruct import Reconstruct, reconstruct
from .remote import local_copies
from .render import Render, render
from .repose import Repose, repose
from .segment import Segment, segment
from .terminal import DONE, FAILED, PlainOutput, log_to_stderr, report
from .transfer import Transfer, transfer
from .understand import Understand, understand
from .view import View, view

logger = logging.getLogger(__name__)

DESCRIPTION = (
    "RGB-D frames in, a map out: surface, colour, any property.\n\n"
    "unifusion COMMAND --help: explains a command\n\nunifusion --version: prints the version"
)

# name -> options and function of a command, or help and commands of a group
Commands = dict[str, tuple[type, Callable[..., int] | dict[str, Any]]]

COMMANDS: Commands = {
    "check": (Check, check),
    "reconstruct": (Reconstruct, reconstruct),
    "transfer": (Transfer, transfer),
    "understand": (Understand, understand),
    "query": (Query, query),
    "segment": (Segment, segment),
    "view": (View, view),
    "render": (Render, render),
    "mesh": (ExtractMesh, extract_mesh),
    "merge": (Merge, merge),
    "batch": (Batch, batch),
    "repose": (Repose, repose),
    "export": (Export, export),
    "convert": (Convert, convert),
    "info": (Info, info),
    "formats": (ShowFormats, show_formats),
    "config": (ShowConfig, show_config),
    "evaluate": (Evaluate, METRICS),
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code."""
    argv = [_american(word) for word in (sys.argv[1:] if argv is None else argv)]
    debug = bool(os.environ.get("UNIFUSION_DEBUG"))
    with log_to_stderr(debug):
        try:
            code = _dispatch(argv)
            if sys.stdout is not None:
                sys.stdout.flush()
            return code
        except SystemExit as exit:  # from tyro, which has printed help or what is wrong
            return exit.code if isinstance(exit.code, int) else FAILED
        except KeyboardInterrupt:
            logger.error("stopped")
            return INTERRUPTED
        except BrokenPipeError:  # the reader of our output has left, as `head` does
            if sys.stdout is not None:
                os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return DONE
        except UniFusionError as error:
            if debug:
                raise
            return report([error])
        except OSError as error:
            # of standard output, as on a full disk: files raise FileError
            if debug:
                raise
            return report([FileError(f"output could not be written: {error.strerror or error}")])
        except (MemoryError, RuntimeError) as error:
            if debug or (known := as_known(error)) is error:
                raise
            return report([known])


def _american(word: str) -> str:
    """An option as it is spelled here: --colour-camera is --color-camera; its value stays."""
    if not word.startswith("--"):
        return word
    name, equals, value = word.partition("=")
    return f"{name.replace('colour', 'color')}{equals}{value}"


def _dispatch(argv: list[str]) -> int:
    if argv == ["--version"]:
        from .. import __version__

        print(f"unifusion {__version__}")
        return DONE
    return _run("unifusion", DESCRIPTION, COMMANDS, argv)


def _run(prog: str, description: str, commands: Commands, argv: list[str]) -> int:
    name, arguments = (argv[0], argv[1:]) if argv and argv[0] in commands else (None, argv)
    if name is None and arguments and not {arguments[0][:1], *arguments} & {"-", "--help"}:
        check_choice("command", arguments[0], commands)
    if name is None:  # help, or no command: tyro prints what there is
        _say_commands(prog, description, commands, arguments)
        return FAILED
    options, command = commands[name]
    if isinstance(command, dict):
        return _run(f"{prog} {name}", _docstring(options), command, arguments)
    parsed = _parse(f"{prog} {name}", options, arguments)
    with redirect_stdout(PlainOutput(sys.stdout)), local_copies(parsed) as local:
        return command(local)


def _docstring(options: type) -> str:
    """What a command says of itself; from its source where Python was told to drop docstrings (-OO)."""
    if sys.flags.optimize < 2:
        return inspect.getdoc(options) or ""
    (body,) = ast.parse(inspect.getsource(options)).body
    return ast.get_docstring(body) or "" if isinstance(body, ast.ClassDef) else ""


def _first_paragraph(options: type) -> str:
    return " ".join(_docstring(options).split("\n\n")[0].split())


def _say_commands(prog: str, description: str, commands: Commands, arguments: list[str]) -> None:
    kinds = (
        Annotated[options, subcommand(name, description=_first_paragraph(options) or name)]
        for name, (options, _) in commands.items()
    )
    with no_settings(), whole_sentences():
        every: Any = reduce(or_, kinds)
        tyro.cli(every, prog=prog, description=description, args=arguments)


def _parse(prog: str, options: type, arguments: list[str]) -> Any:
    """The options of a command; the file that --config names gives the defaults of the settings."""
    told = _docstring(options)
    if "settings" not in options.__dataclass_fields__:
        with whole_sentences():
            return tyro.cli(options, prog=prog, args=arguments, description=told)
    if {"-h", "--help"} & set(arguments) and options is not ShowConfig:
        with few_settings(), whole_sentences():
            return tyro.cli(options, prog=prog, args=arguments, description=told)
    arguments = with_long_names(arguments)
    finder = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--config", nargs="?")
    finder.add_argument("--fix", nargs="?")
    finder.add_argument("--into", nargs="?")
    finder.add_argument("--out", nargs="?")
    files = finder.parse_known_args(arguments)[0]
    settings = Config()
    if files.into:
        settings = settings_of(files.into)
        arguments += [] if files.out else ["--out", files.into]
    if files.fix:
        settings = config_of(read_fix(files.fix).settings, files.fix, settings)
    if files.config:
        settings = load_config(files.config, settings)
    required = {
        field.name: tyro.MISSING_NONPROP
        for field in dataclasses.fields(options)
        if field.default is field.default_factory is dataclasses.MISSING
    }
    with whole_sentences():
        return tyro.cli(
            options, prog=prog, args=arguments, default=options(**required, settings=settings)
        )
