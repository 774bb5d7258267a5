"""Texts and features from files: tokens, embeddings, stored features; relevance, regions and labels
on meshes.
"""

from __future__ import annotations

import gzip
import pickle
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from taichi_unifusion import Frame, Mesh, PinholeCamera
from taichi_unifusion.errors import FileError, FrameError, InputError
from taichi_unifusion.geometry.triangles import vertex_areas
from taichi_unifusion.language import (
    feature_image,
    folder,
    make_image_encoder,
    make_text_encoder,
    unit_length,
)
from taichi_unifusion.language.embeddings import TextEmbeddings, read_embeddings
from taichi_unifusion.language.prompts import competitors, embed, relevance
from taichi_unifusion.language.regions import find_regions
from taichi_unifusion.networks.tokenizer import ClipTokenizer

HALF = 1e-3  # half precision of stored features
EXACT = 1e-6
FRAME = Frame(
    np.ones((6, 8), np.float32),
    PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5),
    index=17,
    name="rgb/frame-000017.color.png",
)


def embeddings(**vectors) -> TextEmbeddings:
    return TextEmbeddings(
        "test", tuple(vectors), unit_length(np.array(list(vectors.values()), np.float32))
    )


# ---- Tokens ----


def test_tokens_join_the_pairs_that_were_learned_first(tmp_path):
    merges = tmp_path / "merges.txt"
    merges.write_text("#version: 0.2\nl o\nlo w</w>\ne r</w>\n")
    tokenizer = ClipTokenizer(merges)
    byte = {letter: tokenizer.numbers[letter] for letter in "lower"}
    lo, low, er = (512, 513, 514)  # after every byte, alone and at a word's end
    assert tokenizer(["low  LOWER"], 8).tolist() == [[515, low, lo, byte["w"], er, 516, 0, 0]]
    assert tokenizer.numbers["w</w>"] == byte["w"] + 256


def test_tokens_of_the_real_merges(data):
    tokenizer = ClipTokenizer(data("clip-tokenizer") / "bpe_simple_vocab_16e6.txt.gz")
    # as CLIP has them
    assert tokenizer(["a photo of a cat"], 9).tolist() == [
        [49406, 320, 1125, 539, 320, 2368, 49407, 0, 0]
    ]
    with pytest.raises(InputError, match="77"):
        tokenizer(["cat " * 80])


@pytest.mark.parametrize(
    "content", [b"\x1f\x8bbroken", b"\xff\xfe\x00", b"#version\nnot a pair of tokens\n", b""]
)
def test_a_wrong_list_of_merges_is_said(tmp_path, content):
    (tmp_path / "merges").write_bytes(content)
    with pytest.raises(FileError, match="merges"):
        ClipTokenizer(tmp_path / "merges")
    with pytest.raises(FileError, match="no such file"):
        ClipTokenizer(tmp_path / "absent")


def test_merges_are_read_from_gzip_too(tmp_path):
    (tmp_path / "plain").write_text("#v\na b\n")
    (tmp_path / "zipped").write_bytes(gzip.compress(b"#v\na b\n"))
    assert (
        ClipTokenizer(tmp_path / "plain")(["ab ba"])
        == ClipTokenizer(tmp_path / "zipped")(["ab ba"])
    ).all()


# ---- Embeddings ----


def test_names_are_found_as_people_write_them():
    file = embeddings(sofa=[1, 0, 0], television_set=[0, 1, 0], **{"runner_(carpet)": [0, 0, 1]})
    found = file.text_features(["Sofa", "television set", "runner (carpet)", "runner"])
    assert found.argmax(axis=1).tolist() == [0, 1, 2, 2]
    with pytest.raises(InputError, match="did you mean 'sofa'"):
        file.text_features(["soffa"])


def test_embeddings_are_read_from_npz_and_from_npy_with_names(tmp_path):
    vectors = np.array([[3, 0], [0, 0.5]], np.float16)
    np.savez(tmp_path / "a.npz", names=["bed", "lamp"], vectors=vectors)
    np.save(tmp_path / "b.npy", vectors)
    (tmp_path / "b.txt").write_text("bed\nlamp\n")
    (tmp_path / "list.json").write_text('[{"id": 1, "name": "bed"}, {"id": 2, "name": "lamp"}]')
    (tmp_path / "list.csv").write_text("1,bed,bed\n2,lamp,lamp\n")
    for found in (
        make_text_encoder(f"embeddings:{tmp_path / 'a.npz'}"),
        read_embeddings(tmp_path / "b.npy"),
        read_embeddings(tmp_path / "b.npy", names=tmp_path / "list.json"),
        read_embeddings(tmp_path / "b.npy", names=tmp_path / "list.csv"),
    ):
        assert found.names == ("bed", "lamp") and (found.vectors == np.eye(2)).all()


def test_wrong_embeddings_are_said(tmp_path):
    np.savez(tmp_path / "nan.npz", names=["bed", "lamp"], vectors=np.array([[1, 0], [0, np.nan]]))
    np.savez(tmp_path / "more.npz", names=["bed"], vectors=np.eye(2))
    np.savez(tmp_path / "other.npz", vectors=np.eye(2))
    np.savez(tmp_path / "objects.npz", names=np.array(["bed", None], object), vectors=np.eye(2))
    np.save(tmp_path / "alone.npy", np.eye(2))
    (tmp_path / "text.npz").write_text("no array")
    for name, message in (
        ("nan.npz", "'lamp' is zero or not finite"),
        ("more.npz", "one vector a name"),
        ("other.npz", "names"),
        ("objects.npz", "can run code"),
        ("alone.npy", "--names"),
        ("text.npz", "not an array"),
        ("absent.npz", "no such file"),
    ):
        with pytest.raises((InputError, FileError), match=message):
            read_embeddings(tmp_path / name)


def test_unknown_encoders_print_the_right_ones():
    with pytest.raises(InputError, match="clip, onnx, folder"):
        make_image_encoder("klip:x")
    with pytest.raises(InputError, match="clip:MODEL"):
        make_text_encoder("clip")


# ---- Relevance ----


class Letters:
    """A text encoder of letters: counts of a, b, c."""

    name = "letters"

    def text_features(self, texts):
        return unit_length(
            np.array([[text.count(letter) + 0.01 for letter in "abc"] for text in texts])
        )


def test_templates_are_averaged():
    vectors = [unit_length(np.array([2.01, 0.01, 0.01])), unit_length(np.array([1.01, 0.01, 1.01]))]
    assert (
        np.abs(
            embed(Letters(), ["a"], ["{}a", "{}c"])[0] - unit_length(np.mean(vectors, axis=0))
        ).max()
        < EXACT
    )
    with pytest.raises(InputError, match="needs one"):
        embed(Letters(), ["a"], ["no place"])
    with pytest.raises(InputError, match="empty"):
        embed(Letters(), ["a", " "])


def test_a_query_competes_with_all_but_its_synonyms(monkeypatch):
    monkeypatch.setattr("taichi_unifusion.language.prompts.NEGATIVES", ("c",))
    queries = Letters().text_features(["a", "b"])
    rivals, competes = competitors(Letters(), queries, ["a", "b"], ["{}"])
    assert rivals.shape == (3, 3) and competes.tolist() == [
        [True, False, True],
        [True, True, False],
    ]
    with pytest.raises(InputError, match="nothing is left"):
        competitors(Letters(), Letters().text_features(["cc"]), [], ["{}"])


def test_rivals_from_a_file_are_what_it_holds():
    file = embeddings(sofa=[1, 0, 0, 0], bed=[0, 1, 0, 0], zebra=[0, 0, 1, 0])
    rivals, competes = competitors(file, file.text_features(["sofa"]))
    # what all have in common, the bed and the sofa, which does not compete with itself
    assert rivals.shape == (3, 4)
    np.testing.assert_allclose(rivals[0], np.array([1, 1, 1, 0]) / np.sqrt(3), atol=EXACT)
    assert competes.sum() == 2


def test_relevance_is_a_half_at_a_draw_and_rises():
    similarity = np.linspace(-1, 1, 41, dtype=np.float32)
    found = relevance(similarity, np.zeros(41, np.float32))
    assert (
        found[20] == 0.5
        and (np.diff(found) >= 0).all()
        and found[0] < 1e-3
        and found[-1] > 1 - 1e-3
    )
    assert np.abs(found + relevance(-similarity, np.zeros(41, np.float32)) - 1).max() < EXACT


# ---- Regions ----


def sheets(*places: float) -> Mesh:
    """Unit squares of 10 x 10 vertices at these x, not connected."""
    x, y = np.meshgrid(np.linspace(0, 1, 10), np.linspace(0, 1, 10), indexing="ij")
    one = np.column_stack([x.ravel(), y.ravel(), np.zeros(100)])
    corner = (np.arange(9)[:, None] * 10 + np.arange(9)).ravel()
    faces = np.concatenate(
        [
            np.column_stack([corner, corner + 10, corner + 1]),
            np.column_stack([corner + 1, corner + 10, corner + 11]),
        ]
    )
    return Mesh(
        np.concatenate([one + [place, 0, 0] for place in places]).astype(np.float32),
        np.concatenate([faces + 100 * i for i in range(len(places))]).astype(np.int32),
    )


def test_regions_are_parts_with_their_boxes_best_first():
    mesh = sheets(0, 3, 6)
    score = np.repeat([0.7, 0.2, 0.9], 100)
    score[299] = 0.1
    regions = find_regions(mesh, score)
    assert [round(region.score, 6) for region in regions] == [0.9, 0.7]
    np.testing.assert_allclose(regions[1].box, [[0, 0, 0], [1, 1, 0]], atol=EXACT)
    np.testing.assert_allclose(regions[1].centroid, [0.5, 0.5, 0], atol=EXACT)
    assert (
        abs(regions[1].area - 1) < EXACT
        and set(regions[1].vertices) == set(range(100))
        and 299 not in regions[0].vertices
    )
    assert find_regions(mesh, score, min_area=2.0) == [] and find_regions(mesh, np.zeros(300)) == []


def test_areas_add_up_and_wrong_arguments_are_said():
    mesh = sheets(0, 5)
    assert abs(vertex_areas(mesh.vertices, mesh.faces).sum() - 2) < EXACT
    for relevance_, threshold in ((np.zeros(7), 0.5), (np.zeros(200), 1.0)):
        with pytest.raises(InputError):
            find_regions(mesh, relevance_, threshold=threshold)


# ---- Stored features ----


def stored(seed=0, shape=(12, 16, 5)):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float16)


def test_features_are_found_by_name_or_number_and_have_unit_length(tmp_path):
    for name in ("frame-000017.color", "18", "other"):
        np.save(tmp_path / f"{name}.npy", stored())
    encoder = make_image_encoder(f"folder:{tmp_path}")
    found = feature_image(encoder, FRAME)
    np.testing.assert_allclose(found, unit_length(stored()), atol=HALF)
    assert (
        feature_image(encoder, Frame(FRAME.depth, FRAME.camera, name="depth/0018.png")) == found
    ).all()
    with pytest.raises(FrameError, match="no features for 19.png"):
        encoder.image_features(Frame(FRAME.depth, FRAME.camera, name="19.png"))


@pytest.mark.parametrize("layout", ["hwc", "chw"])
@pytest.mark.parametrize("suffix", [".npy", ".npz", ".pt"])
def test_large_features_become_block_means(tmp_path, layout, suffix, monkeypatch):
    monkeypatch.setattr(folder, "LONGEST_SIDE", 4)
    values = stored()
    array = values if layout == "hwc" else np.ascontiguousarray(values.transpose(2, 0, 1))
    path = write_features(tmp_path / f"a{suffix}", array)
    found = folder.read_features(path, layout)
    wanted = values.astype(float).reshape(3, 4, 4, 4, 5).mean(axis=(1, 3))
    np.testing.assert_allclose(found, wanted, atol=HALF)


def write_features(path: Path, array) -> Path:
    if path.suffix == ".pt":
        torch = pytest.importorskip("torch", reason=".pt files need torch")
        torch.save(torch.from_numpy(array), path)
    else:
        (np.save if path.suffix == ".npy" else np.savez)(path, array)
    return path


def test_uneven_sizes_lose_nothing(tmp_path, monkeypatch):
    monkeypatch.setattr(folder, "LONGEST_SIDE", 4)
    for shape in ((7, 13, 3), (13, 7, 3), (1, 9, 2)):
        found = folder.read_features(
            write_features(tmp_path / "a.npy", np.full(shape, 2, np.float16)), "hwc"
        )
        assert max(found.shape[:2]) <= 4 and (found == 2).all() and found.shape[2] == shape[2]


def test_the_usual_channels_tell_the_layout(tmp_path):
    found = folder.read_features(write_features(tmp_path / "a.npy", stored(shape=(512, 3, 4))))
    assert found.shape == (3, 4, 512)


def test_full_resolution_is_never_in_memory(tmp_path):
    values = np.zeros((480, 640, 64), np.float16)
    path = write_features(tmp_path / "large.npy", values)
    size = values.nbytes
    del values
    tracemalloc.start()
    found = folder.read_features(path, "hwc")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.shape[1] <= 96 and peak < size / 5


class Payload:
    """Writes a file when it is unpickled."""

    def __init__(self, marker: Path) -> None:
        self.marker = marker

    def __reduce__(self):
        return (Path.touch, (self.marker,))


def test_damaged_and_dangerous_files_cost_the_frame_only(tmp_path):
    marker = tmp_path / "was-run"
    names = ("cut.npy", "text.npy", "pickle.npy", "archive.npz", "two.npz", "flat.npy", "tensor.pt")
    files = {name: tmp_path / name for name in names}
    np.save(files["cut.npy"], stored())
    files["cut.npy"].write_bytes(files["cut.npy"].read_bytes()[:-9])
    files["text.npy"].write_text("no array")
    np.save(files["pickle.npy"], np.array([Payload(marker)], object), allow_pickle=True)
    files["archive.npz"].write_bytes(b"PK\x03\x04 cut")
    np.savez(files["two.npz"], a=stored(), b=stored())
    np.save(files["flat.npy"], stored(shape=(4, 5)))
    files["tensor.pt"].write_bytes(pickle.dumps(Payload(marker)))
    encoder = make_image_encoder(f"folder:{tmp_path}")
    for stem in ("text", "two", "flat"):
        with pytest.raises(FrameError):
            encoder.image_features(Frame(FRAME.depth, FRAME.camera, name=f"{stem}.png"))
    for path in files.values():
        with pytest.raises((FileError, InputError, ImportError)):
            folder.read_features(path)
    assert not marker.exists()


def test_features_without_one_finite_number_are_left_out(tmp_path):
    np.save(tmp_path / "17.npy", np.full((3, 4, 5), np.nan, np.float32))
    with pytest.raises(FrameError, match="finite"):
        feature_image(make_image_encoder(f"folder:{tmp_path}"), FRAME)


def test_folders_without_features_are_said(tmp_path):
    for path, message in ((tmp_path, "no \\*.npy"), (tmp_path / "absent", "no such folder")):
        with pytest.raises(FileError, match=message):
            make_image_encoder(f"folder:{path}")
