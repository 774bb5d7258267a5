"""The engine that runs work in other processes: Dask, on this machine, at an address, or under SLURM."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from ..errors import InputError, MissingDependency, UniFusionError
from ..files.strict_yaml import read_yaml
from ..kernel_cache import seed_kernel_cache, write_kernels

logger = logging.getLogger(__name__)

T = TypeVar("T")

RETRIES = 5  # of work whose worker was lost
STARTING = 15  # [s] that a worker may take to start before another is started in its place
CONNECTING = 30  # [s] that a scheduler may take to answer
KERNELS = "TI_OFFLINE_CACHE_FILE_PATH"  # where Taichi keeps them
SLURM = "slurm:"
LACKING = "--workers and --cluster need Dask: pip install 'taichi-unifusion[cluster]'"


@dataclass(frozen=True)
class ClusterSettings:
    """Which processes do the work."""

    workers: int = 0
    """Processes on this machine that share the work, each on its part of the cores."""
    cluster: str = ""
    """Workers elsewhere: a scheduler of Dask as tcp://host:8786, or slurm:FILE.yaml, options of
    dask_jobqueue.SLURMCluster with how many jobs to start (jobs).
    """

    def __post_init__(self) -> None:
        if not 0 <= self.workers <= 1024:
            raise InputError(f"workers: must lie in 0..1024, got {self.workers}")
        if self.workers and self.cluster:
            raise InputError("give one of --workers and --cluster: they are two ways to say where")

    @property
    def wanted(self) -> bool:
        """Whether work goes to other processes at all."""
        return bool(self.workers or self.cluster)

    @property
    def share(self) -> int:
        """Threads of a worker on this machine; 0 elsewhere: all."""
        return max((os.cpu_count() or 1) // self.workers, 1) if self.workers else 0


class Engine:
    """Runs functions in worker processes; only small values and paths go there and come back. Workers of
    a `local` cluster that are lost before they could start are started again.
    """

    def __init__(self, client: Any, local: Any = None) -> None:
        self._client, self._local = client, local
        self._restarts, self._looked = 0, 0.0

    @property
    def workers(self) -> int:
        """Worker processes that are there now."""
        return len(self._client.scheduler_info(n_workers=-1)["workers"])

    def map(
        self,
        work: Callable[..., T],
        arguments: Sequence[tuple],
        on_done: Callable[[], None] = lambda: None,
        stop: Callable[[], bool] = lambda: False,
    ) -> list[T | UniFusionError | None]:
        """The result of `work` for each of the arguments, or the error that it ended with; None for
        what was not done because `stop` said so. Work of a worker that is lost is done again; raises
        UniFusionError where the scheduler is lost.
        """
        with _connected():
            return self._map(work, arguments, on_done, stop)

    def _map(
        self,
        work: Callable[..., T],
        arguments: Sequence[tuple],
        on_done: Callable[[], None],
        stop: Callable[[], bool],
    ) -> list[T | UniFusionError | None]:
        from distributed import client as dask_client

        wait: Any = dask_client.wait

        futures = [self._client.submit(work, *each, pure=False) for each in arguments]
        pending = set(futures)
        while pending and not stop():
            try:
                done, pending = wait(
                    list(pending), timeout=0.5, return_when=dask_client.FIRST_COMPLETED
                )
            except TimeoutError:
                self._start_lost()
                continue
            for _ in done:
                on_done()
        self._client.cancel(list(pending))
        return [None if each in pending else _result(each) for each in futures]

    def _start_lost(self) -> None:
        """Start workers on this machine that Dask has given up, as it does with those that end while they
        start; raises UniFusionError where that happens again and again.
        """
        now = time.monotonic()
        if self._local is None or now < self._looked + STARTING:
            return
        if len(self._local.workers) == len(self._local.worker_spec):
            return
        self._restarts, self._looked = self._restarts + 1, now
        if self._restarts > RETRIES * len(self._local.worker_spec):
            raise UniFusionError("workers end before they have started, again and again")
        self._local.scale(len(self._local.worker_spec))


@contextmanager
def _connected() -> Iterator[None]:
    """Say in a sentence that the connection to the scheduler is gone, which Dask says in several ways."""
    from distributed.comm.core import CommClosedError

    try:
        yield
    except (CancelledError, CommClosedError):
        raise UniFusionError(
            "the scheduler that hands out the work is gone, or no longer reached: start it again"
        ) from None


def _result(future: Any) -> Any:
    """What a task gave, or why there is nothing; a bug is raised."""
    try:
        return future.result()
    except UniFusionError as error:
        return error
    except Exception as error:
        if type(error).__name__ == "KilledWorker":
            return UniFusionError(
                f"work was given up after its worker was lost {RETRIES} times: {error}"
            )
        raise


def own_kernels() -> dict[str, str]:
    """The environment in which Taichi keeps compiled kernels in a folder of this worker; empty outside
    of workers, and where a folder is named already.
    """
    from distributed import get_worker

    try:
        worker = str(get_worker().name)
    except ValueError:  # not in a worker
        return {}
    if KERNELS in os.environ:
        return {}
    name = "".join(letter if letter.isalnum() else "-" for letter in worker)
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = cache / "taichi_unifusion" / f"worker-{name}"
    seed_kernel_cache(folder)
    return {KERNELS: str(folder)}


@contextmanager
def open_engine(settings: ClusterSettings) -> Iterator[Engine]:
    """Workers that are ready; those on this machine listen on 127.0.0.1 alone and end with the block.

    Raises MissingDependency without Dask, InputError where a cluster cannot be reached.
    """
    try:
        import distributed
        from dask import config as dask_config
    except ImportError:
        raise MissingDependency(LACKING) from None
    dask_config.set({"distributed.scheduler.allowed-failures": RETRIES})
    with ExitStack() as stack:
        local = None
        if settings.cluster.startswith(SLURM):
            address = stack.enter_context(_slurm(settings.cluster.removeprefix(SLURM)))
        elif settings.cluster:
            address = settings.cluster
        else:
            address = local = stack.enter_context(_local(distributed, settings.workers))
        try:
            client = stack.enter_context(distributed.Client(address, timeout=CONNECTING))
        except (OSError, ValueError, TimeoutError) as error:
            raise InputError(
                f"--cluster {settings.cluster}: no scheduler answers there ({error}); start one with: dask scheduler"
            ) from None
        client.forward_logging("taichi_unifusion", level=logging.WARNING)
        yield Engine(client, local)
        if address != settings.cluster:  # these workers end now, and sooner than Taichi would write
            with suppress(Exception):
                client.run(write_kernels, on_error="ignore")


def _local(distributed: Any, workers: int) -> Any:
    """Processes on this machine, each with one thread of Dask's, started afresh and not forked."""
    return distributed.LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host="127.0.0.1",
        dashboard_address=None,
        silence_logs=logging.CRITICAL,
        memory_limit=0,
    )


def _slurm(file: str) -> Any:
    """Jobs of SLURM as a file says; raises MissingDependency or InputError."""
    try:
        from dask_jobqueue.slurm import SLURMCluster
    except ImportError:
        raise MissingDependency(
            "--cluster slurm: needs dask-jobqueue: pip install 'taichi-unifusion[cluster]'"
        ) from None
    options = dict(read_yaml(Path(file)) or {})
    jobs = options.pop("jobs", 1)
    if type(jobs) is not int or jobs < 1:
        raise InputError(f"{file}: jobs: must be a whole number above 0, got {jobs}")
    cluster = SLURMCluster(**options)
    cluster.scale(jobs=jobs)
    return cluster
