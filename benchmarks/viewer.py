"""What the viewers cost: bytes a page is sent and seconds of the processor until it has them, by number
of triangles; the shared page; and what watching a run adds to its time.

    python benchmarks/viewer.py page --triangles 200000 1000000 5000000
    python benchmarks/viewer.py live 7scenes PATH --end 150 --every 3
"""

from __future__ import annotations

import argparse
import asyncio
import logging
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import viser

import taichi_unifusion as uf
from taichi_unifusion.datasets import FORMATS
from taichi_unifusion.results.tables import format_bytes, format_table
from taichi_unifusion.viewer.null import NullViewer
from taichi_unifusion.viewer.page import write_page
from taichi_unifusion.viewer.results_scene import layers_of
from taichi_unifusion.viewer.scene import Scene, SceneMesh
from taichi_unifusion.viewer.source import ResultsSource
from taichi_unifusion.viewer.web import WebViewer
from taichi_unifusion.viewer.web_live import WebLive
from taichi_unifusion.viewer.web_page import ResultsPage

QUIET = 1.0  # [s] without a message after which a page has everything
EXTENT = 5.0  # [m] of the surface that is shown
REPEATS = 3  # of a run, watched and not


def main() -> None:
    """Measure what is asked for, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    page = commands.add_parser("page", help="a surface of so many triangles")
    page.add_argument("--triangles", type=int, nargs="+", default=[200_000, 1_000_000, 5_000_000])
    page.set_defaults(run=measure_pages)
    live = commands.add_parser("live", help="a run, watched and not")
    live.add_argument("format", choices=FORMATS)
    live.add_argument("path", nargs="?")
    live.add_argument("--end", type=int)
    live.add_argument("--every", type=int, default=1)
    live.set_defaults(run=measure_live)
    options = parser.parse_args()
    logging.basicConfig(level=logging.WARNING)
    options.run(options)


def measure_pages(options: argparse.Namespace) -> None:
    """Show waves of so many triangles."""
    uf.init()
    rows = [["triangles", "shown", "ready s", "sent", "layer s", "click ms", "page file"]]
    for triangles in options.triangles:
        scene = waves(triangles)
        started = time.process_time()
        viewer = WebViewer()
        page = ResultsPage(viewer, scene, [ResultsSource(Path("."))])
        ready = time.process_time() - started
        sent = asyncio.run(receive(viewer.server.get_port()))
        switching = time.process_time()
        page.layers.show("height")
        switched = time.process_time() - switching
        clicks = [click(page) for _ in range(3)]
        viewer.close()
        with tempfile.TemporaryDirectory() as folder:
            write_page(scene, Path(folder) / "page.html")
            size = (Path(folder) / "page.html").stat().st_size
        rows.append(
            [
                f"{triangles:,}",
                f"{page.scene.triangles:,}",
                f"{ready:.1f}",
                format_bytes(sent),
                f"{switched:.2f}",
                f"{1e3 * min(clicks):.0f}",
                format_bytes(size),
            ]
        )
    print(format_table(rows))


def waves(triangles: int) -> Scene:
    """A coloured floor with waves, of about so many triangles."""
    steps = int(np.sqrt(triangles / 2))
    x, y = np.meshgrid(*[np.linspace(0, EXTENT, steps + 1, dtype=np.float32)] * 2, indexing="ij")
    z = 0.2 * np.sin(3 * x) * np.sin(2 * y) + 0.01 * np.sin(40 * x * y)
    points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    index = np.arange((steps + 1) ** 2, dtype=np.int32).reshape(steps + 1, steps + 1)
    a, b, c, d = (
        part.ravel() for part in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    mesh = uf.Mesh(points, faces).with_attribute("color", 0.5 + 0.5 * np.sin(5 * points))
    bare = Scene("waves", ())
    return Scene("waves", (SceneMesh("waves", mesh, layers_of(mesh, None, bare)),))


async def receive(port: int) -> int:
    """Bytes that a page gets when it opens."""
    import websockets

    count = 0
    protocol = websockets.Subprotocol(f"viser-v{viser.__version__}")
    async with websockets.connect(
        f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None
    ) as page:
        while True:
            try:
                message = await asyncio.wait_for(page.recv(), QUIET)
            except TimeoutError:
                return count
            count += len(message)


def click(page: ResultsPage) -> float:
    """Seconds of the processor that the answer to a click takes."""
    started = time.process_time()
    page.point.click(np.array([EXTENT / 2, EXTENT / 2, 5.0]), np.array([0.1, 0.1, -1.0]))
    assert page.point.last is not None
    return time.process_time() - started


@dataclass(frozen=True)
class Watched:
    """What a run took by the clock and of the processor, and how often the page was brought up to
    date.
    """

    seconds: float
    cpu_seconds: float
    updates: int


def measure_live(options: argparse.Namespace) -> None:
    """Run a recording with and without a page that watches, by turns."""
    recording = uf.open_dataset(options.format, options.path)
    frames = recording[: options.end : options.every]
    uf.warm_up()
    one_run(frames, watched=True)  # compiles what meshing needs
    pairs = [[one_run(frames, watched) for watched in (False, True)] for _ in range(REPEATS)]
    rows = [["run", "s", "CPU s", "updates"]]
    for name, runs in zip(("alone", "watched"), zip(*pairs, strict=True), strict=True):
        rows.append(
            [
                name,
                f"{min(run.seconds for run in runs):.2f}",
                f"{min(run.cpu_seconds for run in runs):.2f}",
                str(runs[0].updates),
            ]
        )
    print(format_table(rows))


def one_run(frames: Sequence[uf.Frame], watched: bool) -> Watched:
    pipeline = uf.Pipeline()
    viewer = WebViewer() if watched else None
    live = WebLive(viewer, len(frames), lambda: False) if viewer else NullViewer()
    started = time.perf_counter(), time.process_time()
    try:
        pipeline.run(frames, on_step=live.on_step, on_skip=live.on_skip)
        spent = time.perf_counter() - started[0], time.process_time() - started[1]
        return Watched(*spent, live.updates if isinstance(live, WebLive) else 0)
    finally:
        live.close()


if __name__ == "__main__":
    main()
