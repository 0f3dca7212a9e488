"""The kernel's threads, which live on: through forks, beside other callers, and no more of them than were asked for."""

import os
import threading
from pathlib import Path

import pytest
import torch

from tests import fresh
from tests.problems import posed
from tests.robots import T
from tests.test_fast import needs_compiler
from torchrod import GaussianCoordinates, kernel
from torchrod.estimation.evaluator import KernelEvaluator

CODE = """
import os, threading
import torch
from torchrod import kernel
torch.set_num_threads(1)
torch.set_default_dtype(torch.float64)
from tests import test_crew
assert kernel.available()
call, tasks = test_crew.caller(400), lambda: len(os.listdir("/proc/self/task"))
torch.set_num_threads(3)
whole, before = call(), tasks()
for _ in range(20):
    call()
assert tasks() == before, (before, tasks())
torch.set_num_threads(5)
call()
assert tasks() == before + 2, (before, tasks())

torch.set_num_threads(3)
stop, failed = threading.Event(), 0
def busy():
    while not stop.is_set():
        call()
other = threading.Thread(target=busy)
other.start()
for _ in range(10):  # the other thread is in the kernel at nearly any time
    child = os.fork()
    if child == 0:
        before, found, after = tasks(), call(), tasks()
        os._exit((before, after, test_crew.same(found, whole)) != (1, 3, True))
    failed += os.waitpid(child, 0)[1] != 0
stop.set()
other.join()
assert failed == 0
"""


def caller(samples: int):
    """The normal equations of so many samples: the kernel, and nothing of torch that has threads of its own."""
    problem = posed(T([0.1, 0.4]), torch.zeros(samples, 2, 3), loads=GaussianCoordinates(1, 0.4, 1.0))
    x = torch.randn(samples, problem.size, generator=torch.Generator().manual_seed(0)) * 0.3
    evaluate = KernelEvaluator(problem)
    return lambda: evaluate.sums(x)


def same(a: kernel.Sums, b: kernel.Sums) -> bool:
    return all(torch.equal(getattr(a, name), getattr(b, name)) for name in vars(a))


linux = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="no /proc here, which counts a process's threads")


@needs_compiler
@linux
def test_threads_are_begun_once_and_anew_in_a_fork(tmp_path):
    """In a process of its own, which has begun no others. A fork has its own whatever its parent's threads were doing."""
    done = fresh.run(CODE, tmp_path, **os.environ)
    assert done.returncode == 0, done.stderr


@needs_compiler
def test_callers_at_once_get_the_answers_of_each_alone():
    calls = [caller(samples) for samples in (40, 90, 400, 401)]
    alone, found = [call() for call in calls], [[] for _ in calls]
    start = threading.Barrier(len(calls))

    def ask(k: int) -> None:
        start.wait()
        found[k].extend(calls[k]() for _ in range(100))

    before = torch.get_num_threads()
    torch.set_num_threads(3)
    try:
        threads = [threading.Thread(target=ask, args=(k,), daemon=True) for k in range(len(calls))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60.0)  # two that wait for the same threads may wait for ever
    finally:
        torch.set_num_threads(before)
    for one, several in zip(alone, found, strict=True):
        assert len(several) == 100
        assert all(same(one, other) for other in several)
