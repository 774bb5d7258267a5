"""`unifusion formats`: which recordings can be read, and how one of them is laid out."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import Annotated

from tyro.conf import Positional, arg

from ..datasets import AUTO, FORMATS, format_layout, format_options
from ..errors import check_choice
from .terminal import DONE

WIDTH = 100  # columns


@dataclass(frozen=True)
class ShowFormats:
    """List the formats of recordings, or print the layout and the options of one.

    Example: unifusion formats record3d
    """

    format: Annotated[
        Positional[str | None], arg(metavar="[FORMAT]", help_behavior_hint="(default: all)")
    ] = None
    """The format to explain."""


def show_formats(options: ShowFormats) -> int:
    """Formats -> text."""
    if options.format is not None:
        check_choice("format", options.format, FORMATS)
    print(_list() if options.format is None else _explain(options.format))
    return DONE


def _list() -> str:
    """A line or two for each."""
    wide = max(map(len, FORMATS)) + 2
    lines = []
    for format in FORMATS:
        first = " ".join(format_layout(format).split("\n\n")[0].split()).replace("`", "")
        lines += textwrap.wrap(
            first,
            WIDTH,
            initial_indent=format.ljust(wide),
            subsequent_indent=" " * wide,
            break_on_hyphens=False,
        )
    return "\n".join(
        [
            *lines,
            "",
            f"unifusion formats FORMAT explains one; unifusion reconstruct {AUTO} PATH finds it by the files",
        ]
    )


def _explain(format: str) -> str:
    """The layout of one, how it is known, and its options."""
    from ..datasets.detection import SIGNS

    lines = [format_layout(format), ""]
    if format in SIGNS:
        lines += [f"Known by: {SIGNS[format].looked_for}", ""]
    lines.append("Options, given as --option NAME=VALUE:")
    for option in format_options(format).values():
        default = "" if option.default is None else f" (default: {option.default})"
        where = "" if option.has_text_form else " Only in Python."
        text = f"{option.name}: {option.sentence}{where}{default}"
        lines += textwrap.wrap(text, WIDTH, initial_indent="  ", subsequent_indent="      ")
    return "\n".join(lines)
