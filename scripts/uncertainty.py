"""What it costs to state what is nearly known of a robot: python scripts/uncertainty.py [--samples N] [--repeats N] [--out DIR].

Writes DIR/uncertainty.md and its figure. Every row is timed in turn with the robot taken as exact, so that a busy machine is so for
both.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from studies.reproduction.cases import steel_rod
from torch import Tensor
from tqdm import tqdm

import torchrod as tr
from torchrod.estimation.evaluator import evaluator

LENGTH, MARKERS, NOISE = 0.4, 20, 1e-3
HEAD = """\
# What it costs to state what is only nearly known

Made by `python scripts/uncertainty.py`: {samples} samples of one push, 20 markers, 40 steps, 2 threads. Each error of a
parameter is one more unknown of every sample, and one more tangent of the walk along the rod
([model.md](model.md#robots-that-are-off)). The times are those of h, H and the normal equations, over those of the same robot
taken as exact, which has ten tangents, measured in turn. "Whole" is a fit with its covariance, from a cold start to the end, all
its iterations included. An oval section costs a passive rod more: what is round is walked in the frame of the section, by half
the work.

| robot | stated | unknowns more | h, H and sums: times | more for each unknown | whole: times |
|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Row:
    """A robot, what is stated of it, and the tensions (N) of all samples."""

    name: str
    robot: tr.Robot
    stated: tr.Uncertainty
    tension: Tensor | None = None


def three_tendons() -> tr.Robot:
    """A rod with weight and three straight tendons."""
    robot = steel_rod()
    at = ((8e-3, 0.0), (-4e-3, 6.9e-3), (-4e-3, -6.9e-3))
    tendons = tr.Tendons(tuple(tr.Tendon.straight(x, y, LENGTH) for x, y in at))
    rod = replace(robot.rod, mass_per_length=torch.tensor(0.05, dtype=torch.float64))
    return tr.Robot(rod, tendons, torch.tensor([0.0, 0.0, -9.81], dtype=torch.float64))


def rows() -> list[Row]:
    """What is measured."""
    tension = torch.tensor([2.0, 1.0, 0.5], dtype=torch.float64)
    passive: list[dict[str, Any]] = [
        {"stiffness": 0.03},
        {"set": 0.1},
        {"stiffness": 0.03, "set": 0.1},
        {"stiffness": 0.03, "set": 0.1, "oval": 0.05},
        {"curvature": 0.2},
    ]
    pulled: list[dict[str, Any]] = [
        {"stiffness": 0.03},
        {"tension": 0.05},
        {"friction": 0.1},
        {"mass": 0.05, "gravity": 0.05},
        {"tendon_place": 2e-4},
    ]
    return [Row("steel rod", steel_rod(), tr.Uncertainty(**of)) for of in passive] + [
        Row("three tendons, weight", three_tendons(), tr.Uncertainty(**of), tension) for of in pulled
    ]


def posed(row: Row, samples: int, stated: bool = True) -> tr.Problem:
    """Pushes on the robot as it is, read by markers."""
    g, s, robot = (
        torch.Generator().manual_seed(0),
        torch.linspace(LENGTH / MARKERS, LENGTH, MARKERS, dtype=torch.float64),
        row.robot,
    )
    scale = robot.rod.force_scale
    force = scale * torch.nn.functional.pad(torch.randn(samples, 1, 2, generator=g, dtype=torch.float64).clamp(-1, 1), (0, 1))
    place = LENGTH * (0.3 + 0.6 * torch.rand(samples, 1, generator=g, dtype=torch.float64))
    tension = None if row.tension is None else row.tension.expand(samples, -1)
    p = tr.solve_shape(robot, (tr.PointForces(force, place),), tension, s, samples, 40).p
    markers = tr.Markers(s, p + NOISE * torch.randn(p.shape, generator=g, dtype=torch.float64), NOISE)
    unknowns = tr.Unknowns(tr.GaussianCoordinates(1, LENGTH, scale), uncertainty=row.stated if stated else None)
    return tr.Problem(robot, unknowns, [markers], tension, 40)


def of_sums(problem: tr.Problem) -> Callable[[], object]:
    """h, H and the normal equations somewhere."""
    e = evaluator(problem)
    x = 0.1 * torch.randn(problem.batch, problem.size, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return lambda: e.sums(x)


def in_turn(calls: list[Callable[[], object]], repeats: int) -> list[float]:
    """The least time (s) of every call."""
    times: list[list[float]] = [[] for _ in calls]
    for call in calls:
        call()
    for _ in range(repeats):
        for own, call in zip(times, calls, strict=True):
            begun = time.perf_counter()
            call()
            own.append(time.perf_counter() - begun)
    return [min(own) for own in times]


@dataclass(frozen=True)
class Price:
    """unknowns: how many more; times, whole: of h, H and sums, and of a fit, over the exact robot's."""

    unknowns: int
    times: float
    whole: float


def price(row: Row, samples: int, repeats: int) -> Price:
    """Of what a row states."""
    exact, nearly = posed(row, samples, False), posed(row, samples)
    base, stated = in_turn([of_sums(p) for p in (exact, nearly)], repeats)
    fits = in_turn([lambda p=p: tr.estimate(p) for p in (exact, nearly)], max(repeats // 5, 3))
    return Price(nearly.state.parameters.size, stated / base, fits[1] / fits[0])


def main() -> None:
    """Write the page and its figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--samples", type=int, default=4096)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(2)
    lines, names, prices = [HEAD.format(samples=options.samples)], [], []
    for row in tqdm(rows(), leave=False):
        found = price(row, options.samples, options.repeats)
        stated = ", ".join(f"{kind} {value:g}" for kind in row.stated.__dataclass_fields__ if (value := getattr(row.stated, kind)))
        each = (found.times - 1) / found.unknowns
        lines.append(f"| {row.name} | {stated} | {found.unknowns} | {found.times:.2f} | {each:.2f} | {found.whole:.2f} |")
        names.append(f"{row.name}: {stated} ({found.unknowns})")
        prices.append(each)
    lines.append("\n![What one unknown costs](uncertainty.png)\n")
    (options.out / "uncertainty.md").write_text("\n".join(lines), encoding="utf-8")
    figure = Figure(figsize=(8, 3.6), layout="constrained")
    axes = figure.subplots()
    axes.barh(names[::-1], prices[::-1], color="tab:blue")
    axes.set_xlabel("time of one unknown more, in those of all of the exact robot")
    figure.savefig(options.out / "uncertainty.png", dpi=150)
    print("\n".join(lines))


if __name__ == "__main__":
    main()
