"""Actuation by displacement: the tensions at which the path of every tendon has the length that its motor leaves it.

A tendon that does not stretch, of which d has been pulled out of the robot, leaves A = l0 - d of path (l0: in the reference shape).
It cannot push, so that with l(tau) the length of its path in equilibrium

    (1)  0 <= tau,   0 <= A - l(tau),   tau (A - l(tau)) = 0        (taut with some tension, or slack with none)

for all tendons together, a complementarity problem. Newton's method of Josephy: (1) is solved exactly with the gap A - l linearized
in tau, by principal pivoting, so that which tendons are taut is decided for all of them at once; a step that does not lower the
worst violation of (1) is halved. Antagonists pulled and paid out by the same length are taut or slack by micrometres.
Source: Facchinei & Pang, Finite-Dimensional Variational Inequalities and Complementarity Problems, 2003, sec. 7.3 (the method);
K. G. Murty, Opsearch 11, 1974 (least-index principal pivoting).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..util.status import Status
from .lie import rotate
from .loads import Load, taken
from .robot import Robot
from .statics import Equilibrium, needs_finer, replaced, solve_shape, steps_for
from .tendons import Tendons

CHORDS = 32  # per tendon; the sum of chords is extrapolated from 16 and 32 (Richardson), which leaves about 1e-9 of the length
LENGTH_TOLERANCE = 1e-9  # of the path, relative to the rod's length
MAX_ITERATIONS = 60
MAX_PIVOTS = 200
HALVINGS = 8  # of a step that leads nowhere
STALE = 0.3  # a step that leaves more than this of the violation has shown that the slope is out of date
FREE = 1e-9  # of the largest entry of the slope: keeps antagonists of a rod that hardly shortens apart
PROBE = 1e-3  # relative change of tension by which the first Jacobian is differenced


@dataclass(frozen=True)
class Actuated:
    """equilibrium: the robot's shape. slack (B, T): which tendons carry nothing; path (B, T) m: their lengths.

    tension (B, T) N: what the tendons carry; a load cell reads `tension_offset` less.
    """

    equilibrium: Equilibrium
    tension: Float[Tensor, "B T"]
    slack: Bool[Tensor, "B T"]
    path: Float[Tensor, "B T"]


def _stations(robot: Robot) -> Float[Tensor, "T n"]:
    """Arc lengths (m) at which each tendon's path is sampled: where it runs from disc to disc its holes, and then its end."""
    n = max([CHORDS + 1, *(len(t.holes) | 1 for t in robot.tendons.tendons)])
    even, rows = torch.linspace(0, 1, n, dtype=torch.float64), []
    for t in robot.tendons.tendons:
        holes = torch.tensor([*t.holes, *[t.ends_at] * (n - len(t.holes))], dtype=torch.float64)
        rows.append(holes if t.discs else t.ends_at * even)
    return torch.stack(rows)


def _path_lengths(robot: Robot, stations: Float[Tensor, "T n"], shape: Equilibrium) -> Float[Tensor, "B T"]:
    """l_j = integral of |v + u x r_j + r_j'| ds (m), as the length of the curve p(s) + R(s) r_j(s), or from disc to disc.

    Chords miss the arc by c h^2 + O(h^4): 4/3 of the fine sum less 1/3 of the coarse one has no c. shape: sampled at the stations
    of every tendon, one after the other, behind whatever else was asked for.
    """
    first = shape.p.shape[1] - stations.numel()
    p, q = (x[:, first:].unflatten(1, stations.shape) for x in (shape.p, shape.q))
    r = torch.stack([t.offset_at(s)[0] for t, s in zip(robot.tendons.tendons, stations, strict=True)])
    curve = p + rotate(q, r)
    fine = curve.diff(dim=2).norm(dim=-1).sum(-1)
    coarse = curve[:, :, ::2].diff(dim=2).norm(dim=-1).sum(-1)
    straight = torch.tensor([bool(t.discs) for t in robot.tendons.tendons])
    return torch.where(straight, fine, (4 * fine - coarse) / 3)


def reference_lengths(robot: Robot) -> Float[Tensor, " T"]:
    """l0 (m): every tendon's path in the unloaded robot without gravity or tension."""
    stations = _stations(robot)
    none = torch.zeros(1, len(robot.tendons), dtype=torch.float64)
    weightless = Robot(robot.rod, robot.tendons, torch.zeros_like(robot.gravity.reshape(-1, 3)[0]))
    return _path_lengths(robot, stations, solve_shape(weightless, (), none, stations.flatten(), 1))[0]


def solve_displacement(
    robot: Robot,
    loads: tuple[Load, ...],
    displacement: Float[Tensor, "B T"],
    outputs: Float[Tensor, " P"],
    steps: int | None = None,
) -> Actuated:
    """The shape of B samples under known loads with d (m) of each tendon pulled out, and the tensions that this takes (1).

    d < 0 pays tendon out: it goes slack unless something else stretches its path. Loads and steps as in solve_shape; outputs in m.
    Errors: ValueError for a robot without tendons or d of another shape; a sample that cannot be solved has status NOT_CONVERGED.
    """
    B, T = displacement.shape
    if len(robot.tendons) != T or not T:
        raise ValueError(f"{T} displacements for {len(robot.tendons)} tendons; give one per tendon")
    # The load cells' offsets belong to readings; here the unknowns are the tensions themselves.
    robot = replace(robot, tendons=Tendons(tuple(replace(t, tension_offset=0.0, tension_gain=1.0) for t in robot.tendons.tendons)))
    n = steps or steps_for(replace(robot, gravity=torch.zeros(3, dtype=torch.float64)), outputs)
    answer = _pulled(robot, loads, displacement, outputs, n)
    if steps is not None:
        return answer
    # The number of steps stays what it is while a sample is solved, and is no matter of its neighbours.
    for b in needs_finer(robot, loads, answer.tension, outputs, B, n).nonzero().squeeze(-1).tolist():
        index = torch.tensor([b])
        own = taken(loads, index)
        if own is None or int(answer.equilibrium.status[b]) != int(Status.CONVERGED):
            continue
        one = replace(robot, gravity=robot.gravity[index]) if robot.gravity.ndim > 1 and len(robot.gravity) == B else robot
        more = steps_for(one, outputs, answer.tension[index], own)
        if more > n:
            answer = _with_row(answer, b, _pulled(one, own, displacement[index], outputs, more))
    return answer


def _with_row(answer: Actuated, b: int, new: Actuated) -> Actuated:
    """The answer with sample b replaced."""
    at = torch.tensor([b])
    e = replaced(answer.equilibrium, new.equilibrium, at)
    return Actuated(e, *(getattr(answer, n).index_copy(0, at, getattr(new, n)) for n in ("tension", "slack", "path")))


def _pulled(
    robot: Robot, loads: tuple[Load, ...], displacement: Float[Tensor, "B T"], outputs: Float[Tensor, " P"], steps: int
) -> Actuated:
    B = len(displacement)
    stations = _stations(robot)
    allowed = reference_lengths(robot) - displacement
    places = torch.cat([outputs, stations.flatten()])

    def solved(tension: Float[Tensor, "B T"]) -> tuple[Equilibrium, Float[Tensor, "B T"]]:
        shape = solve_shape(robot, loads, tension, places, B, steps)
        return shape, allowed - _path_lengths(robot, stations, shape)

    # k (N/m): the tension that bends a straight rod so far that a path a metre long is a metre shorter.
    reach = torch.stack([t.offset_at(s)[0].square().sum(-1).mean() for t, s in zip(robot.tendons.tendons, stations, strict=True)])
    k = robot.rod.bending_stiffness / (reach * stations[:, -1])

    def violation(tension: Float[Tensor, "B T"], gap: Float[Tensor, "B T"]) -> Float[Tensor, " B"]:
        """The worst of min(tau / k, gap) (m), which (1) makes zero; inf where there is no shape."""
        return torch.minimum(tension / k, gap).abs().amax(-1).nan_to_num(torch.inf)

    tension = (k * displacement).clamp(min=0.0)
    shape, gap = solved(tension)
    slope = _slope(solved, tension, gap, PROBE * k * robot.rod.length)
    off, share = violation(tension, gap), torch.ones(B, dtype=tension.dtype)
    fresh = torch.ones(B, dtype=torch.bool)
    live = off > LENGTH_TOLERANCE * robot.rod.length
    for _ in range(MAX_ITERATIONS):
        if not bool(live.any()):
            break
        full = _complementary(slope, gap, tension, k) - tension
        step = torch.where(live.unsqueeze(-1), share.unsqueeze(-1) * full, 0.0)
        tried, after = solved(tension + step)
        now = violation(tension + step, after)
        better = live & (now < off)
        slope = torch.where((live & torch.isfinite(now))[:, None, None], _secant(slope, step, after - gap), slope)
        slow = live & ~(now <= STALE * off)
        tension, gap = (torch.where(better.unsqueeze(-1), new, old) for new, old in ((tension + step, tension), (after, gap)))
        shape = replaced(shape, tried.take(better), better.nonzero().squeeze(-1))
        share = torch.where(better, 1.0, 0.5 * share)
        off = torch.where(better, now, off)
        again = slow & ~fresh
        if bool(again.any()):
            probed = _slope(solved, tension, gap, 0.1 * PROBE * k * robot.rod.length)
            usable = again & torch.isfinite(probed).flatten(1).all(-1)
            slope = torch.where(usable[:, None, None], probed, slope)
        fresh = again
        live = live & (off > LENGTH_TOLERANCE * robot.rod.length) & (share > 0.5**HALVINGS)
    missing = off > LENGTH_TOLERANCE * robot.rod.length
    return _actuated(shape, tension, allowed - gap, missing, len(outputs))


def _slope(solved, tension: Float[Tensor, "B T"], gap: Float[Tensor, "B T"], by: Float[Tensor, " T"]) -> Float[Tensor, "B T T"]:
    """d gap / d tension by forward differences of the forward solve: pulling makes the path shorter and the gap larger."""
    columns = []
    for j, e in enumerate(torch.eye(len(by), dtype=tension.dtype) * by):
        columns.append((solved(tension + e)[1] - gap) / by[j])
    return torch.stack(columns, -1)


def _complementary(
    slope: Float[Tensor, "B T T"], gap: Float[Tensor, "B T"], tension: Float[Tensor, "B T"], k: Float[Tensor, " T"]
) -> Float[Tensor, "B T"]:
    """tau >= 0 with gap + slope (tau - tension) >= 0 and their product zero: least-index pivoting from what seems taut."""
    eye = torch.eye(tension.shape[-1], dtype=tension.dtype)
    S = slope.nan_to_num(0.0)
    S = S + FREE * S.abs().amax((-2, -1))[:, None, None] * eye
    rest = gap - (S @ tension.unsqueeze(-1)).squeeze(-1)
    taut = tension - k * gap > 0
    tau = tension
    for _ in range(MAX_PIVOTS):
        A = torch.where(taut.unsqueeze(-1), torch.where(taut.unsqueeze(-2), S, 0.0), eye)
        tau = torch.linalg.solve_ex(A, torch.where(taut, -rest, 0.0).unsqueeze(-1))[0].squeeze(-1).nan_to_num(0.0)
        left = rest + (S @ tau.unsqueeze(-1)).squeeze(-1)
        wrong = torch.where(taut, tau < 0, left < 0)
        if not bool(wrong.any()):
            break
        first = wrong & (wrong.cumsum(-1) == 1)
        taut = taut ^ first
    return torch.where(taut, tau, 0.0).clamp(min=0.0)


def _secant(slope: Float[Tensor, "B T T"], step: Float[Tensor, "B T"], change: Float[Tensor, "B T"]) -> Float[Tensor, "B T T"]:
    """Broyden's rank-one update: the slope that would have foretold the last change."""
    missed = change - (slope @ step.unsqueeze(-1)).squeeze(-1)
    size = step.square().sum(-1, keepdim=True)
    correction = missed.unsqueeze(-1) * (step / size.clamp(min=1e-30)).unsqueeze(-2)
    return slope + torch.where((size > 1e-24).unsqueeze(-1), correction, 0.0).nan_to_num(0.0)


def _actuated(
    shape: Equilibrium, tension: Float[Tensor, "B T"], path: Float[Tensor, "B T"], live: Bool[Tensor, " B"], P: int
) -> Actuated:
    """The answer at the outputs that were asked for; a sample whose tensions did not settle is NOT_CONVERGED and holds NaN."""
    failed = live | (shape.status != int(Status.CONVERGED))
    status = torch.where(live & (shape.status == int(Status.CONVERGED)), int(Status.NOT_CONVERGED), shape.status)

    def kept(x: Tensor) -> Tensor:
        return torch.where(failed.reshape(-1, *[1] * (x.ndim - 1)), torch.nan, x)

    equilibrium = Equilibrium(
        shape.s[:P],
        kept(shape.p[:, :P]),
        kept(shape.q[:, :P]),
        kept(shape.base_wrench),
        status,
        shape.residual,
        shape.iterations,
        shape.stable & ~failed,
        shape.resolved,
    )
    return Actuated(equilibrium, kept(tension), tension <= 0, kept(path))
