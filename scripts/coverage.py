"""How often 95 % intervals hold the truth: python scripts/coverage.py [--cases N] [--kinds K ..] [--forms N] [--out DIR].

It writes DIR/coverage.md. Each kind has the right model and random members. Shapes are of torchrod.solve_shape with point forces or
dead tip wrenches on four times the steps of the fit: another discretization and another load than the Gaussians that are fitted.
"""

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from studies import bands
from studies.reproduction.cases import steel_rod
from torch import Tensor

import torchrod as tr
from torchrod.estimation.draws import Method
from torchrod.util.status import Status

STEPS, MARKERS = 160, 20


@dataclass(frozen=True)
class Kind:
    """contacts: how many are fitted; noise: of the length; force, place: ranges in force scales and lengths; tip: unknown."""

    name: str
    contacts: int
    noise: float
    force: tuple[float, float] = (0.5, 2.0)
    place: tuple[float, float] = (0.25, 1.0)
    gap: float = 0.0
    tip: str = "none"


KINDS = {
    "one": Kind("one push, 0.25 % noise", 1, 2.5e-3),
    "one-exact": Kind("one push, 0.1 % noise", 1, 1e-3),
    "weak": Kind("weak push near the base, 0.25 % noise", 1, 2.5e-3, (0.1, 0.4), (0.05, 0.3)),
    "two": Kind("two pushes 15 % of the length apart or more, 0.1 % noise", 2, 1e-3, gap=0.15),
    "close": Kind("two pushes 5 to 10 % of the length apart, 0.1 % noise", 2, 1e-3, place=(0.3, 0.9), gap=-0.05),
    "moment": Kind("nothing but a moment at the tip, wrench unknown, 0.1 % noise", 0, 1e-3, (0.1, 0.5), tip="wrench"),
}


@dataclass(frozen=True)
class Truth:
    """size, at (B, K) N, m, in the order along the rod; tip (B, 6) [N, N m]."""

    size: Tensor
    at: Tensor
    tip: Tensor


def posed(kind: Kind, cases: int, seed: int = 0) -> tuple[tr.Problem, Truth]:
    """Members of a kind."""
    random, robot, K = torch.Generator().manual_seed(seed), steel_rod(), kind.contacts
    rod = robot.rod

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=random, dtype=torch.float64)

    at = uniform(*kind.place, cases, max(K, 1))
    if kind.gap > 0:
        first = uniform(0.2, 0.8 - kind.gap, cases, 1)
        at = torch.cat([first, first + kind.gap + torch.rand(cases, 1, generator=random) * (1 - kind.gap - first)], -1)
    elif kind.gap < 0:
        at = torch.cat([at[:, :1], at[:, :1] + uniform(-kind.gap, -2 * kind.gap, cases, 1)], -1)
    size, turn = rod.force_scale * uniform(*kind.force, cases, max(K, 1)), uniform(0, 2 * math.pi, cases, max(K, 1))
    at, F = rod.length * at, torch.stack([size * turn.cos(), size * turn.sin(), 0 * size], -1)
    s = torch.linspace(rod.length / MARKERS, rod.length, MARKERS, dtype=torch.float64)
    tip = torch.zeros(cases, 6, dtype=torch.float64)
    if K:
        loads = (tr.PointForces(F, at),)
    else:
        tip[:, 3:] = rod.moment_scale * F[:, 0] / rod.force_scale
        loads = (tr.PointWrenches(tip[:, None, :3], tip[:, None, 3:], torch.tensor([rod.length], dtype=torch.float64)),)
    p = tr.solve_shape(robot, loads, None, s, cases, STEPS).p
    noise = kind.noise * rod.length
    unknowns = tr.Unknowns(tr.GaussianCoordinates(K, rod.length, rod.force_scale), kind.tip)
    readings = p + noise * torch.randn(p.shape, generator=random, dtype=torch.float64)
    return tr.Problem(robot, unknowns, [tr.Markers(s, readings, noise)]), Truth(size, at, tip)


def _share(value: Tensor, interval: Tensor, rows: Tensor) -> str:
    inside = (value >= interval[..., 0]) & (value <= interval[..., 1])
    return f"{100 * float(inside[rows].double().mean()):.1f}"


def row(kind: Kind, cases: int) -> str:
    """One line of the table."""
    problem, truth = posed(kind, cases)
    begun = time.process_time()
    fit = tr.estimate(problem)
    middle = time.process_time()
    found = tr.sampled_intervals(problem, fit)
    spent = [1e3 * t / cases for t in (middle - begun, time.process_time() - middle)]
    rows = fit.status == int(Status.CONVERGED)
    if kind.contacts:
        order = fit.location.argsort(-1)

        def along(interval: Tensor) -> Tensor:
            return interval.gather(1, order.unsqueeze(-1).expand_as(interval))

        cells = [
            _share(value, along(interval), rows)
            for value, pair in (
                (truth.size, (found.magnitude, fit.magnitude_interval)),
                (truth.at, (found.location, fit.location_interval)),
            )
            for interval in pair
        ]
    else:
        assert found.tip is not None and fit.tip is not None and fit.tip_covariance is not None
        std = fit.tip_covariance.diagonal(dim1=-2, dim2=-1).sqrt().unsqueeze(-1)
        normal = fit.tip.unsqueeze(-1) + std * torch.tensor([-1.96, 1.96], dtype=torch.float64)
        cells = [_share(truth.tip, found.tip, rows), _share(truth.tip, normal, rows), "-", "-"]
    methods = " / ".join(str(int((found.method == int(m)).sum())) for m in (Method.IMPORTANCE, Method.MATCHED, Method.TEMPERED))
    doubtful = f"{100 * float((found.k_hat > 0.7).double().mean()):.1f}"
    times = f"{spent[0]:.2f} / {spent[1]:.1f}"
    numbers = f"{methods} | {doubtful} | {float(found.ess[rows].median()):.0f} | {times}"
    return f"| {kind.name} | {cases} | {' | '.join(cells)} | {numbers} |"


HEAD = [
    "# Coverage of 95 % intervals",
    "",
    "Made by `python scripts/coverage.py`: the 400 mm steel rod, 20 markers, point forces on four times the steps of",
    "the fit, the right number of loads. Share (%) of truths inside the interval, all loads together; sampled: of",
    "draws of the posterior; normal: of its covariance. Of a tip wrench all six components count as forces. Draws:",
    "importance / matched / tempered. CPU in ms a shape, of the fit and of the draws, 512 a shape, on a busy machine.",
    "",
    "| kind | cases | force, sampled | normal | place, sampled | normal | draws | k-hat > 0.7 (%) | ess | CPU |",
    "|---|---|---|---|---|---|---|---|---|---|",
]


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=500, help="of each kind")
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--forms", type=int, default=60, help="loads of each form for the bands of f(s); 0 for none")
    parser.add_argument("--out", type=Path, default=Path(__file__).resolve().parents[1] / "docs")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)  # before the work that would be lost
    say: Callable[[str], None] = print
    lines = list(HEAD)
    for name in options.kinds:
        lines.append(row(KINDS[name], options.cases))
        say(lines[-1])
    if options.forms:
        lines += bands.table(options.forms)
    (options.out / "coverage.md").write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
