"""Starting Taichi: what another process left behind does not slow it down."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from taichi_unifusion import runtime


@pytest.mark.parametrize(("age", "stays"), [(1, True), (3600, False)])
def test_only_an_old_lock_is_taken_from_the_cache_of_kernels(age, stays, tmp_path):
    """A fresh one belongs to a process that is writing; an old one to a process that was killed."""
    lock = tmp_path / "ticache.lock"
    lock.touch()
    os.utime(lock, (time.time() - age,) * 2)
    code = "import taichi_unifusion as uf; uf.init('cpu', threads=1)"
    subprocess.run(
        [sys.executable, "-c", code],
        check=True,
        env=os.environ | {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path)},
    )
    assert lock.exists() == stays


def test_a_cache_that_is_not_there_is_no_error(tmp_path):
    runtime._free_kernel_cache(str(tmp_path / "none"))
