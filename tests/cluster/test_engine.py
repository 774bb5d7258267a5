"""The engine: results come back, errors too, and work of a lost worker is done again."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from taichi_unifusion.cluster import work
from taichi_unifusion.cluster.engine import KERNELS, ClusterSettings, open_engine
from taichi_unifusion.config import Config
from taichi_unifusion.errors import FileError, InputError, UniFusionError
from taichi_unifusion.maps.pool import Pool
from taichi_unifusion.maps.voxel_data import VoxelField

pytest.importorskip("distributed", reason="needs Dask: pip install 'taichi-unifusion[cluster]'")


def double(number: int, folder: str) -> tuple[int, int]:
    """Twice a number; 3 ends its worker when it is asked for the first time, 4 is refused."""
    first = Path(folder) / "was-here"
    if number == 3 and not first.exists():
        first.touch()
        os._exit(9)
    if number == 4:
        raise FileError("4.png: no such file")
    return 2 * number, os.getpid()


def test_work_is_done_elsewhere_and_again_where_a_worker_is_lost(tmp_path):
    done = []
    with open_engine(ClusterSettings(workers=1)) as engine:
        found = engine.map(
            double, [(n, str(tmp_path)) for n in range(1, 5)], lambda: done.append(1)
        )
    assert [each[0] for each in found[:3]] == [2, 4, 6]
    assert isinstance(found[3], FileError) and "4.png" in str(found[3])
    assert os.getpid() not in {each[1] for each in found[:3]} and len(done) == 4


def compiled(count: int) -> str:
    """Where this worker keeps its kernels, of which it has compiled one."""
    work.start(Config(device="cpu", threads=1))
    Pool(VoxelField("rows", np.dtype(np.float32), (1,)), count).take(np.zeros(1, np.int32))
    return os.environ[KERNELS]


def test_kernels_are_on_disk_when_a_worker_of_this_machine_has_ended(tmp_path, monkeypatch):
    """It is ended before Taichi would write them, so that each start would compile all again."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(KERNELS, raising=False)
    with open_engine(ClusterSettings(workers=1)) as engine:
        (folder,) = engine.map(compiled, [(4,)])
    assert folder == str(tmp_path / "taichi_unifusion" / "worker-0")
    assert list(Path(folder).glob("*.tic"))


def test_workers_that_are_given_up_are_started_again(tmp_path, monkeypatch):
    """As Dask gives up those that end while they start; without others the work would wait forever."""
    monkeypatch.setattr("taichi_unifusion.cluster.engine.STARTING", 3)
    with open_engine(ClusterSettings(workers=1)) as engine:
        cluster = engine._local
        cluster.sync(cluster.workers[0].close)
        wait_for(lambda: not engine.workers)
        del cluster.workers[0]
        deadline = time.monotonic() + 120
        found = engine.map(double, [(1, str(tmp_path))], stop=lambda: time.monotonic() > deadline)
        assert found[0] and found[0][0] == 2
        assert engine.workers == 1


def test_nobody_answers_at_the_address(monkeypatch):
    monkeypatch.setattr("taichi_unifusion.cluster.engine.CONNECTING", 2)
    cluster = ClusterSettings(cluster="tcp://127.0.0.1:1")
    with pytest.raises(InputError, match="no scheduler answers"), open_engine(cluster):
        pass


def test_the_scheduler_is_lost(tmp_path):
    """Nobody waits forever, and it is said."""
    file = tmp_path / "scheduler.json"
    command = ["dask", "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"]
    scheduler = subprocess.Popen(
        [sys.executable, "-m", *command, "--scheduler-file", str(file)],
        stderr=subprocess.DEVNULL,
    )
    try:
        wait_for(lambda: file.exists() and file.read_text().strip().endswith("}"))
        address = json.loads(file.read_text())["address"]

        def stop() -> bool:  # asked while work waits for workers that never come
            scheduler.kill()
            return False

        with (
            open_engine(ClusterSettings(cluster=address)) as engine,
            pytest.raises(UniFusionError, match="scheduler .* is gone"),
        ):
            engine.map(double, [(1, str(tmp_path))], stop=stop)
    finally:
        scheduler.kill()
        scheduler.wait()


def wait_for(there, seconds: float = 60) -> None:
    """Until `there` says so."""
    deadline = time.monotonic() + seconds
    while not there():
        assert time.monotonic() < deadline, "the scheduler did not start"
        time.sleep(0.1)


def test_workers_are_counted_and_one_place_is_named():
    with pytest.raises(InputError, match="workers"):
        ClusterSettings(workers=-1)
    with pytest.raises(InputError, match="one of"):
        ClusterSettings(workers=2, cluster="tcp://x:1")
    assert not ClusterSettings().wanted and ClusterSettings(workers=1).share >= 1
