"""What is checked of a fit that has converged: whether its steps follow its load, and whether its equilibrium is stable."""

from functools import lru_cache
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..mechanics.loads import PointWrenches
from ..mechanics.statics import stable_at
from ..model.problem import TIP_ROWS, Problem
from ..util.precision import DTYPE
from .evaluator import evaluator

STEP_SHARE = 0.05  # of chi^2: what the length of the steps may move in what is read
MOST_STEPS = 640
ERROR_OF_TURN = 0.002  # a rod that turns by a in each step and by b in all is off by less than this share of b a^4 of its length
LIGHT = 1.5  # loads of fixed direction, in EI / L^2, below which no rod buckles: pi^2 / 4 at the tip of a column


@lru_cache(maxsize=64)
def _squared(force: float, moment: float) -> Float[Tensor, " 6"]:
    """Units of the base wrench, twice their squares."""
    return torch.tensor([2 * force**2] * 3 + [2 * moment**2] * 3, dtype=DTYPE)


def _bend(problem: Problem, x: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
    """The square of the moment (N m) that a section carries at most: |M| + L |F| of the base, hence 2 (|M|^2 + L^2 |F|^2)."""
    base = problem.state.base
    force, moment = base.unit[2:4].tolist()
    return x[:, base.at].square() @ _squared(force * problem.robot.rod.length, moment)


def _moved(problem: Problem, bend: Any, weight: Any) -> Any:
    """By how much chi^2 moves at most with the steps: RK4's error is bounded by how far the rod turns in a step."""
    rod = problem.robot.rod
    curved = 0.0 if rod.straight else float(rod.reference_curvature[:, 1:].detach().norm(dim=-1).max()) * rod.length
    turn = bend**0.5 * rod.length / rod.softest + curved
    return weight * (ERROR_OF_TURN * turn * (turn / problem.steps) ** 4 * rod.length) ** 2


def all_follow(problem: Problem, x: Float[Tensor, "B n"]) -> bool:
    """Whether the bound clears all samples at once, as it does as a rule; False says nothing."""
    weight = float(problem.weights[:, :-TIP_ROWS].sum(-1).max())
    return _moved(problem, float(_bend(problem, x).max()), weight) < STEP_SHARE


def follows(problem: Problem, x: Float[Tensor, "B n"], wanted: Bool[Tensor, " B"] | bool = True) -> Bool[Tensor, " B"]:
    """Whether twice as many steps would read the same, to STEP_SHARE of chi^2; true where nobody wants to know.

    The bound clears nearly all samples; the others are evaluated.
    """
    good, w = torch.ones(len(x), dtype=torch.bool), problem.weights[:, :-TIP_ROWS]
    doubtful = (~(_moved(problem, _bend(problem, x), w.sum(-1)) < STEP_SHARE) & wanted).nonzero().squeeze(-1)
    if len(doubtful):
        part, at = problem.take(doubtful), x[doubtful]
        here, finer = (evaluator(p).sums(at).r[:, :-TIP_ROWS] for p in (part, part.with_steps(2 * part.steps)))
        good[doubtful] = ((w[doubtful] * (here - finer) ** 2).sum(-1) < STEP_SHARE) & torch.isfinite(finer).all(-1)
    return good


def in_the_way(problem: Problem, x: Float[Tensor, "B n"]) -> Bool[Tensor, " B"]:
    """Whether steps of this length h may keep a fit from a load that is narrower than they are.

    Within a step the moment then has a kink of slope F. Simpson's rule misses up to F h^2 / 24 of its integral, that of a parabola
    nothing, so that markers move by up to F L h^2 / (24 EI) with where in the step the load lies.
    """
    rod = problem.robot.rod
    off = _bend(problem, x).sqrt() * (rod.length / problem.steps) ** 2 / (24 * rod.softest)
    return problem.weights[:, :-TIP_ROWS].sum(-1) * off**2 > 1


def stable(problem: Problem, x: Float[Tensor, "B n"]) -> Bool[Tensor, " B"]:
    """Whether the equilibria at x are stable: `mechanics.statics.stable_at`."""
    robot, state = problem.robot, problem.state
    wrench = state.tip_wrench(x)
    dead = wrench[:, :3].norm(dim=-1) + wrench[:, 3:].norm(dim=-1) / robot.rod.length + robot.rod.mass * robot.gravity.norm()
    heavy = (dead * robot.rod.length**2 > LIGHT * robot.rod.bending_stiffness).nonzero().squeeze(-1)
    good = torch.ones(len(x), dtype=torch.bool)
    if len(heavy):
        part, at, L = problem.take(heavy), x[heavy], robot.rod.length
        loads = list(part.unknowns.loads.loads(at[:, state.loads.at])) if state.loads.size else []
        if state.tip.size:
            tip = wrench[heavy].unsqueeze(1)
            loads.append(PointWrenches(tip[..., :3], tip[..., 3:], tip.new_tensor([L])))
        q_tip = part.shape(at, differentiable=False).tip_q
        good[heavy] = stable_at(robot, tuple(loads), part.pulling(at), q_tip, part.steps)
    return good
