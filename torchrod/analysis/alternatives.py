"""Other equilibria that explain the same readings, where a rod is read at few places, or has several (estimation.elsewhere).

A tip pose alone, say, fits a rod that bends to either side. The fit that is reported is one of them; the others are looked for from
loads, and wrenches at the tip, of several sizes and directions, and told with their cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.elsewhere import elsewhere, fits_elsewhere
from ..estimation.other_fits import other_fits, shape_at
from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate_each
from ..estimation.starts import Start
from ..mechanics.loads import PointWrenches
from ..mechanics.statics import solve_shape
from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from ..util.threads import one_thread

FEW_PLACES = 3  # along the rod: with more of them a rod that is fitted is as a rule the only one
TIP_SIZES = (1.0, 3.0)  # force and moment scales of the starts
SAME = 1e-3  # of the length: fits whose rods lie closer together than that everywhere are one
CHUNK = 256  # samples at a time
MORE_SENSORS = "add sensors along the rod"


@dataclass(frozen=True)
class Solution:
    """One other equilibrium of a sample: chi2, forces (K, 2) N at (K,) m, section frame, the unknown wrench (6,) [N, N m] at the
    tip or None. remedy: what tells it from the fit.
    """

    chi2: float
    force: Float[Tensor, "K 2"]
    location: Float[Tensor, " K"]
    tip: Float[Tensor, " 6"] | None
    remedy: str

    @property
    def said(self) -> str:
        """What acts on the rod in it."""
        pushes = zip(self.force.tolist(), self.location.tolist(), strict=True)
        parts = [f"({x:.3g}, {y:.3g}) N at {1e3 * s:.4g} mm" for (x, y), s in pushes]
        if self.tip is not None:
            force, moment = (", ".join(f"{v:.3g}" for v in part.tolist()) for part in (self.tip[:3], self.tip[3:]))
            parts.append(f"a force of ({force}) N{f' and a moment of ({moment}) N m' * bool(self.tip[3:].any())} at the tip")
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


def _starts(problem: Problem) -> tuple[Float[Tensor, "N n"], Int[Tensor, " N"]]:
    """States in equilibrium, of the robot under the tensions of each sample, and which sample each is for.

    Without tensions they are the same for all samples, and solved once.
    """
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
    C, B, tension = len(gamma), problem.batch, problem.tension
    between = gamma.new_zeros(C, state.base.at.start - state.tip.at.stop)
    each = torch.cat([gamma, tip, between, gamma.new_zeros(C, 6)], -1)
    x = each if tension is None else each.repeat(B, 1)
    loads = list(family.loads(x[:, state.loads.at])) if family.size else []
    if state.tip.size:
        wrench = state.tip_wrench(x).unsqueeze(1)
        loads.append(PointWrenches(wrench[..., :3], wrench[..., 3:], torch.tensor([robot.rod.length], dtype=DTYPE)))
    tension = None if tension is None else tension.repeat_interleave(C, 0)
    solved = solve_shape(robot, tuple(loads), tension, problem.s.new_tensor([robot.rod.length]), len(x))
    x[:, state.base.at] = solved.base_wrench / state.base.unit
    x = x if problem.tension is not None else x.repeat(B, 1)
    found = torch.isfinite(x).all(-1)
    return x[found], torch.arange(B).repeat_interleave(C)[found]


def other_solutions(
    problem: Problem, fit: Estimate, parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]], settings: Settings | None = None
) -> tuple[tuple[Solution, ...], ...]:
    """For every sample of a fit the other equilibria that explain its readings too (their chi^2 is accepted), cheapest first.

    Only of samples that are accepted and that were read at few places, or for which estimation.elsewhere has others. parts: the
    unknowns of each sample, as in Analysis.
    """
    settings = replace(settings or Settings(), restarts=(), basins=0, sized=False)
    found: list[tuple[Solution, ...]] = [()] * problem.batch
    few = read_at_few_places(problem)
    for unknowns, index in parts:
        own = problem.of(unknowns)
        several = elsewhere(own) is not None
        asked = [index[fit.accepted[index] & few[index]], index[fit.accepted[index] & ~few[index] & several]]
        for rows in (chunk for wanted in asked if len(wanted) for chunk in wanted.split(CHUNK)):
            with one_thread(True):  # many small tensors, which several threads wait for longer than they work at
                each = _others(own.take(rows), fit.x[rows, : own.size], settings, bool(few[rows[0]]))
            for b, others in zip(rows.tolist(), each, strict=True):
                found[b] = others
    return tuple(found)


def _others(problem: Problem, x: Float[Tensor, "B n"], settings: Settings, few: bool) -> list[tuple[Solution, ...]]:
    """Of samples whose fits are x. few: read at few places, else for which estimation.elsewhere has others."""

    def fitting(problem: Problem, start: Start) -> Estimate:
        return estimate_each(problem, settings, start)

    def rods(problem: Problem, x: Float[Tensor, "N n"]) -> Float[Tensor, "N K 3"]:
        return shape_at(problem, x).p

    if few:
        others = other_fits(problem, x, *_starts(problem), rods, SAME * problem.robot.rod.length, fitting)
    else:
        others = fits_elsewhere(problem, x, fitting)
    found: list[list[Solution]] = [[] for _ in range(problem.batch)]
    if others is not None:
        to, (tried, of) = elsewhere(problem), others
        remedy = MORE_SENSORS if to is None else to.remedy
        for c, b in enumerate(of.tolist()):
            tip = None if tried.tip is None else tried.tip[c]
            found[b].append(Solution(float(tried.chi2[c]), tried.force[c], tried.location[c], tip, remedy))
    return [tuple(others) for others in found]
