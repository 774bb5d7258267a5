"""The command line as a user meets it: exit codes, messages, files, and what a bad day leaves
behind.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import resource
import runpy
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from tiny_recording import CONFIG, DEVICE, FLAGS, make_frames, write_folder

import taichi_unifusion as uf
from taichi_unifusion.cli import main as cli
from taichi_unifusion.cli.info import Info
from taichi_unifusion.config import Config, dump_config, load_config
from taichi_unifusion.files.maps import read_map
from taichi_unifusion.files.mesh_reading import read_any_mesh, read_mesh
from taichi_unifusion.files.trajectories import read_trajectory
from taichi_unifusion.results import writer as results

ROOT = Path(__file__).resolve().parents[2]
OUTPUTS = [
    "config.yaml",
    "maps/color.safetensors",
    "maps/surface.safetensors",
    "mesh.glb",
    "mesh.ply",
    "metrics.json",
    "preview.png",
    "trajectory.txt",
]
# bytes; trajectory, configuration and metrics are smaller, maps, meshes and preview larger
FILE_LIMIT = 20_000
LINKED_FRAMES = 3000  # enough to be interrupted in the middle on any machine
SAME_VERTEX = 2e-6  # [m] rounding of float32: another map's kernels are compiled anew
SAME_COLOR = 1.01 / 255  # 8-bit colours that round the other way
PATIENCE = 120  # [s] for a process that has to start Taichi on a busy machine


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("data") / "recording", make_frames(3))


@pytest.fixture(scope="module")
def made(recording, tmp_path_factory):
    """A results folder; tests that change it work on a copy."""
    out = tmp_path_factory.mktemp("results") / "made"
    assert cli.main(["reconstruct", "folder", str(recording), *FLAGS, "--out", str(out)]) == 0
    return out


@pytest.fixture
def spoiled(recording, tmp_path):
    """The recording with its second depth image cut short."""
    folder = shutil.copytree(recording, tmp_path / "spoiled")
    image = folder / "depth" / "1.png"
    image.write_bytes(image.read_bytes()[:200])
    return folder


def files_in(folder: Path) -> list[str]:
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


# --- Exit codes and messages ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["--help"], 0, ["reconstruct", "transfer", "mesh", "info", "config"]),
        (["--version"], 0, [f"unifusion {uf.__version__}"]),
        (
            ["reconstruct", "--help"],
            0,
            [
                "FORMAT",
                "synthetic, 7scenes, replica, tum, scannet, k4a, folder",
                "--every",
                "unifusion config --help",
            ],
        ),
        (
            ["transfer", "--help"],
            0,
            ["--property NAME[=SETTINGS]", "infrared, saliency, style, images, normal, curvature"],
        ),
        (
            ["config", "--help"],
            0,
            ["--surface.voxel-size", "--preprocess.depth-max", "--mesh.resolution"],
        ),
        (
            [],
            2,
            [
                "reconstruct, transfer, understand, query, segment, view, render, mesh, merge, batch,",
                "repose,",
                "info, formats, config",
            ],
        ),
        (
            ["reconstrukt", "7scenes", "x", "--out", "o"],
            2,
            ["command: 'reconstrukt' is unknown (did you mean 'reconstruct'?)"],
        ),
        (
            ["reconstruct", "7scene", "x", "--out", "o"],
            2,
            ["'7scene' is unknown (did you mean '7scenes'?)", "scannet"],
        ),
        (
            ["reconstruct", "folder", "nowhere", "--out", "o"],
            2,
            ["nowhere: no such file or folder"],
        ),
        (["reconstruct", "synthetic"], 2, ["--out"]),
        (
            ["reconstruct", "synthetic", "--out", "o", "--surface.voxel-siz", "1"],
            2,
            ["--surface.voxel-size"],
        ),
        (
            ["reconstruct", "synthetic", "--out", "o", "--surface.voxel-size", "-1"],
            2,
            ["voxel_size: must lie in 0.0001..2 metres"],
        ),
        (
            ["reconstruct", "synthetic", "--out", "o", "--depth-scale", "1000"],
            2,
            ["'depth_scale' is unknown for format"],
        ),
        (
            ["reconstruct", "synthetic", "--out", "o", "--start", "60"],
            2,
            ["there is no frame 60, it has 60 (0 is the first)"],
        ),
        (["reconstruct", "synthetic", "--out", "o", "--every", "0"], 2, ["every >= 1"]),
        (
            ["reconstruct", "synthetic", "--out", "o", "--start", "5", "--end", "5"],
            2,
            ["start < end"],
        ),
        (["config", "--device", "gpu"], 2, ["auto", "cuda", "cpu"]),
        (["config", "--config", "none.yaml"], 2, ["none.yaml: no such file"]),
        (["info", "nowhere"], 2, ["nowhere: no such file or folder"]),
        (["mesh", "nowhere"], 2, ["nowhere: no maps/surface.safetensors"]),
        (["mesh", "nowhere", "--out", "x.stl"], 2, [".ply, .glb, .obj"]),
    ],
)
def test_V4_exit_codes_and_messages(arguments, code, told, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments) == code
    captured = capsys.readouterr()
    said = " ".join((captured.err if code else captured.out).replace("│", " ").split())
    for part in told:
        assert part in said
    assert "Traceback" not in said and not any(tmp_path.iterdir())


def test_V4_interrupted_is_130(monkeypatch, capsys):
    def interrupted(options):
        raise KeyboardInterrupt

    monkeypatch.setitem(cli.COMMANDS, "info", (Info, interrupted))
    assert cli.main(["info", "x"]) == 130
    assert "stopped" in capsys.readouterr().err


def test_debug_shows_where_an_error_comes_from(monkeypatch):
    monkeypatch.setenv("UNIFUSION_DEBUG", "1")
    with pytest.raises(uf.UniFusionError):
        cli.main(["info", "nowhere"])


def test_a_reader_that_leaves_early_is_no_error():
    code = "import sys\nfrom taichi_unifusion.cli.main import main\nsys.exit(main(['config', '--help']))"
    process = subprocess.Popen(
        [sys.executable, "-c", code], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    )
    process.stdout.close()
    assert process.stderr.read() == b"" and process.wait() == 0
    process.stderr.close()


# --- config ---------------------------------------------------------------------------------------------------------


def test_config_prints_what_it_reads(tmp_path, capsys):
    assert cli.main(["config", *FLAGS]) == 0
    printed = capsys.readouterr().out
    assert yaml.safe_load(printed) == yaml.safe_load(dump_config(CONFIG))
    (tmp_path / "all.yaml").write_text(printed)
    assert cli.main(["config", "--config", str(tmp_path / "all.yaml")]) == 0
    assert capsys.readouterr().out == printed


def test_flags_count_more_than_the_file_and_the_file_more_than_defaults(tmp_path, capsys):
    path = tmp_path / "some.yaml"
    path.write_text("threads: 2\nsurface: {voxel_size: 0.2, noise: 3}\n")
    assert cli.main(["config", f"--config={path}", "--surface.voxel-size", "0.3"]) == 0
    (tmp_path / "printed.yaml").write_text(capsys.readouterr().out)
    config = load_config(tmp_path / "printed.yaml")
    assert (config.surface.voxel_size, config.surface.noise, config.threads) == (0.3, 3.0, 2)
    assert config.color == Config().color


def test_an_unknown_key_names_the_right_ones(tmp_path, capsys):
    path = tmp_path / "some.yaml"
    path.write_text("surface: {voxelsize: 1}\n")
    assert (
        cli.main(["reconstruct", "synthetic", "--config", str(path), "--out", str(tmp_path / "o")])
        == 2
    )
    assert "'surface.voxelsize' (did you mean 'voxel_size'?)" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()


def test_a_command_leaves_the_processor_to_taichi():
    """NumPy reads it when it is imported, so nothing may import it before; users may say else."""
    code = (
        "import taichi_unifusion.cli, os, sys; before = 'numpy' in sys.modules;"
        "import taichi_unifusion.cli.main; print(before, os.environ['OPENBLAS_NUM_THREADS'])"
    )
    for asked, used in ((None, "1"), ("3", "3")):
        environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
        done = subprocess.run(
            [sys.executable, "-c", code],
            env=environment | ({"OPENBLAS_NUM_THREADS": asked} if asked else {}),
            capture_output=True,
            text=True,
            check=True,
        )
        assert done.stdout.split() == ["False", used]


# --- reconstruct ----------------------------------------------------------------------------------------------------


def test_the_results_folder_holds_everything(made):
    assert files_in(made) == OUTPUTS
    mesh = read_mesh(made / "mesh.ply")
    assert len(mesh.faces) > 0 and mesh.normals is not None and "color" in mesh.attributes
    assert load_config(made / "config.yaml") == CONFIG.settled(())
    assert len(read_trajectory(made / "trajectory.txt")) == 3
    assert (made / "preview.png").read_bytes()[:4] == b"\x89PNG"
    glb = read_any_mesh(made / "mesh.glb")
    assert np.array_equal(glb.vertices, mesh.vertices) and np.array_equal(glb.faces, mesh.faces)
    np.testing.assert_allclose(glb.attributes["color"], mesh.attributes["color"], atol=1e-6)


def test_the_glb_stands_upright_as_the_record_says(made, tmp_path):
    def turn(folder):
        data = (folder / "mesh.glb").read_bytes()
        said = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
        return np.reshape(said["nodes"][0]["matrix"], (4, 4)).T

    T_up_world = np.array(json.loads((made / "metrics.json").read_text())["T_up_world"])
    np.testing.assert_allclose(turn(made)[1], T_up_world[2], atol=1e-9)  # y is up
    copy = shutil.copytree(made, tmp_path / "copy")
    assert cli.main(["mesh", str(copy), "--up", "x", "--device", DEVICE]) == 0
    np.testing.assert_allclose(turn(copy)[1, :3], [1, 0, 0], atol=1e-9)


def test_the_metrics_agree_with_the_files(made):
    metrics = json.loads((made / "metrics.json").read_text())
    mesh = read_mesh(made / "mesh.ply")
    assert metrics["mesh"] == {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
    assert (metrics["device"], metrics["frames"]["used"], metrics["frames"]["skipped"]) == (
        DEVICE,
        3,
        0,
    )
    assert list(metrics["milliseconds"]) == [
        "load",
        "preprocess",
        "sum",
        "surface",
        "color",
        "frame",
    ]  # all of it is in one window, which is fused after the last frame, as a part of it
    assert all(
        value["median"] > 0 and value["mean"] > 0
        for stage, value in metrics["milliseconds"].items()
        if stage != "load"
    )
    for name, entry in metrics["maps"].items():
        file = made / "maps" / f"{name}.safetensors"
        assert (entry["voxels"], entry["file_bytes"]) == (
            len(read_map(file)[0]["keys"]),
            file.stat().st_size,
        )
        assert entry["bytes"] > 0
    assert (
        metrics["peak_memory_bytes"] > 50e6
        and metrics["seconds"]["mesh"] > 0
        and "taichi" in metrics["versions"]
    )
    assert metrics["errors"] == metrics["warnings"] == []


def test_V4_json_alone_on_stdout_and_no_bar_without_a_screen(recording, tmp_path, capfd):
    assert (
        cli.main(
            [
                "reconstruct",
                "folder",
                str(recording),
                *FLAGS,
                "--start",
                "1",
                "--every",
                "5",
                "--json",
                "--mesh.formats",
                "obj",
                "--out",
                str(tmp_path),
            ]
        )
        == 0
    )
    captured = capfd.readouterr()
    metrics = json.loads(captured.out)
    assert metrics["frames"]["used"] == 1 and metrics == json.loads(
        (tmp_path / "metrics.json").read_text()
    )
    assert "frame 1 of 1" in captured.err
    assert "\x1b" not in captured.err and "\r" not in captured.err and "━" not in captured.err
    assert (tmp_path / "mesh.obj").exists() and not (tmp_path / "mesh.ply").exists()


def test_F7_a_truncated_image_is_skipped_listed_and_the_run_ends_well(spoiled, tmp_path, capsys):
    arguments = ["reconstruct", "folder", str(spoiled), *FLAGS, "--out", str(tmp_path / "out")]
    assert cli.main(arguments) == 0
    captured = capsys.readouterr()
    assert captured.err.rstrip().splitlines()[-1] == (
        "unifusion: warning: 1 of 3 frames are not in the map: 1 unreadable image"
    )
    image = str(spoiled / "depth" / "1.png")
    assert (
        "2 used, 1 skipped" in captured.out
        and image in captured.out
        and captured.err.count(image) == 1
    )
    frames = json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"]
    assert [(entry["frame"], image in entry["message"]) for entry in frames["skipped_frames"]] == [
        (1, True)
    ]

    assert cli.main([*arguments, "--strict"]) == 2  # and the results so far are on disk
    captured = capsys.readouterr()
    ended, missing = captured.err.rstrip().splitlines()[-2:]
    assert ended.startswith(f"unifusion: error: {image}")
    assert missing == (
        "unifusion: error: 2 of 3 frames are not in the map: 1 unreadable image, 1 not reached"
    )
    assert "ended early after 2 of 3 frames" in captured.err
    assert files_in(tmp_path / "out") == OUTPUTS
    assert len(read_trajectory(tmp_path / "out" / "trajectory.txt")) == 1


def test_no_usable_frame_is_an_error_and_writes_nothing(recording, tmp_path, capsys):
    out = tmp_path / "out"
    assert (
        cli.main(
            [
                "reconstruct",
                "folder",
                str(recording),
                *FLAGS,
                "--depth-scale",
                "1e6",
                "--out",
                str(out),
            ]
        )
        == 2
    )
    error = capsys.readouterr().err
    assert (
        "none of 3 frames could be used, 3 for 'no usable depth'" in error
        and "is depth_scale 1000" in error
    )
    assert files_in(out) == []


@pytest.mark.parametrize("what", ["a file stands in the way", "read-only"])
def test_R6_a_folder_that_cannot_be_written_is_told_before_the_first_frame(
    what, recording, tmp_path, capsys
):
    target = tmp_path / "taken"
    if what == "read-only":
        target.mkdir(mode=0o500)
        if os.access(target, os.W_OK):
            pytest.skip("this user may write anywhere")
    else:
        target.write_text("mine")
    assert (
        cli.main(["reconstruct", "folder", str(recording), *FLAGS, "--out", str(target / "out")])
        == 2
    )
    error = capsys.readouterr().err
    assert str(target / "out") in error and "frame 1 of" not in error


def test_a_folder_that_is_used_again_holds_one_run(made, recording, tmp_path, capsys):
    """Maps, properties and answers of an earlier run go, which is said; other people's files stay."""
    out = shutil.copytree(made, tmp_path / "out")
    old = ["maps/style.safetensors", "style.ply", "style.png", "mesh.obj", "tracking.txt"]
    answers = ["query-sofa.ply", "query-sofa.png", "query.json", "segmentation.ply"]
    others = ["maps/my_llm.safetensors", "query-notes.png", "segmentation.md", "photo.png", "a.obj"]
    for name in [*old, *answers, *others]:
        (out / name).write_text("of somebody")
    record = json.loads((out / "metrics.json").read_text())
    record |= {"files": record["files"] | dict.fromkeys(old, 11), "answers": answers}
    (out / "metrics.json").write_text(json.dumps(record))
    assert cli.main(["reconstruct", "folder", str(recording), *FLAGS, "--out", str(out)]) == 0
    assert files_in(out) == sorted([*OUTPUTS, *others])
    assert all((out / name).read_text() == "of somebody" for name in others)
    (said,) = (line for line in capsys.readouterr().err.splitlines() if "earlier run" in line)
    assert f"{out} holds an earlier run (maps color, style, surface; a mesh; answers)" in said


def test_a_run_that_fails_leaves_an_earlier_one_alone_and_no_empty_folder(made, tmp_path):
    blind = write_folder(
        tmp_path / "blind", [replace(frame, depth=0 * frame.depth) for frame in make_frames(2)]
    )
    kept = shutil.copytree(made, tmp_path / "kept")
    for out in (tmp_path / "new", kept):
        assert cli.main(["reconstruct", "folder", str(blind), *FLAGS, "--out", str(out)]) == 2
    assert list((tmp_path / "new").iterdir()) == []
    assert files_in(kept) == OUTPUTS


def test_one_failing_output_does_not_cost_the_others(recording, tmp_path, monkeypatch, capsys):
    def full(path, mesh, *rest):
        if path.suffix == ".glb":
            raise OSError(errno.ENOSPC, "No space left on device")
        return write_mesh(path, mesh, *rest)

    def broken(*arguments, **options):
        raise RuntimeError("out of ink")

    write_mesh = results.write_mesh
    monkeypatch.setattr(results, "write_mesh", full)
    monkeypatch.setattr(results, "draw_views", broken)
    assert (
        cli.main(
            ["reconstruct", "folder", str(recording), *FLAGS, "--end", "1", "--out", str(tmp_path)]
        )
        == 2
    )
    error = capsys.readouterr().err
    assert f"{tmp_path / 'mesh.glb'}: could not be written" in error and "No space left" in error
    assert f"{tmp_path / 'preview.png'}: could not be written" in error and "out of ink" in error
    assert files_in(tmp_path) == [
        name for name in OUTPUTS if name not in ("mesh.glb", "preview.png")
    ]
    assert len(json.loads((tmp_path / "metrics.json").read_text())["errors"]) == 2


def test_R5_a_file_size_limit_keeps_the_old_files_whole(recording, made, tmp_path, capsys):
    out = shutil.copytree(made, tmp_path / "out")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_LIMIT, hard))
    try:
        assert (
            cli.main(
                ["reconstruct", "folder", str(recording), *FLAGS, "--end", "1", "--out", str(out)]
            )
            == 2
        )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    error = capsys.readouterr().err
    for name in OUTPUTS:
        if (made / name).stat().st_size > FILE_LIMIT:
            assert str(out / name) in error and "file-size limit" in error
            assert (out / name).read_bytes() == (made / name).read_bytes()
    assert files_in(out) == OUTPUTS and len(read_trajectory(out / "trajectory.txt")) == 1


def test_an_empty_mesh_is_said_and_the_rest_is_written(recording, tmp_path, capsys):
    assert (
        cli.main(
            [
                "reconstruct",
                "folder",
                str(recording),
                *FLAGS,
                "--end",
                "1",
                "--surface.min-points",
                "100000",
                "--out",
                str(tmp_path),
            ]
        )
        == 2
    )
    assert "the mesh is empty" in capsys.readouterr().err
    assert files_in(tmp_path) == [
        name for name in OUTPUTS if name not in ("mesh.glb", "preview.png")
    ]


# --- Signals --------------------------------------------------------------------------------------------------------


@pytest.fixture
def long_run(recording, tmp_path):
    """A `reconstruct` process in the middle of its frames, its results folder, and its stderr as
    lines that wait for it.
    """
    folder = tmp_path / "long"
    for name in ("depth", "color", "poses"):
        (folder / name).mkdir(parents=True)
        for source in (recording / name).iterdir():
            for i in range(int(source.stem), LINKED_FRAMES, 3):
                (folder / name / f"{i}{source.suffix}").symlink_to(source)
    shutil.copy(recording / "camera.yaml", folder)
    out = tmp_path / "out"
    code = "import sys\nfrom taichi_unifusion.cli.main import main\nsys.exit(main(sys.argv[1:]))"
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            code,
            "reconstruct",
            "folder",
            str(folder),
            *FLAGS,
            "--out",
            str(out),
        ],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    watchdog = threading.Timer(PATIENCE, process.kill)
    watchdog.start()
    wait_for(process, "frame 1 of")
    yield process, out
    watchdog.cancel()
    process.kill()
    process.communicate()


def wait_for(process: subprocess.Popen, words: str) -> None:
    for line in process.stderr:
        if words in line:
            return
    raise AssertionError(f"the process ended without saying '{words}'")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_R3_a_signal_while_integrating_writes_everything(long_run, number):
    process, out = long_run
    process.send_signal(number)
    stdout, stderr = process.communicate()
    assert process.returncode == 130
    assert "stopped after" in stderr and "stopped early" in stdout and "Traceback" not in stderr
    assert files_in(out) == OUTPUTS  # and no .tmp
    frames = json.loads((out / "metrics.json").read_text())["frames"]
    assert frames["interrupted"] and 0 < frames["used"] < LINKED_FRAMES
    assert len(read_trajectory(out / "trajectory.txt")) == frames["used"]
    for name in ("surface", "color"):
        read_map(out / "maps" / f"{name}.safetensors")
    assert len(read_mesh(out / "mesh.ply").faces) > 0


def test_R3_a_second_signal_stops_at_once_and_leaves_no_temporary_file(long_run):
    process, out = long_run
    process.send_signal(signal.SIGINT)
    wait_for(process, "stopping: this frame")
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    _, stderr = process.communicate()
    assert process.returncode == 130 and time.monotonic() - began < PATIENCE / 4
    assert "unifusion: error: stopped" in stderr and "Traceback" not in stderr
    assert not [name for name in files_in(out) if name.endswith(".tmp")]


def test_a_signal_while_writing_finishes_the_writing(recording, tmp_path, monkeypatch, capfd):
    def interrupted(*arguments, **options):
        os.kill(os.getpid(), signal.SIGINT)
        return draw_views(*arguments, **options)

    draw_views, before = results.draw_views, signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(results, "draw_views", interrupted)
    assert (
        cli.main(
            ["reconstruct", "folder", str(recording), *FLAGS, "--end", "1", "--out", str(tmp_path)]
        )
        == 130
    )
    assert "stopping: " in capfd.readouterr().err
    assert files_in(tmp_path) == OUTPUTS
    assert signal.getsignal(signal.SIGINT) is before  # which a shell may have set to ignore it


# --- mesh and info --------------------------------------------------------------------------------------------------


def test_mesh_extracts_again_finer(made, tmp_path, capsys):
    out = tmp_path / "finer.ply"
    assert (
        cli.main(["mesh", str(made), "--resolution", "8", "--out", str(out), "--device", DEVICE])
        == 0
    )
    before, after = read_mesh(made / "mesh.ply"), read_mesh(out)
    assert len(after.faces) > 3 * len(before.faces)  # triangles of a surface grow with the square
    assert "color" in after.attributes
    assert str(out) in capsys.readouterr().out

    copy = shutil.copytree(made, tmp_path / "copy")
    for name in ("mesh.ply", "mesh.glb"):
        (copy / name).unlink()
    assert cli.main(["mesh", str(copy), "--device", DEVICE]) == 0
    again = read_mesh(copy / "mesh.ply")
    np.testing.assert_array_equal(again.faces, before.faces)
    np.testing.assert_allclose(again.vertices, before.vertices, atol=SAME_VERTEX)
    np.testing.assert_allclose(
        again.attributes["color"], before.attributes["color"], atol=SAME_COLOR
    )
    assert (copy / "mesh.glb").exists()


def test_mesh_leaves_no_picture_or_number_of_the_old_mesh(made, tmp_path):
    copy = shutil.copytree(made, tmp_path / "copy")
    (copy / "preview.png").write_bytes(b"of the old mesh")
    before = json.loads((copy / "metrics.json").read_text())
    assert cli.main(["mesh", str(copy), "--resolution", "2", "--device", DEVICE]) == 0
    mesh, after = read_mesh(copy / "mesh.ply"), json.loads((copy / "metrics.json").read_text())
    assert (copy / "preview.png").read_bytes()[:4] == b"\x89PNG"
    assert after["mesh"] == {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)}
    assert after["mesh"] != before["mesh"] and after["files"].keys() == before["files"].keys()
    assert after["files"]["mesh.ply"] == (copy / "mesh.ply").stat().st_size
    changed = {name for name in before if before[name] != after[name]}
    assert changed == {"mesh", "files"} and files_in(copy) == OUTPUTS


def test_info_describes_a_folder_a_map_and_a_mesh(made, recording, capsys):
    voxels = {
        name: f"{len(read_map(made / 'maps' / f'{name}.safetensors')[0]['keys']):,}"
        for name in ("surface", "color")
    }
    assert cli.main(["info", str(made)]) == 0
    text = capsys.readouterr().out
    for part in (
        *voxels.values(),
        "10 cm",
        "5 cm",
        "rank 20 of 256",
        "triangles",
        "normals, color",
        "3 used, 0 skipped",
        f"folder {recording}, frames 0 to the last",
    ):
        assert part in text
    assert cli.main(["info", str(made / "maps" / "color.safetensors")]) == 0
    assert voxels["color"] in capsys.readouterr().out
    assert cli.main(["info", str(made / "mesh.ply")]) == 0
    assert "triangles" in capsys.readouterr().out


def test_M2_info_names_a_damaged_map_and_still_shows_the_rest(made, tmp_path, capsys):
    copy = shutil.copytree(made, tmp_path / "copy")
    path = copy / "maps" / "surface.safetensors"
    data = bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    (copy / "metrics.json").write_text("{}")
    assert cli.main(["info", str(copy)]) == 2
    captured = capsys.readouterr()
    assert (
        f"{path}: tensor" in captured.err
        and "checksum" in captured.err
        and "metrics.json" in captured.err
    )
    assert "property, 3 channels" in captured.out and "triangles" in captured.out
    assert cli.main(["mesh", str(copy), "--device", DEVICE]) == 2
    assert "checksum" in capsys.readouterr().err


def test_weights_of_a_network_among_the_maps_stand_in_no_ones_way(made, tmp_path, capsys):
    copy = shutil.copytree(made, tmp_path / "copy")
    header = b'{"w":{"dtype":"BF16","shape":[2],"data_offsets":[0,4]}}'
    foreign = len(header).to_bytes(8, "little") + header + bytes(4)
    (copy / "maps" / "clip.safetensors").write_bytes(foreign)
    assert cli.main(["mesh", str(copy), "--resolution", "2", "--device", DEVICE]) == 0
    assert cli.main(["info", str(copy)]) == 0
    said = capsys.readouterr()
    assert "maps/clip.safetensors: written by another program" in said.out
    assert (copy / "maps" / "clip.safetensors").read_bytes() == foreign


def test_mesh_refuses_a_map_of_another_kind(made, tmp_path, capsys):
    copy = shutil.copytree(made, tmp_path / "copy")
    shutil.copy(copy / "maps" / "color.safetensors", copy / "maps" / "surface.safetensors")
    assert cli.main(["mesh", str(copy), "--device", DEVICE]) == 2
    assert "kind 'property', not 'surface'" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("x.safetensors", b"", "the file is empty"),
        ("x.safetensors", b"\x80\x04pickle..........", "a pickle"),
        ("x.png", b"\x89PNG\r\n\x1a\n", "not a map file"),
        ("x.ply", b"ply\n", "x.ply"),
    ],
)
def test_info_on_what_is_not_ours_is_one_sentence(tmp_path, capsys, name, content, told):
    path = tmp_path / name
    path.write_bytes(content)
    assert cli.main(["info", str(path)]) == 2
    error = capsys.readouterr().err
    assert told in error and str(path) in error and error.count("\n") == 1
    assert cli.main(["info", str(tmp_path)]) == 2
    assert "holds no results" in capsys.readouterr().err


def test_the_app_goes_through_the_same_pipeline(recording, tmp_path, monkeypatch, capsys):
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):  # or a window would wait for somebody
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "argv", ["reconstruct.py", "folder", str(recording), str(tmp_path)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_path(str(ROOT / "apps" / "reconstruct.py"), run_name="__main__")
    assert ended.value.code == 0
    assert "3 frames used, 0 skipped" in capsys.readouterr().out
    with contextlib.suppress(FileNotFoundError):
        (tmp_path / "mesh.obj").unlink()
    assert files_in(tmp_path) == OUTPUTS


def test_no_mesh_and_a_part_of_the_mesh(recording, tmp_path, capsys):
    out = tmp_path / "maps-only"
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, "--no-mesh"]
    assert cli.main([*arguments, "--out", str(out)]) == 0
    assert "mesh " not in capsys.readouterr().out.replace("for the mesh", "")
    assert (out / "maps" / "surface.safetensors").exists() and not (out / "mesh.ply").exists()
    assert not (out / "preview.png").exists()
    box = ["-0.5", "-0.5", "0", "0.5", "0.5", "1.5"]
    file = tmp_path / "part.ply"
    assert cli.main(["mesh", str(out), "--bounds", *box, "--out", str(file)]) == 0
    part = read_mesh(file)
    low, high = np.array(box, float).reshape(2, 3)
    assert len(part.faces) and ((part.vertices >= low) & (part.vertices <= high)).all()
