"""Other equilibria that explain the same readings, where a rod is read at few places.

A tip pose alone, say, fits a rod that bends to either side. The fit that is reported is one of them; the others are looked for from
loads, and wrenches at the tip, of several sizes and directions, and told with their cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate_each
from ..estimation.starts import Origin, Start
from ..mechanics.loads import PointWrenches
from ..mechanics.statics import shape_from_base, solve_shape
from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from ..util.status import Status

FEW_PLACES = 3  # along the rod: with more of them a rod that is fitted is as a rule the only one
TIP_SIZES = (1.0, 3.0)  # force and moment scales of the starts
SAME = 1e-3  # of the length: fits whose rods lie closer together than that everywhere are one
NODES = 21


@dataclass(frozen=True)
class Solution:
    """One other equilibrium of a sample: chi2, forces (K, 2) N at (K,) m, the unknown wrench (6,) [N, N m] at the tip or None."""

    chi2: float
    force: Float[Tensor, "K 2"]
    location: Float[Tensor, " K"]
    tip: Float[Tensor, " 6"] | None

    @property
    def said(self) -> str:
        """What acts on the rod in it."""
        parts = [
            f"{f:.3g} N at {1e3 * s:.4g} mm" for f, s in zip(self.force.norm(dim=-1).tolist(), self.location.tolist(), strict=True)
        ]
        if self.tip is not None:
            force, moment = (", ".join(f"{v:.3g}" for v in part.tolist()) for part in (self.tip[:3], self.tip[3:]))
            parts.append(f"force ({force}) N and moment ({moment}) N m at the tip")
        return " and ".join(parts)


def read_at_few_places(problem: Problem) -> Bool[Tensor, " B"]:
    """Samples that were read at so few different arc lengths that other equilibria may explain them as well."""
    read, first = torch.zeros(problem.batch, len(problem.s), dtype=torch.bool), 0
    for sensor in problem.sensors:
        n = len(sensor.s)
        if n:
            rows = (
                (sensor.weights > 0).unflatten(-1, (n, -1)).any(-1) if sensor.rows % n == 0 else torch.ones(problem.batch, n).bool()
            )
            read[:, first : first + n] = rows
        first += n
    places, which = problem.s.unique(return_inverse=True)
    count = torch.stack([read[:, which == k].any(-1) for k in range(len(places))], -1).sum(-1) if len(places) else read.sum(-1)
    return (count > 0) & (count <= FEW_PLACES)


def _starts(problem: Problem) -> Float[Tensor, "C n"]:
    """States in equilibrium, of the robot under the tensions of a problem of one sample."""
    robot, state, family = problem.robot, problem.state, problem.unknowns.loads
    elsewhere = getattr(family, "elsewhere", None)
    gamma = family.start().unsqueeze(0)
    if not state.tip.size:
        gamma = gamma if elsewhere is None else elsewhere()
        tip = gamma.new_zeros(len(gamma), 0)
    else:
        axes = torch.cat([torch.eye(state.tip.size, dtype=DTYPE), -torch.eye(state.tip.size, dtype=DTYPE)])
        tip = torch.cat([size * axes for size in TIP_SIZES])
        gamma = gamma.expand(len(tip), -1)
    C = len(gamma)
    between = gamma.new_zeros(C, state.base.at.start - state.tip.at.stop)
    x = torch.cat([gamma, tip, between, gamma.new_zeros(C, 6)], -1)
    loads = list(family.loads(gamma)) if family.size else []
    if state.tip.size:
        wrench = state.tip_wrench(x).unsqueeze(1)
        loads.append(PointWrenches(wrench[..., :3], wrench[..., 3:], torch.tensor([robot.rod.length], dtype=DTYPE)))
    tension = None if problem.tension is None else problem.tension.expand(C, -1)
    solved = solve_shape(robot, tuple(loads), tension, problem.s.new_tensor([robot.rod.length]), C)
    x[:, state.base.at] = solved.base_wrench / state.base.unit
    return x[torch.isfinite(x).all(-1)]


def other_solutions(
    problem: Problem, fit: Estimate, parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]], settings: Settings | None = None
) -> tuple[tuple[Solution, ...], ...]:
    """For every sample of a fit the other equilibria that explain its readings too (their chi^2 is accepted), cheapest first.

    Only of samples that were read at few places, and that are accepted. parts: the unknowns of each sample, as in Analysis.
    """
    settings = replace(settings or Settings(), restarts=(), basins=0, sized=False)
    found: list[tuple[Solution, ...]] = [()] * problem.batch
    few = read_at_few_places(problem) & fit.accepted
    for unknowns, index in parts:
        own = problem.of(unknowns)
        for b in index[few[index]].tolist():
            one = own.take(torch.tensor([b]))
            begin = _starts(one)
            if len(begin):
                found[b] = _others(one, fit.x[b, : own.size], begin, settings)
    return tuple(found)


def _others(one: Problem, x: Float[Tensor, " n"], begin: Float[Tensor, "C n"], settings: Settings) -> tuple[Solution, ...]:
    """Of one sample whose fit is x."""
    many = one.take(torch.zeros(len(begin), dtype=torch.int64))
    tried = estimate_each(many, settings, Start.at(begin, Origin.ELSEWHERE))
    good = (tried.accepted & (tried.status == int(Status.CONVERGED))).nonzero().squeeze(-1)
    along = torch.linspace(0, one.robot.rod.length, NODES, dtype=DTYPE)
    known, kept = [_rod(one, x.unsqueeze(0), along)[0]], []
    for c in good[tried.chi2[good].argsort()].tolist():
        p = _rod(one, tried.x[c : c + 1], along)[0]
        if all(float((p - other).norm(dim=-1).max()) > SAME * one.robot.rod.length for other in known):
            known.append(p)
            kept.append(
                Solution(float(tried.chi2[c]), tried.force[c], tried.location[c], None if tried.tip is None else tried.tip[c])
            )
    return tuple(kept)


def _rod(one: Problem, x: Float[Tensor, "1 n"], along: Float[Tensor, " N"]) -> Float[Tensor, "1 N 3"]:
    """The centre line (m) at other places than the sensors'."""
    state = one.state
    loads = one.unknowns.loads.loads(x[:, state.loads.at]) if state.loads.size else ()
    return shape_from_base(one.robot, loads, state.base.of(x), one.pulling(x), along, one.steps, differentiable=False).p
