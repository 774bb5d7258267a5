"""A real browser without a screen, driven by selenium: Chromium with a renderer in software."""

from __future__ import annotations

import io
import json
import shutil
import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest

PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
SIZE = (980, 620)  # pixels of the window: software draws large ones slowly
PATIENCE = 45.0  # [s] for what a page does on a machine that is busy
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
    "--hide-scrollbars",
)


def open_browser() -> Any:
    """A browser that notes what it asks the network for; skips, saying why, where there is none."""
    webdriver = pytest.importorskip(
        "selenium.webdriver", reason="no selenium; pip install selenium"
    )
    program = next(filter(None, map(shutil.which, PROGRAMS)), None)
    driver = shutil.which("chromedriver")
    if program is None or driver is None:
        pytest.skip("no chromium with its chromedriver; `make viewers` installs them on Debian")
    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*FLAGS, f"--window-size={SIZE[0]},{SIZE[1]}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    service = webdriver.ChromeService(executable_path=driver)
    return webdriver.Chrome(options=options, service=service)


def until(
    condition: Callable[[], Any], what: str, meanwhile: Callable[[], Any] = lambda: None
) -> Any:
    """Wait until the condition holds, and give what it gave; `meanwhile` is done all the time."""
    end = time.monotonic() + PATIENCE
    while True:
        meanwhile()
        if found := condition():
            return found
        assert time.monotonic() < end, f"waited {PATIENCE:.0f} s for {what}"
        time.sleep(0.2)


def screenshot(browser: Any) -> np.ndarray:
    """What the browser shows, (H, W, 3) RGB; a slow renderer gets more than one chance."""
    from selenium.common.exceptions import WebDriverException

    for chance in range(4):
        try:
            png = browser.get_screenshot_as_png()
            break
        except WebDriverException:
            if chance == 3:
                raise
            time.sleep(1.0)
    return cv2.imdecode(np.frombuffer(io.BytesIO(png).read(), np.uint8), cv2.IMREAD_COLOR)[
        ..., ::-1
    ]


def canvas_part(picture: np.ndarray) -> np.ndarray:
    """The middle of a picture, left of the controls."""
    height, width = picture.shape[:2]
    return picture[height // 4 : 3 * height // 4, width // 8 : width // 2]


def is_empty(picture: np.ndarray) -> bool:
    """Whether next to nothing is drawn in the middle."""
    part = canvas_part(picture).astype(int)
    return float(part.std(axis=(0, 1)).max()) < 4


def requests_of(browser: Any) -> list[str]:
    """The addresses that pages have asked for since this was last called."""
    messages = [json.loads(entry["message"])["message"] for entry in browser.get_log("performance")]
    return [
        message["params"]["request"]["url"]
        for message in messages
        if message["method"] == "Network.requestWillBeSent"
    ]
