"""The robot in equilibrium under loads that are known, roughly and fast: what a start of the filter is made of."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from .. import kernel
from ..mechanics.robot import Robot
from ..mechanics.statics import LOAD_PER_INCREMENT, ROUGH_TOLERANCE, solve_shape
from ..model.load_families import GaussianCoordinates
from ..model.problem import Problem
from ..model.sensors import Markers
from ..model.unknowns import Unknowns
from ..util.by_value import Kept, key
from .walk import Walk, family_of, kernel_walks

_bare = Kept()

HEAVY = 7.0  # in EI / L^3: the weight under which an upright rod buckles is 7.84


@dataclass(frozen=True)
class Rest:
    """B robots in equilibrium: wrench (B, 6) = [n(0) N, m(0) N m] and p (B, P, 3) m, base frame; NaN where there is none."""

    wrench: Float[Tensor, "B 6"]
    p: Float[Tensor, "B P 3"]


def at_rest(problem: Problem, gamma: Float[Tensor, "B g"], q_tip: Float[Tensor, "B 4"] | None = None) -> Rest:
    """The base wrench and the shape at problem.s under the loads gamma and the tensions, to ROUGH_TOLERANCE on coarse steps.

    q_tip: the orientation of the tip near which to look, where it is known: sooner found. By the compiled kernel where it serves;
    what does not settle there, rods so heavy that an upright one would fall over, and all else, by torchrod.solve_shape, which is
    the definition and stays in stable equilibrium.
    """
    s, B, P, family = problem.s, len(gamma), len(problem.s), problem.unknowns.loads
    plain = Problem(
        problem.robot, Unknowns(family), [Markers(s, s.new_empty(B, len(s), 3), 1.0)], problem.tension, problem.coarse.steps
    )
    wrench, p = gamma.new_full((B, 6), torch.nan), gamma.new_full((B, P, 3), torch.nan)
    settled = torch.zeros(B, dtype=torch.bool)
    # Where tendons rub, how far they have turned at the tip is unknown as well.
    smooth = problem.robot.tendons.friction is None
    light = smooth and problem.robot.gravity.ndim == 1 and math.isfinite(_weight(problem.robot))
    if light and family_of(plain) != "point" and kernel_walks(plain):
        increments = _increments(problem.robot) if q_tip is None else 1
        x = plain.state.join(gamma, gamma.new_zeros(B, 6))
        wrench, missed, p = Walk(plain).balance(x, q_tip, increments, ROUGH_TOLERANCE)
        settled = (missed <= ROUGH_TOLERANCE) & torch.isfinite(wrench).all(-1)
    if bool(settled.all()):
        return Rest(wrench, p)
    index = (~settled).nonzero().squeeze(-1)
    tension = None if problem.tension is None else problem.tension[index]
    start = None if q_tip is None else q_tip[index]
    loads = family.loads(gamma[index]) if gamma.shape[-1] else ()
    solved = solve_shape(problem.robot, loads, tension, s, len(index), plain.steps, ROUGH_TOLERANCE, start)
    return Rest(wrench.index_copy(0, index, solved.base_wrench), p.index_copy(0, index, solved.p))


def without_load(problem: Problem, s: Float[Tensor, " P"] | None = None) -> Rest:
    """The robot under its tensions and its weight alone, at problem.s or at s (m): one forward solve where the samples are alike
    before the load, kept for the next shapes of the same robot.
    """
    robot, B, s = problem.robot, problem.batch, problem.s if s is None else s
    none = Unknowns(GaussianCoordinates(0, robot.rod.length, robot.rod.force_scale))

    def bare(count: int) -> Rest:
        at = [Markers(s, s.new_empty(count, len(s), 3), 1.0)]
        return at_rest(Problem(robot, none, at, problem.tension, problem.steps), s.new_zeros(count, 0))

    if problem.tension is not None or robot.gravity.ndim > 1:
        return bare(B)
    rest = _bare(key((robot, problem.steps, s, kernel.available())), lambda: bare(1))
    return Rest(rest.wrench.expand(B, 6), rest.p.expand(B, *rest.p.shape[1:]))


def _weight(robot: Robot) -> float:
    """In EI / L^3; infinite where the rod has no stiffness to speak of."""
    load = robot.rod.mass * float(robot.gravity.norm()) * robot.rod.length**2
    return load / robot.rod.bending_stiffness if load < HEAVY * robot.rod.bending_stiffness else math.inf


def _increments(robot: Robot) -> int:
    """In how many parts the weight is put on, so that each is no more than solve_shape's."""
    return max(1, math.ceil(_weight(robot) / LOAD_PER_INCREMENT))
