"""Where else the same readings may have their explanation: samples of which other fits are looked for from the start.

Where an unknown force acts on the tip beside a push, a rod has as a rule two shapes of its forces: the tip is pushed along the rod
while something pushes near its middle, or it is pulled aside while something holds it nearer the base. It is begun at such: for
places of a push and axial forces at the tip, with the lateral force that leaves the moment at the clamp as it is on the shape of
the fit,

    (1)  p(s) x R(s) F = M - p(L) x F_z e_3,    M the moment of all loads of the fit about the clamp, across the rod

A strip hardly bends to a push across it. It twists, and what shows is how that lets it bend to its soft side, which is alike for
both signs of the push across: it is begun at the fit with the other sign, of each push and of two at once.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..mechanics.lie import cross, rotate
from ..mechanics.rod import Rod
from ..mechanics.statics import Shape
from ..model.load_families import GaussianCoordinates, PointCoordinates
from ..model.problem import Problem
from ..util.precision import DTYPE
from ..util.status import Status
from .other_fits import NODES, Fitting, other_fits, shape_at
from .result import Estimate, with_covariance

ALIKE = 0.03  # of the length, and in force scales: places and forces that are closer together are those of one fit
PLACES = (0.2, 0.4, 0.6, 0.8, 0.95)  # of the length
AXIAL = (-1.5, -0.75, -0.3, 0.3)  # force scales
MOST_FORCE = 3.0  # force scales: what (1) asks for at a place where it hardly tells the force
FLAT = 100.0  # times as stiff to one side as to the other: a strip
MOST_PUSHES = 2  # on a strip, all of whose signs are tried; of more, none

Starts = Callable[[Problem, Float[Tensor, "B n"]], list[Float[Tensor, "B n"]]]


@dataclass(frozen=True)
class Elsewhere:
    """starts: states to begin at, of samples whose fits are x. remedy: what would tell one from the other."""

    starts: Starts
    remedy: str


def elsewhere(problem: Problem) -> Elsewhere | None:
    """Where else to look for fits of a problem; None where nothing calls for it.

    Nor where a moment is unknown at the tip as well: there estimation.tip_size chooses, and draws are not held more often (of 30).
    """
    loads, tip = problem.unknowns.loads, problem.state.tip
    if not isinstance(loads, GaussianCoordinates | PointCoordinates) or loads.locations is not None:
        return None
    if tip.size == 3 and loads.count == 1:
        return Elsewhere(_beside_the_tip, "measure the force at the tip, or what pushes")
    if not tip.size and 1 <= loads.count <= MOST_PUSHES and across_strip(problem.robot.rod) is not None:
        return Elsewhere(_other_signs, "measure the force under the base")
    return None


def fits_elsewhere(problem: Problem, x: Float[Tensor, "B n"], fitting: Fitting) -> tuple[Estimate, Int[Tensor, " k"]] | None:
    """Other fits of samples whose fits are x: see other_fits. None where there is none, or nothing to look for."""
    to = elsewhere(problem)
    if to is None:
        return None

    def looks(part: Problem, x: Float[Tensor, "N n"]) -> Float[Tensor, "N c 1"]:
        return marks(part, x).unsqueeze(-1)

    starts = to.starts(problem, x)
    every, of = torch.cat(starts), torch.arange(len(x)).repeat(len(starts))
    sound = torch.isfinite(every).all(-1)  # not of a fit that has gone so far astray that it has no shape
    return other_fits(problem, x, every[sound], of[sound], looks, ALIKE, fitting)


def cheapest(problem: Problem, fit: Estimate, fitting: Fitting) -> Estimate:
    """The fit of least cost, of every sample that can be fitted: of `fit` and of fits_elsewhere.

    Its covariance is that of all of them about it, each weighed by Laplace's method,

        (2)  log w = -cost / 2 + log det C_yy / 2 + const

    with the covariance C_yy of everything but the base wrench. Where several are as likely, a spread about one says too little.
    """
    index = ((fit.status != int(Status.INVALID)) & torch.isfinite(fit.x).all(-1)).nonzero().squeeze(-1)
    others = fits_elsewhere(problem.take(index), fit.x[index], fitting) if len(index) else None
    if others is None:
        return fit
    other, of = others
    first = torch.cat([of.new_ones(1, dtype=torch.bool), of.diff() > 0])  # of each sample the cheapest
    best = fit.improved_by(other.of(first.nonzero().squeeze(-1), problem.size), index[of[first]])
    mine, rows = torch.zeros(problem.batch, dtype=torch.bool), index[of]
    mine[rows] = fit.status[rows] == int(Status.CONVERGED)
    mine = mine.nonzero().squeeze(-1)
    row = torch.cat([rows, mine])
    x, C, cost = (torch.cat([getattr(other, name), getattr(fit, name)[mine]]) for name in ("x", "covariance", "cost"))
    m = problem.state.base.at.start
    log_w = (-0.5 * cost + 0.5 * torch.linalg.slogdet(C[:, :m, :m])[1]).nan_to_num(-torch.inf, -torch.inf, -torch.inf)
    w = torch.exp(log_w - log_w.new_full((problem.batch,), -torch.inf).scatter_reduce(0, row, log_w, "amax")[row])
    off = x - best.x[row]
    about = w[:, None, None] * (C + off.unsqueeze(-1) * off.unsqueeze(-2))
    total = torch.zeros_like(fit.cost).index_add(0, row, w)[:, None, None]
    joined = torch.zeros_like(fit.covariance).index_add(0, row, about) / total
    sound = (total > 0) & torch.isfinite(joined).flatten(1).all(-1)[:, None, None]
    return with_covariance(problem, best, torch.where(sound, joined, best.covariance))


def _pushes(problem: Problem, x: Float[Tensor, "... n"]) -> tuple[Float[Tensor, "... K 2"], Float[Tensor, "... K"]]:
    """Forces (force scales) and places (lengths)."""
    loads = problem.unknowns.loads
    assert isinstance(loads, GaussianCoordinates | PointCoordinates)
    each = x[..., problem.state.loads.at].unflatten(-1, (loads.count, loads.per_load))
    return each[..., :2], torch.sigmoid(each[..., 2])


def _at_tip(problem: Problem, x: Float[Tensor, "... n"]) -> Float[Tensor, "... q"]:
    """What is unknown there: nothing, a force, or a force and a moment; in force and moment scales."""
    tip, rod = problem.state.tip, problem.robot.rod
    scale = x.new_tensor([rod.force_scale] * 3 + [rod.moment_scale] * 3)[: tip.size]
    return x[..., tip.at] * (tip.unit / scale)


def _wrench(problem: Problem, shape: Shape, x: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B 3"], Float[Tensor, "B 3"]]:
    """The forces of pushes and tip together, and their moment about the clamp, on given shapes (N, N m)."""
    lateral, place = _pushes(problem, x)
    scale, rows = problem.robot.rod.force_scale, torch.arange(len(x)).unsqueeze(-1)
    at = (place * (NODES - 1)).nan_to_num(0.0).round().long()
    F = rotate(shape.q[rows, at], torch.nn.functional.pad(scale * lateral, (0, 1)))
    force, moment = F.sum(1), cross(shape.p[rows, at], F).sum(1)
    if problem.state.tip.size:
        F_tip = scale * _at_tip(problem, x)[..., :3]
        force, moment = force + F_tip, moment + cross(shape.p[:, -1], F_tip)
    return force, moment


def _held(problem: Problem, shape: Shape, start: Float[Tensor, "B n"], x: Float[Tensor, "B n"]) -> Float[Tensor, "B n"]:
    """A start with the base wrench that holds its loads, on the shape of the fit x."""
    base = problem.state.base
    more = [new - old for new, old in zip(_wrench(problem, shape, start), _wrench(problem, shape, x), strict=True)]
    start[:, base.at] += torch.cat(more, -1) / base.unit
    return start


def marks(problem: Problem, x: Float[Tensor, "... n"]) -> Float[Tensor, "... c"]:
    """By what fits differ: the places of the pushes (lengths), what is unknown at the tip and, on a strip, what pushes across it
    (force and moment scales).
    """
    force, place = _pushes(problem, x)
    across = across_strip(problem.robot.rod)
    return torch.cat([place, _at_tip(problem, x), *(() if across is None else (force @ across,))], -1)


def _beside_the_tip(problem: Problem, x: Float[Tensor, "B n"]) -> list[Float[Tensor, "B n"]]:
    """(1)."""
    rod, push, tip = problem.robot.rod, problem.state.loads.at.start, problem.state.tip
    shape = shape_at(problem, x)
    _, M = _wrench(problem, shape, x)
    starts = []
    for place, axial in itertools.product(PLACES, AXIAL):
        start, k = x.clone(), round(place * (NODES - 1))
        start[:, push : push + 2], start[:, push + 2] = 0.0, torch.logit(torch.tensor(place, dtype=DTYPE))
        start[:, tip.at.start : tip.at.start + 3] = x.new_tensor([0.0, 0.0, axial * rod.force_scale]) / tip.unit[:3]
        _, M_tip = _wrench(problem, shape, start)
        axes = rotate(shape.q[:, k].unsqueeze(1), torch.eye(3, dtype=DTYPE)[:2])
        by = cross(shape.p[:, k].unsqueeze(1), axes)[..., :2].mT
        asked = (M - M_tip)[:, :2].unsqueeze(-1)
        F = torch.linalg.lstsq(by.nan_to_num(0.0), asked.nan_to_num(0.0)).solution.squeeze(-1) / rod.force_scale
        start[:, push : push + 2] = F * (MOST_FORCE / F.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1.0)
        starts.append(_held(problem, shape, start, x))
    return starts


def across_strip(rod: Rod) -> Float[Tensor, " 2"] | None:
    """The direction of the section to which a strip hardly bends; None of a rod that is no strip."""
    stiffness, axes = torch.linalg.eigh(rod.K_bt.detach()[:2, :2])
    if not float(stiffness[1]) > FLAT * float(stiffness[0]):
        return None
    return torch.stack([-axes[1, 1], axes[0, 1]])  # what bends the rod about an axis pushes normal to it


def _other_signs(problem: Problem, x: Float[Tensor, "B n"]) -> list[Float[Tensor, "B n"]]:
    """The fits, with pushes across of other signs."""
    n, loads = across_strip(problem.robot.rod), problem.unknowns.loads
    assert n is not None and isinstance(loads, GaussianCoordinates | PointCoordinates)
    shape, starts = shape_at(problem, x), []
    force, _ = _pushes(problem, x)
    for turned in itertools.product((0.0, 1.0), repeat=loads.count):
        if any(turned):
            start = x.clone()
            other = force - 2 * x.new_tensor(turned).unsqueeze(-1) * (force @ n).unsqueeze(-1) * n
            for k in range(loads.count):
                first = problem.state.loads.at.start + k * loads.per_load
                start[:, first : first + 2] = other[:, k]
            starts.append(_held(problem, shape, start, x))
    return starts
