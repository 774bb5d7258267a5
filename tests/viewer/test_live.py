"""Watching a run: nothing changes by it, the chunks together are the mesh, and the page ends with the
results.
"""

from __future__ import annotations

import json
import struct
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from map_kinds import content
from meshes import box
from tiny_recording import CONFIG, make_frames

from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli.viewing import WatchOptions, open_watcher
from taichi_unifusion.pipeline import Pipeline
from taichi_unifusion.viewer import live
from taichi_unifusion.viewer.live import ChangedChunks, Pace
from taichi_unifusion.viewer.null import NullViewer

EXACT = 1e-6  # [m] of the same float32 vertices


@pytest.fixture(scope="module")
def frames():
    return make_frames(12)


def corners_of(mesh) -> np.ndarray:
    """Triangles (F, 9) in an order of their own."""
    corners = mesh.vertices[mesh.faces].reshape(-1, 9)
    return corners[np.lexsort(corners.T)]


class Keeping:
    """A watcher that keeps the chunks that it is given."""

    def __init__(self, count: int) -> None:
        self.chunks, self.feed, self.count = {}, ChangedChunks(), count

    def on_step(self, frame, step, pipeline) -> None:
        taken = self.feed.take(pipeline, frame, self.count)
        assert len(taken) <= self.count
        self.chunks.update(taken)


@pytest.mark.parametrize("window", [1, 4])
def test_looking_at_a_run_does_not_change_its_maps(frames, window):
    config = replace(CONFIG, window=window)
    alone, watched, watcher = Pipeline(config), Pipeline(config), Keeping(5)
    alone.run(frames)
    watched.run(frames, on_step=watcher.on_step)
    assert watcher.chunks
    for name in alone.maps:
        assert content(alone.maps[name]) == content(watched.maps[name])


def test_all_chunks_together_are_the_mesh_of_what_is_fused(frames):
    pipeline, watcher = Pipeline(replace(CONFIG, window=4)), Keeping(7)
    pipeline.run(frames[:8], on_step=watcher.on_step)
    last = frames[7]
    while taken := watcher.feed.take(pipeline, last, 50):
        watcher.chunks.update(taken)
    # a voxel that changed little is not meshed again: what is shown may lag behind by that
    assert len(watcher.chunks) > 3
    fresh, whole = ChangedChunks(), pipeline.extract_mesh(live.RESOLUTION, flush=False)
    chunks = fresh.take(pipeline, last, 10_000)
    assert not fresh.waiting and set(chunks) >= {
        k for k, v in watcher.chunks.items() if len(v.faces)
    }
    together = np.concatenate(
        [mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in chunks.values()]
    )
    together = together[np.lexsort(together.T)]
    unculled = pipeline.surface.extract_mesh(live.RESOLUTION, flush=False)
    assert len(whole.faces) <= len(unculled.faces) == len(together)
    assert np.abs(together - corners_of(unculled)).max() < EXACT


def test_the_nearest_chunks_come_first(frames):
    pipeline = Pipeline(CONFIG)
    pipeline.step(frames[0])
    pipeline.flush()
    feed = ChangedChunks()
    first = feed.take(pipeline, frames[0], 3)
    rest = feed.take(pipeline, frames[0], 1000)
    edge = live.MESH_BLOCK * pipeline.surface.voxel_size
    eye = frames[0].T_world_camera[:3, 3]

    def distance(block) -> float:
        return float(np.linalg.norm((np.array(block) + 0.5) * edge - eye))

    assert max(map(distance, first)) <= min(map(distance, rest)) and not feed.waiting


def test_what_was_never_shown_comes_before_what_has_changed(frames):
    pipeline = Pipeline(replace(CONFIG, window=1))
    pipeline.step(frames[0])
    feed = ChangedChunks()
    first = feed.take(pipeline, frames[0], 5)
    for frame in frames[1:4]:
        pipeline.step(frame)
    changed = set(first) & set(feed.take(pipeline, frames[3], len(feed.waiting)))
    assert changed == set()
    assert set(first) & set(feed.take(pipeline, frames[3], 1000))


def test_watching_keeps_to_its_share_of_the_time(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(time, "perf_counter", lambda: now[0])
    pace, spent = Pace(due=0.0), 0.0
    for _ in range(3000):
        now[0] += 0.05  # a frame
        if pace.ready():
            took = 0.02 * pace.blocks()
            now[0] += took
            spent += took
            pace.took(took, pace.blocks())
    assert 0.25 * live.SHARE <= spent / now[0] <= 1.02 * live.SHARE


def test_who_does_not_ask_for_a_view_gets_none():
    assert isinstance(open_watcher(WatchOptions(), "run", 3, lambda: False), NullViewer)
    run = NullViewer()
    assert run.on_step(None, None, None) is run.finish(None) is run.close() is None


# ---- on a page ----


@pytest.fixture
def live_page(monkeypatch, frames):
    pytest.importorskip("viser")
    from ports import some_port

    from taichi_unifusion.viewer.web import WebViewer
    from taichi_unifusion.viewer.web_live import WebLive

    monkeypatch.setattr(live, "INTERVAL", 0.0)
    monkeypatch.setattr(live, "SHARE", 1.0)
    viewer = WebViewer(port=some_port())
    yield WebLive(viewer, len(frames), lambda: False)
    viewer.close()


def test_the_page_of_a_run_shows_mesh_camera_stages_and_what_was_skipped(live_page, frames):
    bad = replace(frames[2], T_world_camera=None)
    pipeline = Pipeline(replace(CONFIG, window=2))
    sequence = [*frames[:2], bad, *frames[3:]]
    pipeline.run(sequence, on_step=live_page.on_step, on_skip=live_page.on_skip)
    said = live_page.said.content
    assert "there is no pose for this frame" in said and "surface" in said and "ms" in said
    assert live_page.nodes and live_page.camera.image is not None
    assert np.allclose(live_page.camera.position, live_page.path[-1])


def test_a_map_without_colour_is_drawn_with_its_shape():
    pytest.importorskip("viser")
    from taichi_unifusion.viewer.web_live import chunk_glb

    data = chunk_glb(box((0.0,) * 3, (1.0,) * 3))
    header = json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])
    color = header["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]
    assert header["accessors"][color]["max"][0] > 1.3 * header["accessors"][color]["min"][0]


def test_a_run_that_is_paused_goes_on_when_told(live_page, frames):
    pipeline = Pipeline(CONFIG)
    live_page.viewer.request(live_page.pause)
    threading.Timer(0.7, lambda: live_page.viewer.request(live_page.pause)).start()
    started = time.perf_counter()
    pipeline.run(frames[:1], on_step=live_page.on_step)
    assert time.perf_counter() - started > 0.6 and not live_page.paused
    live_page.paused, live_page.stop = True, lambda: True  # a run that is stopped does not wait
    pipeline.run(frames[1:2], on_step=live_page.on_step)


def test_a_run_that_is_paused_meshes_what_waits(live_page, frames, monkeypatch):
    from taichi_unifusion.viewer import live

    monkeypatch.setattr(live, "LEAST_BLOCKS", 1)
    asked = iter([False] * 200)
    live_page.stop = lambda: not live_page.chunks.waiting or next(asked, True)
    live_page.paused = True
    pipeline = Pipeline(replace(CONFIG, window=2))
    pipeline.run(frames[:4], on_step=live_page.on_step)
    assert live_page.updates > 4 and not live_page.chunks.waiting
    assert "0 blocks" in live_page.said.content


def test_the_page_ends_with_the_results(live_page, results, frames, monkeypatch):
    pipeline = Pipeline(CONFIG)
    pipeline.run(frames[:2], on_step=live_page.on_step)
    served = []
    monkeypatch.setattr(live_page.viewer, "serve", lambda stop: served.append("until Ctrl-C"))
    live_page.finish(results.path)
    assert served and live_page.nodes == {}
    scene = live_page.viewer.server.scene
    assert scene.get_handle_by_name("/live/camera") is None


def test_the_command_shows_what_it_makes(results, tmp_path, monkeypatch):
    viser = pytest.importorskip("viser")
    from ports import some_port

    from taichi_unifusion.viewer.web import WebViewer

    seen = {}

    def serve(viewer: WebViewer, stop=None) -> None:
        seen["clients"] = viewer.server.get_clients()
        seen["nodes"] = list(viewer.server.scene._handle_from_node_name)

    monkeypatch.setattr(WebViewer, "serve", serve)
    words = ["reconstruct", "folder", str(results.recording), "--surface.voxel-size", "0.1"]
    words += ["--surface.support-points", "1", "--color.voxel-size", "0.05", "--view"]
    words += ["--view.port", str(some_port()), "--out", str(tmp_path / "out")]
    assert cli.main(words) == 0
    assert viser and any(name.startswith("/mesh0/") for name in seen["nodes"])
    assert not any(name.startswith("/live") for name in seen["nodes"])
