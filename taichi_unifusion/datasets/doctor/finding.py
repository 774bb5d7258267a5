"""What the doctor says of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from .fix import Fix

# cause -> what it is about, for a heading
CAUSES = {
    "unreadable": "the recording, or some of its frames, cannot be read",
    "no-depth": "hardly any depth readings",
    "depth-scale": "the unit of the depth images",
    "far-plane": "values that stand for no reading",
    "intrinsics": "intrinsics of another resolution or camera",
    "distortion": "lens distortion that is ignored",
    "pose-reading": "how poses are written",
    "pose-scale": "the unit of the poses' translations",
    "poses": "poses that do not fit the depth",
    "clock-offset": "the clocks of images and poses",
    "time-stamps": "time stamps",
    "still": "a camera that never moves",
    "repeated": "frames that are repeated",
    "swapped": "frames out of their order",
    "exposure": "jumps of exposure",
    "color": "colour that is not registered to depth",
}


@dataclass(frozen=True)
class Finding:
    """One thing about a recording, with its evidence, and the option that mends it."""

    cause: str  # one of CAUSES
    sentence: str
    advice: str = ""  # what to do; empty where nothing needs to be done
    fix: Fix = field(default_factory=Fix)
    wrong: bool = True  # False: worth knowing, but the map is right without a change
    rivals: tuple[str, ...] = ()  # other causes that the evidence fits as well


@dataclass(frozen=True)
class Diagnosis:
    """What there is, and what is wrong with it."""

    facts: Mapping[str, str]
    findings: tuple[Finding, ...]

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong."""
        return not any(finding.wrong for finding in self.findings)

    @property
    def fix(self) -> Fix:
        """All answers together."""
        recording: dict[str, Any] = {}
        settings: dict[str, Any] = {}
        for finding in self.findings:
            recording.update(finding.fix.recording)
            settings.update(finding.fix.settings)
        return Fix(recording, settings)

    def to_json(self) -> dict[str, Any]:
        """The diagnosis as JSON values."""
        return {
            "sound": self.sound,
            "facts": dict(self.facts),
            "findings": [
                {
                    "cause": finding.cause,
                    "rivals": list(finding.rivals),
                    "wrong": finding.wrong,
                    "sentence": finding.sentence,
                    "advice": finding.advice,
                    "recording": dict(finding.fix.recording),
                    "settings": dict(finding.fix.settings),
                }
                for finding in self.findings
            ],
        }
