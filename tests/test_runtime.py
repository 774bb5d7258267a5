"""Starting Taichi: what another process left behind does not slow it down."""

import inspect
import os
import re
import subprocess
import sys
import time

import pytest
import taichi as ti
from places import DEVICE

from taichi_unifusion import runtime
from taichi_unifusion.errors import InputError
from taichi_unifusion.kernel_cache import open_kernel_cache, seed_kernel_cache

GETFRAMEINFO = inspect.getframeinfo


@pytest.mark.parametrize(("age", "stays"), [(1, True), (3600, False), (-86400, False)])
def test_only_an_old_lock_is_taken_from_the_cache_of_kernels(age, stays, tmp_path):
    """A fresh one belongs to a process that is writing; an old one to a process that was killed, and
    one from tomorrow too: the clock was set back.
    """
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


@pytest.mark.parametrize(
    ("libraries", "answer", "said"),
    [
        ((), None, "no NVIDIA driver"),
        (("libcuda.so.1",), None, "make a link of that name to libcuda.so.1"),
        (("libcuda.so.1", "libcuda.so"), 1, "finds no device that works"),
        (("libcuda.so.1", "libcuda.so"), "never", "did not answer in 20 s"),
        (("libcuda.so.1", "libcuda.so"), 0, ""),
    ],
)
def test_X3_a_driver_that_cannot_be_used_is_found_out_without_starting_it(
    libraries, answer, said, monkeypatch
):
    def load(name):
        if name not in libraries:
            raise OSError(name)

    def run(command, timeout, **_):
        if answer == "never":
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, answer, stdout=f"{8 * runtime.GIB}\n")

    monkeypatch.setattr(runtime.ctypes, "CDLL", load)
    monkeypatch.setattr(runtime.subprocess, "run", run)
    found, memory = runtime._probe_cuda()
    assert said in found and bool(found) == bool(said)
    assert memory == (0 if said else 8 * runtime.GIB)


@pytest.mark.parametrize(
    ("memory_gb", "asked_gb", "pool_gb"),
    [(0, None, 2), (2, None, 1), (24, None, 6), (140, None, 8), (24, 20, 20), (0, 20, 20)],
)
def test_the_pool_for_voxels_follows_the_gpu(memory_gb, asked_gb, pool_gb):
    assert runtime._sparse_pool(asked_gb, memory_gb * runtime.GIB) == pool_gb * runtime.GIB


def test_a_pool_larger_than_the_gpu_is_refused():
    with pytest.raises(InputError, match="16 is more than the 8.0 GiB of the GPU"):
        runtime._sparse_pool(16, 8 * runtime.GIB)


def test_another_taichi_that_is_not_there_is_named(tmp_path):
    code = "import taichi_unifusion as uf; uf.init('cpu')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"UNIFUSION_TAICHI": "taichi_of_nobody"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert "UNIFUSION_TAICHI=taichi_of_nobody: there is no such package" in done.stderr


def test_a_cache_that_is_not_there_is_made(tmp_path, caplog):
    assert open_kernel_cache(str(tmp_path / "of" / "kernels")) == str(tmp_path / "of" / "kernels")
    assert (tmp_path / "of" / "kernels").is_dir() and not caplog.text


def test_a_new_worker_has_the_kernels_of_the_one_with_most(tmp_path, monkeypatch):
    """What it has itself stays as it is, and folders without a list are none."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    workers = tmp_path / "taichi_unifusion"
    seed_kernel_cache(workers / "worker-0")
    assert not workers.exists()  # nobody has any
    for name, kernels in (("taichi/ticache", 2), ("taichi_unifusion/worker-1", 3)):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "ticache.tcb").write_text(name)
        for n in range(kernels):
            (tmp_path / name / f"T{n}.tic").write_text(name)
    (workers / "broken").mkdir()
    for n in range(9):
        (workers / "broken" / f"T{n}.tic").touch()
    seed_kernel_cache(workers / "worker-0")
    assert sorted(file.name for file in (workers / "worker-0").iterdir()) == [
        "T0.tic",
        "T1.tic",
        "T2.tic",
        "ticache.tcb",
    ]
    (workers / "worker-0" / "T0.tic").write_text("own")
    seed_kernel_cache(workers / "worker-0")
    assert (workers / "worker-0" / "T0.tic").read_text() == "own"
    assert {each.name for each in workers.iterdir()} == {"broken", "worker-0", "worker-1"}


def test_a_cache_that_cannot_be_written_is_not_used_and_that_is_said(tmp_path):
    """Taichi would end the process, after everything is written or before."""
    (tmp_path / "file").touch()  # also for root, who may write everywhere, no folder
    code = "import taichi_unifusion as uf; uf.warm_up(); print('done')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ
        | {"TI_OFFLINE_CACHE_FILE_PATH": str(tmp_path / "file" / "cache"), "TMPDIR": str(tmp_path)},
    )
    assert done.returncode == 0 and done.stdout.endswith("done\n"), done.stderr
    assert done.stderr.count("compiled kernels cannot be kept in") == 1
    (mine,) = tmp_path.glob("taichi-kernels-of-*")
    assert mine.stat().st_mode & 0o77 == 0 and any(mine.iterdir())


def test_kernels_are_not_taken_from_a_folder_that_others_can_write(tmp_path, monkeypatch):
    monkeypatch.setattr("taichi_unifusion.kernel_cache.gettempdir", lambda: str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "file").touch()
    planted = tmp_path / f"taichi-kernels-of-{os.getuid()}"
    planted.mkdir()
    planted.chmod(0o777)
    found = open_kernel_cache(str(tmp_path / "file" / "cache"))
    assert found != str(planted) and os.stat(found).st_mode & 0o77 == 0


@ti.kernel
def faulty() -> ti.i32:
    return not_defined_anywhere  # noqa: F821  the fault


def test_an_error_in_a_kernel_still_says_where_it_is():
    """Also where Taichi is kept from drawing the source line of every expression."""
    with pytest.raises(ti.TaichiNameError) as error:
        faulty()
    assert re.search(r'test_runtime.py", line \d+, in faulty:\n +return not_def', str(error.value))


def test_what_taichi_reads_of_a_frame_is_what_python_says():
    def said() -> tuple:
        frame = sys._getframe(1)  # the line that calls
        found = inspect.getframeinfo(frame)
        return found.filename, found.function, [line.strip() for line in found.code_context or []]

    with runtime._frames_read_quickly():
        quickly = said()
        assert inspect.getframeinfo is not GETFRAMEINFO
    assert inspect.getframeinfo is GETFRAMEINFO
    slowly = said()
    assert quickly[:2] == slowly[:2]
    assert (quickly[2], slowly[2]) == (["quickly = said()"], ["slowly = said()"])


def test_methods_of_a_class_are_kernels_still():
    """Taichi tells a method from a function by the line that runs when it decorates it."""
    runtime.init(DEVICE)

    @ti.data_oriented
    class Counter:
        def __init__(self) -> None:
            self.seen = ti.field(ti.i32, 4)

        @ti.func
        def twice(self, n):
            return 2 * n

        @ti.kernel
        def count(self):
            for i in self.seen:
                self.seen[i] = self.twice(i)

    counter = Counter()
    counter.count()
    assert counter.seen.to_numpy().tolist() == [0, 2, 4, 6]


def test_kernels_compiled_sooner_leave_the_settings_as_they_were():
    runtime.init(DEVICE)
    config = runtime.import_taichi().lang.impl.current_cfg()

    @runtime.compiled_sooner()
    def inside() -> bool:
        return config.cfg_optimization

    assert [inside(), config.cfg_optimization, inside()] == [False, True, False]


def test_starting_under_a_redirected_output_prints_nothing_of_taichis_own():
    program = (
        "import contextlib, io\n"
        "with contextlib.redirect_stdout(io.StringIO()):\n"
        "    import taichi_unifusion as uf\n"
        "    uf.init('cpu')\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    assert "shell" not in done.stdout + done.stderr


def test_X3_without_a_gpu_the_cpu_is_used_which_is_said_once():
    code = (
        "import taichi_unifusion as uf; uf.init(); uf.init('auto'); uf.SurfaceMap(); uf.init('cpu')"
    )
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"CUDA_VISIBLE_DEVICES": "-1"},
    )
    assert (done.stdout + done.stderr).count(" on CPU (") == 1


def test_X3_cuda_that_is_asked_for_and_absent_is_an_error():
    code = "import taichi_unifusion as uf; uf.init('cuda')"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=os.environ | {"CUDA_VISIBLE_DEVICES": "-1"},
    )
    assert "RuntimeStateError: device: CUDA was asked for but" in done.stderr
