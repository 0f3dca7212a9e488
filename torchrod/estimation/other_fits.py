"""Other fits of the same samples: from many starts, a few iterations of all of them at a time, of which those that come to the same
place are one. What is worth a start is said in estimation.elsewhere.
"""

from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..mechanics.statics import Shape, shape_from_base
from ..model.problem import Problem
from ..util.precision import DTYPE
from ..util.status import Status
from .result import Estimate, limit
from .starts import Origin, Start, onward

NODES = 21
ROUNDS, ITERATIONS = 6, 4  # of the way there, after each of which doubles are dropped: fits that are accepted have arrived
AT_ONCE = 1024  # fits, whose working set then stays in the cache
WRONG = 100.0  # times what is accepted: a start that is as far as that from the readings is given up,
STUCK = 0.8  # where a round has not lowered its cost to this share of it

Fitting = Callable[[Problem, Start], Estimate]
Looks = Callable[[Problem, Float[Tensor, "N n"]], Float[Tensor, "N K c"]]


def other_fits(
    problem: Problem,
    x: Float[Tensor, "B n"],
    starts: Float[Tensor, "N n"],
    of: Int[Tensor, " N"],
    looks: Looks,
    apart: float,
    fitting: Fitting,
) -> tuple[Estimate, Int[Tensor, " k"]] | None:
    """Accepted fits from N starts, and which sample each is of; none is the fit x of its sample, no two of a sample are alike.

    of (N,): which sample each start is for. looks: K points of a fit, which in two that are alike are no farther apart than that.
    fitting: a plain solver. Sorted by sample, then by chi^2. None where there is none.
    """
    known = looks(problem, x)
    enough = WRONG * torch.tensor([limit(n) for n in problem.seen.tolist()], dtype=DTYPE)
    before = starts.new_full((len(starts),), torch.inf)
    for k in range(ROUNDS):
        if not len(of):
            return None
        parts = [onward(problem.take(of[at]), starts[at], ITERATIONS) for at in torch.arange(len(of)).split(AT_ONCE)]
        starts, cost = (torch.cat(values) for values in zip(*parts, strict=True))
        kept = _different(looks(problem.take(of), starts), cost, of, known, apart)
        hopeful = (cost < enough[of]) | ((cost < STUCK * before) & (k < ROUNDS - 1))
        kept = kept[hopeful[kept]]
        starts, of, before = starts[kept], of[kept], cost[kept]
    if not len(of):
        return None
    tried = fitting(problem.take(of), Start.at(starts, Origin.ELSEWHERE))
    good = tried.accepted & (tried.status == int(Status.CONVERGED))
    kept = _different(looks(problem.take(of), tried.x), torch.where(good, tried.chi2, torch.inf), of, known, apart)
    kept = kept[good[kept]]
    return (tried.of(kept, problem.size), of[kept]) if len(kept) else None


def _different(
    looks: Float[Tensor, "N K c"], cost: Float[Tensor, " N"], of: Int[Tensor, " N"], known: Float[Tensor, "B K c"], apart: float
) -> Int[Tensor, " k"]:
    """Which fits to keep: of those of a sample that look alike the cheapest, none like its known one."""
    kept = []
    for b in of.unique().tolist():
        mine = (of == b).nonzero().squeeze(-1)
        mine = mine[cost[mine].argsort(stable=True)]
        p = looks[mine]
        double = ((p - known[b]).norm(dim=-1).amax(-1) <= apart).tolist()
        near = ((p.unsqueeze(1) - p).norm(dim=-1).amax(-1) <= apart).numpy()
        chosen: list[int] = []
        for i, row in enumerate(mine.tolist()):
            if not double[i] and not near[i, chosen].any():
                chosen.append(i)
                kept.append(row)
    return torch.tensor(kept, dtype=torch.int64)


def shape_at(problem: Problem, x: Float[Tensor, "B n"]) -> Shape:
    """The rod at NODES places from the clamp to the tip."""
    state, robot = problem.state, problem.robot
    along = torch.linspace(0, robot.rod.length, NODES, dtype=DTYPE)
    loads = problem.unknowns.loads.loads(x[:, state.loads.at]) if state.loads.size else ()
    return shape_from_base(robot, loads, state.base.of(x), problem.pulling(x), along, problem.steps, differentiable=False)
