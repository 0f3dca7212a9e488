"""Where the filter starts, where that came from, and what it must beat."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..model.problem import Problem
from ..model.sensors import Camera
from ..model.sensors.camera import BEHIND
from ..util.precision import Float64
from . import filter as ekf
from .at_rest import at_rest, without_load
from .evaluator import evaluator, normal

PUSH, PUSH_ANGLES = 3.0, tuple(0.4 + k * math.pi / 2 for k in range(4))  # of a camera's starts, force scales and rad
FOLLOWED = 12  # iterations from each of them


class Origin(IntEnum):
    """Where a start comes from; `.label` names it."""

    COLD = 0
    LEARNED = 1
    PREVIOUS = 2
    SCORE_TEST = 3
    OTHER_FIT = 4
    ELSEWHERE = 5

    @property
    def label(self) -> str:
        """For messages."""
        return _LABELS[self]


_LABELS = {
    Origin.COLD: "cold start",
    Origin.LEARNED: "learned start",
    Origin.PREVIOUS: "start from the previous frame",
    Origin.SCORE_TEST: "start from the score test",
    Origin.OTHER_FIT: "start from another fit",
    Origin.ELSEWHERE: "start elsewhere",
}


class Fate(IntEnum):
    """What became of the start that a sample was given."""

    USED = 0
    DROPPED = 1
    RETRIED = 2


@dataclass(frozen=True)
class Start(Float64):
    """Where B samples start: x (B, n), in the units of the problem's state.

    origin: (B,) Origin codes. challenged: (B,), which samples must show that their x is nearer to the data than a cold start, and
    are followed by a cold start where no accepted fit comes of it; the others start from x whatever it costs. Sigma0: the
    covariance (B, n, n) to start with; None leaves it to the settings. cold: x of a cold start, and costs (B, 2) of x and of that
    by the model, if the rule has them at hand.
    """

    x: Float[Tensor, "B n"]
    origin: Int[Tensor, " B"]
    challenged: Bool[Tensor, " B"]
    Sigma0: Float[Tensor, "B n n"] | None = None
    cold: Float[Tensor, "B n"] | None = None
    costs: Float[Tensor, "B 2"] | None = None

    def __post_init__(self):
        origin = self.origin
        super().__post_init__()
        object.__setattr__(self, "origin", origin)  # codes stay integers

    @classmethod
    def at(cls, x: Float[Tensor, "B n"], origin: Origin | Int[Tensor, " B"], challenged: bool = False) -> "Start":
        """All samples alike."""
        codes = origin if isinstance(origin, Tensor) else torch.full((len(x),), int(origin))
        return cls(x, codes, torch.full((len(x),), challenged))

    def take(self, index: Int[Tensor, " b"]) -> "Start":
        """The samples of an index."""
        Sigma0, cold, costs = (None if part is None else part[index] for part in (self.Sigma0, self.cold, self.costs))
        return Start(self.x[index], self.origin[index], self.challenged[index], Sigma0, cold, costs)


StartRule = Callable[[Problem], Start]


def in_equilibrium(
    problem: Problem, gamma: Float[Tensor, "B g"], q_tip: Float[Tensor, "B 4"] | None = None
) -> Float[Tensor, "B n"]:
    """x at the loads gamma, with the base wrench of the robot in equilibrium under them; of zero where there is none to be found.

    q_tip: the orientation of the tip near which to look, where it is known: sooner found.
    """
    return problem.state.join(gamma, at_rest(problem, gamma, q_tip).wrench.nan_to_num(0.0))


def cold_start(problem: Problem) -> Start:
    """No load where the load family says so, and the base wrench of the rod in equilibrium without it.

    Where nothing but cameras says where the rod is, a start of each sample's own: a rod that bends towards one looks much as if it
    bent away, so pushes to four sides are followed for a while, and the cheapest is taken. Errors: ValueError where the unloaded
    rod is behind a camera in every sample.
    """
    rest = without_load(problem)
    x = cold_from(problem, rest.wrench.nan_to_num(0.0))
    if any(isinstance(sensor, Camera) for sensor in problem.sensors):
        _check_cameras(problem, rest.p)
        placed = problem.distances(problem.weights).shape[1]
        x = x if placed or not problem.state.loads.size else _of_four_ways(problem, x)
    return Start.at(x, Origin.COLD)


def _check_cameras(problem: Problem, p: Float[Tensor, "B P 3"]) -> None:
    first = 0
    for sensor in problem.sensors:
        at = slice(first, first + len(sensor.s))
        if isinstance(sensor, Camera) and bool(((sensor.depth(p[:, at]) <= 0) & sensor.present).any(-1).all()):
            raise ValueError(f"without load {BEHIND}")
        first = at.stop


def _of_four_ways(problem: Problem, cold: Float[Tensor, "B n"]) -> Float[Tensor, "B n"]:
    """The cheapest of where a few iterations lead from pushes to four sides; x of a cold start where no push can be told of."""
    family, start = problem.unknowns.loads, problem.unknowns.loads.start().clone()
    start[:2] = start.new_tensor([1.0, 0.0])  # of every family the first two entries push along x and y
    newtons = float(family.describe(start).force.flatten()[0])
    best, least = cold, torch.full((len(cold),), torch.inf, dtype=cold.dtype)
    for angle in PUSH_ANGLES if newtons > 0 else ():
        push = PUSH * problem.robot.rod.force_scale / newtons
        start[:2] = start.new_tensor([push * math.cos(angle), push * math.sin(angle)])
        x, cost = onward(problem, in_equilibrium(problem, start.expand(len(cold), -1)), FOLLOWED)
        cheaper = cost < least
        best, least = torch.where(cheaper.unsqueeze(-1), x, best), torch.where(cheaper, cost, least)
    return best


def onward(problem: Problem, x: Float[Tensor, "B n"], iterations: int) -> tuple[Float[Tensor, "B n"], Float[Tensor, " B"]]:
    """x after a few iterations of the filter on coarse steps, and its cost."""
    coarse = problem.coarse
    evaluate, eye = evaluator(coarse), torch.eye(problem.size, dtype=x.dtype).expand(len(x), -1, -1)
    run = ekf.Iterate.start(x, eye, torch.inf)
    for _ in range(iterations):
        sums, prior = evaluate.sums(run.x), (coarse.mean, coarse.precision)
        run = ekf.advance(run, normal(coarse, sums), eye, prior, x.new_ones(problem.size), ekf.Limits())
        if bool(run.done.all()):
            break
    return run.x, evaluate.cost(run.x)


def cold_from(problem: Problem, alpha: Float[Tensor, "B 6"]) -> Float[Tensor, "B n"]:
    """x of a cold start, from the base wrench (N, N m) of the robot without load."""
    return problem.state.join(problem.unknowns.loads.start().expand(len(alpha), -1), alpha)


def challenged_by_cold(problem: Problem, start: Start, Sigma0: Float[Tensor, "n n"]) -> tuple[Start, Bool[Tensor, " B"]]:
    """Per challenged sample, the cheaper of its start and a cold start, and which starts were dropped, (B,).

    Sigma0 is what a cold start goes with. Where the rule does not have their costs, each takes one evaluation of h without its
    Jacobian, on coarse steps. A start that is not finite, or that bends the rod out of all bounds, is dropped with the rest.
    """
    index = start.challenged.nonzero().squeeze(-1)
    if not len(index):
        return start, start.challenged
    part = problem.take(index)
    cold = cold_start(part).x if start.cold is None else start.cold[index]
    if start.costs is None:
        evaluate = evaluator(part.coarse)
        costs = torch.stack([evaluate.cost(start.x[index]), evaluate.cost(cold)], -1)
    else:
        costs = start.costs[index]
    guessed, known = costs.nan_to_num(torch.inf, posinf=torch.inf).unbind(-1)
    worse = ~(guessed < known)
    dropped = torch.zeros_like(start.challenged).index_copy(0, index, worse)
    x, origin = start.x.clone(), start.origin.clone()
    x[dropped], origin[dropped] = cold[worse], int(Origin.COLD)
    spread = None if start.Sigma0 is None else torch.where(dropped[:, None, None], Sigma0, start.Sigma0)
    return Start(x, origin, start.challenged & ~dropped, spread), dropped
