"""Maps stay what they were, to the bit, unless a change means to change them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

GOLDEN = Path(__file__).parent / "golden"
# relative: what another processor's order of summation may change in a mean over a whole map
ROUNDING = 2e-3


@pytest.fixture(scope="module")
def made() -> dict:
    """Hashes and summaries of the maps as they are made now, in a process with one thread."""
    done = subprocess.run(
        [sys.executable, GOLDEN / "make_maps.py"], capture_output=True, text=True, check=True
    )
    return json.loads(done.stdout)


@pytest.fixture(scope="module")
def kept() -> dict:
    return json.loads((GOLDEN / "maps.json").read_text())


def test_maps_are_the_same_to_the_bit(made, kept):
    if made["machine"] != kept["machine"]:
        pytest.skip(f"hashes are of a machine with {kept['machine']}; this one: {made['machine']}")
    assert made["hashes"] == kept["hashes"]


def test_maps_are_the_same_within_rounding_on_every_machine(made, kept):
    assert made["summaries"].keys() == kept["summaries"].keys()
    for name, summary in kept["summaries"].items():
        scale = max(abs(summary[2]), 1e-6)
        assert made["summaries"][name][0] == pytest.approx(summary[0], rel=ROUNDING), name
        assert made["summaries"][name][1:] == pytest.approx(summary[1:], abs=ROUNDING * scale), name
