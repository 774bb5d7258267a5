"""Is a recording all right? What a person should know before mapping it, each with its evidence and
the option that mends it.

    diagnosis = examine(open_dataset("folder", path))
    diagnosis.sound, diagnosis.findings, diagnosis.fix

Nothing is changed: `write_fix` writes the answers for a run to take. Thresholds are the worst of
many scenes; `benchmarks/doctor.py` prints what they are worth.
"""

from __future__ import annotations

from ..dataset import Dataset
from .color import color_findings
from .depth import depth_findings
from .facts import facts_of
from .finding import CAUSES, Diagnosis, Finding
from .fix import Fix, read_fix, write_fix
from .poses import pose_findings
from .sampling import take_sample
from .stills import frame_findings

__all__ = [
    "CAUSES",
    "Diagnosis",
    "Finding",
    "Fix",
    "examine",
    "read_fix",
    "write_fix",
]

# what readers say when they open a recording -> its cause; what is not here is examined more closely
SAID = {
    "paired in their order": "time-stamps",
    "its time stamps are": "time-stamps",
    "appears again": "time-stamps",
    "distortion ignored": "distortion",
    "no usable pose": "unreadable",
    "have no partner": "time-stamps",
}


def examine(recording: Dataset) -> Diagnosis:
    """Look at up to 40 frames of a recording that is open."""
    sample = take_sample(recording)
    findings = [*_said(recording), *_unreadable(sample.problems, sample.asked)]
    if sample.frames:
        unit = depth_findings(sample)
        findings += unit
        pictures = frame_findings(sample)
        findings += pictures
        # poses in metres cannot fit a depth whose unit is wrong, nor those of other pictures
        if not {each.cause for each in (*unit, *pictures)} & {"depth-scale", "repeated", "still"}:
            findings += pose_findings(sample)
        findings += color_findings(sample)
    return Diagnosis(facts_of(sample), tuple(findings))


def _said(recording: Dataset) -> list[Finding]:
    """What the reader found unusual but usable."""
    return [
        Finding(cause, sentence, wrong=False)
        for sentence in recording.warnings
        for words, cause in SAID.items()
        if words in sentence
    ]


def _unreadable(problems: tuple[str, ...], asked: int) -> list[Finding]:
    if not problems:
        return []
    return [
        Finding(
            "unreadable",
            f"{len(problems)} of {asked} frames cannot be read (first: {problems[0]})",
            "a run leaves them out and goes on; --strict stops there",
        )
    ]
