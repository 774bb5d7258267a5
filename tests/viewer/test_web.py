"""The page in the browser, as far as no browser is needed: the server, and what its controls do."""

from __future__ import annotations

import http.client
import logging
import shutil
import time
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from colored_results import NAMES
from meshes import rectangle
from ports import some_port

from taichi_unifusion.cli import main as cli
from taichi_unifusion.errors import InputError
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.files.meshes import write_mesh
from taichi_unifusion.language.embeddings import read_embeddings
from taichi_unifusion.viewer.parts import upright
from taichi_unifusion.viewer.picking import Picker
from taichi_unifusion.viewer.scene import Layer, Legend, Scene, SceneMesh
from taichi_unifusion.viewer.several import beside
from taichi_unifusion.viewer.source import ResultsSource
from taichi_unifusion.viewer.web_text import describe_hit, legend_html, paragraph

pytest.importorskip("viser", reason="the page needs viser: pip install 'taichi-unifusion[viewer]'")

from taichi_unifusion.viewer.web import WebViewer, has_screen
from taichi_unifusion.viewer.web_nodes import BANDS, KEPT_LAYERS
from taichi_unifusion.viewer.web_page import ResultsPage

SCENE_FILE = "mesh.ply"
EXACT = 1e-5  # [m] of float32 coordinates of a room


@pytest.fixture
def viewer():
    made = WebViewer(port=some_port())
    yield made
    made.close()


def source_of(results) -> ResultsSource:
    return ResultsSource(results.path, make_encoder=lambda *_: read_embeddings(results.embeddings))


@pytest.fixture
def page(viewer, results) -> ResultsPage:
    source = source_of(results)
    return ResultsPage(viewer, source.open(), [source])


def shown_layers(page: ResultsPage) -> list[str]:
    return [name for name, nodes in page.stage.nodes[0].layers.items() if nodes.visible]


def ray_of(page: ResultsPage, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Where camera `number` looks."""
    T = page.scene.cameras[number].T_world_camera
    return T[:3, 3], T[:3, 2]


# ---- the server ----


def test_only_this_machine_is_answered_and_a_port_that_is_taken_gives_the_next(viewer, caplog):
    assert viewer.address == f"http://127.0.0.1:{viewer.server.get_port()}"
    assert viewer.server.get_host() == "127.0.0.1"
    other = WebViewer(port=viewer.server.get_port())
    try:
        with caplog.at_level(logging.INFO):
            other.announce(open_browser=False)
        assert other.server.get_port() != viewer.server.get_port()
        assert f"port {viewer.server.get_port()} is taken" in caplog.text
    finally:
        other.close()


def test_V1_another_host_is_warned_of(caplog):
    viewer = WebViewer(host="0.0.0.0", port=some_port())
    try:
        with caplog.at_level(logging.WARNING):
            viewer.announce(open_browser=False)
        assert "whoever reaches this machine" in caplog.text
    finally:
        viewer.close()


def test_an_address_that_cannot_be_is_said():
    with pytest.raises(InputError, match=r"203\.0\.113\.1"):
        WebViewer(host="203.0.113.1", port=some_port())


def test_no_public_tunnel_can_be_asked_for(viewer):
    assert viewer.server.request_share_url() is None


@pytest.mark.parametrize(
    "path",
    ["/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "//etc/passwd", "/..\\setup.py"],
)
def test_a_path_in_the_address_opens_nothing(viewer, path):
    connection = http.client.HTTPConnection("127.0.0.1", viewer.server.get_port(), timeout=10)
    connection.request("GET", path)
    answer = connection.getresponse()
    assert answer.status == 404 and b"root:" not in answer.read()
    connection.close()


def test_a_browser_is_opened_only_where_somebody_sees_it(monkeypatch):
    for name in ("SSH_CONNECTION", "CI", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    assert has_screen()
    monkeypatch.setenv("SSH_CONNECTION", "somewhere")
    assert not has_screen()


def test_a_fault_behind_a_button_ends_neither_the_page_nor_others_wishes(viewer, caplog):
    done = []
    viewer.request(lambda: [][0])
    viewer.request(lambda: done.append("next"))
    assert viewer.poll() == 2 and done == ["next"]
    assert "IndexError" in caplog.text


# ---- layers ----


def test_one_layer_shows_at_a_time_and_few_are_kept(page):
    assert shown_layers(page) == ["color"]
    for name in page.scene.layer_names:
        page.layers.show(name)
        assert shown_layers(page) == [name]
    assert len(page.stage.nodes[0].layers) == KEPT_LAYERS
    page.layers.show("saliency")
    assert "saliency" in page.layers.legend.content


def test_a_cut_hides_what_is_higher_from_eyes_and_clicks(page):
    nodes = page.stage.nodes[0]
    low, high = page.scene.heights()
    middle = (low + high) / 2
    page.stage.cut_above(middle)
    assert page.stage.bands in (BANDS // 2, BANDS // 2 + 1)
    heights = page.scene.heights_of(nodes.shown.mesh.vertices)[nodes.shown.mesh.faces]
    assert heights[nodes.kept].mean(axis=1).max() <= middle + (high - low) / BANDS
    bands = nodes.layers["color"].bands
    assert all(node.visible == (band < page.stage.bands) for band, node in bands.items())
    page.layers.show("height")  # a layer made later is cut too
    bands = nodes.layers["height"].bands
    assert all(node.visible == (band < page.stage.bands) for band, node in bands.items())
    page.stage.cut_above(high + 1)
    assert nodes.kept.all() and all(node.visible for node in bands.values())


def test_the_mesh_is_extracted_again_finer_or_coarser(page):
    before = len(page.scene.meshes[0].mesh.faces)
    page.layers.resolution.value = 2
    page.layers._extract(None)
    assert page.layers.progress.value == 100 and not page.layers.progress.visible
    after = page.scene.meshes[0]
    assert 0.1 * before < len(after.mesh.faces) < 0.5 * before
    assert {"color", "saliency", "weight", "height"} <= set(page.scene.layer_names)
    assert (
        shown_layers(page) == ["color"]
        and f"{len(after.mesh.faces):,}" in page.layers.notes.content
    )


def test_cameras_come_with_what_they_saw_and_go(page):
    page.layers.cameras.shown.value = True
    page.layers.cameras.show()
    assert len(page.stage.cameras) == 3
    assert all(camera.image is not None for camera in page.scene.cameras)
    page.layers.cameras.shown.value = False
    page.layers.cameras.show()
    assert page.stage.cameras == []


def test_who_looks_from_a_camera_sees_the_map_its_outline_and_the_picture_beside(page):
    cameras, drawn = page.layers.cameras, page.stage.cameras
    cameras.shown.value = True
    while not page.viewer.poll():  # the box asks for them
        time.sleep(0.01)
    client = SimpleNamespace(camera=SimpleNamespace(), client_id=5, atomic=nullcontext)
    cameras.look_from(client, 1)
    assert [each.visible for each in drawn] == [False, True, False] and drawn[1].image is None
    assert np.array_equal(cameras.image.image, page.scene.cameras[1].image)
    assert cameras.image.visible and "frame 1" in cameras.name.content
    away = client.camera.position + page.stage.size
    for position, left in ((away, False), (client.camera.position, False), (away, True)):
        client.camera.position = position
        cameras._moved(client)
        page.viewer.poll()
        assert all(each.visible for each in drawn) is left
    assert all(each.image is not None for each in drawn) and not cameras.image.visible
    cameras.look_from(client, 2)
    cameras.shown.value = False
    cameras.show()
    assert page.stage.cameras == [] and not cameras.image.visible


# ---- questions ----


def test_a_question_is_answered_by_heat_boxes_labels_and_a_list(page):
    page.ask.text.value = "red"
    page.ask.ask()
    assert shown_layers(page) == ["query: red"] and page.layers.layer.value == "query: red"
    assert "place" in page.ask.said.content and page.ask.folder.visible
    assert len(page.ask.rows) >= 1 and "score" in page.ask.rows[0].label
    assert len(page.stage.marked["answer"]) == 1 + len(page.ask.rows)  # lines, and a label each
    red = page.scene.meshes[0].layer("query: red").values[:, 0]
    color = page.scene.meshes[0].layer("color").colors.astype(float)
    assert color[red > 0.5][:, 0].mean() > color[red > 0.5][:, 1:].mean()
    assert (
        len(page.results.shared_scene.boxes)
        == len(page.results.shared_scene.labels)
        == len(page.ask.rows)
    )
    page.ask.text.value = ""
    page.ask.ask()
    assert page.stage.marked["answer"] == [] and page.ask.rows == []
    assert page.results.shared_scene.boxes == ()


@pytest.mark.parametrize("text", ["/etc/passwd", "<b>purple</b>"])
def test_a_text_without_a_vector_is_said_and_opens_nothing(page, text):
    page.ask.text.value = text
    page.ask.ask()
    assert "has no vector" in page.ask.said.content
    assert "<b>" not in page.ask.said.content and shown_layers(page) == ["color"]


def test_what_is_not_here_is_said(viewer, results, tmp_path):
    vectors = np.vstack([np.eye(3), -np.ones(3)])
    np.savez(tmp_path / "names.npz", names=(*NAMES, "nothing"), vectors=vectors)
    embeddings = read_embeddings(tmp_path / "names.npz")
    source = ResultsSource(results.path, make_encoder=lambda *_: embeddings)
    page = ResultsPage(viewer, source.open(), [source])
    page.ask.text.value = "nothing"
    page.ask.ask()
    assert "nothing: not here" in page.ask.said.content and page.ask.rows == []


def test_results_without_features_have_no_text_box(viewer, results):
    page = ResultsPage(viewer, ResultsSource(results.path).open(), [ResultsSource(results.path)])
    assert page.ask is None


# ---- points and parts ----


def test_a_click_says_what_is_there_and_two_clicks_how_far_apart(page):
    page.point.click(*ray_of(page, 0))
    said = page.point.said.content
    for word in ("position", "height", "normal", "color", "saliency", "weight", "words", *NAMES):
        assert word in said
    first = page.point.last.point
    page.point.click(*ray_of(page, 2))
    distance = np.linalg.norm(page.point.last.point - first)
    assert f"{distance:.3f} m" in page.point.said.content
    page.point.clear()
    assert page.point.last is None and page.stage.marked["measured"] == []


def test_a_zero_has_no_sign():
    mesh = rectangle((-1, -1), (1, 1), -1e-5)
    scene = Scene(
        "floor", (SceneMesh("floor", mesh, (Layer("color", np.zeros((4, 3), np.uint8)),)),)
    )
    hit = Picker(scene.meshes[0]).pick(np.array([-1e-5, 0.1, 1]), np.array([0.0, 0, -1]))
    said = dict(describe_hit(scene, hit, []))
    assert said["position"] == "0.000, 0.100, 0.000 m" and said["height"] == "0.000 m"
    assert said["normal"] == "0.00, 0.00, 1.00"


def test_a_part_is_written_beside_the_results_and_replaces_nothing(viewer, results, tmp_path):
    whole = read_mesh(results.path / SCENE_FILE)
    write_mesh(tmp_path / "room.ply", whole)
    source = ResultsSource(tmp_path / "room.ply")
    page = ResultsPage(viewer, source.open(), [source])
    middle = upright(whole.vertices, page.scene.T_up_world).mean(axis=0)
    page.part.low.value, page.part.high.value = tuple(middle - 5), tuple(middle + (5, 5, 0))
    page.part.measure()
    assert "m² of surface" in page.part.said.content
    page.part.write()
    page.part.write()
    one, two = (read_mesh(tmp_path / f"part-{number}.ply") for number in (1, 2))
    assert np.array_equal(one.vertices, two.vertices)
    assert 0 < len(one.faces) < len(whole.faces)
    assert page.scene.heights_of(one.vertices).max() <= middle[2] + EXACT
    assert str(tmp_path / "part-2.ply") in page.part.said.content


def test_a_page_to_share_is_written_beside_the_results(viewer, results, tmp_path):
    write_mesh(tmp_path / "room.ply", read_mesh(results.path / SCENE_FILE))
    source = ResultsSource(tmp_path / "room.ply")
    page = ResultsPage(viewer, source.open(), [source])
    page.keep.write_page(None)
    assert (tmp_path / "page.html").stat().st_size > 10_000
    assert str(tmp_path / "page.html") in page.keep.said.content


def test_a_new_page_shows_what_was_chosen_without_old_messages(page):
    page.layers.show("height")
    page.point.click(*ray_of(page, 0))
    clicked = page.point.said.content
    page.part.measure()
    measured = page.part.said.content
    page.part.said.content = page.keep.said.content = page.ask.said.content = "page.html: old"
    page.greet()
    assert page.keep.said.content == page.ask.said.content == ""
    assert (page.part.said.content, page.point.said.content) == (measured, clicked)
    assert page.layers.layer.value == "height"
    page.point.clear()
    page.point.click(np.zeros(3) + 100, np.array([0.0, 0, 1]))
    page.greet()
    assert "Click on the surface" in page.point.said.content


def test_results_that_are_gone_get_nothing_written_elsewhere(viewer, results, tmp_path, caplog):
    gone = shutil.copytree(results.path, tmp_path / "gone")
    source = ResultsSource(gone)
    page = ResultsPage(viewer, source.open(), [source])
    shutil.rmtree(gone)
    viewer.request(lambda: page.keep.write_page(None))
    viewer.request(page.part.write)
    viewer.request(lambda: page.layers._extract(None))
    page.point.click(*ray_of(page, 0))
    viewer.poll()
    assert caplog.text.count(f"{gone}: is gone") == 3
    assert list(tmp_path.iterdir()) == [] and "position" in page.point.said.content
    assert not page.layers.progress.visible


# ---- several results ----


def test_results_side_by_side_share_layers_and_can_be_hidden(viewer, results):
    sources = [source_of(results), ResultsSource(results.path)]
    scene = beside([source.open() for source in sources])
    page = ResultsPage(viewer, scene, sources)
    page.layers.show("saliency")
    assert [nodes.current for nodes in page.stage.nodes] == ["saliency"] * 2
    origin, direction = ray_of(page, 0)
    by = page.scene.meshes[1].T_scene_map[:3, 3]
    assert page.stage.pick(origin, direction)[0] == 0
    assert page.stage.pick(origin + by, direction)[0] == 1
    page.stage.set_visible(1, False)
    assert page.stage.pick(origin + by, direction) is None
    page.ask.text.value = "green"
    page.ask.ask()
    assert [nodes.current for nodes in page.stage.nodes] == ["query: green", "color"]


def test_a_mesh_that_is_extracted_again_keeps_one_scale_with_its_neighbours(viewer, results):
    sources = [source_of(results), ResultsSource(results.path / SCENE_FILE)]
    page = ResultsPage(viewer, beside([source.open() for source in sources]), sources)
    page.layers.show("height")
    page.layers.resolution.value = 1
    page.layers._extract(None)
    one, two = (mesh.layer("height").legend for mesh in page.scene.meshes)
    assert (one.low, one.high, one.label) == (two.low, two.high, two.label)
    for nodes, mesh in zip(page.stage.nodes, page.scene.meshes, strict=True):
        assert nodes.layers["height"].layer is mesh.layer("height")


def test_words_of_files_are_escaped():
    legend = Legend("<i>label</i>", np.zeros((1, 3), np.uint8), names=("<script>",))
    assert "<i>" not in legend_html(legend) and "<script>" not in legend_html(legend)
    assert "<" not in paragraph("<").replace("<div", "").replace("</div", "")


# ---- the command ----


@pytest.fixture
def not_serving(monkeypatch) -> list[list[str]]:
    """Nodes of the pages that commands left when they began to wait."""
    left: list[list[str]] = []

    def serve(viewer: WebViewer, stop=None) -> None:
        left.append(list(viewer.server.scene._handle_from_node_name))

    monkeypatch.setattr(WebViewer, "serve", serve)
    return left


def test_the_command_says_where_the_page_is_and_shows_results_side_by_side(
    results, not_serving, capsys
):
    port = some_port()
    words = ["view", str(results.path), str(results.path / SCENE_FILE), "--port", str(port)]
    assert cli.main([*words, "--no-open"]) == 0
    said = capsys.readouterr().err
    assert f"http://127.0.0.1:{port}" in said
    assert "to ask, give the text encoder that belongs to them, with --text" in said
    assert {"/mesh0", "/mesh1"} <= {
        f"/{name.split('/')[1]}" for name in not_serving[0] if "/" in name
    }


def test_the_command_asks_what_it_is_told_to(results, not_serving):
    words = ["view", str(results.path), "--port", str(some_port()), "--no-open"]
    assert cli.main([*words, "--text", results.text, "--query", "red", "--query", "green"]) == 0
    layers = {
        bytes.fromhex(name.split("/")[2]).decode() for name in not_serving[0] if "/mesh0/" in name
    }
    assert {"query: red", "query: green"} <= layers


@pytest.mark.parametrize(
    "words, told",
    [
        ([], "say what to show"),
        (["{results}", "--query", "red"], "there are no features to ask, or no text encoder"),
        (["{tmp}/none"], "none: no such file or folder"),
        (["{tmp}"], "mesh.ply: no such file; give a results folder"),
        (["{results}", "--port", "99999"], "port: must lie in 1..65535"),
        (["{results}", "--compare", "{tmp}/other.ply"], "other.ply: no such file"),
    ],
)
def test_what_cannot_be_shown_is_said_in_a_sentence(words, told, results, tmp_path, capsys):
    words = [word.format(tmp=tmp_path, results=results.path) for word in words]
    assert cli.main(["view", *words, "--no-open"]) == 2
    said = capsys.readouterr().err
    assert told in said and "Traceback" not in said
