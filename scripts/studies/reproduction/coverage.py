"""Coverage: how often the reported 95 % regions and intervals hold the truth, over noisy repeats of Study 1."""

from pathlib import Path

import torch
from matplotlib.figure import Figure
from scipy.stats import chi2
from torch import Tensor

from .cases import study1

NOISE = 1e-3
THIRDS = ((0.1, 0.2), (0.2, 0.3), (0.3, 0.39))


def run(quick: bool, folder: Path) -> tuple[dict[str, float], list[str]]:
    """1,000 runs with 1 mm noise and the point-like prior: joint region of (force, location), and each interval."""
    study = study1(100 if quick else 1000, seed=7)
    fit = study.estimate(study.noisy(NOISE, 11), "point")
    size, estimated = study.force.norm(dim=-1), fit.force[:, 0]
    turn = torch.atan2(study.force[:, 0] * estimated[:, 1] - study.force[:, 1] * estimated[:, 0], (study.force * estimated).sum(-1))
    error = torch.stack([torch.log(fit.magnitude[:, 0] / size), turn, torch.log(fit.location[:, 0] / study.location)], -1)
    d2 = (error * torch.linalg.solve(fit.log_covariance[:, 0], error.unsqueeze(-1)).squeeze(-1)).sum(-1)
    plain = torch.cat([estimated - study.force, (fit.location[:, 0] - study.location).unsqueeze(-1)], -1)
    plain_d2 = (plain * torch.linalg.solve(fit.load_covariance[:, 0, :3, :3], plain.unsqueeze(-1)).squeeze(-1)).sum(-1)
    inside = {
        "region_95": d2 < chi2.ppf(0.95, 3),
        "magnitude_95": _holds(fit.magnitude_interval[:, 0], size),
        "location_95": _holds(fit.location_interval[:, 0], study.location),
        "region_95_without_logarithms": plain_d2 < chi2.ppf(0.95, 3),
    }
    data = {"converged": float((fit.status == 0).double().mean()), "runs": float(len(d2))}
    data |= {name: float(hit.double().mean()) for name, hit in inside.items()}
    lines = ["## Coverage", "", f"{len(d2)} runs, 1 mm noise, point-like prior. Covariance (H^T W H + P)^-1, carried to", ""]
    lines[-2] += " [log force, direction, log location]; intervals symmetric in the logarithm."
    lines += [
        "| | all | " + " | ".join(f"{1e3 * a:.0f}-{1e3 * b:.0f} mm" for a, b in THIRDS) + " |",
        "|---|---|" + "---|" * len(THIRDS),
    ]
    for name, hit in inside.items():
        cells = [hit.double().mean(), *(hit[_between(study.location, a, b)].double().mean() for a, b in THIRDS)]
        lines.append(f"| {name} | " + " | ".join(f"{100 * float(c):.1f} %" for c in cells) + " |")
    lines += ["", "![Distribution of the squared error in units of the reported covariance](coverage.png)", ""]
    _figure(d2, folder / "coverage.png")
    return data, lines


def _holds(interval: Tensor, truth: Tensor) -> Tensor:
    return (interval[:, 0] <= truth) & (truth <= interval[:, 1])


def _between(x: Tensor, a: float, b: float) -> Tensor:
    return (x >= a) & (x < b)


def _figure(d2: Tensor, path: Path) -> None:
    """Observed against nominal probability of the joint region."""
    figure = Figure(figsize=(4.5, 4.2), layout="constrained")
    axes = figure.add_subplot()
    nominal = torch.linspace(0, 1, 201, dtype=torch.float64)
    observed = (torch.from_numpy(chi2.cdf(d2.numpy(), 3)).unsqueeze(-1) < nominal).double().mean(0)
    axes.plot([0, 1], [0, 1], color="#9a9a9a", lw=1, label="exact")
    axes.plot(nominal, observed, color="#c8102e", label="observed")
    axes.set_xlabel("nominal probability of the region of (force, location)")
    axes.set_ylabel("share of runs inside")
    axes.set_aspect("equal")
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=150)
