"""Ctrl-C and SIGTERM at any moment of any command: exit code 130, nothing torn, nothing left."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from ports import some_port
from tiny_recording import CONFIG, DEVICE, make_frames

from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.results import write_results

ROOT = Path(__file__).resolve().parents[2]
PATIENCE = 120  # [s] for a process that has to start Taichi on a busy machine
SIGNALS = [signal.SIGINT, signal.SIGTERM]
START = """
import sys, time
def wait():
    sys.stderr.write("now\\n")
    sys.stderr.flush()
    time.sleep(60)
{}
from taichi_unifusion.cli.start import main
sys.exit(main())
"""
# each calls wait() at its moment
IMPORTING = """
class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == "tyro":
            wait()
sys.meta_path.insert(0, Slow())
"""
# as compiled modules, which make another error of it
COMPILED = """
class Compiled:
    def find_spec(self, name, path=None, target=None):
        if name == "tyro":
            try:
                wait()
            except KeyboardInterrupt:
                raise ImportError("initialization failed") from None
sys.meta_path.insert(0, Compiled())
"""
TAICHI = """
class Slow:
    def find_spec(self, name, path=None, target=None):
        if name == "taichi._lib.core.taichi_python":
            sys.stderr.write("now\\n")
            sys.stderr.flush()
            try:
                time.sleep(2)
            except KeyboardInterrupt:
                sys.stderr.write("broken\\n")
                raise ImportError("initialization failed") from None
sys.meta_path.insert(0, Slow())
"""
# among what was registered once the command runs
AT_THE_END = """
import atexit
class Last:
    def find_spec(self, name, path=None, target=None):
        if name == "tyro":
            atexit.register(wait)
sys.meta_path.insert(0, Last())
"""
# Python hears no signals any more when it takes modules apart
TAKEN_APART = """
class Last:
    def __del__(self, write=__import__("os").write, sleep=time.sleep):
        write(2, b"now\\n")
        sleep(2)
sys.modules["last"] = type(sys)("last")
sys.modules["last"].last = Last()
"""
WRITING = """
from taichi_unifusion.files import atomic
atomic._flush_to_disk = lambda path: wait()
"""
# a viewer says that it is there, and waits
PAGE = """
from taichi_unifusion.viewer import web
def announce(self, open_browser):
    sys.stderr.write("now\\n")
    sys.stderr.flush()
web.WebViewer.announce = announce
"""
WINDOW = """
from taichi_unifusion.viewer import window
class Window:
    def __init__(self, title): pass
    def put(self, scene): pass
    def close(self): pass
    def serve(self, ask, stop):
        sys.stderr.write("now\\n")
        sys.stderr.flush()
        while not stop():
            time.sleep(0.05)
window.SceneWindow = Window
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    pipeline = Pipeline(CONFIG)
    out = tmp_path_factory.mktemp("results") / "made"
    write_results(out, pipeline, pipeline.run(make_frames(1)))
    return out


def signalled(
    moment: str, number: signal.Signals, *arguments: str, times: int = 1
) -> tuple[int, str]:
    """Exit code and stderr of a command that gets a signal at a moment, so many times."""
    process = subprocess.Popen(
        [sys.executable, "-c", START.format(moment), *arguments],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    watchdog = threading.Timer(PATIENCE, process.kill)
    watchdog.start()
    try:
        assert any(line == "now\n" for line in process.stderr)
        for _ in range(times):
            process.send_signal(number)
            time.sleep(0.02)
        said = process.stderr.read()
        return process.wait(), said
    finally:
        watchdog.cancel()
        process.kill()
        process.stderr.close()


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize(
    ("moment", "code"),
    [(IMPORTING, 130), (COMPILED, 130), (AT_THE_END, 0), (TAKEN_APART, 0)],
    ids=["imports", "compiled", "end", "taken apart"],
)
def test_c16_R3_R4_signals_at_the_edges_are_no_traceback(number, moment, code):
    ended, said = signalled(moment, number, "--version")
    assert ended == code and said == ("unifusion: error: stopped\n" if code else "")


@pytest.mark.parametrize("number", SIGNALS)
def test_c16_R3_R4_a_signal_waits_until_taichi_is_imported(number, tmp_path):
    out = str(tmp_path / "out")
    ended, said = signalled(TAICHI, number, "reconstruct", "synthetic", "--end", "1", "--out", out)
    assert ended == 130 and said == "unifusion: error: stopped\n"


@pytest.mark.parametrize("number", SIGNALS)
@pytest.mark.parametrize("times", [1, 2])  # `timeout` sends two
def test_a_signal_is_the_usual_end_of_a_page(number, times, made):
    pytest.importorskip("viser", reason="the page needs viser")
    words = ["view", str(made), "--port", str(some_port()), "--no-open"]
    ended, said = signalled(PAGE, number, *words, times=times)
    assert ended == 0 and said == "\nunifusion: closed\n"


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_is_the_usual_end_of_a_window(number, made):
    ended, said = signalled(WINDOW, number, "view", str(made), "--window")
    assert ended == 0 and said == "\nunifusion: closed\n"


def test_c16_R4_a_signal_while_mesh_writes_leaves_no_temporary_file(made, tmp_path):
    out = shutil.copytree(made, tmp_path / "out")
    before = sorted(path.name for path in out.iterdir())
    code, said = signalled(WRITING, signal.SIGTERM, "mesh", str(out), "--device", DEVICE)
    assert code == 130 and said.endswith("unifusion: error: stopped\n")
    assert sorted(path.name for path in out.iterdir()) == before  # no .tmp, no lock
    assert len(read_mesh(out / "mesh.ply").faces) > 0


def test_R4_a_process_that_ignores_sigterm_goes_on_doing_so():
    code = "import signal, subprocess, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
    code += "from taichi_unifusion.cli import start, main as cli\n"
    code += "cli.main = lambda: print(signal.getsignal(signal.SIGTERM) is signal.SIG_IGN) or 0\n"
    code += "start.main()"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert done.stdout == "True\n"
