"""Poor surroundings of a process: no home, no locale, closed files, a folder that is gone."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys

import pytest
from tiny_recording import FLAGS, make_frames, write_folder

from taichi_unifusion.files.maps import read_map

RUN = "import sys; from taichi_unifusion.cli.main import main; sys.exit(main(sys.argv[1:]))"


def run(arguments, **options):
    return subprocess.run(
        [sys.executable, "-c", RUN, *map(str, arguments)],
        capture_output=True,
        text=True,
        check=False,
        **options,
    )


def test_a_run_without_home_locale_docstrings_terminal_or_input(tmp_path):
    folder = write_folder(tmp_path / "Räume", make_frames(2))
    keep = {key: value for key, value in os.environ.items() if key in ("PATH", "PYTHONPATH")}
    poor = {"LANG": "C", "LC_ALL": "C", "TERM": "dumb", "PYTHONOPTIMIZE": "2", **keep}
    arguments = ["reconstruct", "folder", folder, "--out", tmp_path / "out", *FLAGS]
    done = run(arguments, env=poor, stdin=subprocess.DEVNULL, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "out" / "mesh.ply").exists() and "Traceback" not in done.stderr


@pytest.mark.parametrize("arguments", [["--help"], ["config"], ["info", "nowhere"]])
def test_commands_without_docstrings_in_a_folder_that_is_gone(tmp_path, arguments):
    gone = tmp_path / "gone"
    gone.mkdir()
    code = f"import os; os.rmdir({str(gone)!r})\n{RUN}"
    done = subprocess.run(
        [sys.executable, "-OO", "-c", code, *arguments],
        capture_output=True,
        text=True,
        check=False,
        cwd=gone,
    )
    assert done.returncode == (2 if "info" in arguments else 0), done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_input_and_output_end_no_command(closed):
    command = f'{sys.executable} -c "{RUN}"'
    assert subprocess.run(["bash", "-c", f"{command} config {closed}"], check=False).returncode == 0
    assert (
        subprocess.run(["bash", "-c", f"{command} info nowhere {closed}"], check=False).returncode
        == 2
    )


def test_a_run_with_everything_closed_writes_whole_files(tmp_path):
    """What is printed goes into no file that took the number of standard output."""
    folder = write_folder(tmp_path / "room", make_frames(2))
    words = ["reconstruct", "folder", folder, "--out", tmp_path / "out", *FLAGS]
    command = shlex.join([sys.executable, "-m", "taichi_unifusion", *map(str, words)])
    done = subprocess.run(["bash", "-c", f"{command} <&- >&- 2>&-"], check=False)
    assert done.returncode == 0
    files = [tmp_path / "out" / "maps" / f"{name}.safetensors" for name in ("surface", "color")]
    assert all(read_map(file)[0] for file in files)  # with their sums


def test_a_run_from_a_folder_that_is_gone_says_so(tmp_path):
    gone = tmp_path / "gone"
    gone.mkdir()
    code = f"import os; os.rmdir({str(gone)!r})\n{RUN}"
    words = ["reconstruct", "synthetic", "--end", "1", "--out", str(tmp_path / "out")]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=False, cwd=gone
    )
    assert done.returncode == 2 and done.stderr.splitlines()[-1].endswith(
        "the folder that this process was started in is gone; change to one that exists"
    )


@pytest.mark.parametrize("arguments", [["--help"], ["info", "--help"]])
def test_help_says_the_same_without_docstrings(arguments):
    command = ["-m", "taichi_unifusion", *arguments]
    plain, stripped = (
        subprocess.run(
            [sys.executable, *flags, *command], capture_output=True, text=True, check=True
        ).stdout
        for flags in ([], ["-OO"])
    )
    assert plain == stripped
