"""Engines: who runs the jobs of a batch. Each gives the same answers, whatever the number of workers and their order."""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import islice
from types import TracebackType
from typing import Any

from fusiond.app.batch.job import Answer, Job
from fusiond.app.batch.keeper import ATTEMPTS, Keeper
from fusiond.errors import UnusableError, UsageError

AHEAD = 2  # jobs for each worker that are handed over before their turn

Numbered = tuple[str, Job]  # the key of the row, and what gives it


class Engine(ABC):
    """Runs jobs in parallel. A context manager: its end stops what runs."""

    @abstractmethod
    def answers(self, jobs: Iterable[Numbered]) -> Iterator[tuple[str, Answer]]:
        """The answers by key, as they are completed. Only a few jobs are taken ahead."""

    @abstractmethod
    def close(self) -> None:
        """Stop."""

    def __enter__(self) -> Engine:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class LocalPool(Engine):
    """Processes of this machine: a keeper for each worker."""

    def __init__(self, workers: int) -> None:
        self._workers = workers
        self._own = threading.local()
        self._keepers: list[Keeper] = []
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="batch", initializer=self._begin)

    def _begin(self) -> None:
        self._own.keeper = Keeper()
        self._keepers.append(self._own.keeper)

    def _run(self, job: Job) -> Answer:
        keeper: Keeper = self._own.keeper
        return keeper.run(job)

    def answers(self, jobs: Iterable[Numbered]) -> Iterator[tuple[str, Answer]]:
        """The answers by key, as they are completed."""
        waiting: dict[Future[Answer], str] = {}
        left = iter(jobs)
        while True:
            for key, job in islice(left, AHEAD * self._workers - len(waiting)):
                waiting[self._pool.submit(self._run, job)] = key
            if not waiting:
                return
            done, _ = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield waiting.pop(future), future.result()

    def close(self) -> None:
        """End the keepers, and with them what runs."""
        for keeper in self._keepers:
            keeper.stop()
        self._pool.shutdown(wait=True, cancel_futures=True)
        for keeper in self._keepers:
            keeper.close()


class Cluster(Engine):
    """Workers of Dask distributed: those of a scheduler, or of a cluster on this machine."""

    def __init__(self, scheduler: str | None, workers: int) -> None:
        try:
            import dask  # noqa: PLC0415 - needs the extra `dask`
            from distributed import Client, LocalCluster  # noqa: PLC0415
        except ModuleNotFoundError as missing:
            raise UsageError("--engine dask and --scheduler need the extra dask: pip install 'fusiond[dask]'") from missing
        self._cluster: Any = None
        dask.config.set({"distributed.scheduler.allowed-failures": ATTEMPTS})
        if scheduler is None:
            self._cluster = LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, host="127.0.0.1"
            )
        try:
            self._client = Client(self._cluster or scheduler, timeout="10s")
        except (OSError, TimeoutError, ValueError) as error:
            raise UnusableError(f"--scheduler {scheduler}: no Dask scheduler answers: {error}") from error

    def answers(self, jobs: Iterable[Numbered]) -> Iterator[tuple[str, Answer]]:
        """The answers by key, as they are completed. A job whose worker dies is given to another."""
        from distributed import KilledWorker, as_completed  # noqa: PLC0415

        left, waiting = iter(jobs), dict[Any, str]()
        completed = as_completed()

        def hand_over(count: int) -> None:
            for key, job in islice(left, count):
                future = self._client.submit(run_here, job, key=f"fusiond-{key}", pure=False, retries=ATTEMPTS - 1)
                waiting[future] = key
                completed.add(future)

        hand_over(AHEAD * max(1, len(self._client.scheduler_info(n_workers=-1)["workers"])))
        while waiting:
            future = next(completed)
            key = waiting.pop(future)
            try:
                answer = future.result()
            except KilledWorker:
                answer = Answer(status="crashed", reason=f"the worker that ran it was killed, {ATTEMPTS} times")
            future.release()
            hand_over(1)
            yield key, answer

    def close(self) -> None:
        """Leave the scheduler; a cluster of this machine ends."""
        self._client.close()
        if self._cluster is not None:
            self._cluster.close()


_own = threading.local()  # of each thread of a worker of Dask: its keeper, which ends with the process


def run_here(job: Job) -> Answer:
    """Run a job in this thread's keeper, on a worker of Dask."""
    if not hasattr(_own, "keeper"):
        _own.keeper = Keeper()
    keeper: Keeper = _own.keeper
    return keeper.run(job)


def cores() -> int:
    """The processors that this process may use."""
    return len(os.sched_getaffinity(0))
