"""Intervals where the number of loads is told."""

import time

import torch
from torch import Tensor

import torchrod as tr
from torchrod.estimation.draws import Method
from torchrod.util.status import Status

from .cases import TOLD, Kind, Truth, posed

HEAD = [
    "## The number of loads told",
    "",
    "Share (%) of truths inside the interval, all loads together; sampled: of draws of the posterior; normal: of the",
    "covariance. At the tip all unknown components count. Draws: importance / matched / tempered. CPU in ms a shape, of the",
    "fit and of the draws, 512 a shape, on a busy machine.",
    "",
    "| kind | cases | force, sampled | normal | place, sampled | normal | resultant | tip, sampled | normal | draws "
    "| k-hat > 0.7 (%) | ess | CPU |",
    "|" + "---|" * 13,
]


def share(value: Tensor, interval: Tensor, rows: Tensor) -> str:
    """Percent of the rows whose value is inside."""
    inside = (value >= interval[..., 0]) & (value <= interval[..., 1])
    return f"{100 * float(inside[rows].double().mean()):.1f}"


def line(name: str, cases: int) -> str:
    """One line of the table."""
    kind = TOLD[name]
    problem, truth = posed(kind, cases)
    begun = time.process_time()
    fit = tr.estimate(problem)
    middle = time.process_time()
    found = tr.sampled_intervals(problem, fit)
    spent = [1e3 * t / cases for t in (middle - begun, time.process_time() - middle)]
    rows = fit.status == int(Status.CONVERGED)
    cells = [*_of_pushes(kind, truth, fit, found, rows), *_of_tip(problem, truth, fit, found, rows)]
    methods = " / ".join(str(int((found.method == int(m)).sum())) for m in (Method.IMPORTANCE, Method.MATCHED, Method.TEMPERED))
    doubtful = f"{100 * float((found.k_hat > 0.7).double().mean()):.1f}"
    numbers = f"{methods} | {doubtful} | {float(found.ess[rows].median()):.0f} | {spent[0]:.2f} / {spent[1]:.1f}"
    return f"| {kind.name} | {int(rows.sum())} | {' | '.join(cells)} | {numbers} |"


def _of_pushes(kind: Kind, truth: Truth, fit: tr.Estimate, found: tr.Intervals, rows: Tensor) -> list[str]:
    if not kind.contacts:
        return ["-"] * 5
    order = fit.location.argsort(-1)

    def along(interval: Tensor) -> Tensor:
        return interval.gather(1, order.unsqueeze(-1).expand_as(interval))

    pairs = (
        (truth.size, (found.magnitude, fit.magnitude_interval)),
        (truth.at, (found.location, fit.location_interval)),
    )
    shares = [share(value, along(interval), rows) for value, pair in pairs for interval in pair]
    return [*shares, share(truth.resultant, found.resultant[:, 3], rows)]


def _of_tip(problem: tr.Problem, truth: Truth, fit: tr.Estimate, found: tr.Intervals, rows: Tensor) -> list[str]:
    n = problem.state.tip.size
    if not n:
        return ["-"] * 2
    assert fit.tip is not None and fit.tip_covariance is not None and found.tip is not None
    std = fit.tip_covariance.diagonal(dim1=-2, dim2=-1)[:, :n].sqrt().unsqueeze(-1)
    normal = fit.tip[:, :n].unsqueeze(-1) + std * torch.tensor([-1.96, 1.96], dtype=torch.float64)
    return [share(truth.tip[:, :n], found.tip[:, :n], rows), share(truth.tip[:, :n], normal, rows)]
