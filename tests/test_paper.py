"""The paper's tables by one command each, on miniatures of the data sets, laid out as these unpack."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from paper_roots import (
    FREIBURG3,
    SETTINGS,
    write_band_features,
    write_replica_root,
    write_scannet_root,
    write_stanford_root,
    write_tum_root,
)
from places import DEVICE

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
sys.path.insert(0, str(BENCHMARKS))

import paper  # noqa: E402
import paper_experiments  # noqa: E402
import paper_methods  # noqa: E402
import paper_pictures  # noqa: E402
import paper_runs  # noqa: E402
import paper_scenes  # noqa: E402
import paper_tables  # noqa: E402
import paper_times  # noqa: E402
from paper_experiments import S3DIS13, SCANNET20  # noqa: E402
from paper_truth import write_room_labels  # noqa: E402

from taichi_unifusion.cli import main as cli  # noqa: E402
from taichi_unifusion.errors import FileError, InputError, UniFusionError  # noqa: E402
from taichi_unifusion.files.labels import read_labels  # noqa: E402

FLOOR, DESK, SOFA, WALL = 2, 14, 6, 1  # NYU40


@pytest.fixture
def here(monkeypatch):
    """Commands run in this process; which they were."""
    commands: list[list[str]] = []

    def unifusion(command: list[str], log: Path) -> None:
        commands.append(command)
        if cli.main(command):
            raise paper_runs.SceneFailed(f"unifusion {command[0]} failed")

    monkeypatch.setattr(paper_runs, "unifusion", unifusion)
    monkeypatch.setattr(paper_experiments, "SAMPLES", 4000)
    return commands


@pytest.fixture
def mini(tmp_path) -> list[str]:
    """Options that suit images of 80 x 60 pixels."""
    (tmp_path / "mini.yaml").write_text(SETTINGS)
    method = str(tmp_path / "mini.yaml")
    return ["--methods", method, "--device", DEVICE, "--out", str(tmp_path / "out")]


def rows_of(text: str, method: str) -> list[list[str]]:
    """Cells of a method's rows in the first table of a report."""
    table = text.split("\nTable ")[1].split("\n\n")[1]
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]
    return [line[1:] for line in lines if line[0].partition(" (")[0] == method]


def test_help_reads_like_the_list_of_experiments(capsys):
    with pytest.raises(SystemExit) as ended:
        paper.main(["--help"])
    text = " ".join(capsys.readouterr().out.split())
    assert ended.value.code == 0
    for said in (
        "I surface of the 312 validation scans of ScanNet",
        "II camera tracking on three sequences of TUM RGB-D",
        "III rendered depth and colour of the eight scenes of Replica",
        "V zero-shot segmentation of ScanNet (20 classes) and S3DIS (13)",
        "VIII milliseconds a frame",
        "fig13 error of the kernel's approximation",
    ):
        assert said in text


def test_the_lists_are_those_of_the_paper():
    names = paper_scenes.read_list(paper_scenes.LISTS / "scannetv2_val.txt")
    assert len(names) == len(set(names)) == 312 and names[0] == "scene0568_00"
    assert (len(SCANNET20.names), len(S3DIS13.names)) == (20, 13)
    for classes, number in ((SCANNET20, "VI"), (S3DIS13, "VII")):
        header, *rows = paper_tables.paper_rows(number)
        assert [classes.names[label] for label in classes.unseen] == header[2:-1]
        for row in rows:  # the paper's own mean, where all its classes can be read
            values = [float(cell) for cell in row[2:] if cell != "-"]
            if len(values) == 5:
                assert np.mean(values[:4]) == pytest.approx(values[4], abs=0.06)
    header, *rows = paper_tables.paper_rows("III")
    for row in rows:
        assert np.mean(list(map(float, row[2:-1]))) == pytest.approx(float(row[-1]), abs=0.01)
    for file in paper_scenes.LISTS.iterdir():
        assert "Source:" in file.read_text(), f"{file.name} does not say where it is from"


def test_surfaces_of_scannet_resume_and_name_what_fails(tmp_path, here, mini, capsys, monkeypatch):
    names = ["scene0304_00", "scene0568_00"]
    root = write_scannet_root(tmp_path / "scannet", names)
    for file in (root / "scans" / "scene0568_00").glob("*.sens"):
        file.write_bytes(b"not a recording")
    arguments = ["I", str(root), "--every", "2", *mini]
    assert paper.main(arguments) == 1
    text = capsys.readouterr().out
    accuracy, completeness, f1 = map(float, rows_of(text, "mini")[0])
    # of what 3 frames see, against the whole room and by samples, few ones here
    assert 0 < completeness < accuracy < 100
    assert f1 == pytest.approx(2 * accuracy * completeness / (accuracy + completeness), abs=0.01)
    assert rows_of(text, "Uni-Fusion as published") == [["80.43", "84.91", "82.44"]]
    assert "1 of 312 scenes; 310 not found" in text and "1 failed: scene0568_00" in text
    of_scene = [c for c in here if c[1].endswith("scene0304_00") or "scene0304_00" in c[2]]
    assert [c[:2] for c in of_scene[1:]] == [["evaluate", "surface"]] * 2
    assert of_scene[0][:5] == ["reconstruct", "scannet", of_scene[0][2], "--every", "2"]
    assert {"--whole", "samples"} <= set(of_scene[1]) and "--whole" not in of_scene[2]

    written = json.loads((tmp_path / "out" / "table_I.json").read_text())
    numbers = written["scenes"]["mini"]["scannet-surface"]["done"]["scene0304_00"]
    assert numbers["Accuracy %"] == pytest.approx(accuracy, abs=0.01) and numbers["frames"] == 3
    assert numbers["of what was seen: accuracy %"] > 90
    assert cv2.imread(str(tmp_path / "out" / "table_I.png")).shape[0] == 3 * paper_pictures.HEIGHT

    # the same again: only what had failed is tried, and now it is there
    write_scannet_root(tmp_path / "new", names[1:])
    bad = root / "scans" / "scene0568_00" / "scene0568_00.sens"
    (tmp_path / "new" / "scans" / "scene0568_00" / "scene0568_00.sens").replace(bad)
    here.clear()
    assert paper.main(arguments) == 0
    assert all("scene0568_00" in command[2] for command in here) and len(here) == 3
    assert "2 of 312 scenes" in capsys.readouterr().out
    # other settings are another experiment
    asked = []
    monkeypatch.setattr(paper_runs, "unifusion", lambda command, log: asked.append(command))
    assert paper.main([*arguments, "--every", "1", "--scenes", "scene0304_00"]) == 0
    assert asked[0][4] == "1" and len(asked) == 3


def test_rendering_of_replica(tmp_path, here, mini, capsys):
    root = write_replica_root(tmp_path / "Replica", ["office0"])
    assert paper.main(["III", str(root), "--every", "2", "--tracking", "given", *mini]) == 0
    text = capsys.readouterr().out
    depth, color = (list(row) for row in rows_of(text, "mini"))
    assert depth[0] == "Depth L1 cm" and color[0] == "PSNR dB"
    assert depth[2:] == color[2:] == ["-"] * 8  # no average of other scenes than the paper's
    assert 0 < float(depth[1]) < 6 and float(color[1]) > 15
    assert here[1][:2] == ["evaluate", "rendering"] and here[2][3].endswith("office0_mesh.ply")
    assert "7 not found: office-1" in text and "mini (1 scene)" in text
    said = (
        "every 2nd frame mapped at the recording's poses; compared with frames that are not, those "
        "half-way between: 1, 3, 5 ..."
    )
    assert f"Ours, replica-rendering: {said}." in text and "tracked" not in text
    written = json.loads((tmp_path / "out" / "table_III.json").read_text())
    written = written["scenes"]["mini"]["replica-rendering"]
    assert written["said"] == [said]
    assert written["done"]["office-0"]["frames compared"][:2] == [1, 3]
    assert cv2.imread(str(tmp_path / "out" / "table_III.png")).shape[0] == 2 * paper_pictures.HEIGHT
    # as the paper does it
    scene = paper_scenes.replica(root).scenes[0]
    experiment = paper_tables.TABLES["III"].experiments[0]
    command = experiment.commands(scene, tmp_path, None, experiment.settings)[0]
    assert command[command.index("--tracking") + 1] == "rgbd"
    assert command[command.index("--every") + 1] == "10"
    with pytest.raises(InputError, match="did you mean 'office-1'"):
        paper_scenes.replica(root, ["ofice-1"])
    # frames between those that are mapped are compared: there must be some, which is said at once
    del here[:]
    with pytest.raises(InputError, match="--every 1.*give 2 or more"):
        options = paper.parser().parse_args(["III", str(root), "--every", "1", *mini])
        paper.run_table(paper_tables.TABLES["III"], options)
    assert not here


def test_tracking_on_tum(tmp_path, here, mini, capsys):
    root = write_tum_root(tmp_path / "tum")
    assert paper.main(["II", str(root), "--every", "2", *mini]) == 0
    text = capsys.readouterr().out
    desk, xyz, office = rows_of(text, "mini")[0]
    assert (desk, xyz) == ("-", "-") and float(office) < 3
    numbers = json.loads(
        (tmp_path / "out" / "tum-tracking" / "mini" / "fr3-office.json").read_text()
    )
    assert numbers["numbers"]["poses"] == numbers["numbers"]["of frames"] == 5
    assert "ATE RMSE [cm]" in text and "| 5 | 5 |" in text  # poses are whole
    assert "every 2nd frame mapped at poses tracked from all frames alone" in text
    assert FREIBURG3.size == (640, 480)


def test_classes_of_scannet_and_s3dis(tmp_path, here, mini, capsys):
    scan = "scene0304_00"
    scannet = write_scannet_root(tmp_path / "scannet", [scan], labels=(FLOOR, DESK, SOFA, WALL))
    stanford = write_stanford_root(tmp_path / "2d3ds", {"area_1": ["office_1"]})
    numbers = list(SCANNET20.names)
    rows = [numbers.index(label) for label in (FLOOR, DESK, SOFA, WALL)]
    write_band_features(tmp_path / "features" / scan, list(map(str, range(6))), rows, 20)
    listed = list(S3DIS13.names.values())
    rows = [listed.index(name) for name in ("floor", "sofa", "window", "wall")]
    frames = [f"camera_{'0' * 31}{i}_office_1_frame_{i}_domain_rgb" for i in range(3)]
    write_band_features(tmp_path / "features" / "area_1" / "office_1", frames, rows, 13)
    texts = {}
    for classes, file in ((SCANNET20, "scannet"), (S3DIS13, "s3dis")):
        texts[file] = tmp_path / f"{file}.npz"
        vectors = np.eye(len(classes.names), dtype=np.float32)
        np.savez(texts[file], names=list(classes.names.values()), vectors=vectors)
    features = ["--features", f"folder:{tmp_path}/features/{{scene}}"]

    arguments = [*features, *mini, "--text", f"embeddings:{texts['scannet']}"]
    assert paper.main(["VI", str(scannet), "--every", "2", *arguments]) == 0
    iou, accuracy = rows_of(capsys.readouterr().out, "mini")
    assert iou[:2] == ["IoU %", "-"] and iou[4] == "-"  # neither bookshelf nor toilet is there
    assert float(iou[2]) > 60 and float(iou[3]) > 60 and float(accuracy[-1]) > 70
    maps = tmp_path / "out" / "scannet-classes" / "mini" / scan / "maps"
    assert not maps.exists()  # they are large

    here.clear()
    # ScanNet is done; the room is not
    assert paper.main(["V", str(scannet), "--every", "2", *arguments]) == 0 and not here
    assert rows_of(capsys.readouterr().out, "mini")[0][3:] == ["-"] * 3
    arguments = [*features, *mini, "--text", f"embeddings:{texts['s3dis']}"]
    assert paper.main(["V", str(stanford), "--keep-maps", *arguments]) == 0
    text = capsys.readouterr().out
    row = rows_of(text, "mini")[0]
    assert "scannet-classes: 1 scenes, done before" in text
    assert "scannet-classes: every 2nd frame mapped" in text  # as the earlier call did it
    assert "s3dis-classes: every frame mapped at the recording's poses" in text
    assert all(float(share) > 60 for share in row)  # that of ScanNet was kept
    assert (tmp_path / "out" / "s3dis-classes" / "mini" / "area_1-office_1" / "maps").is_dir()


def test_ctrl_c_ends_all_and_keeps_what_is_done(tmp_path, mini, monkeypatch, capsys):
    def unifusion(command: list[str], log: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(paper_runs, "unifusion", unifusion)
    root = write_tum_root(tmp_path / "tum", count=1)
    assert paper.main(["II", str(root), *mini]) == 130
    assert "the same command goes on" in capsys.readouterr().out


def test_points_of_all_scenes_count_once_each():
    """Scores are of the points of all scenes together, not means of the scenes' scores."""
    labels = list(SCANNET20.names)
    desk, sofa = labels.index(DESK), labels.index(SOFA)
    counts = np.zeros((2, 20, 21), int)
    counts[0, desk, desk], counts[0, desk, sofa], counts[1, sofa, sofa] = 30, 10, 60
    results = paper_runs.Results(
        {
            str(i): {"confusion": {"labels": labels, "counts": each.tolist()}}
            for i, each in enumerate(counts)
        }
    )
    scores = paper_tables.pooled(results, SCANNET20)
    assert [(score.name, score.iou, score.seen) for score in scores.classes] == [
        ("sofa", 60 / 70, False),
        ("desk", 30 / 40, False),
    ]
    assert scores.points == 100 and scores.seen is None
    assert paper_tables.pooled(paper_runs.Results(), SCANNET20) is None


def test_a_dead_process_costs_its_scene_only(tmp_path):
    log = tmp_path / "log.txt"
    with pytest.raises(paper_runs.SceneFailed, match="no such file or folder.*see .*log.txt"):
        paper_runs.unifusion(["reconstruct", "replica", str(tmp_path / "no"), "--out", "x"], log)
    assert log.read_text().startswith("$ unifusion reconstruct replica")


@pytest.mark.parametrize(
    ("find", "said"),
    [
        (paper_scenes.scannet, "no scan of the list"),
        (paper_scenes.tum, "no rgbd_dataset_freiburg"),
        (paper_scenes.replica, "none of office0"),
        (paper_scenes.stanford, "no area_1"),
    ],
)
def test_an_empty_root_is_said(tmp_path, find, said):
    with pytest.raises(FileError, match=said):
        find(tmp_path)


def test_rooms_are_found_by_area_or_by_name(tmp_path):
    root = write_stanford_root(
        tmp_path, {"area_1": ["office_1", "hallway_2"], "area_5a": ["office_1"]}, count=1
    )
    found = paper_scenes.stanford(root)
    assert [scene.name for scene in found.scenes] == [
        "area_1/hallway_2",
        "area_1/office_1",
        "area_5a/office_1",
    ]
    assert found.scenes[2].truth == root / "Stanford3dDataset_v1.2" / "Area_5" / "office_1"
    some = paper_scenes.stanford(root, ["area_5a", "area_1/office_1", "area_6"])
    assert len(some.scenes) == 2 and some.missing == ("area_6",)


def test_labels_of_a_room_are_read_past_its_one_bad_byte(tmp_path):
    folder = tmp_path / "Annotations"
    folder.mkdir()
    (folder / "chair_1.txt").write_text("1.0 2.0 3.0 10 20 30\n1.5 2.0 3.0 10 185\x10187\n")
    (folder / "board_2.txt").write_text("0.0 0.0 1.0 1 2 3\n")
    (folder / "stairs_1.txt").write_text("9 9 9 1 2 3\n")
    assert write_room_labels(tmp_path, S3DIS13.names, tmp_path / "truth.ply") == 3
    labels = read_labels(tmp_path / "truth.ply")
    assert labels.labels.tolist() == [11, 8, 8]
    np.testing.assert_allclose(labels.points[1:], [[1, 2, 3], [1.5, 2, 3]])
    (folder / "wall_1.txt").write_text("not numbers\n")
    with pytest.raises(FileError, match="wall_1.txt"):
        write_room_labels(tmp_path, S3DIS13.names, tmp_path / "truth.ply")
    with pytest.raises(FileError, match="no CLASS_N.txt"):
        write_room_labels(folder, S3DIS13.names, tmp_path / "truth.ply")


def test_methods_are_named_or_files(tmp_path):
    assert paper_methods.method_of("ours") == paper_methods.Method("ours")
    assert paper_methods.method_of("published").config.name == "paper.yaml"
    with pytest.raises(UniFusionError, match="ours, published and FILE.yaml"):
        paper_methods.method_of("mine")


def test_methods_of_one_name_are_refused(tmp_path):
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "my.yaml").write_text("window: 1\n")
    (tmp_path / "ours.yaml").write_text("window: 1\n")
    a, b, ours = (str(tmp_path / name) for name in ("a/my.yaml", "b/my.yaml", "ours.yaml"))
    assert [each.name for each in paper_methods.methods_of(["ours", a])] == ["ours", "my"]
    for names, said in (
        ([a, b], "would both be called 'my'"),
        (["ours", "ours"], "would both be called 'ours'"),
        ([ours], "'.*ours.yaml' would be called 'ours'"),
    ):
        with pytest.raises(InputError, match=said):
            paper_methods.methods_of(names)


def test_a_wrong_configuration_is_said_before_any_scene_runs(tmp_path, here, capsys):
    root = write_tum_root(tmp_path / "tum", count=1)
    (tmp_path / "wrong.yaml").write_text("widow: 1\n")
    arguments = ["--methods", "ours", str(tmp_path / "wrong.yaml"), "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit, match="wrong.yaml: unknown key 'widow'.*did you mean 'window'"):
        paper.main(["II", str(root), *arguments])
    assert not here and not (tmp_path / "out").exists()


def test_other_settings_in_the_same_file_are_another_experiment(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr(paper_runs, "unifusion", lambda command, log: asked.append(command))
    experiment = replace(paper_experiments.TRACKING, numbers=lambda folder: {"poses": 5})
    scenes = paper_scenes.tum(write_tum_root(tmp_path / "tum", count=1)).scenes
    file = tmp_path / "my.yaml"

    def commands_run(text: str) -> int:
        asked.clear()
        file.write_text(text)
        method = paper_methods.method_of(str(file))
        out = tmp_path / "out"
        done = paper_runs.run_scenes(experiment, scenes, out, method, experiment.settings).done
        assert done == {"fr3/office": {"poses": 5}}
        return len(asked)

    assert [commands_run(text) for text in ("window: 1", "# one\nwindow: 1", "window: 2")] == [
        *(2, 0, 2)
    ]
    # of files that earlier versions wrote the settings are not known
    kept = tmp_path / "out" / "fr3-office.json"
    values = json.loads(kept.read_text())
    del values["configuration"]
    kept.write_text(json.dumps(values))
    assert commands_run("window: 2") == 2


def test_two_roots_of_one_data_set_are_refused(tmp_path):
    with pytest.raises(InputError, match="both taken for scannet-classes"):
        paper.roots_by_experiment(paper_tables.TABLES["V"], [tmp_path / "a", tmp_path / "b"])


@pytest.mark.parametrize(
    ("every", "said"),
    [
        (1, "every frame mapped"),
        (2, "every 2nd frame mapped"),
        (11, "every 11th frame mapped"),
        (23, "every 23rd frame mapped"),
    ],
)
def test_frames_are_counted_in_words(every, said):
    settings = paper_experiments.Settings(every=every, tracking="rgbd")
    assert paper_experiments.mapped(settings) == f"{said} at {paper_experiments.POSES['rgbd'][3:]}"


def test_bars_have_their_heights():
    rows = {"a": [1.0, None], "b": [2.0, 4.0]}
    image = paper_pictures.bars("t", ["x", "y"], rows, paper_pictures.colors_of(["a"], ["b"]))
    red = (image == paper_pictures.OURS[0]).all(axis=2)
    red[:, paper_pictures.WIDTH - paper_pictures.RIGHT :] = False  # the legend
    heights = red.sum(axis=0)
    assert heights.max() == pytest.approx(2 * heights[heights > 0].min(), abs=4)


def test_times_have_the_paper_s_columns(tmp_path, monkeypatch, capsys):
    import gpu_checks

    monkeypatch.setattr(gpu_checks, "FEATURES", (6, 8))
    monkeypatch.setattr(gpu_checks, "CHANNELS", 32)
    monkeypatch.setattr(paper_times, "CHANNELS", 32)
    monkeypatch.setattr(paper_times, "SIZE", (160, 120))
    monkeypatch.setattr(paper_times.milliseconds, "__defaults__", ((160, 120),))
    arguments = ["VIII", "--frames", "4", "--device", DEVICE, "--out", str(tmp_path)]
    assert paper.main(arguments) == 0
    text = capsys.readouterr().out
    ours = next(line for line in text.splitlines() if line.startswith("| ours"))
    assert len([cell for cell in ours.strip("|").split("|")[1:] if float(cell) > 0]) == 7
    found = json.loads((tmp_path / "table_VIII.json").read_text())
    assert found["size"] == [160, 120] and found["frames"] == 2
    with pytest.raises(SystemExit, match="gives 2 frames, more than 2 are needed"):
        paper.main([*arguments, "--frames", "2"])


def test_figures_are_the_ablations(tmp_path, monkeypatch):
    import ablation

    ran = []

    def study(scene, out):
        """A study: that does nothing."""
        ran.append((scene, out))

    monkeypatch.setattr(ablation, "STUDIES", {"kernel": study})
    assert paper.main(["fig13", "--out", str(tmp_path / "new")]) == 0
    assert ran == [(None, tmp_path / "new")] and (tmp_path / "new").is_dir()
    assert {study for study, _ in paper.FIGURES.values()} == {"encoding", "voxel-size", "kernel"}
