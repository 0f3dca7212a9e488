"""The measurements: every path is asked in turn, round by round, and the fastest call of each counts."""

import contextlib
import importlib.util
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from .cases import ITERATION, STUDY, write, write_frames
from .plans import WHOLE, Plan
from .processes import TORCHROD, Process

FLOP = 0.37e6  # of one iteration of the base case: as the task of this benchmark states it, not counted here
MATRIX = 1024
EXAMPLE = Path(__file__).resolve().parents[3] / "docs" / "example"
Progress = Callable[[str], None]


def dgemm_rate(threads: int, caches: Path) -> float:
    """Floating-point operations a second of a large float64 matrix product: the better of torch's BLAS and numpy's."""
    a = torch.rand(MATRIX, MATRIX, dtype=torch.float64)
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    taken = []
    for _ in range(10):
        begin = time.perf_counter()
        torch.mm(a, a)
        taken.append(time.perf_counter() - begin)
    torch.set_num_threads(before)
    with Process("scipy", caches, threads) as process:
        return max(2 * MATRIX**3 / min(taken), process.ask("dgemm")["rate"])


def machine(caches: Path) -> dict[str, Any]:
    """Where this was measured, and the floor of an iteration."""
    cores = len(os.sched_getaffinity(0))
    info = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").is_file() else ""
    model = next((line.split(":")[1].strip() for line in info.splitlines() if line.startswith("model name")), "unknown processor")
    rates = {str(n): dgemm_rate(n, caches) for n in sorted({1, cores})}
    versions = {
        name: metadata.version(name) for name in ("torch", "numpy", "scipy", "numba", "jax") if importlib.util.find_spec(name)
    }
    floor = {n: FLOP / rate for n, rate in rates.items()}
    return {"processor": model, "cores": cores, "versions": versions, "dgemm": rates, "floor": floor}


@contextlib.contextmanager
def workers(names: list[str], caches: Path) -> Iterator[dict[str, Process]]:
    """A worker for every path, ended afterwards."""
    with contextlib.ExitStack() as stack:
        yield {name: stack.enter_context(Process(name, caches)) for name in names}


def in_turn(processes: dict[str, Process], rounds: int, **job: Any) -> dict[str, dict[str, Any]]:
    """The fastest of several rounds of the same job, by path."""
    best: dict[str, dict[str, Any]] = {}
    for _ in range(rounds):
        for name, process in processes.items():
            answer = process.ask(**job)
            if name not in best or answer["seconds"] < best[name]["seconds"]:
                best[name] = answer
    return best


def by_batch(processes: dict[str, Process], plan: Plan, folder: Path, progress: Progress) -> dict[str, dict[str, float]]:
    """Seconds per sample and iteration, by path and batch."""
    data, found = str(write(ITERATION, folder)), {name: {} for name in processes}
    for batch in plan.batches:
        progress(f"iteration, batch {batch}")
        able = {name: process for name, process in processes.items() if batch <= plan.largest.get(name, batch)}
        for name, answer in in_turn(able, plan.rounds, job="iteration", data=data, batch=batch, budget=plan.budget).items():
            found[name][str(batch)] = answer["seconds"] / batch
    return found


def growth(processes: dict[str, Process], plan: Plan, folder: Path, progress: Progress) -> dict[str, dict[str, dict[str, float]]]:
    """Seconds per sample and iteration along steps, markers and loads, by path."""
    able = {name: process for name, process in processes.items() if name in plan.growing}
    found: dict[str, dict[str, dict[str, float]]] = {}
    for what in ("steps", "markers", "loads"):
        found[what] = {name: {} for name in able}
        for value in getattr(plan, what):
            progress(f"growth, {value} {what}")
            data = str(write(replace(ITERATION, **{what: value}), folder))
            job = {"job": "iteration", "data": data, "batch": plan.growth_batch, "budget": plan.budget}
            for name, answer in in_turn(able, plan.rounds, **job).items():
                found[what][name][str(value)] = answer["seconds"] / plan.growth_batch
    return found


def linearity(processes: dict[str, Process], plan: Plan, folder: Path, progress: Progress) -> dict[str, dict[str, float]]:
    """Seconds per sample, of an iteration and of torchrod's whole estimates, by path and batch.

    Every batch does the same work in turn, round by round. The fastest of several calls, which serves elsewhere, would favour short
    ones: they fit between two disturbances. Each time is taken over the mean of its round, because a machine that is slower for a
    minute is so for all; then the median over the rounds.
    """
    found = {}
    for name in (name for name in ("torchrod", "numba") if name in processes):
        found[name] = _linear(processes[name], str(write(ITERATION, folder)), plan, plan.linear_rounds, progress)
    found[WHOLE] = _linear(processes["torchrod"], str(write(STUDY, folder)), plan, plan.linear_rounds_whole, progress, whole=True)
    return found


def _linear(process: Process, data: str, plan: Plan, rounds: int, progress: Progress, **what: bool) -> dict[str, float]:
    """Of one path, by batch."""
    taken: dict[str, list[float]] = {str(batch): [] for batch in plan.linear}
    for k in range(rounds):
        progress(f"the same work in batches of every size, round {k + 1}")
        for batch in plan.linear:
            answer = process.ask("share", data=data, batch=batch, samples=plan.linear_samples, **what)
            taken[str(batch)].append(answer["seconds"] / plan.linear_samples)
    return steady(taken)


def steady(taken: dict[str, list[float]]) -> dict[str, float]:
    """Times by batch from those of every round: medians of the ratios to the round's mean, times the median round."""
    rounds = [statistics.mean(times) for times in zip(*taken.values(), strict=True)]
    scale = statistics.median(rounds)
    return {
        batch: scale * statistics.median(t / mean for t, mean in zip(times, rounds, strict=True)) for batch, times in taken.items()
    }


def by_cores(names: list[str], plan: Plan, folder: Path, caches: Path, progress: Progress) -> dict[str, dict[str, float]]:
    """Seconds per sample and iteration, by path and number of cores."""
    data, found = str(write(ITERATION, folder)), {name: {} for name in names if name in plan.growing}
    for cores in range(1, len(os.sched_getaffinity(0)) + 1):
        progress(f"{cores} cores")
        with contextlib.ExitStack() as stack:
            able = {name: stack.enter_context(Process(name, caches, cores)) for name in found}
            job = {"job": "iteration", "data": data, "batch": plan.core_batch, "budget": plan.budget}
            for name, answer in in_turn(able, plan.rounds, **job).items():
                found[name][str(cores)] = answer["seconds"] / plan.core_batch
    return found


def estimates(processes: dict[str, Process], plan: Plan, folder: Path, progress: Progress) -> dict[str, dict[str, Any]]:
    """Whole estimates of Study 1 with 1 mm noise: seconds per estimate and what became of them, by path and start."""
    data, found = str(write(STUDY, folder)), {}
    for name, process in processes.items():
        batch = plan.batch_of_estimates(name)
        for start in ("cold", "warm") if name in TORCHROD else ("cold",):
            if not batch:
                continue
            progress(f"estimates, {name}, {start}")
            job = {"job": "estimate", "data": data, "batch": batch, "budget": plan.budget}
            job |= {"start": start} if name in TORCHROD else {}
            answer = in_turn({name: process}, plan.rounds, **job)[name]
            found[f"{name}, {start}"] = answer | {"batch": batch, "seconds": answer["seconds"] / batch}
    return found


def single(processes: dict[str, Process], plan: Plan, folder: Path, progress: Progress) -> dict[str, Any]:
    """One sample: frames through torchrod.Tracker, and whole estimates of a batch of one."""
    progress("single frames")
    seconds = processes["torchrod"].ask("frames", data=str(write_frames(plan.frames, folder)))["seconds"]
    later = torch.tensor(seconds[1:], dtype=torch.float64)
    frames = {"first_s": seconds[0], "median_s": float(later.median()), "p99_s": float(later.quantile(0.99)), "count": len(later)}
    job = {"job": "estimate", "data": str(write(STUDY, folder)), "batch": 1, "budget": plan.budget}
    able = {name: process for name, process in processes.items() if name in ("torchrod", "numba", "jax, tuned")}
    alone = {name: answer["seconds"] for name, answer in in_turn(able, plan.rounds, **job).items()}
    return {"frames": frames, "estimate_s": alone}


def first_calls(names: list[str], plan: Plan, folder: Path, caches: Path, progress: Progress) -> dict[str, dict[str, float]]:
    """Seconds of import and of the first iteration in a fresh process, with and without what an earlier one left on disk."""
    found, data = {}, str(write(ITERATION, folder))
    variable = {"torchrod": "TORCHROD_CACHE", "numba": "NUMBA_CACHE_DIR"}
    for name in names:
        kinds = ["from scratch", "cached"] if name in variable else ["from scratch"]
        for kind in [kind for kind in kinds if f"{name}, {kind}" not in plan.without_first_call]:
            progress(f"first call, {name}, {kind}")
            with tempfile.TemporaryDirectory() as empty:
                more = {variable[name]: empty} if name in variable and kind == "from scratch" else {}
                with Process(name, caches, more=more) as process:
                    took = process.ask("ready")
                    job = {"job": "iteration", "data": data, "batch": 1 if name == "scipy" else plan.growth_batch, "budget": 0.0}
                    found[f"{name}, {kind}"] = took | {"first_s": process.ask(**job)["first_s"]}
    return found


def memory(plan: Plan, folder: Path, caches: Path, progress: Progress) -> dict[str, dict[str, float]]:
    """Peak resident bytes and seconds of whole estimates, each batch in a process of its own."""
    found, data = {}, str(write(STUDY, folder))
    for batch in plan.memory:
        progress(f"memory, batch {batch}")
        with Process("torchrod", caches) as process:
            process.ask("ready")
            found[str(batch)] = process.ask("memory", data=data, batch=batch)
    return found


def command_line(plan: Plan, folder: Path, progress: Progress) -> dict[str, float]:
    """Seconds of `torchrod estimate` on one shape, and of importing torch, each from a cold process."""
    progress("command line")
    lines = (EXAMPLE / "rod.csv").read_text(encoding="utf-8").splitlines(keepends=True)
    (folder / "one.csv").write_text(lines[0] + "".join(line for line in lines[1:] if line.startswith("0,")), encoding="utf-8")
    arguments = ["estimate", str(EXAMPLE / "rod.toml"), str(folder / "one.csv"), "--noise", "1e-3"]
    commands = {
        "command_s": f"import sys; from torchrod.cli import main; sys.exit(main({arguments!r}))",
        "import_s": "import torch",
    }
    found = dict.fromkeys(commands, float("inf"))
    for _ in range(plan.commands):
        for name, code in commands.items():
            begin = time.perf_counter()
            subprocess.run([sys.executable, "-c", code], check=True, capture_output=True)
            found[name] = min(found[name], time.perf_counter() - begin)
    return found
