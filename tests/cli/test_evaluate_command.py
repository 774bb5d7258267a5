"""`unifusion evaluate` as a user meets it: which frames and meshes it takes, tables, JSON, one
sentence for what is wrong.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from meshes import joined, mesh_of, random_rigid, rectangle
from tiny_recording import FLAGS, make_frames, write_folder

from taichi_unifusion import Trajectory, load_map, open_dataset
from taichi_unifusion.cli import main as cli
from taichi_unifusion.datasets.color_camera import kinect_color_camera
from taichi_unifusion.errors import FileError
from taichi_unifusion.evaluation import Viewpoints, evaluate_rendering, evaluate_surface
from taichi_unifusion.files.mesh_reading import read_any_mesh, read_mesh
from taichi_unifusion.files.trajectories import read_trajectory, write_trajectory
from taichi_unifusion.geometry import triangles as geometry
from taichi_unifusion.results.reader import read_run

FRAMES, EVERY = 7, 3  # frames 0, 3 and 6 are used
SAMPLES = "3000"
SAME = 1e-6  # relative: the same code on the same files


@pytest.fixture(autouse=True)
def coarse_pieces(monkeypatch):
    """Distances a little less exact and much sooner: here they only have to be the same everywhere."""
    monkeypatch.setattr(geometry, "PIECE_M", 0.3)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("data") / "recording", make_frames(FRAMES))


@pytest.fixture(scope="module")
def results(recording, tmp_path_factory):
    """A results folder; tests that change it work on a copy."""
    out = tmp_path_factory.mktemp("results") / "made"
    assert (
        cli.main(
            [
                "reconstruct",
                "folder",
                str(recording),
                *FLAGS,
                "--every",
                str(EVERY),
                "--mesh.formats",
                "ply",
                "--out",
                str(out),
            ]
        )
        == 0
    )
    return out


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    path = tmp_path_factory.mktemp("truth") / "room.ply"
    open_dataset("synthetic").ground_truth_mesh().save(path)
    return path


@pytest.fixture
def evaluate(capsys):
    """Runs the command and gives its JSON, after it ended well."""

    def run(*arguments):
        capsys.readouterr()
        assert cli.main(["evaluate", *map(str, arguments), "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    return run


@pytest.fixture
def told(capsys):
    """Runs the command and gives what it says on its way to exit code 2."""

    def run(*arguments):
        capsys.readouterr()
        assert cli.main(["evaluate", *map(str, arguments)]) == 2
        captured = capsys.readouterr()
        assert captured.out == "" and "Traceback" not in captured.err
        return " ".join(captured.err.replace("│", " ").split())

    return run


def with_metrics(results: Path, folder: Path, **changes) -> Path:
    """A copy of the results folder whose metrics.json says something else about the recording."""
    shutil.copytree(results, folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["recording"].update(changes)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


# --- What a results folder says -------------------------------------------------------------------------------------


def test_a_run_knows_its_frames_camera_and_poses(results, recording):
    run = read_run(results)
    assert (run.source.format, run.source.path) == ("folder", str(recording))
    assert run.used == (0, 3, 6)
    assert run.views().camera == make_frames(1)[0].camera and len(run.recording) == FRAMES
    assert (run.T_recording_run() == np.eye(4)).all()
    np.testing.assert_allclose(
        run.trajectory().T_world_camera, run.true_trajectory().T_world_camera, atol=1e-8
    )
    limits = run.config().preprocess
    assert (run.views().depth_min, run.views().depth_max) == (limits.depth_min, limits.depth_max)


@pytest.mark.parametrize(
    ("frames", "used"),
    [
        ({"used": 2, "skipped_frames": [{"frame": 3, "message": ""}]}, (0, 6)),
        ({"used": 1, "skipped_frames": []}, (0,)),  # stopped after the first
        ({"used": 1, "skipped_frames": [{"frame": 0, "message": ""}]}, (3,)),
    ],
)
def test_frames_skipped_or_never_reached_are_not_used(results, tmp_path, frames, used):
    folder = with_metrics(results, tmp_path / "copy")
    metrics = json.loads((folder / "metrics.json").read_text())
    metrics["frames"].update(frames)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    assert read_run(folder).used == used


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"recording": 3, "frames": {}}',
        '{"recording": {"start": "x"}, "frames": {"skipped_frames": []}}',
    ],
)
def test_damaged_metrics_are_told(results, tmp_path, text):
    folder = with_metrics(results, tmp_path / "copy")
    (folder / "metrics.json").write_text(text)
    with pytest.raises(FileError, match="not the metrics of a run"):
        read_run(folder)


# --- surface --------------------------------------------------------------------------------------------------------


def test_surface_of_a_results_folder_is_judged_by_what_its_frames_saw(results, truth, evaluate):
    found = evaluate("surface", results, truth, "--samples", SAMPLES)
    run = read_run(results)
    limits = run.config().preprocess
    camera = make_frames(1)[0].camera
    views = Viewpoints(camera, run.trajectory().T_world_camera, limits.depth_min, limits.depth_max)
    known = evaluate_surface(run.mesh(), read_mesh(truth), views=views, samples=int(SAMPLES))
    assert found["accuracy_cm"] == pytest.approx(known.accuracy_cm, rel=SAME)
    assert [s["f1"] for s in found["scores"]] == pytest.approx(
        [s.f1 for s in known.scores], rel=SAME
    )
    assert found["ground_truth_unseen"] > 0.5 and found["seen_by"] == str(results)
    whole = evaluate(
        "surface", results, truth, "--whole", "--samples", SAMPLES, "--thresholds", "0.05"
    )
    seen = evaluate("surface", results, truth, "--samples", SAMPLES, "--thresholds", "0.05")
    assert whole["scores"][0]["recall"] < 0.5 < seen["scores"][0]["recall"]
    assert (whole["ground_truth_unseen"], whole["seen_by"], len(whole["scores"])) == (0, None, 1)


def test_surface_of_a_mesh_file_is_judged_whole_or_by_another_run(
    results, truth, evaluate, tmp_path
):
    mesh = shutil.copy(results / "mesh.ply", tmp_path / "other.ply")
    assert evaluate("surface", mesh, truth, "--samples", SAMPLES)["ground_truth_unseen"] == 0
    seen = evaluate("surface", mesh, truth, "--seen-by", results, "--samples", SAMPLES)
    assert seen["scores"] == evaluate("surface", results, truth, "--samples", SAMPLES)["scores"]


def test_surface_without_a_truth_takes_the_recordings_own(results, truth, evaluate, tmp_path):
    folder = with_metrics(results, tmp_path / "copy", format="synthetic", path="")
    own, given = (
        evaluate("surface", *arguments, "--samples", SAMPLES)
        for arguments in ((folder,), (folder, truth))
    )
    assert own["scores"] == given["scores"] and own["ground_truth"] == "the recording's"


def test_surface_table_and_file(results, truth, capsys, tmp_path):
    file = tmp_path / "scores" / "surface.json"
    assert (
        cli.main(
            [
                "evaluate",
                "surface",
                str(results),
                str(truth),
                "--samples",
                SAMPLES,
                "--to",
                "samples",
                "--out",
                str(file),
            ]
        )
        == 0
    )
    captured, written = capsys.readouterr(), json.loads(file.read_text())
    lines = captured.out.splitlines()
    assert lines[0].split() == ["within", "cm", "precision", "%", "recall", "%", "F1", "%"]
    assert float(lines[1].split()[-1]) == pytest.approx(100 * written["scores"][0]["f1"], abs=0.051)
    assert (
        "3 frames could tell" in captured.out
        and written["distance_to"] == "samples"
        and "\x1b" not in captured.out
    )


@pytest.mark.parametrize("suffix", [".glb", ".obj", ".stl", ".off"])
def test_meshes_of_other_programs_are_read(suffix, tmp_path):
    trimesh = pytest.importorskip("trimesh")
    mesh = joined(rectangle((0, 0), (1, 2), 0.5), rectangle((3, 0), (4, 1), 0.0))
    trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).export(tmp_path / f"mesh{suffix}")
    found = read_any_mesh(tmp_path / f"mesh{suffix}")
    assert len(found.faces) == 4
    np.testing.assert_allclose(
        np.sort(found.vertices[found.faces].reshape(-1, 3), axis=0),
        np.sort(mesh.vertices[mesh.faces].reshape(-1, 3), axis=0),
        atol=1e-6,
    )


# --- rendering ------------------------------------------------------------------------------------------------------


def test_rendering_takes_held_out_frames_half_way_between_the_used_ones(
    results, recording, evaluate
):
    found = evaluate("rendering", results)
    assert [frame["index"] for frame in found["frames"]] == [1, 4] and found[
        "used_by_the_run"
    ] == []
    limits = read_run(results).config().preprocess
    frames = open_dataset("folder", recording)
    known = evaluate_rendering(
        read_mesh(results / "mesh.ply"),
        [frames[1], frames[4]],
        color=load_map(results / "maps" / "color.safetensors").query,
        depth_min=limits.depth_min,
        depth_max=limits.depth_max,
    )
    for name in ("depth_l1_cm", "depth_median_cm", "coverage", "psnr_db", "ssim"):
        # the map's kernels are compiled anew
        assert found[name] == pytest.approx(getattr(known, name), rel=1e-4)
    assert found["depth_l1_cm"] < 20 and found["coverage"] > 0.5 and found["psnr_db"] > 15


@pytest.mark.parametrize(
    ("flags", "frames", "used"),
    [
        (["--start", "2"], [4], []),
        (["--end", "4"], [1], []),
        (["--start", "2", "--every", "1"], [2, 4, 5], []),
        (["--every", "2", "--all"], [0, 2, 4, 6], [0, 6]),
        (["--every", "2"], [2, 4], []),
        (["--all"], [0, 3, 6], [0, 3, 6]),
        (["--start", "1", "--end", "5", "--all"], [3], [3]),
        (["--start", "3", "--end", "5", "--every", "1", "--all"], [3, 4], [3]),
        (["--all", "--end", "1"], [0], [0]),
    ],
)
def test_rendering_takes_the_frames_that_are_asked_for(results, evaluate, flags, frames, used):
    found = evaluate("rendering", results, *flags)
    assert [frame["index"] for frame in found["frames"]] == frames and found[
        "used_by_the_run"
    ] == used


def test_rendering_stays_between_the_runs_first_and_last_frame(
    results, recording, evaluate, tmp_path
):
    longer = write_folder(tmp_path / "longer", [*make_frames(FRAMES), *make_frames(6)])
    for flags, frames in (
        ([], [1, 4, 7]),
        (["--every", "2"], [2, 4, 8]),
        (["--start", "7", "--end", "11"], [7, 10]),
        (["--start", "9"], [10]),
        (["--start", "11", "--every", "1"], [11, 12]),
    ):
        found = evaluate("rendering", results, "folder", longer, *flags)
        assert [frame["index"] for frame in found["frames"]] == frames


def test_rendering_of_a_mesh_file(results, recording, evaluate):
    found = evaluate("rendering", results / "mesh.ply", "folder", recording, "--end", "2")
    assert [frame["index"] for frame in found["frames"]] == [0, 1] and found["colour"] == "vertices"
    own = evaluate("rendering", results, "--vertex-colors", "--all", "--every", "1", "--end", "2")
    assert own["psnr_db"] == pytest.approx(found["psnr_db"]) and own["colour"] == "vertices"
    assert (
        evaluate("rendering", results, "--all", "--every", "1", "--end", "2")["psnr_db"]
        != found["psnr_db"]
    )


def test_rendering_of_a_recording_that_was_moved(results, recording, evaluate, told, tmp_path):
    moved = shutil.copytree(recording, tmp_path / "elsewhere")
    lost = with_metrics(results, tmp_path / "copy", path=str(tmp_path / "gone"))
    assert "was made from folder" in told("rendering", lost)
    assert [frame["index"] for frame in evaluate("rendering", lost, "folder", moved)["frames"]] == [
        1,
        4,
    ]


def test_rendering_leaves_out_frames_that_cannot_be_used(results, recording, capsys, tmp_path):
    spoiled = shutil.copytree(recording, tmp_path / "spoiled")
    (spoiled / "depth" / "1.png").write_bytes(b"no image")
    (spoiled / "poses" / "2.txt").write_text("nan " * 16)
    arguments = [
        "evaluate",
        "rendering",
        str(results),
        "folder",
        str(spoiled),
        *("--start", "0", "--end", "5", "--every", "1"),
        "--json",
    ]
    assert cli.main(arguments) == 0
    captured = capsys.readouterr()
    assert [frame["index"] for frame in json.loads(captured.out)["frames"]] == [4]
    assert captured.err.count("frame left out") == 2 and "1.png" in captured.err
    assert "frames have no usable pose and will be skipped (first: " in captured.err


def test_rendering_table(results, capsys):
    assert cli.main(["evaluate", "rendering", str(results), "--depth-max", "2.5"]) == 0
    out = capsys.readouterr().out
    assert (
        out.splitlines()[0].split("  ")[0] == "depth L1 cm"
        and "none of which the run has used; colour from the map, compared with images as recorded."
        in out
    )


def test_rendering_of_one_frame_of_a_mesh_file_reads_well(results, recording, capsys):
    arguments = [str(results / "mesh.ply"), "folder", str(recording), "--end", "1"]
    assert cli.main(["evaluate", "rendering", *arguments]) == 0
    out = " ".join(capsys.readouterr().out.split())
    assert "Of 1 frame of folder" in out and "from file" not in out
    assert "choose others); colour from the vertices, compared with images as recorded." in out


def test_rendering_says_which_colour_camera_images_were_registered_with(
    results, recording, evaluate, tmp_path
):
    registered = "registered with the run's colour camera (--color-camera kinect)"
    color = {"choice": "kinect", "camera": kinect_color_camera().to_values(), "verdict": ""}
    folder = with_metrics(results, tmp_path / "copy", color=color)
    assert evaluate("rendering", folder)["images"] == registered
    assert evaluate("rendering", folder, "--color-camera", "none")["images"] == "as recorded"
    asked = evaluate("rendering", results, "--color-camera", "kinect")["images"]
    assert asked == "registered with --color-camera kinect"
    assert evaluate("rendering", results, "synthetic")["images"] == (
        "as the recording registers them"
    )


def test_a_mesh_in_another_world_is_told(results, recording, told, tmp_path, caplog):
    away = np.eye(4)
    away[2, 3] = 100
    read_mesh(results / "mesh.ply").transformed(away).save(tmp_path / "away.ply")
    said = told("rendering", tmp_path / "away.ply", "folder", recording, "--end", "2")
    assert "no ray of 2 frames meets the mesh; is it in the world of the frames' poses" in said
    frame = make_frames(1)[0]
    piece = rectangle((-0.1, -0.1), (0.1, 0.1), 1.0)  # before the first camera
    piece.transformed(frame.T_world_camera).save(tmp_path / "piece.ply")
    arguments = [str(tmp_path / "piece.ply"), "folder", str(recording), "--end", "2"]
    assert cli.main(["evaluate", "rendering", *arguments]) == 0
    assert "% of readings meet the mesh: is it in the world" in caplog.text


# --- Runs whose poses were tracked ----------------------------------------------------------------------------------


def test_a_tracked_run_is_fitted_to_the_recording(results, truth, evaluate, tmp_path, caplog):
    """As if a tracker had found every pose, but for its own choice of the world."""
    T, folder = random_rigid(1), with_metrics(results, tmp_path / "copy")
    metrics = json.loads((folder / "metrics.json").read_text()) | {"tracking": {"mode": "rgbd"}}
    (folder / "metrics.json").write_text(json.dumps(metrics))
    mesh, path = read_mesh(folder / "mesh.ply"), read_trajectory(folder / "trajectory.txt")
    mesh.transformed(T).save(folder / "mesh.ply")
    write_trajectory(
        folder / "trajectory.txt", Trajectory(path.timestamps, T @ path.T_world_camera)
    )
    np.testing.assert_allclose(read_run(folder).T_recording_run() @ T, np.eye(4), atol=1e-6)
    there, here = (evaluate("surface", of, truth, "--samples", SAMPLES) for of in (folder, results))
    assert there["accuracy_cm"] == pytest.approx(here["accuracy_cm"], abs=1e-3)
    assert there["ground_truth_unseen"] == pytest.approx(here["ground_truth_unseen"], abs=1e-3)
    there, here = (evaluate("rendering", of, "--vertex-colors") for of in (folder, results))
    assert there["depth_median_cm"] == pytest.approx(here["depth_median_cm"], abs=1e-2)
    assert there["psnr_db"] == pytest.approx(here["psnr_db"], abs=0.05)
    fitted = "its world is fitted to the recording's by the means of the cameras' rotations and positions"
    assert f"{fitted}, 0.0 cm off in the mean (ATE is of another fit" in caplog.text
    caplog.clear()
    evaluate("surface", folder, truth, "--samples", SAMPLES)
    assert caplog.text.count("its world is fitted") == 1
    assert evaluate("trajectory", folder)["ate_cm"]["max"] < 1e-4


# --- trajectory -----------------------------------------------------------------------------------------------------


def test_trajectory_of_a_results_folder_and_of_files(results, evaluate, tmp_path):
    # the recording's own poses, to 9 digits
    assert evaluate("trajectory", results)["ate_unaligned_cm"]["max"] < 1e-5
    estimate = read_trajectory(results / "trajectory.txt")
    poses = estimate.T_world_camera.copy()
    poses[:, :3, 3] += (0, 0, 0.5)
    poses[1, 0, 3] += 0.01
    write_trajectory(tmp_path / "truth.txt", Trajectory(estimate.timestamps + 0.01, poses))
    for arguments in (
        (results, tmp_path / "truth.txt"),
        (results / "trajectory.txt", tmp_path / "truth.txt"),
    ):
        found = evaluate("trajectory", *arguments, "--rpe-delta", "2")
        assert (
            found["ate_unaligned_cm"]["median"] == pytest.approx(50, abs=0.1)
            and 0 < found["ate_cm"]["rmse"] < 1
        )
        assert (found["matches"], found["rpe_delta"], found["rpe_unit"]) == (3, 2, "frames")
    assert evaluate("trajectory", tmp_path / "truth.txt", results)["matches"] == 3


def test_all_tracked_poses_are_judged_if_asked_for(results, recording, evaluate, told, tmp_path):
    """As if a tracker had found the pose of every frame but one, a little off."""
    folder = with_metrics(results, tmp_path / "copy")
    frames, file = (0, 1, 3, 4, 5, 6), folder / "tracking.txt"
    truth = Trajectory(
        np.array(frames, float),
        np.array([open_dataset("folder", recording).pose_at(i)[1] for i in frames]),
    )
    write_trajectory(file, truth)
    (folder / "tracking.csv").write_text(
        "frame,timestamp,verdict\n" + "".join(f"{i},,tracked\n" for i in range(FRAMES))
    )
    found = evaluate("trajectory", folder)
    assert found["matches"] == 3 and found["rpe_frames_of_the_recording"] == [3, 3]
    found = evaluate("trajectory", folder, "--tracked")
    assert found["matches"] == 6 and found["rpe_frames_of_the_recording"] == [1, 2]
    assert found["ate_unaligned_cm"]["max"] < 1e-5
    found = evaluate("trajectory", folder, file, "--tracked", "--rpe-delta", "2")
    assert found["matches"] == 6 and found["rpe_frames_of_the_recording"] == [2, 3]
    assert "its poses were not tracked" in told("trajectory", results, "--tracked")
    assert "--tracked is for a results folder" in told("trajectory", file, file, "--tracked")
    assert "is a folder without trajectory.txt; the truth is a file of poses or a results" in told(
        "trajectory", file, recording
    )


def test_rpe_is_said_to_be_over_frames_of_the_recording(results, capsys, tmp_path):
    folder = with_metrics(results, tmp_path / "copy")
    shutil.copy(folder / "trajectory.txt", folder / "tracking.txt")
    with open(folder / "tracking.txt", "a") as file:
        file.write("7 0 0 0 0 0 0 1\n")
    assert cli.main(["evaluate", "trajectory", str(folder)]) == 0
    out = capsys.readouterr().out
    assert "RPE, translation over 3 frames [cm]" in out
    assert "poses of the 3 frames that were mapped; --tracked judges all 4" in out
    poses = str(folder / "trajectory.txt")
    assert cli.main(["evaluate", "trajectory", poses, poses, "--rpe-delta", "2"]) == 0
    assert "RPE, translation over 2 poses [cm]" in capsys.readouterr().out


def test_trajectory_table(results, capsys):
    assert (
        cli.main(
            ["evaluate", "trajectory", str(results), "--rpe-unit", "metres", "--rpe-delta", "99"]
        )
        == 0
    )
    out = capsys.readouterr().out
    assert (
        "ATE, aligned [cm]" in out
        and "RPE, translation over 99 metres [cm]" in out
        and "3 of 3 estimated poses" in out
        and "they are compared with themselves" in out
    )


# --- segmentation ---------------------------------------------------------------------------------------------------


def test_segmentation_of_every_kind_of_file(evaluate, tmp_path):
    (tmp_path / "given.txt").write_text("# from a network\n1\n2\n\n2.0\n-1\n")
    np.save(tmp_path / "true.npy", np.array([1, 2, 1, 2], np.uint8))
    (tmp_path / "names.txt").write_text("﻿# classes\r\n1 kitchen table\r\n2  lamp\r\n")
    found = evaluate(
        "segmentation",
        tmp_path / "given.txt",
        tmp_path / "true.npy",
        "--names",
        tmp_path / "names.txt",
        "--unseen",
        "lamp",
    )
    assert found["overall_accuracy"] == 0.5 and found["unlabelled"] == 1
    table, lamp = ((c["name"], c["iou"], c["seen"]) for c in found["classes"])
    assert (table, lamp) == (("kitchen table", 0.5, True), ("lamp", 1 / 3, False))
    assert found["unseen"]["mean_iou"] == pytest.approx(1 / 3)
    by_label = evaluate(
        "segmentation",
        tmp_path / "given.txt",
        tmp_path / "true.npy",
        "--unseen",
        "2",
        "--ignore",
        "1",
    )
    assert [c["name"] for c in by_label["classes"]] == ["2"] and by_label["seen"] is None


def test_segmentation_carries_labels_between_meshes(evaluate, tmp_path):
    coarse, fine = (
        rectangle((0, 0), (1, 1), 0.0, steps=4),
        rectangle((0, 0), (1, 1), 0.01, steps=20),
    )
    for name, mesh in (("coarse", coarse), ("fine", fine)):
        mesh.with_attribute("class", mesh.vertices[:, 0] > 0.63).save(tmp_path / f"{name}.ply")
    arguments = [
        "segmentation",
        tmp_path / "coarse.ply",
        tmp_path / "fine.ply",
        "--attribute",
        "class",
        "--max-distance",
    ]
    assert evaluate(*arguments, "0.3")["overall_accuracy"] == 1
    assert evaluate(*arguments, "0.05")["unlabelled"] > 0
    same = evaluate("segmentation", tmp_path / "fine.ply", *arguments[2:], "1e-9")
    assert same["overall_accuracy"] == 1 and same["unlabelled"] == 0


def test_segmentation_table(capsys, tmp_path):
    for name in ("a.txt", "b.txt"):
        (tmp_path / name).write_text("0\n0\n1\n")
    assert (
        cli.main(
            [
                "evaluate",
                "segmentation",
                str(tmp_path / "a.txt"),
                str(tmp_path / "b.txt"),
                "--unseen",
                "1",
            ]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["class", "IoU", "%", "accuracy", "%", "points"]
    assert [line.split() for line in lines[1:3]] == [
        ["0", "100.0", "100.0", "2"],
        ["1", "*", "100.0", "100.0", "1"],
    ]
    assert [line.split()[0] for line in lines[4:8]] == ["mean", "all", "seen", "unseen"]


# --- Bad input, at the command line ---------------------------------------------------------------------------------


@pytest.fixture
def files(tmp_path, monkeypatch):
    """Files of every bad kind in the working folder."""
    monkeypatch.chdir(tmp_path)
    Path("empty_folder").mkdir()
    mesh_of([], []).save("empty.ply")
    mesh_of([(0, 0, 0), (1, 0, 0), (0, 1, np.nan)], [(0, 1, 2)]).save("nan.ply")
    rectangle((0, 0), (1, 1), 0.0).save("square.ply")
    rectangle((50, 50), (51, 51), 0.0).save("far.ply")
    Path("text.ply").write_text("hello")
    Path("junk.glb").write_bytes(b"glTF\x02junk")
    Path("poses.txt").write_text("".join(f"{i} {i} 0 0 0 0 0 1\n" for i in range(5)))
    Path("later.txt").write_text("".join(f"{i + 100} {i} 0 0 0 0 0 1\n" for i in range(5)))
    Path("nan.txt").write_text("0 nan 0 0 0 0 0 1\n")
    Path("one.txt").write_text("1\n")
    Path("two.txt").write_text("1\n2\n")
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["surface", "nowhere.ply", "square.ply"], "nowhere.ply: no such file"),
        (["surface", "square.ply", "nowhere.ply"], "nowhere.ply: no such file"),
        (["surface", "square.ply"], "give the true mesh too"),
        (["surface", "empty_folder", "square.ply"], "empty_folder: holds no metrics.json"),
        (["surface", "text.ply", "square.ply"], "text.ply: not a PLY file"),
        (["surface", "junk.glb", "square.ply"], "junk.glb: cannot be read as a mesh"),
        (["surface", "poses.txt", "square.ply"], "poses.txt: meshes are read from .ply"),
        (["surface", "empty.ply", "square.ply"], "reconstruction: has no triangles"),
        (["surface", "nan.ply", "square.ply"], "1 of 3 vertices are not finite"),
        (["surface", "far.ply", "square.ply"], "do not overlap"),
        (["surface", "square.ply", "square.ply", "--thresholds", "-1"], "thresholds above 0"),
        (["surface", "square.ply", "square.ply", "--samples", "0"], "samples >= 1"),
        (
            ["surface", "square.ply", "square.ply", "--seen-by", "empty_folder"],
            "empty_folder: holds no metrics.json",
        ),
        (
            ["surface", "square.ply", "square.ply", "--seen-by", "x", "--whole"],
            "exclude each other",
        ),
        (
            ["surface", "square.ply", "square.ply", "--out", "square.ply/x.json"],
            "square.ply: cannot write",
        ),
        (["rendering", "square.ply"], "give the recording to compare the mesh with"),
        (["rendering", "square.ply", "folder", "nowhere"], "nowhere: no such file or folder"),
        (["rendering", "square.ply", "7scene", "nowhere"], "did you mean '7scenes'?"),
        (["rendering", "square.ply", "synthetic", "--start", "99"], "there is no frame 99"),
        (["rendering", "square.ply", "synthetic", "--every", "0"], "every >= 1"),
        (["trajectory", "poses.txt"], "give the true poses too"),
        (["trajectory", "poses.txt", "nowhere.txt"], "nowhere.txt: no such file"),
        (["trajectory", "poses.txt", "later.txt"], "0 of 5 estimated poses lie within 0.02 frames"),
        (["trajectory", "nan.txt", "poses.txt"], "nan.txt, line 1: holds NaN or infinite numbers"),
        (["trajectory", "square.ply", "poses.txt"], "square.ply"),
        (
            ["trajectory", "poses.txt", "poses.txt", "--rpe-delta", "0"],
            "rpe_delta must be a positive number",
        ),
        (["segmentation", "one.txt", "two.txt"], "1 predicted labels but 2 true ones"),
        (["segmentation", "one.txt", "nowhere.txt"], "nowhere.txt: no such file"),
        (["segmentation", "one.txt", "one.txt", "--ignore", "1"], "every true label is ignored"),
        (["segmentation", "one.txt", "one.txt", "--unseen", "lamp"], "give --names to use names"),
        (["segmentation", "square.ply", "one.txt"], "no vertex property 'label'"),
        (["trajectorie"], "surface, rendering, trajectory, segmentation"),
        ([], "surface, rendering, trajectory, segmentation"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(files, told, arguments, sentence):
    assert sentence in told(*arguments)


@pytest.mark.parametrize("metric", ["surface", "rendering", "trajectory"])
def test_a_folder_that_is_not_there_is_told(metric, told, tmp_path):
    assert "nope: no such file or folder" in told(metric, tmp_path / "nope")


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["surface", "RESULTS"], "a recording of format 'folder' holds no true surface; give one"),
        (["rendering", "RESULTS", "--every", "3"], "the run has used every one of these frames"),
        (
            ["rendering", "RESULTS", "--start", "2", "--end", "4"],
            "no frame half-way between those the run used is among 2 to 3 of",
        ),
        (
            ["rendering", "RESULTS", "--end", "1"],
            "held-out ones with --every 1, or used ones with --all",
        ),
        (
            ["rendering", "RESULTS", "--start", "4", "--end", "6", "--all"],
            "no frame that the run used",
        ),
        (["rendering", "RESULTS", "--depth-max", "0.01"], "depth_min < depth_max"),
        (
            ["rendering", "RESULTS", "--depth-min", "50", "--depth-max", "60"],
            "none of 2 frames has a depth reading",
        ),
    ],
)
def test_results_that_do_not_fit_are_told(results, told, arguments, sentence):
    assert sentence in told(*(results if a == "RESULTS" else a for a in arguments))


def test_what_a_results_folder_lacks_is_told(results, truth, told, tmp_path):
    folder = with_metrics(results, tmp_path / "copy", path="gone")
    assert "gone: no such file or folder" in told("surface", folder, truth)
    (folder / "mesh.ply").unlink()
    assert f"make it with: unifusion mesh {folder}" in told("rendering", folder)


def test_a_missing_colour_map_is_said_and_vertex_colours_are_judged(results, capsys, tmp_path):
    folder = with_metrics(results, tmp_path / "copy")
    (folder / "maps" / "color.safetensors").unlink()
    assert cli.main(["evaluate", "rendering", str(folder)]) == 0
    captured = capsys.readouterr()
    assert (
        "color.safetensors: no such file" in captured.err
        and "colour from the vertices" in captured.out
    )


@pytest.mark.parametrize("metric", ["surface", "rendering", "trajectory", "segmentation"])
def test_every_metric_has_help(metric, capsys):
    assert cli.main(["evaluate", metric, "--help"]) == 0
    out = capsys.readouterr().out
    assert f"unifusion evaluate {metric}" in out and "Example:" in out and "--json" in out
