"""The device that tests run on, and where the repository and real recordings are."""

from __future__ import annotations

import os
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DEVICE = os.environ.get("UNIFUSION_TEST_DEVICE", "cpu")
DATA = Path(os.environ.get("UNIFUSION_DATA", ROOT.parent / "shared" / "data"))
