"""What becomes of an answer: distinct files, reasons that agree with their numbers, synonyms, regions
that are one, pictures with what they show.
"""

from __future__ import annotations

import json
import unicodedata

import cv2
import numpy as np
import pytest
from places import DEVICE

import taichi_unifusion as uf
from taichi_unifusion.errors import InputError
from taichi_unifusion.language.answers import answer_picture, file_name, why_not_here
from taichi_unifusion.language.embeddings import read_embeddings
from taichi_unifusion.language.pictures import (
    MARGIN,
    WIDEST_LEGEND,
    label_colors,
    segmentation_picture,
)
from taichi_unifusion.language.questions import Answer, Segmentation
from taichi_unifusion.language.regions import Region, find_regions
from taichi_unifusion.rendering.drawing import Viewpoint
from taichi_unifusion.rendering.preview import choose_views
from taichi_unifusion.types import Mesh, PinholeCamera

LONG = "a very long description of something that stands in a corner of the room behind"


@pytest.fixture(scope="module", autouse=True)
def runtime():
    uf.init(DEVICE)


def squares(*places: float, size: float = 1.0) -> Mesh:
    """Flat squares of 10 x 10 points each, at these x [m]."""
    u, v = (x.ravel() for x in np.meshgrid(np.linspace(0, size, 10), np.linspace(0, size, 10)))
    i = (np.arange(9)[:, None] * 10 + np.arange(9)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 11], 1), np.stack([i, i + 11, i + 10], 1)])
    vertices = np.concatenate([np.stack([u + x, v, 0 * u], 1) for x in places])
    numbers = np.concatenate([faces + 100 * k for k in range(len(places))])
    return Mesh(vertices.astype(np.float32), numbers.astype(np.int32))


def test_files_of_texts_that_look_alike_differ():
    texts = [
        f"{LONG} the sofa",
        f"{LONG} the door",
        "🪑",
        "🛋",
        "?!",
        "sofa",
        "sofa!",
        "so-fa",
        "so fa!",
    ]
    names = [file_name(text) for text in texts]
    assert len(set(names)) == len(texts) and all(len(name) < 80 for name in names)
    assert file_name("sofa") == "sofa" and file_name("Kitchen  table") == "kitchen-table"
    assert file_name(unicodedata.normalize("NFD", "Küche")) == file_name("küche") == "küche"
    assert not any(set('/\\:*?"<>|. ') & set(name) for name in names)


@pytest.fixture
def names_file(tmp_path):
    entries = [
        {"name": "sofa", "synonyms": ["sofa", "couch", "lounge"]},
        {"name": "pouch", "synonyms": ["pouch"]},
        {"name": "crutch"},
        {"name": unicodedata.normalize("NFD", "Küche"), "synonyms": ["kitchen"]},
        {"name": "chair"},
    ]
    np.save(tmp_path / "vectors.npy", np.eye(5, dtype=np.float32))
    (tmp_path / "vectors.json").write_text(json.dumps(entries))
    return read_embeddings(tmp_path / "vectors.npy")


def test_a_listing_holds_every_name_and_its_synonyms_once(names_file):
    kitchen = unicodedata.normalize("NFD", "Küche")
    assert names_file.listing() == [
        ("sofa", ("couch", "lounge")),
        ("pouch", ()),
        ("crutch", ()),
        (kitchen, ("kitchen",)),
        ("chair", ()),
    ]


@pytest.mark.parametrize(
    ("text", "row"),
    [("couch", 0), ("Lounge", 0), ("sofa", 0), ("pouch", 1), ("küche", 3), ("kitchen", 3)],
)
def test_synonyms_and_composed_letters_are_found(names_file, text, row):
    assert names_file.has(text) and names_file.text_features([text]).argmax() == row


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("televison", " (did you mean 'television set'?)"),
        ("telveision", " (did you mean 'television set'?)"),
        ("televizion", " (did you mean 'television set'?)"),
        ("comforler", ""),  # another letter makes another word of a shorter one
        ("televisiom", ""),  # a slip at the end makes too many other words
        ("comftorer", ""),  # two slips
        ("tabel", ""),
        ("cleaning", ""),
        ("television", " (names with that word: 'television set')"),
        ("table", " (names with that word: 'billiard table', 'coffee table', 'kitchen table')"),
    ],
)
def test_a_slip_in_one_word_of_several_is_guessed_where_that_word_is_long(tmp_path, text, told):
    names = ["television set", "kitchen table", "coffee table", "billiard table", "night table"]
    names += ["dining comforter", "cleaner's bag"]
    (tmp_path / "v.txt").write_text("\n".join(names))
    np.save(tmp_path / "v.npy", np.eye(len(names), dtype=np.float32))
    with pytest.raises(InputError) as raised:
        read_embeddings(tmp_path / "v.npy").text_features([text])
    said = str(raised.value)
    assert told in said and ("(" in said.split(";")[0]) == bool(told)


@pytest.mark.parametrize(
    ("text", "told"),
    [("chiar", " (did you mean 'chair'?)"), ("coach", ""), ("couches", ""), ("touch", "")],
)
def test_only_slips_of_the_fingers_are_guessed(names_file, text, told):
    with pytest.raises(InputError) as raised:
        names_file.text_features([text])
    said = str(raised.value)
    assert told in said and ("did you mean" in said) == bool(told)


def test_pieces_a_few_centimetres_apart_are_one_region():
    mesh = squares(0, 1.03, 2.3)
    (one, other) = find_regions(mesh, np.repeat([0.9, 0.8, 0.7], 100), join=0.05)
    np.testing.assert_allclose(one.box, [[0, 0, 0], [2.03, 1, 0]], atol=1e-5)
    assert one.area == pytest.approx(2, abs=1e-4) and one.score == pytest.approx(0.85)
    assert len(one.vertices) == 200 and other.box[0, 0] == pytest.approx(2.3)
    assert len(find_regions(mesh, np.repeat([0.9, 0.8, 0.7], 100), join=0)) == 3
    # pieces that are too small alone count together
    small = squares(0, 0.13, size=0.1)
    assert len(find_regions(small, np.full(200, 0.9), min_area=0.015, join=0.05)) == 1


def test_regions_are_ranked_by_the_strength_that_they_carry():
    """A large one before a small one that wins more clearly."""
    mesh = squares(0, 2, 4)
    mesh.vertices[100:200, :2] *= np.float32([1, 0.1])  # a tenth of the area
    large, small, weak = find_regions(mesh, np.repeat([0.7, 0.95, 0.51], 100))
    assert [round(each.score, 2) for each in (large, small, weak)] == [0.7, 0.95, 0.51]
    strengths = [large.strength, small.strength, weak.strength]
    assert strengths == pytest.approx([0.2, 0.045, 0.01], abs=1e-4)


def test_a_region_goes_on_where_the_query_merely_wins():
    mesh = squares(0, 3)
    column = np.tile(np.arange(10), 20)  # of each square's grid, 0..9 along x
    extent = np.full(200, 0.8)
    certain = np.where(column < 5, 0.9, 0.2)
    certain[100:] = 0.2  # nothing of the second square is certain
    (region,) = find_regions(mesh, certain, extent=extent)
    np.testing.assert_allclose(region.box, [[0, 0, 0], [1, 1, 0]], atol=1e-5)
    assert region.area == pytest.approx(1, abs=1e-4) and len(region.vertices) == 100
    assert region.score == pytest.approx(0.9)  # of what is certain
    # as large as min_area, or three tenths of the region, must be certain
    few = np.where(column < 1, 0.9, 0.2)
    assert len(find_regions(mesh, few, extent=extent, min_area=0.01)) == 2
    assert find_regions(mesh, few, extent=extent, min_area=0.5) == []
    assert [region.area for region in find_regions(mesh, few)] == pytest.approx([1 / 18] * 2)


@pytest.mark.parametrize(("share", "regions"), [(1.0, 2), (0.15, 1)])
def test_what_faces_each_other_is_two_things_unless_one_is_a_small_piece(share, regions):
    near, far = squares(0), squares(0, size=np.sqrt(share))
    turned = far.vertices + np.float32([0, 0, 0.04])
    mesh = Mesh(
        np.concatenate([near.vertices, turned]),
        np.concatenate([near.faces, far.faces[:, ::-1] + 100]),
    )
    assert len(find_regions(mesh, np.full(200, 0.9))) == regions


def test_surface_of_something_else_keeps_pieces_apart():
    size = 0.09  # a step of 1 cm
    mesh = squares(0, size=size)
    column = np.tile(np.arange(10), 10)
    score = np.where((column > 3) & (column < 7), 0.1, 0.9)  # 4 cm from the left to the right piece
    assert len(find_regions(mesh, score, min_area=0.001)) == 2
    gone = (column > 3) & (column < 7)
    hole = Mesh(mesh.vertices, mesh.faces[~gone[mesh.faces].any(axis=1)])
    spots = np.where(gone[:, None], np.float32(9), hole.vertices)  # a hole has no vertices either
    assert len(find_regions(Mesh(spots, hole.faces), score, min_area=0.001)) == 1


def test_the_reason_agrees_with_its_numbers():
    mesh = squares(0)
    low, high = (
        Answer("x", np.full(100, level, np.float32), np.zeros(100), ()) for level in (0.3, 0.7)
    )
    assert "0.30 at most" in why_not_here(low, mesh, 0.5, 0.01)
    reason = why_not_here(high, mesh, 0.5, 2.0)
    assert (
        "0.70" in reason and "1.0000 m2" in reason and "2 m2" in reason and "nearer" not in reason
    )


def test_a_picture_shows_title_scale_and_a_box_a_region():
    mesh = squares(0, 2).with_attribute("color", np.full((200, 3), 0.5))
    regions = find_regions(mesh, np.repeat([0.9, 0.8], 100))
    views = choose_views(mesh, up=np.array([0.0, 0.0, 1.0]), size=(320, 240))
    plain = answer_picture(mesh, "sofa", (), views)
    boxed = answer_picture(mesh, "sofa", regions, views)
    assert plain.shape == boxed.shape and plain.shape[0] > 240
    header = plain[: plain.shape[0] - 240]
    assert (header[:34] < 100).any() and (header[38:50] != 255).any()
    assert (plain[-240:] != boxed[-240:]).any(axis=2).sum() > 100
    assert (answer_picture(mesh, "küche 🪑", (), views)[:34] < 100).any()


@pytest.fixture
def written(monkeypatch):
    """Every text that is drawn, and where it begins."""
    texts, draw = [], cv2.putText

    def put(picture, text, at, *rest):
        texts.append((text, at))
        return draw(picture, text, at, *rest)

    monkeypatch.setattr(cv2, "putText", put)
    return texts


def looking_down(height: float, size=(320, 240)) -> Viewpoint:
    """From above (0.5, 0.5), with y down in the picture."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = 0.5, 0.5, height
    camera = PinholeCamera(*size, 200.0, 200.0, (size[0] - 1) / 2, (size[1] - 1) / 2)
    return Viewpoint(camera, T, 0.05)


def box(low, high, strength=1.0) -> Region:
    """A region of that box."""
    corners = np.array([low, high], float)
    return Region(0.9, strength, 1.0, corners.mean(axis=0), corners, np.arange(3))


def test_every_box_that_is_seen_has_its_number_in_the_picture(written):
    mesh = squares(0).with_attribute("color", np.full((100, 3), 0.5))
    regions = [
        box((0.4, 0.4, 0), (0.6, 0.6, 0)),
        box((0.4, 0.4, 0), (0.6, 9, 0)),  # its far end lies outside
        box((0.4, 0.4, 0), (0.6, 0.6, 5)),  # and of this one behind the camera
        *[box((0.4, -0.02, 0), (0.6, 0, 0))] * 5,  # all at the lower edge
    ]
    answer_picture(mesh, "sofa", [*regions, box((7, 7, 0), (8, 8, 0))], [looking_down(1.0)])
    numbers = {text: at for text, at in written if text.isdigit()}
    assert sorted(numbers) == [str(n) for n in range(1, len(regions) + 1)]  # not what is not seen
    places = np.array(list(numbers.values()))
    assert (places >= 0).all() and (places < (320, 240)).all()
    apart = np.abs(places[:, None] - places).max(axis=2)
    assert apart[~np.eye(len(places), dtype=bool)].min() > 12  # none covers another


LONG_NAMES = ("monitor (computer equipment) computer monitor", "sofa", "椅子", "name " * 60)


def test_a_legend_is_as_wide_as_its_names_and_says_what_it_leaves_out(written):
    mesh = squares(0).with_attribute("color", np.full((100, 3), 0.5))
    view = looking_down(2.0)
    found = Segmentation(LONG_NAMES, np.arange(100) % 4, np.ones(100))
    picture = segmentation_picture(mesh, found, label_colors(4), [view])
    texts = {text for text, _ in written}
    assert {LONG_NAMES[0], "sofa", "name 3"} <= texts
    cut = next(text for text in texts if text.startswith("name name"))
    assert cut.endswith("...") and picture.shape[1] <= 320 + WIDEST_LEGEND
    assert (picture[:, -MARGIN:] == 255).all()  # nothing is cut off at the edge
    written.clear()
    many = Segmentation(tuple(f"thing {i}" for i in range(50)), np.arange(100) % 50, np.ones(100))
    segmentation_picture(mesh, many, label_colors(50), [view])
    assert written[-1][0] == f"and {51 - len(written)} more"
