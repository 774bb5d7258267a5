"""How much memory of this process a piece of work takes at its peak."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


class Peak:
    """Growth of the peak of resident memory over what was resident before [MB]."""

    megabytes = 0.0


@contextmanager
def peak_memory() -> Iterator[Peak]:
    """Gives a `Peak` that is filled in when the block ends; skips where the system does not tell."""
    peak = Peak()
    try:
        Path("/proc/self/clear_refs").write_text("5")  # the peak begins anew
    except OSError as error:
        pytest.skip(f"the peak of memory cannot be reset here: {error}")
    before = _status("VmRSS")
    yield peak
    peak.megabytes = (_status("VmHWM") - before) / 1e3


def _status(key: str) -> int:
    """A number of /proc/self/status [kB]."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(key))
