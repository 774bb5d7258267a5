"""The pages in a real browser: pictures are drawn, layers switch, questions are typed, clicks are
answered; the shared page opens without a server.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browser import canvas_part, is_empty, open_browser, requests_of, screenshot, until
from meshes import joined, parallelogram
from ports import some_port
from tiny_recording import CONFIG, make_frames

from taichi_unifusion.language.embeddings import read_embeddings
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.rendering.look import Look
from taichi_unifusion.viewer.page import write_page
from taichi_unifusion.viewer.results_scene import open_scene
from taichi_unifusion.viewer.scene import Layer, Scene, SceneMesh
from taichi_unifusion.viewer.source import ResultsSource

pytest.importorskip("viser", reason="the page needs viser: pip install 'taichi-unifusion[viewer]'")

from taichi_unifusion.viewer.web import WebViewer
from taichi_unifusion.viewer.web_live import WebLive
from taichi_unifusion.viewer.web_page import ResultsPage
from taichi_unifusion.viewer.web_stage import Stage

STEP, SHARE = 30, 0.01  # two pictures differ if so many pixels do, by so many steps of 255


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    opened = open_browser()
    yield opened
    opened.quit()


@pytest.fixture(scope="module")
def page(results) -> Iterator[ResultsPage]:
    viewer = WebViewer(port=some_port())
    source = ResultsSource(
        results.path, make_encoder=lambda *_: read_embeddings(results.embeddings)
    )
    yield ResultsPage(viewer, source.open(), [source])
    viewer.close()


@pytest.fixture(scope="module")
def shown(browser, page) -> Any:
    """The browser with the page open and a first picture drawn."""
    return visit(browser, page.viewer)


def visit(browser: Any, viewer: WebViewer) -> Any:
    browser.get(viewer.address)
    until(viewer.server.get_clients, "the page to connect", viewer.poll)
    until(lambda: not is_empty(screenshot(browser)), "a picture", viewer.poll)
    return browser


def settled(browser: Any, viewer: WebViewer | None = None) -> np.ndarray:
    """The picture once it has stopped changing."""
    pictures = [canvas_part(screenshot(browser))]

    def stands_still() -> bool:
        pictures.append(canvas_part(screenshot(browser)))
        return np.abs(pictures[-1].astype(int) - pictures[-2]).mean() < 0.2

    until(stands_still, "a still picture", viewer.poll if viewer else lambda: None)
    return pictures[-1]


def hide_notes(browser: Any) -> None:
    """Take away what viser says over the scene, as that there is no graphics card."""
    browser.execute_script(
        "document.querySelectorAll('[class*=Notification-root]').forEach(e => e.style.display = 'none')"
    )


def differ(one: np.ndarray, other: np.ndarray) -> bool:
    changed = np.abs(one.astype(int) - other).max(axis=2) > STEP
    return float(changed.mean()) > SHARE


def click_on_surface(
    browser: Any, answered: Callable[[], bool], meanwhile: Callable[[], Any] = lambda: None
) -> None:
    """Click here and there, left of the controls, until something is met: the mesh has holes."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    canvas = browser.find_element(By.TAG_NAME, "canvas")
    places = [(x, y) for y in (0, 40, -40, 80, -80) for x in (-140, -60, -220)]

    def click() -> bool:
        ActionChains(browser).move_to_element_with_offset(canvas, *places.pop(0)).click().perform()
        for _ in range(6):
            time.sleep(0.1)
            meanwhile()
        return answered()

    until(click, "a click that meets the surface", meanwhile)


def control(browser: Any, label: str) -> Any:
    """The input of the control with that label."""
    from selenium.webdriver.common.by import By

    return browser.find_element(
        By.XPATH, f"//label[contains(., '{label}')]/following::*[self::input or self::textarea][1]"
    )


def text_of(browser: Any) -> str:
    return browser.execute_script("return document.body.innerText")


def test_the_page_shows_the_surface_and_its_controls(shown):
    said = text_of(shown)
    for word in ("Layer", "Cut above", "Ask", "Click on the surface", "triangles"):
        assert word in said
    assert "Share" not in said


def test_another_layer_is_another_picture(shown, page):
    from selenium.webdriver.common.by import By

    before = settled(shown, page.viewer)
    control(shown, "Layer").click()
    option = until(
        lambda: shown.find_elements(By.XPATH, "//*[@role='option' and contains(., 'height')]"),
        "the list of layers",
    )[0]
    option.click()
    until(lambda: page.stage.layer == "height", "the layer to be chosen", page.viewer.poll)
    until(
        lambda: differ(canvas_part(screenshot(shown)), before), "another picture", page.viewer.poll
    )
    assert "height [m]" in text_of(shown)


def test_a_question_is_asked_by_enter_and_not_while_typing(shown, page):
    from selenium.webdriver.common.keys import Keys

    box = control(shown, "Where is")
    box.send_keys("red")
    until(lambda: page.ask.text.value == "red", "the letters to arrive", page.viewer.poll)
    page.viewer.poll()
    assert page.ask.said.content == ""
    box.send_keys(Keys.ENTER)
    until(lambda: "place" in page.ask.said.content, "an answer", page.viewer.poll)
    until(lambda: "1. score" in text_of(shown), "the list of answers", page.viewer.poll)
    assert page.stage.layer == "query: red"


def test_whoever_types_fast_is_asked_for_all_of_it(shown, page):
    from selenium.webdriver.common.keys import Keys

    box = control(shown, "Where is")
    for before, word in (("red", "blue"), ("blue", "red")):
        box.send_keys(*[Keys.BACKSPACE] * len(before), word, Keys.ENTER)
        asked = f"query: {word}"
        until(lambda asked=asked: page.stage.layer == asked, "an answer", page.viewer.poll)
        assert page.ask.text.value == word
        # the end of the line is taken from the box by the server: letters before that would be lost
        until(
            lambda word=word: box.get_attribute("value") == word, "the box to be cleared of Enter"
        )
    until(lambda: "1. score" in text_of(shown), "the list of answers", page.viewer.poll)


def test_a_row_of_the_answer_flies_there(shown, page):
    from selenium.webdriver.common.by import By

    client = next(iter(page.viewer.server.get_clients().values()))
    before = client.camera.look_at.copy()
    shown.find_element(By.XPATH, "//button[contains(., '1. score')]").click()
    until(
        lambda: np.linalg.norm(client.camera.look_at - before) > 0.05, "a flight", page.viewer.poll
    )


def test_a_click_on_the_surface_is_answered(shown, page):
    page.point.clear()
    click_on_surface(shown, lambda: page.point.last is not None, page.viewer.poll)
    until(lambda: "position" in text_of(shown), "what is there", page.viewer.poll)


def test_a_browser_that_comes_back_finds_the_scene(shown, page):
    first = shown.current_window_handle
    shown.switch_to.new_window("tab")
    second = shown.current_window_handle
    shown.switch_to.window(first)
    shown.close()
    shown.switch_to.window(second)
    until(lambda: not page.viewer.server.get_clients(), "the page to be gone", page.viewer.poll)
    visit(shown, page.viewer)
    assert "query: red" in control(shown, "Layer").get_attribute("value")


def test_a_page_that_goes_away_before_it_is_answered_is_no_warning(browser, recwarn):
    viewer, first = WebViewer(port=some_port()), browser.current_window_handle
    browser.switch_to.new_window("tab")
    browser.get(viewer.address)
    (client,) = until(viewer.server.get_clients, "the page to connect").values()
    browser.close()
    browser.switch_to.window(first)
    until(lambda: not viewer.server.get_clients(), "the page to be gone")
    viewer.say("Extracted", "too late", client)
    viewer.close()
    assert not [each for each in recwarn if "closed connection" in str(each.message)]


PATCHES = {  # of a layer: the colours of what faces up, and of two walls
    "color": [(228, 166, 99), (10, 12, 14), (235, 20, 10)],
    "paint": [(128, 128, 128), (0, 60, 255), (240, 240, 60)],
}
VALUES = (0.0, 0.45, 1.0)  # of the same three, in the layer that has a legend
AS_GIVEN, WITH_RELIEF = 2, 10  # steps of 255 that a drawn colour may be off


def corner_of_a_room_from_outside() -> Scene:
    """Three squares that look up, along x and along y, in flat colours and with flat values."""
    axes = np.eye(3, dtype=np.float32)
    squares = [
        parallelogram(axes[k], axes[(k + 1) % 3], axes[(k + 2) % 3], steps=3) for k in (2, 0, 1)
    ]
    mesh = joined(*squares)
    each = len(squares[0].vertices)
    layers = [
        Layer(name, np.repeat(np.array(colors, np.uint8), each, axis=0))
        for name, colors in PATCHES.items()
    ]
    look = Look("viridis", (0.0, 1.0))
    layers.append(Layer.of_values("value", np.repeat(VALUES, each), look))
    return Scene("corner", (SceneMesh("corner", mesh, tuple(layers)),))


@pytest.mark.parametrize("layer", [*PATCHES, "value"])
def test_what_is_drawn_has_the_colours_of_the_layer_and_its_legend(browser, layer):
    scene, viewer = corner_of_a_room_from_outside(), WebViewer(port=some_port())
    try:
        stage = Stage(viewer.server, scene)
        stage.show_layer(layer)
        viewer.server.initial_camera.position = np.array([3.0, 3.0, 3.0])
        hide_notes(visit(browser, viewer))
        picture = settled(browser, viewer).reshape(-1, 3).astype(int)
    finally:
        viewer.close()
    legend = scene.legend(layer)
    wanted = np.array(
        PATCHES[layer]
        if legend is None
        else [legend.colors[round(255 * value)] for value in VALUES]
    )
    surface = picture[(picture < 250).any(axis=1)]
    off = np.abs(surface[:, None] - wanted.astype(int)).max(axis=2)
    most = AS_GIVEN if legend is None else WITH_RELIEF
    drawn = (off <= most).mean(axis=0)
    assert (drawn > 0.1).all() and drawn.sum() > 0.95, (drawn, np.unique(surface, axis=0)[::50])


def test_a_run_is_watched_until_its_results(browser, results, monkeypatch):
    viewer = WebViewer(port=some_port())
    frames = make_frames(6)
    live = WebLive(viewer, len(frames), lambda: False)
    monkeypatch.setattr(viewer, "serve", lambda stop: None)
    monkeypatch.setattr(viewer, "close", lambda: None)
    try:
        browser.get(viewer.address)
        until(viewer.server.get_clients, "the page to connect", viewer.poll)
        pipeline = Pipeline(replace(CONFIG, window=2))
        pipeline.run(frames, on_step=live.on_step, on_skip=live.on_skip)
        until(lambda: not is_empty(screenshot(browser)), "a mesh that grows", viewer.poll)
        assert "surface" in text_of(browser) and "Pause" in text_of(browser)
        live.finish(results.path)
        until(lambda: "Cut above" in text_of(browser), "the results", viewer.poll)
        until(lambda: not is_empty(screenshot(browser)), "the final mesh", viewer.poll)
        assert "Pause" not in text_of(browser)
    finally:
        monkeypatch.undo()
        viewer.close()


def test_the_shared_page_opens_from_a_file_and_asks_for_nothing(browser, results, tmp_path):
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import Select

    write_page(open_scene(results.path), tmp_path / "page.html")
    address = (tmp_path / "page.html").as_uri()
    browser.get("about:blank")
    requests_of(browser), browser.get_log("browser")  # of earlier pages
    browser.get(address)
    until(
        lambda: browser.execute_script("return document.body.dataset.ready") == "yes", "the program"
    )
    before = settled(browser)
    assert not is_empty(screenshot(browser))
    layer = Select(browser.find_element(By.ID, "layer"))
    assert {"color", "height", "saliency"} <= {option.text for option in layer.options}
    layer.select_by_visible_text("height")
    until(lambda: differ(canvas_part(screenshot(browser)), before), "another picture")
    assert "height [m]" in text_of(browser)
    camera = Select(browser.find_element(By.ID, "camera"))
    camera.select_by_visible_text("frame 1")
    click_on_surface(browser, lambda: "position" in text_of(browser))
    rows = [
        row.text.split(maxsplit=1) for row in browser.find_elements(By.CSS_SELECTOR, "#point tr")
    ]
    said = dict(rows)
    assert len(said) == len(rows) and "normals" not in said
    assert re.fullmatch(r"-?\d+\.\d{3} m", said["height"])
    normal = [float(part) for part in said["normal"].split(", ")]
    assert abs(np.linalg.norm(normal) - 1) < 0.02
    assert re.fullmatch(r"\d+, \d+, \d+ \(#[0-9a-f]{6}\)", said["color"])
    edges = "a => document.querySelector(a).getBoundingClientRect()"
    assert browser.execute_script(
        f"const at = {edges}; return at('canvas').right <= at('#panel').left"
    )
    assert [url for url in requests_of(browser) if not url.startswith("data:")] == [address]
    assert [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"] == []
