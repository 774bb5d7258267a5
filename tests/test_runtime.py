"""Starting Taichi: what another process left behind does not slow it down."""

import os
import re
import subprocess
import sys
import time

import pytest
import taichi as ti

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


@ti.kernel
def faulty() -> ti.i32:
    return not_defined_anywhere  # noqa: F821  the fault


def test_an_error_in_a_kernel_still_says_where_it_is():
    """Also where Taichi is kept from drawing the source line of every expression."""
    with pytest.raises(ti.TaichiNameError) as error:
        faulty()
    assert re.search(r'test_runtime.py", line \d+, in faulty:\n +return not_def', str(error.value))
