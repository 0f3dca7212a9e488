"""Fits all along what the readings leave open, where draws are made beside the fit that is reported.

Some forces bend nothing by themselves and only weigh on what bends the rod already: along the rod at its tip, and across a strip;
and so does a moment about the rod's axis. The readings hardly tell such a force F, and what they leave open is a curved valley:
from a rod that is pressed to one that is pulled a push moves along it, one that pushes a strip harder across does so nearer the
base, and under a torque what bends the rod turns about its axis. A normal distribution about one fit does not follow that. It is
followed here by fits with F held at knots, each begun at its neighbour's and at what that says of the next,

    (1)  x_j+1 = x_j + dx/dF (F_j+1 - F_j),    dx/dF = C_xF / C_FF

from F = 0 and from each fit; beside an axial force with hardly any force across the tip, then with some; beside a torque with some
force and some moment across the tip, then with hardly any of the one or the other. About each, x is taken to be normal, F with
OVERLAP of the way to the next.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..model.load_families import GaussianCoordinates, PointCoordinates
from ..model.problem import Problem
from ..util.precision import DTYPE
from ..util.status import Status
from .elsewhere import ALIKE, across_strip, fits_elsewhere, marks
from .result import Estimate
from .starts import Origin, Start, cold_start

AXIAL = (-2.2, -1.6, -1.2, -0.9, -0.7, -0.55, -0.4, -0.25, -0.1, 0.0, 0.1, 0.3, 0.7, 1.5, 3.0, 6.0)  # force scales; 0.62 buckle
ONE_SIDE = (0.03, 0.07, 0.13, 0.2, 0.3, 0.45, 0.65, 0.9, 1.25, 1.7, 2.3, 3.0, 4.0, 5.5, 7.5, 10.0, 14.0, 20.0)  # force scales
ACROSS = (*(-F for F in reversed(ONE_SIDE)), 0.0, *ONE_SIDE)
TORQUE = (-3.0, -2.2, -1.6, -1.1, -0.75, -0.5, -0.3, -0.15, 0.0, 0.15, 0.3, 0.5, 0.75, 1.1, 1.6, 2.2, 3.0)  # moment scales
HELD = 1e-3  # to within
OVERLAP = 0.6  # of the distance of two knots: a standard deviation
HARDLY, SOME = 0.03, 0.5  # force and moment scales across the tip
PUSH, PLACE = 3.0, 2.0  # standard deviations of pushes (force scales) and of eta, that no fit goes astray
ALIGNED = 1e-6  # of the section's axes with a strip's sides
WORSE = 40.0  # than the best fit, by its cost: such fits are none

Fitting = Callable[[Problem, Start], Estimate]


@dataclass(frozen=True)
class Valley:
    """Fits x (B, S, n) of B samples and their covariances C (B, S, n, n), the first the one that is reported; sound (B, S): which
    there are.
    """

    x: Float[Tensor, "B S n"]
    C: Float[Tensor, "B S n n"]
    sound: Bool[Tensor, "B S"]

    @classmethod
    def of(cls, x: Float[Tensor, "B n"], C: Float[Tensor, "B n n"]) -> "Valley":
        """Of nothing but one fit."""
        return cls(x.unsqueeze(1), C.unsqueeze(1), torch.ones(len(x), 1, dtype=torch.bool))


@dataclass(frozen=True)
class Line:
    """What is held: an entry of x, at knots (J,) in its units, of which `unit` is a force or moment scale.

    across: the entries that are forces across the tip, and those that are moments, each with a scale in their units. sizes: of all
    these, in scales: of the fits from knot to knot, then of those begun at each.
    """

    entry: int
    knots: Float[Tensor, " J"]
    unit: float = 1.0
    across: tuple[tuple[slice, float], ...] = ()
    sizes: tuple[tuple[float, ...], ...] = ((),)


def line_of(problem: Problem) -> Line | None:
    """Along what a problem has a valley; None where it has none.

    A force that is unknown at the tip beside pushes at unknown places; a wrench that is unknown at the tip and nothing else, for
    beside pushes a torque turns these, in the section frame, too far from one fit to the next. And one push on a strip whose sides
    lie along the axes of the section.
    """
    loads, state, rod = problem.unknowns.loads, problem.state, problem.robot.rod
    if problem.prior is not None or not isinstance(loads, GaussianCoordinates | PointCoordinates) or loads.locations is not None:
        return None
    first, units = state.tip.at.start, [rod.force_scale] * 3 + [rod.moment_scale] * 3
    unit = [scale / own for scale, own in zip(units, state.tip.unit.tolist(), strict=False)]
    if state.tip.size == 3 and loads.count:
        across = ((slice(first, first + 2), unit[0]),)
        return Line(first + 2, unit[2] * torch.tensor(AXIAL, dtype=DTYPE), unit[2], across, ((HARDLY,), (SOME,)))
    if state.tip.size == 6 and not loads.count:
        across = (slice(first, first + 2), unit[0]), (slice(first + 3, first + 5), unit[3])
        sizes = (SOME, SOME), (HARDLY, SOME), (SOME, HARDLY)
        return Line(first + 5, unit[5] * torch.tensor(TORQUE, dtype=DTYPE), unit[5], across, sizes)
    strip = across_strip(rod)
    if not state.tip.size and loads.count == 1 and strip is not None and float(strip.abs().amin()) < ALIGNED:
        return Line(int(strip.abs().argmax()), torch.tensor(ACROSS, dtype=DTYPE))
    return None


def valley(problem: Problem, x: Float[Tensor, "B n"], C: Float[Tensor, "B n n"], fitting: Fitting) -> Valley:
    """About fits x of covariance C; of nothing but these where there is no line. fitting: a plain solver."""
    line = line_of(problem)
    if line is None:
        return Valley.of(x, C)
    search, every = _Search(problem, line, fitting), torch.arange(len(x))
    search.along(every, cold_start(problem).x, torch.full_like(every, int(line.knots.abs().argmin())))
    search.along(every, x, search.nearest(x))
    others = fits_elsewhere(problem, x, fitting)
    if others is not None:
        fit, of = others
        search.add(of, torch.full_like(of, -1), fit.x, fit.covariance, fit.cost)
        search.along(of, fit.x, search.nearest(fit.x))
    at = search.knot >= 0
    of, begin, knot = search.of[at], search.x[at], search.knot[at]
    for sizes in line.sizes[1:]:
        search.held(of, begin, knot, sizes)
    return search.joined(x, C)


@dataclass
class _Search:
    """What has been found so far: N fits, of which sample and at which knot (-1: at none), with the cost of the weak prior."""

    problem: Problem
    line: Line
    fitting: Fitting
    of: Int[Tensor, " N"] = field(init=False)
    knot: Int[Tensor, " N"] = field(init=False)
    x: Float[Tensor, "N n"] = field(init=False)
    C: Float[Tensor, "N n n"] = field(init=False)
    cost: Float[Tensor, " N"] = field(init=False)

    def __post_init__(self):
        mean, n = self.problem.mean, self.problem.size
        self.of, self.knot = torch.zeros(2, 0, dtype=torch.int64)
        self.x, self.C, self.cost = mean.new_zeros(0, n), mean.new_zeros(0, n, n), mean.new_zeros(0)
        self.per_load = getattr(self.problem.unknowns.loads, "per_load", 0)

    def add(self, *rows: Tensor) -> None:
        """of, knot, x, C and cost of more fits."""
        for name, more in zip(("of", "knot", "x", "C", "cost"), rows, strict=True):
            setattr(self, name, torch.cat([getattr(self, name), more]))

    def nearest(self, x: Float[Tensor, "N n"]) -> Int[Tensor, " N"]:
        """The knot nearest to fits."""
        return (x[:, self.line.entry, None] - self.line.knots).abs().argmin(-1)

    def least(self) -> Float[Tensor, " B"]:
        """The cost of the best fit of each sample."""
        return self.cost.new_full((self.problem.batch,), torch.inf).scatter_reduce(0, self.of, self.cost, "amin")

    def along(self, of: Int[Tensor, " r"], start: Float[Tensor, "r n"], first: Int[Tensor, " r"]) -> None:
        """Rows of fits both ways from starts at a first knot, until they have gone astray or come upon another row."""
        fit, _ = self.held(of, start, first, self.line.sizes[0])
        here, slope, of, knot = fit.x.repeat(2, 1), self._slope(fit).repeat(2, 1), of.repeat(2), first.repeat(2)
        way = torch.tensor([1, -1]).repeat_interleave(len(first))
        live = (fit.status == int(Status.CONVERGED)).repeat(2)
        while True:
            live = live & (knot + way >= 0) & (knot + way < len(self.line.knots))
            of, here, knot, slope, way = (v[live] for v in (of, here, knot, slope, way))
            if not len(of):
                return
            knot = knot + way
            start = here + slope * (self.line.knots[knot] - here[:, self.line.entry]).unsqueeze(-1)
            fit, live = self.held(of, start, knot, self.line.sizes[0])
            here, slope = fit.x, self._slope(fit)

    def held(
        self, of: Int[Tensor, " r"], start: Float[Tensor, "r n"], knot: Int[Tensor, " r"], sizes: tuple[float, ...]
    ) -> tuple[Estimate, Bool[Tensor, " r"]]:
        """Fits with F held at knots; which of them are worth keeping, and are kept. sizes: see Line."""
        part, line, knots = self.problem.take(of), self.line, self.line.knots
        mean, precision = (v.expand(len(of), -1).clone() for v in (part.mean, part.precision))
        for i in range(0, part.state.loads.size, self.per_load):
            precision[:, i : i + 2], precision[:, i + 2], mean[:, i + 2] = PUSH**-2, PLACE**-2, 0.0
        mean[:, line.entry], precision[:, line.entry] = knots[knot], (HELD * line.unit) ** -2
        for (at, unit), size in zip(line.across, sizes, strict=True):
            precision[:, at] = (size * unit) ** -2
        fit = self.fitting(replace(part, prior=(mean, precision)), Start.at(start, Origin.ELSEWHERE))
        gap = torch.maximum(knots.diff()[(knot - 1).clamp(min=0)], knots.diff()[knot.clamp(max=len(knots) - 2)])
        slope = self._slope(fit)
        C = fit.covariance + slope.unsqueeze(-1) * slope.unsqueeze(-2) * (OVERLAP * gap).square()[:, None, None]
        weak = self.problem.precision * (fit.x - self.problem.mean) ** 2
        cost = fit.cost - (precision * (fit.x - mean) ** 2 - weak).sum(-1)
        away = (marks(self.problem, fit.x).unsqueeze(1) - marks(self.problem, self.x)).norm(dim=-1)
        known = ((away < ALIKE) & (self.of == of.unsqueeze(-1)) & (self.knot == knot.unsqueeze(-1))).any(-1)
        sound = (fit.status == int(Status.CONVERGED)) & torch.isfinite(C).flatten(1).all(-1)
        kept = sound & ~known & (cost < self.least()[of] + WORSE)
        self.add(of[kept], knot[kept], fit.x[kept], C[kept], cost[kept])
        return fit, kept

    def _slope(self, fit: Estimate) -> Float[Tensor, "r n"]:
        """dx/dF of (1)."""
        C = fit.covariance
        return C[:, :, self.line.entry] / C[:, self.line.entry, self.line.entry].clamp(min=1e-14 * self.line.unit**2).unsqueeze(-1)

    def joined(self, x: Float[Tensor, "B n"], C: Float[Tensor, "B n n"]) -> Valley:
        """By sample, after the fits x."""
        kept = (self.cost < self.least()[self.of] + WORSE).nonzero().squeeze(-1)
        kept = kept[self.of[kept].argsort(stable=True)]
        of = self.of[kept]
        place = 1 + torch.arange(len(of)) - torch.searchsorted(of, of)
        own, own_C = self._ordered(self.x[kept], self.C[kept], x[of])
        one, S = Valley.of(x, C), 1 + int(torch.bincount(of, minlength=1).max())
        found = Valley(*(v.expand(-1, S, *v.shape[2:]).clone() for v in (one.x, one.C, one.sound)))
        found.x[of, place], found.C[of, place] = own, own_C
        found.sound[:, 1:] = False
        found.sound[of, place] = True
        return found

    def _ordered(
        self, x: Float[Tensor, "r n"], C: Float[Tensor, "r n n"], like: Float[Tensor, "r n"]
    ) -> tuple[Float[Tensor, "r n"], Float[Tensor, "r n n"]]:
        """With the loads in that order along the rod in which others have them."""
        loads, n = self.problem.state.loads.size, x.shape[1]
        theirs, own = (v[:, :loads].unflatten(1, (-1, self.per_load))[..., 2].argsort(dim=1, stable=True) for v in (like, x))
        block = torch.zeros_like(own).scatter(1, theirs, own)
        entries = (block.unsqueeze(-1) * self.per_load + torch.arange(self.per_load)).flatten(1)
        entries = torch.cat([entries, torch.arange(loads, n).expand(len(x), -1)], 1)
        rows = entries.unsqueeze(-1).expand(-1, -1, n)
        return x.gather(1, entries), C.gather(1, rows).gather(2, rows.mT)
