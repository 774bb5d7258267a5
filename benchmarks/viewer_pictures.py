"""Pictures of pages in a real browser without a screen (Chromium and selenium), for docs/viewer.md.

python benchmarks/viewer_pictures.py page results/demo docs/viewer-page.jpg --layer saliency
python benchmarks/viewer_pictures.py page results/house docs/viewer-ask.jpg --ask sofa --text embeddings:FILE
python benchmarks/viewer_pictures.py file demo.html docs/viewer-shared.jpg --layer height
python benchmarks/viewer_pictures.py live 7scenes PATH docs/viewer-live.jpg --every 3 --end 90
"""

from __future__ import annotations

import argparse
import logging
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import taichi_unifusion as uf
from taichi_unifusion.cli.options import EncoderOptions
from taichi_unifusion.cli.results_source import results_source
from taichi_unifusion.datasets import FORMATS
from taichi_unifusion.viewer.decimation import decimate_scene
from taichi_unifusion.viewer.results_scene import SceneOptions
from taichi_unifusion.viewer.web import WebViewer
from taichi_unifusion.viewer.web_live import WebLive
from taichi_unifusion.viewer.web_page import ResultsPage

SIZE = (1280, 800)  # pixels of the window
QUALITY = 85  # of the JPEG
PATIENCE = 120.0  # [s] for a renderer in software
FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-dev-shm-usage",
)
# what the page says of the renderer; removed it would end the page, which closes its notes itself
HIDE_NOTES = (
    "document.querySelectorAll('.mantine-Notification-root').forEach(e => e.style.display = 'none')"
)


def main() -> None:
    """Take one picture."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    page = commands.add_parser("page", help="of a results folder")
    page.add_argument("dir", type=Path)
    page.add_argument("--ask")
    page.add_argument("--text", help="the text encoder")
    page.add_argument("--names", type=Path, help="of an embeddings file")
    page.add_argument("--triangles", type=int, default=150_000, help="of a renderer in software")
    page.add_argument("--cut", type=float, help="[m] above which nothing is shown")
    page.add_argument("--cameras", action="store_true")
    page.set_defaults(run=picture_page)
    file = commands.add_parser("file", help="of a page to share")
    file.add_argument("file", type=Path)
    file.set_defaults(run=picture_file)
    live = commands.add_parser("live", help="of a run, at its last frame")
    live.add_argument("format", choices=FORMATS)
    live.add_argument("path")
    live.add_argument("--end", type=int)
    live.add_argument("--every", type=int, default=1)
    live.set_defaults(run=picture_live)
    for command in (page, file, live):
        command.add_argument("out", type=Path)
        command.add_argument("--layer", default="color")
        command.add_argument("--click", action="store_true", help="on the middle of the canvas")
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    browser = open_browser()
    try:
        options.run(options, browser)
    finally:
        browser.quit()


def picture_page(options: argparse.Namespace, browser: Any) -> None:
    """The page of `unifusion view`."""
    uf.init()
    encoder = EncoderOptions(text=options.text, names=options.names)
    source = results_source(options.dir, SceneOptions(), encoder)
    viewer = WebViewer()
    scene = decimate_scene(source.open(), options.triangles)
    page = ResultsPage(viewer, scene, [source])
    page.layers.show(options.layer)
    browser.get(viewer.address)
    wait(viewer.server.get_clients, viewer.poll)
    if options.cut is not None:
        page.layers.height.value = options.cut
        page.stage.cut_above(options.cut)
    if options.cameras:
        page.layers.cameras.shown.value = True
        page.layers.cameras.show()
    if options.ask:
        page.ask.put(options.ask)
    wait_still(browser, viewer.poll)
    if options.click:
        click_middle(browser)
        wait(lambda: page.point.last is not None, viewer.poll)
    write_picture(options.out, wait_still(browser, viewer.poll))
    viewer.close()


def picture_file(options: argparse.Namespace, browser: Any) -> None:
    """The page that `unifusion export` writes, opened from the disk."""
    from selenium.webdriver.support.ui import Select

    browser.get(options.file.resolve().as_uri())
    wait(lambda: browser.execute_script("return document.body.dataset.ready") == "yes")
    Select(browser.find_element("id", "layer")).select_by_visible_text(options.layer)
    wait_still(browser)
    if options.click:
        click_middle(browser)
    write_picture(options.out, wait_still(browser))


def picture_live(options: argparse.Namespace, browser: Any) -> None:
    """The page of a run after its last frame."""
    viewer = WebViewer()
    frames = uf.open_dataset(options.format, options.path)[: options.end : options.every]
    live = WebLive(viewer, len(frames), lambda: False)
    browser.get(viewer.address)
    wait(viewer.server.get_clients, viewer.poll)
    uf.Pipeline().run(frames, on_step=live.on_step, on_skip=live.on_skip)
    write_picture(options.out, wait_still(browser, viewer.poll))
    viewer.close()


def open_browser() -> Any:
    """Chromium without a screen."""
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    for flag in (*FLAGS, f"--window-size={SIZE[0]},{SIZE[1]}"):
        options.add_argument(flag)
    options.binary_location = shutil.which("chromium") or shutil.which("google-chrome") or ""
    return webdriver.Chrome(options, webdriver.ChromeService(shutil.which("chromedriver")))


def click_middle(browser: Any) -> None:
    """Click on the canvas, left of the controls."""
    from selenium.webdriver.common.action_chains import ActionChains

    canvas = browser.find_element("tag name", "canvas")
    ActionChains(browser).move_to_element_with_offset(canvas, -150, 60).click().perform()


def wait(condition: Callable[[], Any], meanwhile: Callable[[], Any] = lambda: None) -> Any:
    """Wait until the condition holds; raises TimeoutError after PATIENCE."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        meanwhile()
        if found := condition():
            return found
        time.sleep(0.2)
    raise TimeoutError("the browser did not do it in time")


def wait_still(browser: Any, meanwhile: Callable[[], Any] = lambda: None) -> np.ndarray:
    """What the browser shows, (H, W, 3) RGB, once that has stopped changing."""
    browser.execute_script(HIDE_NOTES)
    pictures = [screenshot(browser)]

    def stands_still() -> bool:
        time.sleep(1.0)
        pictures.append(screenshot(browser))
        change = np.abs(pictures[-1].astype(int) - pictures[-2]).mean()
        return change < 0.05 and pictures[-1].std() > 20

    wait(stands_still, meanwhile)
    return pictures[-1]


def screenshot(browser: Any) -> np.ndarray:
    from selenium.common.exceptions import WebDriverException

    for _ in range(5):
        try:
            png = np.frombuffer(browser.get_screenshot_as_png(), np.uint8)
            return np.ascontiguousarray(cv2.imdecode(png, cv2.IMREAD_COLOR)[..., ::-1])
        except WebDriverException:  # a slow renderer
            time.sleep(1.0)
    raise TimeoutError("the browser gave no picture")


def write_picture(path: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(path), picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(f"{path}: {picture.shape[1]} x {picture.shape[0]}, {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
