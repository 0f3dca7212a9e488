"""How often the 95 % intervals and the band of the profile hold the truth, for loads drawn from the model."""

from dataclasses import dataclass

import torch
from matplotlib.axes import Axes
from torch import Tensor

from studies.reproduction.cases import L, S
from torchrod import Estimate, Problem, Status, estimate, forward_jacobian, load_profile, solve_shape

from .cases import ROBOT, generator, in_parallel, noisy, posed, pushed, pushes

Z95 = 1.959964
SHOWN = 0.05  # of the largest |f| that the band allows: places where it allows less count as unloaded
NAMES = ("force", "location", "f_x", "f_y", "|f|", "|f| at the true place")


@dataclass(frozen=True)
class Row:
    """A kind of load: how many, of which width prior, and their magnitudes (N)."""

    name: str
    contacts: int
    prior: str
    size: tuple[float, float]


ROWS = (
    Row("one contact, 0.5-1 N", 1, "contact", (0.5, 1.0)),
    Row("one point-like contact, 0.5-1 N", 1, "point", (0.5, 1.0)),
    Row("one weak contact, 0.05-0.3 N", 1, "contact", (0.05, 0.3)),
    Row("two contacts, 0.5-1 N", 2, "contact", (0.5, 1.0)),
    Row("one distributed load, 0.5-1 N", 1, "distributed", (0.5, 1.0)),
)


def _drawn(row: Row, samples: int, seed: int) -> tuple[Problem, Tensor, Estimate]:
    """Loads with widths from the prior, gamma (B, n), and their estimate."""
    g, unknowns = generator(seed), pushed(row.contacts, row.prior)
    force, place = pushes(row.contacts, samples, g, row.size)
    mean = unknowns.loads.prior()[0].unflatten(0, (row.contacts, 4))[:, 3]
    width = mean + torch.randn(samples, row.contacts, generator=g, dtype=torch.float64)
    gamma = torch.cat([force / ROBOT.rod.force_scale, torch.stack([torch.logit(place / L), width], -1)], -1).flatten(1)
    shape = solve_shape(ROBOT, unknowns.loads.loads(gamma), None, S, samples, 80)
    problem = posed(noisy(S, shape.p, g), unknowns)
    return problem, gamma, estimate(problem)


def _three(problem: Problem, gamma: Tensor, s: Tensor) -> Tensor:
    """f_x, f_y, |f| (B, S, 3)."""
    f = problem.unknowns.loads.loads(gamma)[0].density(s)
    assert f is not None
    return torch.cat([f[..., :2], f.norm(dim=-1, keepdim=True)], -1)


def measured(row: Row, samples: int, seed: int) -> tuple[list[float], list[float], list[float]]:
    """Shares that hold the truth: NAMES; f_x, f_y, |f| of the first-order band; and |f| by distance from the estimate in widths."""
    problem, gamma, fit = _drawn(row, samples, seed)
    done = fit.status == int(Status.CONVERGED)
    g = problem.state.loads.size
    x, C, true = fit.x[done], fit.covariance[done], problem.unknowns.loads.describe(gamma[done])
    profile = load_profile(problem, x, C)
    assert profile is not None
    f, estimated = _three(problem, gamma[done], profile.s), _three(problem, x[:, :g], profile.s)
    high = profile.band[..., 2, 1]
    seen = high > SHOWN * high.amax(-1, keepdim=True)
    held = (profile.band[..., 0] <= f) & (f <= profile.band[..., 1])
    _, J = forward_jacobian(lambda gamma: _three(problem, gamma, profile.s).flatten(1), x[:, :g])
    std = ((J @ C[:, :g, :g]) * J).sum(-1).clamp(min=0).sqrt().reshape(f.shape)
    linear = (f - estimated).abs() <= Z95 * std
    order = fit.location[done].argsort(-1)
    shares = []
    for interval, value in ((fit.magnitude_interval[done], true.force.norm(dim=-1)), (fit.location_interval[done], true.location)):
        interval = interval.gather(1, order.unsqueeze(-1).expand(-1, -1, 2))
        shares.append(float(((interval[..., 0] <= value) & (value <= interval[..., 1])).double().mean()))
    away = ((profile.s[:, None] - fit.location[done][:, None]).abs() / fit.width[done][:, None]).amin(-1)
    by = [_share(hit[..., 2], seen & (away >= a) & (away < a + 1)) for hit in (held, linear) for a in range(6)]
    at_peak = held[..., 2].gather(1, (true.location[:, :1] / L * (len(profile.s) - 1)).round().long()).double().mean()
    ours = [*shares, *(_share(held[..., i], seen) for i in range(3)), float(at_peak)]
    return ours, [_share(linear[..., i], seen) for i in range(3)], by


def _share(hit: Tensor, of: Tensor) -> float:
    return float((hit & of).sum() / of.sum())


def run(samples: int, axes: Axes) -> list[str]:
    """The table, and |f| by distance from the contact."""
    lines = ["## Do the 95 % intervals and bands hold the truth?", ""]
    lines += [f"{samples} runs a row; places at 100 to 390 mm, widths drawn from the prior, two contacts at least 80 mm apart."]
    lines += [
        "The profile counts where its band allows at least 5 % of the largest |f| (what that is depends on the data alone).",
        "",
    ]
    names = [name.replace("|", "\\|") for name in (*NAMES, "first-order band: f_x", "f_y", "|f|")]
    lines += ["| | " + " | ".join(names) + " |", "|" + "---|" * (len(names) + 1)]
    for row, (ours, linear, by) in zip(ROWS, in_parallel(measured, ROWS, samples, 100, "coverage"), strict=True):
        lines.append(f"| {row.name} | " + " | ".join(f"{100 * v:.1f} %" for v in [*ours, *linear]) + " |")
        for style, name, part in (("-", "draws (what is reported)", by[:6]), ("--", "first order", by[6:])):
            if row is ROWS[0]:
                axes.plot([k + 0.5 for k in range(6)], [100 * v for v in part], style, marker="o", lw=2, label=name)
    axes.axhspan(93, 97, color="#d9ead3", zorder=0, label="93 to 97 %")
    axes.set_xlabel("distance from the estimated contact, in its width (sigma)")
    axes.set_ylabel("truth inside the 95 % band of |f| (%)")
    axes.set_ylim(0, 102)
    axes.set_title("One contact: the band of the load profile", fontsize=11, loc="left")
    axes.grid(alpha=0.3)
    axes.legend(loc="lower left")
    return [*lines, "", *WHY, "", "![Coverage of the band along the rod, and errors with a base frame that is off](trust.png)"]


WHY = """\
The band is that of 256 draws of the posterior, along log force, direction, log location and log width where these are known to a
factor, not the first-order band +-1.96 sqrt(J C J^T). The first-order band of a narrow load is nearly zero a few widths from its
estimated place, where the load may well be.

Where they do not hold 93 to 97 %, and why:
- Distributed loads: the posterior of a wide load is not Gaussian in any of these coordinates. A wide load near the tip, a narrower
  one before it and a stronger one nearer the base make the same shape to within the noise.
- Two contacts, by a percent or so: what one of them loses the other gains, along a line that is bent in these coordinates too.
- At the true place of a load, which is where |f| is largest, the band holds it less often than on average along the rod (column "at
  the true place"), because the prior takes a narrow load for a wider one and its peak for a lower one; elsewhere it holds more
  often. The weaker the load, the more the profile is that of the prior. Net force and location do not suffer.
- With a width that the prior does not know (a point force taken for a contact of 10 mm), f(s) is that of another load; force and
  location still hold ([reproduction.md](reproduction.md)).""".splitlines()
