"""A process that measures one path or peer: python scripts/studies/benchmark/worker.py NAME.

Reads a job a line (JSON) from standard input and answers with a line (JSON). One process per path keeps compilers, thread pools
and memory apart; the parent asks them in turn, so that all are measured on the same machine in the same minutes.
"""

import json
import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

TRIES = 3
MATRIX = 1024


class Worker:
    """One path, its problems by file."""

    def __init__(self, name: str):
        self.name = name
        self.loaded: dict[str, tuple[Any, dict[str, np.ndarray]]] = {}

    def case(self, path: str) -> tuple[Any, dict[str, np.ndarray]]:
        """The peer of a problem, and its samples."""
        if path not in self.loaded:
            from studies.peers import Problem, peer

            problem, arrays = Problem.load(Path(path))
            if self.name.startswith("torchrod"):
                from studies.benchmark.torchrod_path import TorchrodPeer

                self.loaded[path] = TorchrodPeer(problem), arrays
            else:
                self.loaded[path] = peer(self.name, problem), arrays
        return self.loaded[path]

    def ready(self) -> dict[str, Any]:
        """Import what the path needs."""
        from studies.peers import PEERS

        begin = time.perf_counter()
        __import__(PEERS[self.name][0] if self.name in PEERS else "studies.benchmark.torchrod_path")
        return {"import_s": time.perf_counter() - begin}

    def dgemm(self) -> dict[str, Any]:
        """Floating-point operations a second of a large float64 matrix product, by numpy's BLAS."""
        a = np.random.default_rng(0).random((MATRIX, MATRIX))
        return {"rate": 2 * MATRIX**3 / timed(lambda: a @ a, 0.5)["seconds"]}

    def iteration(self, data: str, batch: int, budget: float) -> dict[str, Any]:
        """Seconds of one iteration of the whole batch."""
        once, as_given = self._iteration(data, batch)
        found = timed(once, budget, before=as_given)
        return {name: value for name, value in found.items() if name != "value"}

    def share(self, data: str, batch: int, samples: int, whole: bool = False) -> dict[str, Any]:
        """Seconds of so many samples in calls of `batch`, all calls together: no batch may pick its best moment.

        Of an iteration, or (whole) of the estimate from a cold start.
        """
        once, as_given = self._estimate(data, batch) if whole else self._iteration(data, batch)
        as_given()
        once()
        seconds = 0.0
        for _ in range(samples // batch):
            as_given()
            seconds += clocked(once)
        return {"seconds": seconds}

    def _iteration(self, data: str, batch: int) -> tuple[Callable[[], object], Callable[[], None]]:
        """An iteration of the whole batch, and what puts it back to its beginning."""
        peer, arrays = self.case(data)
        x, positions = repeated(arrays["near"], batch), repeated(arrays["positions"], batch)
        if self.name == "scipy":  # has no iteration of its own: h and H are nearly all of it
            return lambda: peer.linearize(x), lambda: None
        given = x, np.tile(np.eye(x.shape[1]), (batch, 1, 1)), np.full(batch, np.inf)
        state = tuple(a.copy() for a in given)

        def as_given() -> None:
            for a, b in zip(state, given, strict=True):
                np.copyto(a, b)

        return lambda: peer.iterate(*state, positions), as_given

    def _estimate(self, data: str, batch: int) -> tuple[Callable[[], object], Callable[[], None]]:
        """A whole estimate of the batch, which changes nothing that is to be put back."""
        peer, arrays = self.case(data)
        positions = repeated(arrays["positions"], batch)
        return lambda: peer.fitted("cold", positions), lambda: None

    def estimate(self, data: str, batch: int, budget: float, start: str = "cold") -> dict[str, Any]:
        """Seconds of whole estimates of the batch, and the share of torchrod's that is not spent in its kernel."""
        peer, arrays = self.case(data)
        x, positions = repeated(arrays["start"], batch), repeated(arrays["positions"], batch)
        if not self.name.startswith("torchrod"):
            found = timed(lambda: peer.estimate(x, positions), budget)
            fit = found.pop("value")
            return found | {"converged": float(fit.converged.mean()), "iterations": float(fit.iterations.mean())}
        from studies.benchmark.torchrod_path import kernel_seconds

        found = timed(lambda: peer.fitted(start, positions), budget, kernel_seconds)
        fit = found.pop("value")
        return found | {"converged": float((fit.status == 0).double().mean()), "iterations": float(fit.iterations.double().mean())}

    def frames(self, data: str) -> dict[str, Any]:
        """Seconds of each frame of a film, through an estimator that lives on."""
        peer, arrays = self.case(data)
        frame = peer.frame_estimator()
        return {"seconds": [clocked(lambda seen=seen: frame(seen)) for seen in arrays["positions"]]}

    def answers(self, data: str, out: str, samples: int, fits: bool) -> dict[str, Any]:
        """h, H and the filter's next x and Sigma, or finished fits, as a file."""
        peer, arrays = self.case(data)
        x, start, positions = (arrays[name][:samples] for name in ("near", "start", "positions"))
        if fits:
            np.savez(out, **vars(peer.estimate(start, positions)))
            return {}
        found: dict[str, Any] = dict(zip(("h", "H"), peer.linearize(x), strict=True))
        if self.name != "scipy":  # which has no filter
            Sigma, cap = np.tile(np.eye(x.shape[1]), (len(x), 1, 1)), np.full(len(x), np.inf)
            found |= dict(zip(("x", "Sigma", "cap", "done"), peer.iterate(x.copy(), Sigma, cap, positions), strict=True))
        np.savez(out, **found)
        return {}

    def memory(self, data: str, batch: int) -> dict[str, Any]:
        """The largest resident size (bytes) before and after whole estimates of a batch."""
        peer, arrays = self.case(data)
        before = peak_bytes()
        x, positions = repeated(arrays["start"], batch), repeated(arrays["positions"], batch)
        begin = time.perf_counter()
        peer.estimate(x, positions)
        return {"before": before, "peak": peak_bytes(), "seconds": time.perf_counter() - begin}


def repeated(array: np.ndarray, batch: int) -> np.ndarray:
    """`batch` samples, the distinct ones over and over."""
    return array[np.arange(batch) % len(array)]


def peak_bytes() -> int:
    """The largest resident size of this process, up to now.

    By its own high-water mark where there is one (Linux): ru_maxrss also counts the parent that it was forked from.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        mark = next((line for line in status.read_text(encoding="utf-8").splitlines() if line.startswith("VmHWM:")), None)
        if mark is not None:
            return 1024 * int(mark.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def clocked(what: Callable[[], object]) -> float:
    """Wall seconds of one call."""
    begin = time.perf_counter()
    what()
    return time.perf_counter() - begin


def timed(
    what: Callable[[], Any],
    budget: float,
    kernel: Callable[[], float | None] = lambda: None,
    before: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """`before` each, which is not counted: the first call, the fastest of further ones, and the kernel's share of that.

    Further ones: TRIES or as many as a budget of seconds holds, but no more once they have taken three times the budget.
    """
    before()
    taken, shares, value, first = [], [], None, clocked(what)
    while len(taken) < TRIES or sum(taken) < budget:
        before()
        earlier, begin = kernel(), time.perf_counter()
        value = what()
        taken.append(time.perf_counter() - begin)
        later = kernel()
        shares.append(None if earlier is None or later is None else (later - earlier) / taken[-1])
        if sum(taken) > 3 * budget:
            break
    best = min(range(len(taken)), key=taken.__getitem__)
    return {"first_s": first, "seconds": taken[best], "calls": len(taken), "kernel_share": shares[best], "value": value}


def main() -> None:
    """Serve jobs until standard input ends."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
    worker = Worker(sys.argv[1])
    answers, sys.stdout = sys.stdout, sys.stderr  # what a library prints must not be taken for an answer
    for line in sys.stdin:
        job = json.loads(line)
        answer = getattr(worker, job.pop("job"))(**job)
        answer.pop("value", None)
        answers.write(json.dumps(answer) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
