"""The window, in processes of their own: off the screen, on a screen in memory with keys pressed, and
where there is none. Drawn by Mesa's Vulkan in software; without it these tests skip.
"""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import threading

import cv2
import numpy as np
import pytest
from places import ROOT
from screen import PATIENCE, Keyboard, lavapipe, run_python, xvfb

MAIN = "import sys; from taichi_unifusion.cli.main import main; sys.exit(main(sys.argv[1:]))"
START = """
import json
import numpy as np
from meshes import joined, parallelogram
from taichi_unifusion import runtime
from taichi_unifusion.rendering.look import Look
from taichi_unifusion.viewer.scene import Box, Layer, Scene, SceneCamera, SceneMesh
from taichi_unifusion.viewer.window import SceneWindow
from taichi_unifusion.datasets.synthetic import look_at
from taichi_unifusion.viewer.orbit import Orbit
from taichi_unifusion.viewer.render import camera_of

runtime.init("cpu")
mesh = joined(
    parallelogram((-2, -2, 0), (4, 0, 0), (0, 4, 0)),
    parallelogram((2, -2, 0), (0, 0, 2), (0, 4, 0)),
)
wall = mesh.vertices[:, 0] > 2 - 1e-6
layers = (
    Layer("color", np.where(wall[:, None], (200, 20, 20), (20, 20, 200)).astype(np.uint8)),
    Layer("green", np.tile(np.uint8((20, 180, 20)), (len(mesh.vertices), 1))),
    Layer.of_values("height", mesh.vertices[:, 2], Look("viridis", None, "height [m]")),
)
camera = SceneCamera("frame 7", camera_of((64, 48), 50), look_at((-1, 0, 1), (2, 0, 0.4)))
scene = Scene("corner", (SceneMesh("corner", mesh, layers),), (camera,))

def hue(picture, row, column):
    return int(picture[row, column].argmax())
"""

OFF_SCREEN = (
    START
    + """
window = SceneWindow("test", size=(320, 240), visible=False)
window.put(scene)
window.press("c")
told = {"said": window.said}
picture = window.picture()
told["panel"] = float((picture[10:60, 10:90].max(axis=2) < 120).mean())
window.press("h")
picture = window.picture()
told["shape"], told["upper"], told["lower"] = picture.shape, hue(picture, 80, 160), hue(picture, 230, 160)
window.press("y")
told["green"] = [window.layers[window.layer], hue(window.picture(), 80, 160)]
window.press("Tab")
told["height"] = window.layers[window.layer]
bar = window.picture()[228:232, 10:90].astype(int)
told["bar"] = float(np.abs(bar[:, 0] - bar[:, -1]).sum(axis=1).min())
window.press("Tab")
told["again"] = window.layers[window.layer]
window.orbit = Orbit(np.array([6.0, 0, 4]), np.zeros(3), scene.up)  # behind the wall
told["through"] = hue(window.picture(), 120, 160)
window.press("b")
told["backs"] = hue(window.picture(), 120, 160)
before = window.picture()
window.put(Scene("boxed", scene.meshes, boxes=(Box("a", np.array([[-1.0, -1, 0], [1, 1, 1]])),)), keep_camera=True)
told["boxes"] = int((window.picture() != before).any(axis=2).sum())
window.press("Escape")
told["open"] = window.open
window.close()
print(json.dumps(told))
"""
)

ON_SCREEN = (
    START
    + """
from screen import Keyboard
window, keyboard = SceneWindow("test", size=(640, 480)), Keyboard()
window.put(scene)
keyboard.move(500, 450)

def wait(times=4):
    for _ in range(times):
        window.poll()

wait()
told, eye = {"layers": []}, window.orbit.eye
for key in ("y", "Tab", "t"):
    keyboard.press(key)
    wait()
    told["layers"].append(window.layers[window.layer])
keyboard.button(True)
wait()
keyboard.move(560, 430)
wait()
keyboard.button(False)
wait()
told["moved"] = float(np.abs(window.orbit.eye - eye).max())
keyboard.press("p")
wait()
told["written"] = window.said
keyboard.press("Escape")
wait()
told["open"] = window.open
window.close()
print(json.dumps(told))
"""
)

CLOSED_WHILE_RUNNING = """
import json
from dataclasses import replace
from tiny_recording import CONFIG, make_frames
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.viewer.window import SceneWindow
from taichi_unifusion.viewer.window_live import WindowLive

pipeline, frames = Pipeline(replace(CONFIG, window=1)), make_frames(12)
window = SceneWindow("live", size=(320, 240), visible=False)
drawn = []

def poll():  # nobody sees it
    drawn.append(window.said)
    return window.picture() is not None and window.open

window.poll = poll
live = WindowLive(window, len(frames), stop=lambda: False)
seen, first = [], list(drawn)

def on_step(frame, step, running):
    live.pace.due = 0.0
    live.on_step(frame, step, running)
    if window.scene is not None:
        seen.append([len(window.scene.meshes[0].mesh.faces), list(window.layers)])
    if len(seen) == 6:
        window.press("Escape")

run = pipeline.run(frames, on_step=on_step)
live.finish("nowhere")
picture = seen[-1]
print(json.dumps({"used": len(run.steps), "seen": seen, "said": window.said, "open": window.open, "first": first}))
"""


def test_off_the_screen_layers_backs_boxes_and_the_legend_are_drawn():
    told = run_python(OFF_SCREEN, VK_ICD_FILENAMES=lavapipe())
    assert told["said"] == "frame 7" and told["shape"] == [240, 320, 3]
    assert told["panel"] > 0.3  # dark, with the layers and the keys on it
    assert (told["upper"], told["lower"]) == (0, 2)  # a red wall over a blue floor
    assert told["green"] == ["green", 1] and told["height"] == "height" and told["bar"] > 100
    assert told["again"] == "color"
    assert told["through"] == 2 and told["backs"] == 0  # the wall from behind is seen through
    assert told["boxes"] > 50 and told["open"] is False


def test_on_a_screen_keys_switch_layers_the_mouse_turns_and_escape_ends(tmp_path):
    driver = lavapipe()
    with xvfb() as display:
        told = run_python(ON_SCREEN, VK_ICD_FILENAMES=driver, DISPLAY=display, folder=tmp_path)
    assert told["layers"] == ["green", "height", "color"]
    assert told["moved"] > 0.1 and told["open"] is False
    assert told["written"] == f"{tmp_path / 'view-1.png'} is written"
    picture = cv2.imread(str(tmp_path / "view-1.png"))
    assert os.listdir(tmp_path) == ["view-1.png"]  # and no file of ImGui's
    assert picture.shape == (480, 640, 3) and picture[240:, 320:].std() > 10


def test_a_run_grows_in_the_window_and_goes_on_without_it():
    told = run_python(CLOSED_WHILE_RUNNING, VK_ICD_FILENAMES=lavapipe())
    assert told["first"] == ["waiting for the first frame"] * 2  # text appears in the second
    assert told["used"] == 12 and told["open"] is False
    triangles = [count for count, _ in told["seen"]]
    assert len(triangles) >= 6 and triangles[5] > triangles[0] > 0
    assert told["seen"][5][1][:3] == ["color", "normals", "height"]
    assert "of 12, 0 skipped" in told["said"]


def test_questions_by_option_and_by_typing_are_answered_in_the_window(results):
    driver = lavapipe()
    terminal, typed = pty.openpty()
    words = ["view", results.path, "--window", "--query", "red", "--text", results.text]
    with xvfb() as display:
        process = subprocess.Popen(
            [sys.executable, "-c", MAIN, *map(str, words)],
            env={
                **os.environ,
                "PYTHONPATH": str(ROOT),
                "DISPLAY": display,
                "VK_ICD_FILENAMES": driver,
            },
            stdin=typed,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        killer = threading.Timer(PATIENCE, process.kill)
        killer.start()
        try:
            said = [process.stdout.readline()]
            while said[-1] and not said[-1].startswith("type what"):
                said.append(process.stdout.readline())
            os.write(terminal, b"no such word\nblue\n")
            while said[-1] and not said[-1].startswith("blue: "):
                said.append(process.stdout.readline())
            keyboard = Keyboard(display)
            keyboard.move(600, 500)
            keyboard.press("Escape")
            _, errors = process.communicate()
        finally:
            killer.cancel()
            process.kill()
    assert process.returncode == 0, errors
    assert said[0].startswith("red: ") and "place" in said[0] and "1. score" in said[1]
    assert any("no such word" in line for line in said)  # what has no vector is told, and no end
    assert said[-1].startswith("blue: ")


def unifusion(*words, **environment) -> subprocess.CompletedProcess:
    inherited = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "WAYLAND_DISPLAY")}
    return subprocess.run(
        [sys.executable, "-c", MAIN, *map(str, words)],
        env={**inherited, "PYTHONPATH": str(ROOT), **environment},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )


@pytest.mark.parametrize(
    ("display", "told"),
    [({}, "there is no screen (DISPLAY is not set)"), ({"DISPLAY": ":1973"}, "does not answer")],
)
def test_V3_without_a_screen_one_sentence_says_so(tmp_path, display, told):
    from meshes import parallelogram

    mesh = tmp_path / "mesh.ply"
    parallelogram((0, 0, 0), (1, 0, 0), (0, 1, 0)).save(mesh)
    done = unifusion("view", mesh, "--window", **display)
    assert done.returncode == 2 and told in done.stderr
    assert "`unifusion render` writes pictures" in done.stderr and "Traceback" not in done.stderr


def test_V3_a_run_without_a_screen_goes_on(tmp_path):
    out = tmp_path / "out"
    words = ["--option", "width=80", "--option", "height=60", "--end", "2", "--out", out]
    done = unifusion("reconstruct", "synthetic", "--view-window", *words)
    assert done.returncode == 0, done.stderr
    assert "no window: there is no screen" in done.stderr
    assert "the run goes on without it" in done.stderr and (out / "mesh.ply").exists()


def test_without_vulkan_one_sentence_says_so():
    code = """
import json
from taichi_unifusion import runtime
from taichi_unifusion.errors import MissingDependency
from taichi_unifusion.viewer.window import SceneWindow
try:
    SceneWindow("test", visible=False)
except MissingDependency as error:
    print(json.dumps({"told": str(error)}))
"""
    told = run_python(code, VK_ICD_FILENAMES="/nowhere.json")
    assert "no Vulkan driver; install one" in told["told"]


def test_options_that_exclude_each_other_are_told(tmp_path, capsys):
    from taichi_unifusion.cli import main as cli

    words = ["reconstruct", "synthetic", "--end", "1", "--out", str(tmp_path / "out")]
    assert cli.main([*words, "--view", "--view-window"]) == 2
    assert "choose one of them" in capsys.readouterr().err
    assert np.array(os.listdir(tmp_path)).size <= 1
