"""The one place that starts Taichi: chooses CUDA or the CPU, says which, and remembers it.

`ti.init` is global to the process, and a second one frees every field of the first: maps remember
the runtime that they were made under (`current()`) and refuse to go on under another.
"""

from __future__ import annotations

import ctypes
import inspect
import linecache
import logging
import os
import platform
import signal
import subprocess
import sys
import textwrap
import threading
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from functools import cache
from importlib import import_module
from io import StringIO
from pathlib import Path
from types import FrameType, SimpleNamespace
from typing import Any
from weakref import WeakSet

from .device_arrays import Arena
from .errors import (
    CapacityError,
    InputError,
    MissingDependency,
    RuntimeStateError,
    check_choice,
    check_whole,
)
from .kernel_cache import open_kernel_cache

logger = logging.getLogger(__name__)

DEVICES = ("auto", "cuda", "cpu")
MAX_THREADS = 4096  # of a CPU
MAX_TREES = 12
PROBE_SECONDS = 20.0  # a driver that has not answered by then is taken for broken
FORKED = """Taichi was started before this process was forked and does not run here: start processes by \
multiprocessing.get_context('spawn'), or fork before uf.init"""
OTHER_THREAD = """maps are used by the thread that started Taichi alone: do all work with maps there, and hand \
it frames and questions through a queue.Queue"""
STARTED_AGAIN = """Taichi was started again by other code (ti.init), and the memory of all maps is gone: use \
ti.init only before the first map, or start a new process"""
GIB = 1 << 30
# CUDA's pool for sparse voxels: this share of the GPU's memory within limits, and where that is not known
POOL_SHARE, POOL_LIMITS, POOL_UNKNOWN = 0.25, (1 * GIB, 8 * GIB), 2 * GIB


class Runtime:
    """A started Taichi: `device` is "cuda" or "cpu", `description` names it for people.

    `sparse_pool` is the size in bytes of the pool that the indices of all maps share on CUDA.
    """

    def __init__(self, device: str, description: str, sparse_pool: int = 0) -> None:
        self.device, self.description, self.sparse_pool = device, description, sparse_pool
        self._program = import_taichi().lang.impl.get_runtime().prog  # ti.init makes another one
        self._home = os.getpid(), threading.get_ident()
        self.arena = Arena()
        self.warm = (
            False  # whether a pipeline has begun with a frame, for which kernels are compiled
        )
        self.trees = 0  # index trees made
        # those of maps that are gone, with what the maps held: Taichi cannot free them
        self.free_trees: list[tuple[Any, Any]] = []
        self.grids: WeakSet[Any] = WeakSet()  # of the maps that live
        self.leaves: dict[Any, int] = {}  # index tree -> leaves that it ever had, at most
        # the index tree of the map that was made last, and by tree which ones came after it
        self.last_tree: Any = None
        self.followers: defaultdict[Any, set[Any]] = defaultdict(set)

    def check_here(self) -> None:
        """Raise RuntimeStateError where Taichi would crash or hang: in a forked process, in another
        thread than the one that started it, and after somebody else has started it again.
        """
        pid, thread = self._home
        if pid != os.getpid():
            raise RuntimeStateError(FORKED)
        if thread != threading.get_ident():
            raise RuntimeStateError(OTHER_THREAD)
        if self._program is not sys.modules["taichi"].lang.impl.get_runtime().prog:
            raise RuntimeStateError(STARTED_AGAIN)

    def count_tree(self) -> None:
        """Note that one more index tree is made; raises CapacityError before there are more than
        Taichi bears.
        """
        if self.trees >= MAX_TREES:
            raise CapacityError(
                f"more than {MAX_TREES} maps live at once: delete or save some, or use another process"
            )
        self.trees += 1


_runtime: Runtime | None = None


def init(
    device: str = "auto",
    *,
    threads: int | None = None,
    device_memory_gb: float | None = None,
    debug: bool = False,
) -> Runtime:
    """Start Taichi on CUDA if there is one, else on the CPU, and say which; a second call with the
    same device does nothing.

    `threads` caps the CPU threads, `device_memory_gb` is CUDA's fixed pool for sparse voxels [GiB]
    (a quarter of the GPU's memory, 1 to 8), `debug` checks array bounds. Raises InputError for an
    unknown device and a pool larger than the GPU, RuntimeStateError where CUDA is asked for and
    absent, another device is live, or the current folder is gone.
    """
    global _runtime
    check_choice("device", device, DEVICES)
    if threads is not None:
        check_whole("threads", threads, 0, MAX_THREADS)
    if _runtime is not None:
        if device in ("auto", _runtime.device):
            return current()
        raise RuntimeStateError(
            f"device: Taichi already runs on {_runtime.device}; start a new process to use {device}"
        )
    try:
        os.getcwd()  # Taichi asks for it
    except FileNotFoundError:
        raise RuntimeStateError(
            "the folder that this process was started in is gone; change to one that exists"
        ) from None
    ti = import_taichi()
    if not debug:
        _quicken_tracing()
    folder = os.environ.get("TI_OFFLINE_CACHE_FILE_PATH")
    folder = folder or ti.lang.impl.default_cfg().offline_cache_file_path
    folder = open_kernel_cache(folder)
    options = {"log_level": ti.ERROR, "default_fp": ti.f32, "default_ip": ti.i32}
    options |= {"offline_cache": True, "offline_cache_file_path": folder, "debug": debug}
    options |= {"cpu_max_num_threads": threads} if threads else {}
    trouble, memory = ("", 0) if device == "cpu" else _probe_cuda()
    if device == "cuda" and trouble:
        raise RuntimeStateError(f"device: CUDA was asked for but {trouble}; or use device 'cpu'")
    # never ti.gpu: Vulkan has no pointer SNodes
    wanted = ti.cpu if device == "cpu" or trouble else ti.cuda
    with redirect_stdout(StringIO()):  # what we run on is said by us, where people look for it
        pool = _sparse_pool(device_memory_gb, memory)
        ti.init(arch=wanted, device_memory_GB=pool / GIB, **options)
    found = "cuda" if ti.lang.impl.current_cfg().arch == ti.cuda else "cpu"
    if device == "cuda" and found != "cuda":
        raise RuntimeStateError(
            "device: CUDA was asked for but Taichi could not start it; check the NVIDIA driver, or "
            "use device 'cpu'"
        )
    if trouble and trouble != NO_DRIVER:  # there is a GPU, which somebody might want to use
        logger.warning("CUDA is not used: %s", trouble)
    cpu = f"CPU ({_cpu_name()}, {threads or os.cpu_count()} threads)"
    _runtime = Runtime(*(found, "CUDA GPU", pool) if found == "cuda" else (found, cpu, 0))
    name = "Taichi" if ti.__name__ == "taichi" else ti.__name__
    _say(f"{name} {'.'.join(map(str, ti.__version__))} on {_runtime.description}")
    return _runtime


def current() -> Runtime:
    """The live runtime, one with the defaults if there was none; raises RuntimeStateError."""
    if _runtime is None:
        return init()
    _runtime.check_here()
    return _runtime


def check_alive(runtime: Runtime) -> None:
    """Raise RuntimeStateError unless `runtime` is the live one, and can be used here and now."""
    if runtime is _runtime:
        runtime.check_here()
    else:
        raise RuntimeStateError(
            "this map was made before Taichi was started again and its memory is gone; save maps first, "
            "then load them in the new process"
        )


def synchronize() -> None:
    """Wait until the device has finished, so that a clock tells the truth."""
    import taichi as ti

    ti.sync()


def _quicken_tracing() -> None:
    """Let Taichi trace kernels in a third less time, which is what the first frame waits for.

    For every expression of a kernel it wraps the source line to 80 columns, for a message in case
    of an error; and it looks up and wraps the source of every function anew wherever a kernel calls
    it.
    """
    ti = import_taichi()
    kernel_impl, context = ti.lang.kernel_impl, ti.lang.ast.ast_transformer_utils

    def get_pos_info(self: Any, node: Any) -> str:
        line = self.src[node.lineno - 1].rstrip()
        number = node.lineno + self.lineno_offset
        return f'File "{self.file}", line {number}, in {self.func.func.__name__}:\n{line}\n'

    context.ASTTransformerContext.get_pos_info = get_pos_info
    for name in ("getsourcefile", "getsourcelines"):
        if hasattr(kernel_impl, name):  # not in every build of Taichi
            setattr(kernel_impl, name, cache(getattr(kernel_impl, name)))
    kernel_impl.textwrap = SimpleNamespace(fill=cache(textwrap.fill), dedent=textwrap.dedent)


@contextmanager
def compiled_sooner() -> Iterator[None]:
    """Kernels called inside, or in a function that this decorates, are compiled without Taichi's own
    analysis of control flow, whose time grows with the square of a kernel's length.

    That halves the compilation of the long kernels of the regression, to the same code: LLVM does
    that analysis again. Others end up longer. A kernel must always be called inside, or never.
    """
    ti = import_taichi()
    config = ti.lang.impl.current_cfg()
    before, config.cfg_optimization = config.cfg_optimization, False
    try:
        yield
    finally:
        config.cfg_optimization = before


def _say(sentence: str) -> None:
    if logger.hasHandlers():
        logger.info("%s", sentence)
    else:  # a script that has set up no logging
        print(sentence, file=sys.stderr)


@contextmanager
def _signals_later() -> Iterator[None]:
    """Ctrl-C and SIGTERM wait: in the middle of its import Taichi would call itself broken."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def import_taichi() -> Any:
    """Taichi, or what UNIFUSION_TAICHI names, such as `taichi_forge`; kernels are imported after it."""
    os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
    os.environ.setdefault("TI_ENABLE_PYBUF", "0")  # else a line where standard output is redirected
    os.environ.setdefault("HOME", os.path.expanduser("~"))  # without one Taichi ends the process
    name = os.environ.get("UNIFUSION_TAICHI") or "taichi"
    try:
        with _frames_read_quickly(), _signals_later():
            taichi = import_module(name)
            taichi.lang.kernel_impl.inspect = SimpleNamespace(**vars(inspect))  # quick for good
    except (ImportError, OSError) as error:
        if "libX11" in str(error):
            raise MissingDependency(
                "Taichi needs the system library libX11; run: apt-get install -y libx11-6"
            ) from error
        if name != "taichi" and isinstance(error, ModuleNotFoundError):
            raise MissingDependency(
                f"UNIFUSION_TAICHI={name}: there is no such package; install it or unset the variable"
            ) from error
        raise
    if name != "taichi":
        sys.modules["taichi"] = taichi
    return taichi


@contextmanager
def _frames_read_quickly() -> Iterator[None]:
    """While it is entered, `inspect.getframeinfo` reads a frame's line without going by every module
    there is: Taichi asks for that line at each function that it decorates, its own included.
    """

    def read_frame(frame: FrameType, context: int = 1) -> inspect.Traceback:
        file, number = frame.f_code.co_filename, frame.f_lineno
        lines = [linecache.getline(file, number)]
        return inspect.Traceback(file, number, frame.f_code.co_name, lines, 0)

    before, inspect.getframeinfo = inspect.getframeinfo, read_frame
    try:
        yield
    finally:
        inspect.getframeinfo = before


NO_DRIVER = "there is no NVIDIA driver (libcuda.so.1); install one"
# Starts the driver, counts its devices as Taichi would, and prints the bytes of the one that it takes.
_PROBE = """
import ctypes
driver = ctypes.CDLL("libcuda.so.1")
count, device, total = ctypes.c_int(), ctypes.c_int(), ctypes.c_size_t()
failed = driver.cuInit(0) or driver.cuDeviceGetCount(ctypes.byref(count)) or not count.value
if not failed and not driver.cuDeviceGet(ctypes.byref(device), 0):
    driver.cuDeviceTotalMem_v2(ctypes.byref(total), device)
print(total.value)
raise SystemExit(bool(failed))
"""


def _probe_cuda() -> tuple[str, int]:
    """Why CUDA cannot be used, as a clause that says what to do, "" where nothing speaks against
    it; and the GPU's memory in bytes, 0 where it is not known.

    A broken driver can hang whoever starts it, so a process of its own tries it first.
    """
    try:
        ctypes.CDLL("libcuda.so.1")
    except OSError:
        return NO_DRIVER, 0
    try:
        ctypes.CDLL("libcuda.so")  # the name that Taichi opens
    except OSError:
        return "Taichi needs libcuda.so; make a link of that name to libcuda.so.1", 0
    try:
        done = subprocess.run(
            [sys.executable, "-c", _PROBE],
            timeout=PROBE_SECONDS,
            capture_output=True,
            text=True,
            check=False,
        )
    except subprocess.TimeoutExpired:
        trouble = (
            f"the NVIDIA driver did not answer in {PROBE_SECONDS:.0f} s; check it with nvidia-smi"
        )
        return trouble, 0
    if done.returncode:
        return "the NVIDIA driver finds no device that works; check it with nvidia-smi", 0
    return "", int(done.stdout)


def _sparse_pool(asked_gb: float | None, memory: int) -> int:
    """Bytes of CUDA's pool for sparse voxels on a GPU of `memory` bytes, 0 where that is not known.

    Raises InputError for more than the GPU has: Taichi would end the process.
    """
    if asked_gb is None:
        low, high = POOL_LIMITS
        return int(min(max(POOL_SHARE * memory, low), high)) if memory else POOL_UNKNOWN
    if memory and asked_gb * GIB > memory:
        raise InputError(
            f"device_memory_gb: {asked_gb:g} is more than the {memory / GIB:.1f} GiB of the GPU"
        )
    return int(asked_gb * GIB)


def _cpu_name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()
