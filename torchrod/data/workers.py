"""Making the shards of a data set: one after the other, on several processes, or on a dask cluster.

Wherever a shard is computed, its arrays come back and this process writes them: a worker needs no shared disk, and one that dies
leaves nothing behind but a shard to be computed again.
"""

import contextlib
import logging
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, CancelledError, Executor, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from multiprocessing import resource_tracker
from pathlib import Path
from typing import Any

import numpy as np

from ..util.errors import InputError
from .dataset import DatasetSpec, simulate_shard
from .shards import write_shard

CONNECT_SECONDS = 20
Made = Iterator[tuple[int, dict[str, np.ndarray]]]


def produce(
    spec: DatasetSpec, folder: Path, indices: list[int], workers: int, scheduler: str | None, progress: Callable[[int], object]
) -> None:
    """Make and write these shards; progress is told the samples of each one written.

    workers: processes on this machine; scheduler: the address of a dask cluster, tcp://host:port, to be used instead.
    Errors: InputError from the shards themselves, or where the workers are not there or have died; what is written stays.
    """
    with contextlib.ExitStack() as stack:
        if scheduler is not None:
            executor, width = stack.enter_context(_cluster(scheduler))
            made = _as_they_come(executor, width, spec, indices)
        elif min(workers, len(indices)) > 1:
            # spawn: a fork would inherit torch's thread pool in the middle of whatever it does
            executor = ProcessPoolExecutor(min(workers, len(indices)), multiprocessing.get_context("spawn"), _leave_with_parent)
            stack.callback(executor.shutdown, cancel_futures=True)
            made = _as_they_come(executor, lambda: 2 * workers, spec, indices)
        else:
            made = ((index, simulate_shard(spec, index)) for index in indices)
        for index, arrays in made:
            write_shard(folder, spec, index, arrays)
            progress(spec.samples_in(index))


@contextlib.contextmanager
def _deaf() -> Iterator[None]:
    """Processes that begin within it never hear of Ctrl-C, from their first import on: the command alone speaks of it.

    The command itself hears of it at the end.
    """
    resource_tracker.ensure_running()  # where it is not, starting it would let the signal through again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _leave_with_parent() -> None:
    """End this worker process when the command is killed: the pool itself would wait for work for ever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _as_they_come(executor: Executor, width: Callable[[], int], spec: DatasetSpec, indices: list[int]) -> Made:
    """Shards in the order in which they are ready, with no more than width() of them under way: finished ones take memory."""
    left, running = iter(indices), {}
    while True:
        for index in islice(left, max(0, width() - len(running))):
            with _deaf():  # a task may start a process
                running[executor.submit(simulate_shard, spec, index)] = index
        if not running:
            return
        done, _ = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            try:
                arrays = future.result()
            except BrokenProcessPool:
                raise InputError("a worker process died, perhaps for want of memory; run again with fewer --workers") from None
            yield running.pop(future), arrays


@contextlib.contextmanager
def _cluster(address: str) -> Iterator[tuple[Executor, Callable[[], int]]]:
    """The cluster as an executor, and how many shards to have under way on it: it may grow and shrink meanwhile."""
    try:
        from distributed import Client, KilledWorker
        from distributed.comm.addressing import parse_address
        from distributed.comm.registry import get_backend
    except ImportError:
        raise InputError("--scheduler needs dask.distributed; install it with: pip install torchrod[scale]") from None
    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # of a connection that is lost we tell in one sentence
    try:
        get_backend(parse_address(address)[0])  # a client that was made in vain complains of that when it goes
        client: Any = Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(f"--scheduler {address}: cannot be reached ({error}); give the address of a dask scheduler") from None
    with client:
        try:
            # Not pure: a key of its own for every call, so that a run never gets another run's results from the cluster.
            yield client.get_executor(pure=False), lambda: 2 * max(1, sum(client.nthreads().values()))
        except KilledWorker as error:
            raise InputError(f"--scheduler {address}: workers died again and again ({error}); give them more memory") from None
        except CancelledError:  # of every task, once it is known that the scheduler is gone
            raise InputError(
                f"--scheduler {address}: has died; start it and run the command again, which keeps the shards that are there"
            ) from None
