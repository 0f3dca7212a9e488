"""How often the band of f(s) holds a load of any form, and the interval its resultant, where forms compete (--load-prior auto)."""

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

import torchrod as tr
from studies.reproduction.cases import steel_rod
from torchrod.analysis.pipeline import SMOOTH_CORRELATIONS, SMOOTH_DEVIATIONS
from torchrod.model.load_families.smooth import TERMS

PIECES, STEPS, MARKERS = 400, 40, 20  # point forces that a load is made of: steps end at each
NOISES = 1e-3, 2.5e-3  # of the length
AT_ONCE = 50  # shapes: each takes 20 MB
LEAST = 0.1  # of the peak: where f(s) counts
SIZE = 0.5, 1.5  # of the resultant, force scales; of loads that change sign, of their mean size

Form = Callable[[Tensor, torch.Generator, int], Tensor]  # (B, T) along one direction, or (B, T, 2) of both, in force scales / L


def _uniform(generator: torch.Generator, low: float, high: float, B: int) -> Tensor:
    return low + (high - low) * torch.rand(B, 1, generator=generator, dtype=torch.float64)


def even(length: float) -> Form:
    """Over a part of the rod, somewhere from a tenth of it on."""

    def form(t: Tensor, generator: torch.Generator, B: int) -> Tensor:
        first = _uniform(generator, 0.1, 1 - length, B)
        return ((t > first) & (t < first + length)) / length

    return form


def ramp(t: Tensor, generator: torch.Generator, B: int) -> Tensor:
    """From nothing at the base to most at the tip."""
    return (2 * t).expand(B, -1)


def half_sine(t: Tensor, generator: torch.Generator, B: int) -> Tensor:
    """Over the whole rod."""
    return (math.pi / 2 * torch.sin(math.pi * t)).expand(B, -1)


def sine(t: Tensor, generator: torch.Generator, B: int) -> Tensor:
    """A whole wave, of any phase."""
    return 2 * torch.sin(2 * math.pi * t + _uniform(generator, 0, 2 * math.pi, B))


def contact(t: Tensor, generator: torch.Generator, B: int) -> Tensor:
    """A Gaussian of 1 to 3 % of the length, at 30 to 95 %."""
    place, width = _uniform(generator, 0.3, 0.95, B), _uniform(generator, 0.01, 0.03, B)
    return torch.exp(-0.5 * ((t - place) / width) ** 2) / (math.sqrt(2 * math.pi) * width)


def of_the_prior(t: Tensor, generator: torch.Generator, B: int) -> Tensor:
    """Of a Matern process (nu = 1/2) of any of the sizes and length scales that compete, as cosines."""
    scales = torch.tensor(list(itertools.product(SMOOTH_DEVIATIONS, SMOOTH_CORRELATIONS)), dtype=torch.float64)
    deviation, ell = scales[torch.randint(len(scales), (B,), generator=generator)].T.unsqueeze(-1).unbind(0)
    k = torch.arange(TERMS, dtype=torch.float64)
    unit = deviation * (2 * ell / (1 + (k * math.pi * ell) ** 2) * torch.where(k > 0, 2.0, 1.0)).sqrt()
    z = torch.randn(B, 2, TERMS, generator=generator, dtype=torch.float64)
    return torch.einsum("bk,bck,tk->btc", unit, z, torch.cos(math.pi * t.unsqueeze(-1) * k))


OF_THE_PRIOR = "drawn from the prior of a smooth load"
WITHOUT_PLACE = "sine", OF_THE_PRIOR  # of no net force to speak of
FORMS: dict[str, Form] = {
    "uniform over 30 % of the rod": even(0.3),
    "uniform over 60 %": even(0.6),
    "ramp": ramp,
    "half sine": half_sine,
    "sine": sine,
    "contact": contact,
    OF_THE_PRIOR: of_the_prior,
}


@dataclass(frozen=True)
class Held:
    """Shares: of places where the band holds |f|, of samples whose resultant is held, and of those told as one load, whose net
    force and place (its moment over its force) are. width: of the band over the peak, median.
    """

    band: float
    resultant: float
    force: float
    place: float
    width: float
    cpu: float


@dataclass(frozen=True)
class Truth:
    """Of B loads. density: (B, T, 2) N/m at s / L; net (B,) N, of the side that a load pushes to; place (B,) m, of its moment;
    whole (B,) N, the resultant.
    """

    density: Callable[[Tensor], Tensor]
    net: Tensor
    place: Tensor
    whole: Tensor


def posed(form: Form, noise: float, cases: int, seed: int = 1) -> tuple[tr.Problem, Truth]:
    """So many loads, one contact told."""
    robot, generator = steel_rod(), torch.Generator().manual_seed(seed)
    rod = robot.rod
    L, size, turn = rod.length, rod.force_scale * _uniform(generator, *SIZE, cases), _uniform(generator, 0, 2 * math.pi, cases)
    state = generator.get_state()

    def density(t: Tensor) -> Tensor:
        generator.set_state(state)
        found = form(t, generator, cases)
        if found.ndim == 2:
            found = (size / rod.force_scale * found).unsqueeze(-1) * torch.stack([turn.cos(), turn.sin()], -1)
        return rod.force_scale / L * found

    t = (torch.arange(PIECES, dtype=torch.float64) + 0.5) / PIECES
    forces = torch.nn.functional.pad(density(t) * L / PIECES, (0, 1))
    s = torch.linspace(L / MARKERS, L, MARKERS, dtype=torch.float64)
    load, shapes = tr.PointForces(forces, (L * t).expand(cases, -1)), []
    for rows in torch.arange(cases).split(AT_ONCE):
        shapes.append(tr.solve_shape(robot, (load.take(rows),), None, s, len(rows), STEPS))
    p, wrench = (torch.cat([getattr(shape, name) for shape in shapes]) for name in ("p", "base_wrench"))
    p = p + noise * L * torch.randn(p.shape, generator=generator, dtype=torch.float64)
    unknowns = tr.Unknowns(tr.GaussianCoordinates(1, L, rod.force_scale))
    along = forces[..., 0] * turn.cos() + forces[..., 1] * turn.sin()
    truth = Truth(density, along.sum(-1).abs(), (along * L * t).sum(-1) / along.sum(-1), wrench[:, :3].norm(dim=-1))
    return tr.Problem(robot, unknowns, [tr.Markers(s, p, noise * L)]), truth


def measured(form: Form, noise: float, prior: str, cases: int, seed: int = 1) -> Held:
    """Of so many loads."""
    problem, truth = posed(form, noise, cases, seed)
    begun = time.process_time()
    found = tr.analyze(problem, tr.contact_hypotheses(problem, "auto" if prior == "auto" else 1, prior), sampled=True)
    cpu = time.process_time() - begun
    assert found.profile is not None and found.intervals is not None
    f = truth.density(found.profile.s / problem.robot.rod.length).norm(dim=-1)
    low, high = found.profile.band[..., 2, :].unbind(-1)
    peak, inside = f.amax(-1, keepdim=True), (low <= f) & (f <= high)
    one = torch.zeros(cases, dtype=torch.bool)
    for unknowns, rows in found.parts:
        one[rows] = unknowns.tip == "none" and getattr(unknowns.loads, "count", 1) == 1
    one &= found.estimate.accepted

    def held(value: Tensor, interval: Tensor, rows: Tensor) -> float:
        return float(((interval[..., 0] <= value) & (value <= interval[..., 1]))[rows].double().mean())

    return Held(
        float(inside[f > LEAST * peak].double().mean()),
        held(truth.whole, found.intervals.resultant[:, 3], torch.ones_like(one)),
        held(truth.net, found.intervals.magnitude[:, 0], one),
        held(truth.place, found.intervals.location[:, 0], one),
        float(((high - low).mean(-1) / peak.squeeze(-1)).median()),
        cpu / cases,
    )


ROWS = [f"{name}, {100 * noise:g} %" for name in FORMS for noise in NOISES[: 1 if name == OF_THE_PRIOR else None]]


def form_of(row: str) -> tuple[str, float]:
    """The name of its form, and its noise (of the length)."""
    name, noise = row.rsplit(", ", 1)
    return name, float(noise.removesuffix(" %")) / 100


def head(cases: int) -> list[str]:
    """Of the table."""
    return [
        "## Loads of any form",
        "",
        f"{cases} loads a row, each made of {PIECES} point forces: with `--contacts auto --load-prior auto`, which does not know",
        "their form, and with `--load-prior smooth`. Band: share (%) of the places where |f| is above a tenth of its peak at which",
        "the 95 % band holds it; its mean width over the peak, median. Resultant: share of samples whose 95 % interval holds",
        "|resultant|. Force, place: of what is told as one load, its net force and its moment over that (none of a whole wave,",
        "whose net force is nothing). CPU in seconds a shape. The last row is of what a smooth load is taken",
        "to be: what is smoother than most of it is held more often, what is rougher less, and a contact hardly.",
        "",
        "| load, noise (of L) | auto: band | width | force | place | resultant | CPU | smooth: band | width | force | place "
        "| resultant | CPU |",
        "|" + "---|" * 13,
    ]


def line(row: str, cases: int) -> str:
    """One line of it."""
    (name, noise), cells = form_of(row), []
    for prior in ("auto", "smooth"):
        held = measured(FORMS[name], noise, prior, cases)
        of_one = ["-", "-"] if name in WITHOUT_PLACE else [f"{100 * share:.1f}" for share in (held.force, held.place)]
        cells += [f"{100 * held.band:.1f}", f"{held.width:.2f}", *of_one, f"{100 * held.resultant:.1f}", f"{held.cpu:.2f}"]
    return f"| {row} | {' | '.join(cells)} |"
