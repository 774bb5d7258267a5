"""understand, query and segment from the command line, and features through the pipeline."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from tiny_recording import CONFIG, FLAGS, make_frames, write_folder

from taichi_unifusion import Pipeline, load_map
from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli.segment import read_labels_file
from taichi_unifusion.errors import InputError
from taichi_unifusion.files.maps import read_map, write_map
from taichi_unifusion.files.mesh_reading import read_mesh
from taichi_unifusion.maps import FeatureMap
from taichi_unifusion.results import write_results
from taichi_unifusion.results.ownership import mark_unfinished
from taichi_unifusion.results.run_folder import RunFolder

COLORS = np.eye(3)  # names are directions of colour here: what is red is "red"
NAMES = ("red", "green", "blue")
FOUND = 0.8  # share of the clearly red vertices that must be found


class ColorFeatures:
    """Image features that anybody can check: which of three colours a block of 4 x 4 pixels leans
    to.
    """

    name = "colors"

    def image_features(self, frame):
        height, width = frame.color.shape[:2]
        blocks = frame.color.reshape(height // 4, 4, width // 4, 4, 3).mean(axis=(1, 3)) / 255
        return (blocks - blocks.min(axis=2, keepdims=True) + 0.02).astype(np.float32)


@pytest.fixture(scope="module")
def frames():
    return make_frames(3)


@pytest.fixture(scope="module")
def embeddings(tmp_path_factory):
    path = tmp_path_factory.mktemp("texts") / "colors.npz"
    np.savez(path, names=NAMES, vectors=COLORS)
    return path


@pytest.fixture(scope="module")
def recording(frames, tmp_path_factory):
    folder = write_folder(tmp_path_factory.mktemp("data") / "recording", frames)
    (folder / "clip").mkdir()
    for i, frame in enumerate(frames):
        np.save(
            folder / "clip" / f"{i}.npy", ColorFeatures().image_features(frame).astype(np.float16)
        )
    return folder


@pytest.fixture(scope="module")
def made(recording, tmp_path_factory):
    out = tmp_path_factory.mktemp("results") / "made"
    assert (
        cli.main(
            [
                "understand",
                "folder",
                str(recording),
                *FLAGS,
                "--features",
                f"folder:{recording / 'clip'}",
                "--out",
                str(out),
            ]
        )
        == 0
    )
    return out


def ask(made, embeddings, *more) -> int:
    return cli.main(
        [
            *more[:1],
            str(made),
            *more[1:],
            "--text",
            f"embeddings:{embeddings}",
            "--device",
            FLAGS[1],
        ]
    )


def lean(mesh):
    """Colour (V, 3) of vertices less its grey part."""
    color = mesh.attributes["color"]
    return color - color.min(axis=1, keepdims=True)


def test_one_pass_gives_the_map_beside_surface_and_colour(made, recording):
    features = load_map(made / "maps" / "features.safetensors")
    assert isinstance(features, FeatureMap) and features.channels == 3 and len(features) > 100
    assert features.settings.source == str(recording / "clip")
    metrics = json.loads((made / "metrics.json").read_text())
    assert metrics["frames"]["used"] == 3 and metrics["maps"]["features"]["voxels"] == len(features)
    assert "color" in read_mesh(made / "mesh.ply").attributes


def test_a_query_finds_what_is_there_and_says_what_is_not(made, embeddings, capsys):
    assert ask(made, embeddings, "query", "red", "--threshold", "0.4", "--json") == 0
    (answer,) = json.loads(capsys.readouterr().out)
    mesh = read_mesh(made / "query-red.ply")
    red = lean(read_mesh(made / "mesh.ply"))
    clearly = (red[:, 0] > 0.35) & (red[:, 0] > 3 * red[:, 1:].max(axis=1))
    assert answer["found"] and answer["regions"] and clearly.sum() > 50
    strengths = [region["strength_m2"] for region in answer["regions"]]
    assert strengths == sorted(strengths, reverse=True) and strengths[-1] > 0
    scores = mesh.attributes["relevance"][:, 0]
    assert (scores[clearly] > 0.4).mean() > FOUND and (scores[~clearly] > 0.4).mean() < 0.5
    assert (made / "query-red.png").stat().st_size > 1000 and (made / "query.json").exists()
    low, high = np.array(answer["regions"][0]["box"])
    assert (high > low).all() and (low >= mesh.vertices.min(axis=0) - 1e-3).all()
    assert (
        ask(made, embeddings, "query", "blue", "--negative", "red", "--threshold", "0.99999") == 0
    )
    assert "blue: not here" in capsys.readouterr().out


def test_what_is_not_found_leaves_no_mesh_and_what_is_unknown_does_not_cost_the_others(
    made, embeddings, capsys
):
    assert ask(made, embeddings, "query", "red", "green", "--threshold", "0.4") == 0
    out = capsys.readouterr().out
    assert "strength m2  score" in out and "ranked by strength: (score - 0.4) times" in out
    assert "origin of x y z: where the poses of the recording have it" in out
    both = read_mesh(made / "query.ply")
    assert {"relevance_red", "relevance_green"} <= set(both.attributes)
    capsys.readouterr()
    assert ask(made, embeddings, "query", "red", "mauve", "--min-area", "100") == 2
    out, err = capsys.readouterr()
    assert "red: not here; its relevance reaches" in out and "no vector for 'mauve'" in err
    assert not list(made.glob("query-red.*")) and not (made / "query.ply").exists()
    red, mauve = json.loads((made / "query.json").read_text())
    assert not red["found"] and "mesh" not in red and "no vector" in mauve["reason"]


def test_the_names_of_an_embeddings_file_are_listed(made, embeddings, capsys):
    assert ask(made, embeddings, "query", "--list-names") == 0
    assert capsys.readouterr().out.split() == list(NAMES)
    assert ask(made, embeddings, "query", "--list-names", "--json") == 0
    listed = json.loads(capsys.readouterr().out)
    assert listed == [{"name": name, "synonyms": []} for name in NAMES]


def test_names_are_listed_only_where_they_can_be_asked(
    made, recording, embeddings, tmp_path, capsys
):
    np.savez(tmp_path / "wide.npz", names=NAMES, vectors=np.eye(3, 5))
    for folder, text, told in (
        (made, None, f"its features come from {recording / 'clip'}; give the text encoder"),
        (tmp_path / "none", f"embeddings:{embeddings}", "no maps/features.safetensors"),
        (made, f"embeddings:{tmp_path / 'wide.npz'}", f"5 channels, the features of {made} have 3"),
        (made, "clip:nowhere", "clip:nowhere takes any text"),
    ):
        arguments = ["query", str(folder), "--list-names", *(("--text", text) if text else ())]
        assert cli.main(arguments) == 2
        said = capsys.readouterr()
        assert told in said.err and not said.out


def test_segmentation_names_every_vertex_and_measures_itself(made, embeddings, tmp_path, capsys):
    (tmp_path / "labels.txt").write_text("7 red\n8 green\n9 blue\n")
    mesh = read_mesh(made / "mesh.ply")
    colors = lean(mesh)
    clear = np.sort(colors, axis=1)[:, 2] > 0.3 + np.sort(colors, axis=1)[:, 1]
    truth = mesh.with_attribute("label", np.where(clear, 7 + colors.argmax(axis=1), -1))
    truth.save(tmp_path / "truth.ply")
    arguments = (
        "segment",
        "--labels",
        str(tmp_path / "labels.txt"),
        "--truth",
        str(tmp_path / "truth.ply"),
    )
    assert ask(made, embeddings, *arguments, "--json") == 0
    summary = json.loads(capsys.readouterr().out)
    assert (
        summary["scores"]["overall_accuracy"] > 0.9 and summary["scores"]["points"] == clear.sum()
    )
    found = read_mesh(made / "segmentation.ply").attributes["label"][:, 0]
    assert (
        set(np.unique(found)) <= {-1, 7, 8, 9}
        and (found[clear] == 7 + colors.argmax(axis=1)[clear]).mean() > 0.9
    )
    assert (made / "segmentation.png").exists()
    assert ask(made, embeddings, *arguments) == 0
    out = capsys.readouterr().out
    assert "of the points are right" in out and "segmentation.ply" in out


@pytest.mark.parametrize(
    ("lines", "told"),
    [("1 red\n2 blue\n1 green\n", "number '1' 2 times"), ("a\nb\nb\nb\n", "name 'b' 3 times")],
)
def test_labels_that_stand_twice_are_named(tmp_path, lines, told):
    (tmp_path / "labels.txt").write_text(lines)
    with pytest.raises(InputError, match=told):
        read_labels_file(tmp_path / "labels.txt")


def test_info_says_where_features_come_from_and_which_answers_there_are(
    made, recording, embeddings, tmp_path, capsys
):
    copy = shutil.copytree(made, tmp_path / "copy")
    for file in RunFolder(copy).asked:
        file.unlink()
    source = f"features from {recording / 'clip'}; text encoder: that of the network"
    assert cli.main(["info", str(copy)]) == 0
    said = capsys.readouterr().out
    assert source in said and "answers" not in said
    assert ask(copy, embeddings, "query", "red", "--threshold", "0.4") == 0
    features = copy / "maps" / "features.safetensors"
    tensors, manifest = read_map(features)
    settings = {**manifest["settings"], "source": "clip:somebody/vit"}
    write_map(features, tensors, {**manifest, "settings": settings})
    capsys.readouterr()
    cli.main(["info", str(copy)])  # says that the map is not the run's
    said = capsys.readouterr().out
    assert "answers query-red.ply, query-red.png, query.json" in said
    assert "the text encoder of clip:somebody/vit, which `query` takes" in said
    assert cli.main(["info", str(features)]) == 0
    assert "the text encoder of clip:somebody/vit" in capsys.readouterr().out


def test_a_finer_mesh_is_still_extracted_beside_features(made, tmp_path):
    assert (
        cli.main(
            [
                "mesh",
                str(made),
                "--resolution",
                "2",
                "--out",
                str(tmp_path / "a.ply"),
                "--device",
                FLAGS[1],
            ]
        )
        == 0
    )
    assert cli.main(["info", str(made)]) == 0


def test_wrong_questions_end_with_one_sentence(made, embeddings, tmp_path, capfd):
    (tmp_path / "labels.txt").write_text("red\nred\n")
    np.savez(tmp_path / "wide.npz", names=NAMES, vectors=np.eye(3, 5))
    wide = f"embeddings:{tmp_path / 'wide.npz'}"
    for arguments, message in (
        (["query", str(made), "red"], "give the text encoder"),
        (["query", str(made), "--list-names"], "give the text encoder"),
        (
            ["query", str(tmp_path / "none"), "red", "--text", f"embeddings:{embeddings}"],
            "no maps/features.safetensors",
        ),
        (
            ["query", str(made), "mauve", "--text", f"embeddings:{embeddings}"],
            "has no vector for 'mauve'",
        ),
        (["query", str(made), "red", "--text", wide], "3 channels"),
        (["query", str(made), "red", "--text", "letters:x"], "clip, onnx, embeddings"),
        (
            [
                "segment",
                str(made),
                "--labels",
                str(tmp_path / "labels.txt"),
                "--text",
                f"embeddings:{embeddings}",
            ],
            "holds the name 'red' 2 times",
        ),
        (
            [
                "segment",
                str(made),
                "--labels",
                str(tmp_path / "none"),
                "--text",
                f"embeddings:{embeddings}",
            ],
            "no such file",
        ),
        (
            ["understand", "synthetic", "--features", "klip:x", "--out", str(tmp_path / "o")],
            "clip, onnx, folder",
        ),
    ):
        assert cli.main(arguments) == 2
        error = capfd.readouterr().err
        assert message in error and "Traceback" not in error
    assert not (tmp_path / "none").exists()  # a folder that is asked by mistake is not made


def test_frames_without_features_are_counted(recording, tmp_path, capsys):
    folder, out = tmp_path / "features", tmp_path / "out"
    shutil.copytree(recording / "clip", folder)
    (folder / "0.npy").write_bytes(b"no array")
    (folder / "2.npy").unlink()
    run = ["understand", "folder", str(recording), *FLAGS, "--features", f"folder:{folder}"]
    assert cli.main([*run, "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "3 used (2 without features), 0 skipped" in said
    assert "2 without features (first: " in said and "0.npy" in said
    lacking = json.loads((out / "metrics.json").read_text())["frames"]["without"]
    assert lacking.keys() == {"features"} and lacking["features"]["frames"] == [0, 2]
    assert "0.npy" in lacking["features"]["first"]
    assert cli.main(["info", str(out)]) == 0
    assert "3 used (2 without features), 0 skipped" in capsys.readouterr().out


def test_frames_without_features_still_give_their_surface(frames, tmp_path):
    class Sometimes(ColorFeatures):
        def image_features(self, frame):
            values = super().image_features(frame)
            return values if frame.index == 1 else np.full_like(values, np.nan)

    pipeline = Pipeline(CONFIG, encoder=Sometimes())
    run = pipeline.run(frames)
    assert [
        ("features" in step.integrations, "features" in step.lacking) for step in run.steps
    ] == [(False, True), (True, False), (False, True)]
    assert len(pipeline.maps["features"]) > 0 and not run.skipped

    class Never(ColorFeatures):
        def image_features(self, frame):
            return np.full((3, 4, 5), np.nan, np.float32)

    pipeline = Pipeline(replace(CONFIG), encoder=Never())
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "features.safetensors").write_text("of an earlier run")
    mark_unfinished(RunFolder(tmp_path), ["maps/features.safetensors"])
    results = write_results(tmp_path, pipeline, pipeline.run(frames[:1]))
    assert (
        any("no map of features" in str(error) for error in results.failures)
        and (tmp_path / "mesh.ply").exists()
    )
    assert not (tmp_path / "maps" / "features.safetensors").exists()
