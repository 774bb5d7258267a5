"""`unifusion check`: recording -> what is wrong with it, and what mends it."""

from __future__ import annotations

import json
import textwrap
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from tyro.conf import FlagCreatePairsOff, arg

from ..datasets.doctor import CAUSES, Diagnosis, Finding, examine, write_fix
from ..errors import DatasetError
from .options import RecordingOptions, open_recording
from .terminal import DONE, FAILED

LINE = 110  # columns


@dataclass(frozen=True)
class Check:
    """Look at a recording before it is mapped: what is there, what is wrong, what mends it.

    Example: unifusion check folder my_recording --fix fix.yaml

    Then: unifusion reconstruct folder my_recording --fix fix.yaml --out results/mine

    --fix names the file that answers are written to; nothing else is changed. The exit code is 0 if the
    recording is sound, 2 if something is wrong.
    """

    recording: Annotated[RecordingOptions, arg(name="")]
    json: FlagCreatePairsOff[bool] = False
    """Print JSON instead of text."""


def check(options: Check) -> int:
    """Recording -> diagnosis on standard output."""
    file = options.recording.fix
    diagnosis = _examined(replace(options.recording, fix=None))
    if file is not None:
        write_fix(file, diagnosis.fix)
    if options.json:
        print(json.dumps(diagnosis.to_json(), indent=2))
    else:
        print(described(diagnosis, file))
    return DONE if diagnosis.sound else FAILED


def _examined(options: RecordingOptions) -> Diagnosis:
    """The diagnosis; a recording that cannot be opened is a finding like any other."""
    try:
        recording = open_recording(options)
    except DatasetError as error:
        return Diagnosis({}, (Finding("unreadable", str(error)),))
    return examine(recording)


def described(diagnosis: Diagnosis, file: Path | None) -> str:
    """The diagnosis for a person."""
    width = max(map(len, diagnosis.facts), default=0) + 3
    lines = [
        textwrap.fill(f"{name:{width}}{said}", LINE, subsequent_indent=" " * width)
        for name, said in diagnosis.facts.items()
    ]
    for wrong, title in ((True, "wrong"), (False, "worth knowing")):
        found = [finding for finding in diagnosis.findings if finding.wrong is wrong]
        if found:
            lines += ["", f"{title}:"]
        for finding in found:
            text = f"{CAUSES[finding.cause]}: {finding.sentence}"
            lines.append(_paragraph(f"* {text}", "  "))
            if finding.advice:
                lines.append(_paragraph(f"  -> {finding.advice}", "     "))
    if diagnosis.sound:
        lines += ["", "nothing wrong was found"]
    fix = diagnosis.fix
    if fix.recording or fix.settings:
        lines += [
            "",
            f"the answers are in {file}: a run takes them with --fix {file}"
            if file
            else "--fix FILE writes the answers, and a run takes them with --fix FILE",
        ]
    return "\n".join(lines)


def _paragraph(text: str, indent: str) -> str:
    return textwrap.fill(
        text, LINE, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )
