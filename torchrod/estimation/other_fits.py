"""Other fits of the same samples: from many starts, a few iterations of all of them at a time, of which those that come to the same
place are one.

Where an unknown force acts on the tip beside a push, a rod has as a rule two shapes of its forces: the tip is pushed along the rod
while something pushes near its middle, or it is pulled aside while something holds it nearer the base. `pushes_elsewhere` begins at
such: for places of a push and axial forces at the tip, with the lateral force that leaves the moment at the clamp as it is on the
shape of the fit,

    (1)  p(s) x R(s) F = M - p(L) x F_z e_3,    M the moment of all loads of the fit about the clamp, across the rod
"""

import itertools
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..mechanics.lie import cross, rotate
from ..mechanics.statics import Shape, shape_from_base
from ..model.load_families import GaussianCoordinates, PointCoordinates
from ..model.problem import Problem
from ..util.precision import DTYPE
from ..util.status import Status
from .result import Estimate, limit
from .starts import Origin, Start, onward

ALIKE = 0.03  # of the length, and in force scales: places and forces at the tip that are closer together are those of one fit
NODES = 21
ROUNDS, ITERATIONS = 6, 4  # of the way there, after each of which doubles are dropped: fits that are accepted have arrived
AT_ONCE = 1024  # fits, whose working set then stays in the cache
WRONG = 100.0  # times what is accepted: a start that is as far as that from the readings is given up,
STUCK = 0.8  # where a round has not lowered its cost to this share of it
PLACES = (0.2, 0.4, 0.6, 0.8, 0.95)  # of the length
AXIAL = (-1.5, -0.75, -0.3, 0.3)  # force scales
MOST_FORCE = 3.0  # force scales: what (1) asks for at a place where it hardly tells the force


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


def _push(problem: Problem) -> tuple[int, int] | None:
    """The entries of the only push, [F_x, F_y, eta], and of the force at the tip; None where there is no such pair.

    Nor where a moment is unknown at the tip as well: there estimation.tip_size chooses, and draws are not held more often (of 30).
    """
    loads, tip = problem.unknowns.loads, problem.state.tip
    if tip.size != 3 or not isinstance(loads, GaussianCoordinates | PointCoordinates) or loads.locations is not None:
        return None
    return (problem.state.loads.at.start, tip.at.start) if loads.count == 1 else None


def beside_the_tip(problem: Problem) -> bool:
    """Whether a push at an unknown place is to be told from an unknown force at the tip."""
    return _push(problem) is not None


def place_and_tip(problem: Problem, x: Float[Tensor, "... n"]) -> Float[Tensor, "... 4"]:
    """By which such fits differ: the push's place (lengths) and the force at the tip (force scales)."""
    found = _push(problem)
    assert found is not None
    push, tip = found
    unit = problem.state.tip.unit[:3] / problem.robot.rod.force_scale
    return torch.cat([torch.sigmoid(x[..., push + 2 : push + 3]), x[..., tip : tip + 3] * unit], -1)


def cheapest(problem: Problem, fit: Estimate, fitting: Fitting) -> Estimate:
    """The fit of least cost, of every sample that can be fitted: of `fit` and of pushes_elsewhere."""
    index = ((fit.status != int(Status.INVALID)) & torch.isfinite(fit.x).all(-1)).nonzero().squeeze(-1)
    if not beside_the_tip(problem) or not len(index):
        return fit
    others = pushes_elsewhere(problem.take(index), fit.x[index], fitting)
    if others is None:
        return fit
    other, of = others
    first = torch.cat([of.new_ones(1, dtype=torch.bool), of.diff() > 0])  # of each sample the cheapest
    return fit.improved_by(other.of(first.nonzero().squeeze(-1), problem.size), index[of[first]])


def pushes_elsewhere(problem: Problem, x: Float[Tensor, "B n"], fitting: Fitting) -> tuple[Estimate, Int[Tensor, " k"]] | None:
    """Other fits of a push beside an unknown force at the tip, whose fits are x: see other_fits, and (1)."""
    found = _push(problem)
    if found is None:
        return None
    push, tip = found
    rod, state, B = problem.robot.rod, problem.state, len(x)
    shape, unit = shape_at(problem, x), state.tip.unit[:3]

    def forces(x: Float[Tensor, "N n"], of: Int[Tensor, " N"]) -> tuple[Float[Tensor, "N 3"], Float[Tensor, "N 3"]]:
        """The forces of push and tip together, and their moment about the clamp, on the shapes of the fits."""
        at = (torch.sigmoid(x[:, push + 2]) * (NODES - 1)).round().long()
        lateral = torch.nn.functional.pad(x[:, push : push + 2] * rod.force_scale, (0, 1))
        F, F_tip = rotate(shape.q[of, at], lateral), x[:, tip : tip + 3] * unit
        return F + F_tip, cross(shape.p[of, at], F) + cross(shape.p[of, -1], F_tip)

    everyone = torch.arange(B)
    n, M = forces(x, everyone)
    starts, of = [], []
    for place, axial in itertools.product(PLACES, AXIAL):
        start, k = x.clone(), round(place * (NODES - 1))
        start[:, push : push + 2], start[:, push + 2] = 0.0, torch.logit(torch.tensor(place, dtype=DTYPE))
        start[:, tip : tip + 3] = x.new_tensor([0.0, 0.0, axial * rod.force_scale]) / unit
        _, M_tip = forces(start, everyone)
        axes = rotate(shape.q[:, k].unsqueeze(1), torch.eye(3, dtype=DTYPE)[:2])
        by = cross(shape.p[:, k].unsqueeze(1), axes)[..., :2].mT
        asked = (M - M_tip)[:, :2].unsqueeze(-1)
        F = torch.linalg.lstsq(by.nan_to_num(0.0), asked.nan_to_num(0.0)).solution.squeeze(-1) / rod.force_scale
        start[:, push : push + 2] = F * (MOST_FORCE / F.norm(dim=-1, keepdim=True).clamp(min=1e-12)).clamp(max=1.0)
        off, M_off = (a - b for a, b in zip(forces(start, everyone), (n, M), strict=True))
        start[:, state.base.at] += torch.cat([off, M_off], -1) / state.base.unit
        starts.append(start)
        of.append(everyone)

    def looks(part: Problem, x: Float[Tensor, "N n"]) -> Float[Tensor, "N 4 1"]:
        return place_and_tip(part, x).unsqueeze(-1)

    every, of_every = torch.cat(starts), torch.cat(of)
    sound = torch.isfinite(every).all(-1)  # not of a fit that has gone so far astray that it has no shape
    return other_fits(problem, x, every[sound], of_every[sound], looks, ALIKE, fitting)
