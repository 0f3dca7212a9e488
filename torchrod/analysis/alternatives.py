"""Other equilibria that explain the same readings, where a rod is read at few places.

A tip pose alone, say, fits a rod that bends to either side. The fit that is reported is one of them; the others are looked for from
loads, and wrenches at the tip, of several sizes and directions, and told with their cost.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.result import Estimate, limit
from ..estimation.solve import Settings, estimate_each
from ..estimation.starts import Origin, Start, onward
from ..mechanics.loads import PointWrenches
from ..mechanics.statics import shape_from_base, solve_shape
from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from ..util.status import Status
from ..util.threads import one_thread

FEW_PLACES = 3  # along the rod: with more of them a rod that is fitted is as a rule the only one
TIP_SIZES = (1.0, 3.0)  # force and moment scales of the starts
SAME = 1e-3  # of the length: fits whose rods lie closer together than that everywhere are one
NODES = 21
ROUNDS, ITERATIONS = 6, 4  # of the way there, after each of which doubles are dropped: fits that are accepted have arrived
CHUNK = 256  # samples at a time
AT_ONCE = 1024  # fits, whose working set then stays in the cache
WRONG = 100.0  # times what is accepted: a start that is as far as that from the readings is given up,
STUCK = 0.8  # where a round has not lowered its cost to this share of it


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

    Only of samples that were read at few places, and that are accepted. parts: the unknowns of each sample, as in Analysis. All
    samples from all starts at once, a few iterations on coarse steps at a time; of those of a sample that have come to the same
    rod one goes on, and none to that of the fit. What is not near the readings in the end is given up, the rest is fitted.
    """
    settings = replace(settings or Settings(), restarts=(), basins=0, sized=False)
    found: list[tuple[Solution, ...]] = [()] * problem.batch
    few = read_at_few_places(problem) & fit.accepted
    for unknowns, index in parts:
        own = problem.of(unknowns)
        for rows in index[few[index]].split(CHUNK) if bool(few[index].any()) else ():
            with one_thread(True):  # many small tensors, which several threads wait for longer than they work at
                each = _others(own.take(rows), fit.x[rows, : own.size], settings)
            for b, others in zip(rows.tolist(), each, strict=True):
                found[b] = others
    return tuple(found)


def _others(problem: Problem, x: Float[Tensor, "B n"], settings: Settings) -> list[tuple[Solution, ...]]:
    """Of samples whose fits are x."""
    x0, of = _starts(problem)
    known, apart = _rods(problem, x), SAME * problem.robot.rod.length
    enough = WRONG * torch.tensor([limit(n) for n in problem.seen.tolist()], dtype=DTYPE)
    before = x0.new_full((len(x0),), torch.inf)
    for k in range(ROUNDS):
        if not len(of):
            return [()] * problem.batch
        parts = [onward(problem.take(of[at]), x0[at], ITERATIONS) for at in torch.arange(len(of)).split(AT_ONCE)]
        x0, cost = (torch.cat(values) for values in zip(*parts, strict=True))
        kept = _different(_rods(problem.take(of), x0), cost, of, known, apart)
        hopeful = (cost < enough[of]) | ((cost < STUCK * before) & (k < ROUNDS - 1))
        kept = kept[hopeful[kept]]
        x0, of, before = x0[kept], of[kept], cost[kept]
    if not len(of):
        return [()] * problem.batch
    tried = estimate_each(problem.take(of), settings, Start.at(x0, Origin.ELSEWHERE))
    good = tried.accepted & (tried.status == int(Status.CONVERGED))
    kept = _different(_rods(problem.take(of), tried.x), torch.where(good, tried.chi2, torch.inf), of, known, apart)
    kept = kept[good[kept]]
    found: list[list[Solution]] = [[] for _ in range(problem.batch)]
    for c in kept[tried.chi2[kept].argsort(stable=True)].tolist():
        tip = None if tried.tip is None else tried.tip[c]
        found[int(of[c])].append(Solution(float(tried.chi2[c]), tried.force[c], tried.location[c], tip))
    return [tuple(others) for others in found]


def _different(
    rods: Float[Tensor, "N K 3"], cost: Float[Tensor, " N"], of: Int[Tensor, " N"], known: Float[Tensor, "B K 3"], apart: float
) -> Int[Tensor, " k"]:
    """Which rods to keep: of those of a sample that are no farther apart than that (m) the cheapest, none like its known one."""
    kept = []
    for b in of.unique().tolist():
        mine = (of == b).nonzero().squeeze(-1)
        mine = mine[cost[mine].argsort(stable=True)]
        p = rods[mine]
        double = ((p - known[b]).norm(dim=-1).amax(-1) <= apart).tolist()
        near = ((p.unsqueeze(1) - p).norm(dim=-1).amax(-1) <= apart).numpy()
        chosen: list[int] = []
        for i, row in enumerate(mine.tolist()):
            if not double[i] and not near[i, chosen].any():
                chosen.append(i)
                kept.append(row)
    return torch.tensor(kept, dtype=torch.int64)


def _rods(problem: Problem, x: Float[Tensor, "B n"]) -> Float[Tensor, "B N 3"]:
    """The centre lines (m) at other places than the sensors'."""
    state, robot = problem.state, problem.robot
    along = torch.linspace(0, robot.rod.length, NODES, dtype=DTYPE)
    loads = problem.unknowns.loads.loads(x[:, state.loads.at]) if state.loads.size else ()
    return shape_from_base(robot, loads, state.base.of(x), problem.pulling(x), along, problem.steps, differentiable=False).p
