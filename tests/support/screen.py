"""A screen without a monitor, a Vulkan driver in software, and keys pressed on it."""

from __future__ import annotations

import ctypes
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from places import ROOT

DRIVERS = Path("/usr/share/vulkan/icd.d")
PATIENCE = 90  # [s] for a process that draws in software


def lavapipe() -> str:
    """The file that names Mesa's Vulkan driver in software; skips the test where it is not installed."""
    files = sorted(DRIVERS.glob("lvp_icd*.json"))
    if not files:
        pytest.skip("no Vulkan driver in software; `make viewers` installs one on Debian")
    return str(files[0])


@contextmanager
def xvfb() -> Iterator[str]:
    """DISPLAY of a screen of its own; skips the test where Xvfb is not installed."""
    if not shutil.which("Xvfb"):
        pytest.skip("no Xvfb; `make viewers` installs it on Debian")
    read, write = os.pipe()
    words = ["Xvfb", "-displayfd", str(write), "-screen", "0", "1280x900x24", "-nolisten", "tcp"]
    process = subprocess.Popen(words, pass_fds=[write], stderr=subprocess.DEVNULL)
    os.close(write)
    try:
        with os.fdopen(read) as answer:
            yield f":{answer.readline().strip()}"
    finally:
        process.terminate()
        process.wait()


def run_python(code: str, folder: Path | None = None, **environment: str) -> dict:
    """What a fresh interpreter prints last, as JSON, after `code` in a folder; DISPLAY is only what is
    given.
    """
    inherited = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    inherited["PYTHONPATH"] = os.pathsep.join([str(ROOT), str(ROOT / "tests" / "support")])
    done = subprocess.run(
        [sys.executable, "-c", code],
        env={**inherited, **environment},
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return json.loads(done.stdout.splitlines()[-1])


class Keyboard:
    """Presses keys, and moves and drags the pointer, on a screen: that of DISPLAY, or another."""

    def __init__(self, display: str | None = None) -> None:
        self.x11, self.xtest = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXtst.so.6")
        self.x11.XOpenDisplay.restype = ctypes.c_void_p
        self.x11.XStringToKeysym.restype = ctypes.c_ulong
        self.display = ctypes.c_void_p(self.x11.XOpenDisplay(display and display.encode()))

    def press(self, key: str) -> None:
        """Press and let go a key by its X name, as "2", "Tab" or "Escape"."""
        symbol = ctypes.c_ulong(self.x11.XStringToKeysym(key.encode()))
        code = self.x11.XKeysymToKeycode(self.display, symbol)
        for down in (1, 0):
            self.xtest.XTestFakeKeyEvent(self.display, code, down, 0)
            self.flush()

    def move(self, x: int, y: int) -> None:
        """Put the pointer somewhere, in pixels of the screen; keys go to what lies there."""
        self.xtest.XTestFakeMotionEvent(self.display, -1, x, y, 0)
        self.flush()

    def button(self, down: bool) -> None:
        """Press or let go the left button."""
        self.xtest.XTestFakeButtonEvent(self.display, 1, int(down), 0)
        self.flush()

    def flush(self) -> None:
        self.x11.XFlush(self.display)
        time.sleep(0.05)
