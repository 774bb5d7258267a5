"""One process writes into a results folder; one that was killed does not block the next."""

from __future__ import annotations

import fcntl
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from tiny_recording import FLAGS, make_frames, write_folder

from taichi_unifusion.cli import main as cli
from taichi_unifusion.errors import FileError
from taichi_unifusion.results import RunFolder, inspect
from taichi_unifusion.results.lock import Holder, lock_folder, who_writes

ROOT = Path(__file__).resolve().parents[2]
HOLD = """
import sys, time
from pathlib import Path
from taichi_unifusion.results.lock import lock_folder
from taichi_unifusion.results.run_folder import RunFolder
with lock_folder(RunFolder(Path(sys.argv[1]))):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def folder(tmp_path):
    return RunFolder(tmp_path / "out")


@pytest.fixture
def holder(folder):
    """Another process that holds the folder."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder.path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_R10_a_folder_is_held_once_and_free_afterwards(folder):
    with lock_folder(folder):
        assert json.loads(folder.lock.read_text())["pid"] == os.getpid()
        for shared in (False, True):
            with (
                pytest.raises(FileError, match="is in use by process"),
                lock_folder(folder, shared=shared),
            ):
                pass
    assert not folder.lock.exists()
    with (
        lock_folder(folder, shared=True),
        lock_folder(folder, shared=True),
        pytest.raises(FileError, match="is in use"),
        lock_folder(folder),
    ):
        pass
    assert not folder.lock.exists() and who_writes(folder) is None


def test_R10_a_second_run_into_one_folder_is_refused(holder, folder, tmp_path, capsys):
    recording = write_folder(tmp_path / "recording", make_frames(1))
    arguments = ["reconstruct", "folder", str(recording), *FLAGS, "--out", str(folder.path)]
    assert cli.main(arguments) == 2
    said = capsys.readouterr().err
    assert f"is in use by process {holder.pid} on" in said and "frame 1" not in said
    folder.trajectory.write_text("0 0 0 0 0 0 0 1\n")
    folder.record.write_text("{}")
    assert f"writing process {holder.pid}" in inspect(folder.path).text

    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert folder.lock.exists() and who_writes(folder) is None
    folder.record.unlink()
    assert cli.main([*arguments, "--overwrite"]) == 0 and not folder.lock.exists()


def test_R10_the_lock_of_another_machine_counts_until_somebody_deletes_it(folder):
    folder.path.mkdir()
    folder.lock.write_text('{"pid": 1, "host": "elsewhere\\u001b[31m", "since": "2026-01-01"}')
    with (
        pytest.raises(FileError, match="if that has ended, delete .*run.lock") as error,
        lock_folder(folder),
    ):
        pass
    assert "\x1b" not in str(error.value) and who_writes(folder).pid == 1
    folder.lock.write_text("nothing that makes sense")
    with lock_folder(folder):
        pass


def test_R10_without_locks_of_the_file_system_a_living_process_counts(folder, monkeypatch):
    def none(*arguments):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", none)
    folder.path.mkdir()
    this = Holder.this()
    for pid, lives in ((os.getppid(), True), (2**22 - 1, False)):
        folder.lock.write_text(json.dumps({"pid": pid, "host": this.host, "since": "now"}))
        if lives:
            with pytest.raises(FileError, match="is in use"), lock_folder(folder):
                pass
        else:
            with lock_folder(folder):
                pass


def test_R10_the_lock_follows_no_link(folder, tmp_path):
    folder.path.mkdir()
    (tmp_path / "victim").write_text("mine")
    folder.lock.symlink_to(tmp_path / "victim")
    with pytest.raises(FileError, match="cannot lock"), lock_folder(folder):
        pass
    assert (tmp_path / "victim").read_text() == "mine"
