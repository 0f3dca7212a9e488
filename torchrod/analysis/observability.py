"""What markers can see of a push, before any measurement: Cramer-Rao bounds along the rod, and the forces that show.

    t = [F_x, F_y, s, (width), (zeta)]      A = H^T W H + held      C = A^-1                                   (1)

H = dp/dt of all markers at the equilibrium that the push makes, with gravity and tensions. The base wrench alpha is unknown, but
the tip residual is zero in truth, which leaves no choice of it: (2) and (3) below. Nothing is known of the load (held = 0 there);
zeta keeps the estimator's weak prior, because a straight rod does not show its own roll. No unbiased estimator has a smaller
covariance than C (S. M. Kay, Fundamentals of Statistical Signal Processing I: Estimation Theory, 1993, ch. 3).
"""

import math
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float
from scipy.special import chdtri, chndtrinc
from torch import Tensor

from ..estimation.evaluator import evaluator
from ..mechanics.grid import on_rod
from ..mechanics.loads import PointForces
from ..mechanics.robot import Robot
from ..mechanics.statics import solve_shape
from ..model.load_families import GaussianCoordinates
from ..model.problem import TIP_ROWS, Problem
from ..model.sensors import Markers
from ..model.uncertainty import Uncertainty
from ..model.unknowns import Registration, Unknowns
from ..util.precision import DTYPE, as_float64

PUSH_WIDTH = 1 / 400  # sigma / L of a push: 1 mm on the paper's rod
ENDS_AT = 3.0  # the push nearest the tip is centred so many sigma from it
PLACES = 60  # of the push
NEAREST = 0.02  # of L: the push nearest the base
CHUNK = 256  # pushes per pass: the working set stays in cache
FALSE_ALARM, POWER = 0.05, 0.95  # of the test that a push is there
LOCALIZED = 0.05  # of L: a push is localized where the standard deviation of its location is below this
BENDS = tuple(0.02 * 3**i for i in range(5))  # rad: the ladder of forces, by how far each turns the rod where it acts


@dataclass(frozen=True)
class Observability:
    """What markers see of a push of `force` N at K places from D directions, and the forces that show.

    location: (K,) m. direction: (D,) rad, of the force in the section. location_std (m) and magnitude_std (N): (K, D), bounds at
    `force`, inf where the markers say nothing and NaN where there is no equilibrium. detectable, localizable: (K, D) N; inf where
    no force of the ladder is localized.
    """

    force: float
    location: Float[Tensor, " K"]
    direction: Float[Tensor, " D"]
    location_std: Float[Tensor, "K D"]
    magnitude_std: Float[Tensor, "K D"]
    detectable: Float[Tensor, "K D"]
    localizable: Float[Tensor, "K D"]


def push_problem(
    robot: Robot,
    markers: Markers,
    tension: Float[Tensor, "*B T"] | None = None,
    registration: Registration | None = None,
    steps: int = 0,
    uncertainty: Uncertainty | None = None,
) -> Problem:
    """The estimator's problem of one contact, without a prior on it; tensions (N) of every sample or of all.

    steps: 0 takes as many as the reference shape asks for. uncertainty: what is only nearly known of the robot.
    """
    loads = GaussianCoordinates(1, robot.rod.length, robot.rod.force_scale, "none")
    tension = None if tension is None else tension.expand(len(markers.positions), -1)
    return Problem(robot, Unknowns(loads, registration=registration, uncertainty=uncertainty), [markers], tension, steps)


def places(robot: Robot, count: int, nearest: float | None = None) -> Float[Tensor, " K"]:
    """Evenly spaced places (m) of a push, from `nearest` (m; 2 % of L) to the tip."""
    L = robot.rod.length
    return torch.linspace(NEAREST * L if nearest is None else nearest, L * (1 - ENDS_AT * PUSH_WIDTH), count, dtype=DTYPE)


def around(count: int) -> tuple[Float[Tensor, " D"], Float[Tensor, "D 2"]]:
    """Directions all round the section: angles (rad) and unit vectors."""
    angle = 2 * torch.pi * torch.arange(count, dtype=DTYPE) / count
    return angle, torch.stack([angle.cos(), angle.sin()], -1)


def state(problem: Problem, force: Float[Tensor, "B 2"], location: Float[Tensor, " B"], alpha: Float[Tensor, "B 6"]) -> Tensor:
    """x of a push PUSH_WIDTH wide: force (N, section frame), location (m), base wrench alpha (N, N m)."""
    rod = problem.robot.rod
    log_c = torch.full_like(location, -math.log(2 * PUSH_WIDTH**2))
    gamma = torch.cat([force / rod.force_scale, torch.stack([torch.logit(location / rod.length), log_c], -1)], -1)
    return problem.state.join(gamma, alpha)


def pushed(problem: Problem, force: Float[Tensor, "B 2"], location: Float[Tensor, " B"]) -> Float[Tensor, "B n"]:
    """x in equilibrium under a push of force (N, section frame) at location (m); NaN where there is none."""
    push = PointForces(torch.nn.functional.pad(force, (0, 1)).unsqueeze(1), location.unsqueeze(1))
    tip = location.new_tensor([problem.robot.rod.length])
    solved = solve_shape(problem.robot, (push,), problem.tension, tip, len(force), problem.steps)
    return state(problem, force, location, solved.base_wrench)


def sensitivity(problem: Problem, x: Float[Tensor, "B n"], unknown: tuple[int, ...]) -> Float[Tensor, "B P 3 m"]:
    """dp/d[load, zeta] of every marker in equilibrium: `unknown` says which of [F_x, F_y, s, width] are, zeta with registration.

    In units of the force scale, of L for the location, and of Problem.state for zeta.

    (2) The tip residual (17) is zero in truth: dc = C_t dt + C_a d(alpha) = 0 with t = [load, zeta] and C_t, C_a blocks of H.
    (3) Hence d(alpha) = -C_a^-1 C_t dt and dp = (H_t - H_a C_a^-1 C_t) dt: what (1) tends to as the weight of c grows.
    """
    rows, g, base = [], problem.state.loads.size, problem.state.base.at
    for first in range(0, len(x), CHUNK):
        index = torch.arange(first, min(first + CHUNK, len(x)))
        _, H = evaluator(problem.take(index)).linearized(x[index])
        # mu = L S(eta), so d(mu / L)/d(eta) = t (1 - t).
        t = torch.sigmoid(x[index, 2])
        H = torch.cat([H[..., :2], H[..., 2:3] / (t * (1 - t))[:, None, None], H[..., 3:]], -1)
        H_t, H_a = H[..., [*unknown, *range(g, base.start)]], H[..., base]
        turn = torch.linalg.solve_ex(H_a[:, -6:], H_t[:, -6:]).result
        rows.append((H_t - H_a @ turn)[:, :-6])
    return torch.cat(rows).unflatten(1, (-1, 3))


def held(problem: Problem, unknown: tuple[int, ...]) -> Float[Tensor, "m m"]:
    """What (1) adds to the information: the estimator's prior on parameters and on zeta, nothing on the load."""
    state = problem.state
    beside = state.precision[state.loads.at.stop : state.base.at.start]
    return torch.diag(torch.cat([torch.zeros(len(unknown), dtype=DTYPE), beside]))


def covariance(A: Float[Tensor, "*B m m"]) -> tuple[Float[Tensor, "*B m m"], Bool[Tensor, "*B"]]:
    """A^-1, on the unit diagonal, and where A is singular: there something cannot be seen at all."""
    scale = A.diagonal(dim1=-2, dim2=-1).clamp(min=torch.finfo(A.dtype).tiny).rsqrt()
    A = scale.unsqueeze(-1) * A * scale.unsqueeze(-2)
    C = torch.linalg.inv_ex(A).inverse
    singular = (torch.linalg.cholesky_ex(A).info > 0) | ~(C.diagonal(dim1=-2, dim2=-1) > 0).all(-1)
    return scale.unsqueeze(-1) * C * scale.unsqueeze(-2), singular & torch.isfinite(A).all(-1).all(-1)


def _bounded(
    problem: Problem, x: Float[Tensor, "B n"], unknown: tuple[int, ...]
) -> tuple[Float[Tensor, "B m m"], Bool[Tensor, " B"]]:
    """C of (1), and where it does not exist."""
    J = sensitivity(problem, x, unknown).flatten(1, 2)
    J = torch.where(problem.weights[:, :-TIP_ROWS, None] > 0, J * problem.weights[:, :-TIP_ROWS, None].sqrt(), 0.0)
    return covariance(J.mT @ J + held(problem, unknown))


def load_bound(
    robot: Robot,
    markers: Markers,
    force: Float[Tensor, "B 2"],
    location: Float[Tensor, " B"],
    base_wrench: Float[Tensor, "B 6"],
    tension: Float[Tensor, "*B T"] | None = None,
    registration: Registration | None = None,
    width_known: bool = True,
    steps: int = 0,
    uncertainty: Uncertainty | None = None,
) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """Cramer-Rao bounds (standard deviations) of location (m) and magnitude (N) of one push, (B,) each.

    force: (B, 2) N, section frame, not zero; location: (B,) m, inside the rod; base_wrench: (B, 6) N, N m, in equilibrium with the
    push; tension: (B, T) or (T,) N. Markers count with their noise where their positions are finite; the numbers play no part.
    registration: what is known of a base frame that is unknown; uncertainty: what is only nearly known of the robot. A bound is inf
    where the markers do not show the push, NaN where the base wrench is. Source: (1) to (3) of torchrod/analysis/observability.py;
    Kay 1993, ch. 3.
    """
    force, location, base_wrench = as_float64(force), as_float64(location), as_float64(base_wrench)
    problem = push_problem(robot, markers, tension, registration, steps, uncertainty)
    unknown = (0, 1, 2) if width_known else (0, 1, 2, 3)
    C, singular = _bounded(problem, state(problem, force, location, base_wrench), unknown)
    along = force / force.norm(dim=-1, keepdim=True)
    magnitude = (along.unsqueeze(1) @ C[:, :2, :2] @ along.unsqueeze(-1)).flatten().sqrt() * robot.rod.force_scale
    place = C[:, 2, 2].sqrt() * robot.rod.length
    return place.masked_fill(singular, torch.inf), magnitude.masked_fill(singular, torch.inf)


@cache
def noncentrality() -> float:
    """lambda: a chi-square test with 2 degrees of freedom and FALSE_ALARM finds F^T J F = lambda with probability POWER; 15.44."""
    return float(chndtrinc(float(chdtri(2, FALSE_ALARM)), 2, 1 - POWER))


def seen_by(s: Float[Tensor, " P"], location: Float[Tensor, " B"], noise: float) -> Markers:
    """Markers at s (m) with this noise (m), and a missing one at every place of a push.

    That puts a node of the grid at the push, where the discrete integrals move with it as the exact ones do, but for a twelfth of
    the difference of the steps on both sides: 3 % of the bound near the base. Between nodes it is up to a sixth of a step.
    """
    places = location.unique()
    positions = torch.zeros(len(location), len(s) + len(places), 3, dtype=DTYPE)
    positions[:, len(s) :] = torch.nan
    return Markers(torch.cat([s, places]), positions, noise)


def _detectable(problem: Problem, at: Tensor, e: Tensor) -> Float[Tensor, "K D"]:
    """The smallest force (N) along each direction e (D, 2) that the test finds, at each place (m).

    (4) About no push h is linear in F and its location plays no part: F^ ~ N(F, J^-1), J^-1 the force block of C of (1) with
        the location known.
    (5) F^^T J F^ is chi-square with 2 degrees of freedom and noncentrality F^T J F (S. M. Kay, Fundamentals of Statistical Signal
        Processing II: Detection Theory, 1998, sec. 6.5, Wald test). It finds F^T J F >= lambda: |F| >= sqrt(lambda / e^T J e).
    """
    C, singular = _bounded(problem, pushed(problem, at.new_zeros(len(at), 2), at), (0, 1))
    J = torch.linalg.inv_ex(C[:, :2, :2]).inverse
    size = (noncentrality() / torch.einsum("di,kij,dj->kd", e, J, e)).sqrt() * problem.robot.rod.force_scale
    return size.masked_fill(singular.unsqueeze(-1), torch.inf)


def _localizable(force: Float[Tensor, "R K"], std: Float[Tensor, "R K D"], enough: float) -> Float[Tensor, "K D"]:
    """The smallest force (N) whose location is known to `enough` (m), from a ladder of R rising forces at every place.

    (6) Between two rungs log std runs straight in log force. Below the first it falls as 1 / F, which is exact as F -> 0: the
        location's column of H is proportional to F there, the others do not depend on it.
    """
    known = std <= enough
    at = known.int().argmax(0)
    force = force.unsqueeze(-1).expand_as(std)
    high, low = (force.gather(0, i.unsqueeze(0))[0].log() for i in (at, (at - 1).clamp(min=0)))
    after, before = (std.gather(0, i.unsqueeze(0))[0].log() for i in (at, (at - 1).clamp(min=0)))
    goal = torch.as_tensor(enough, dtype=DTYPE).log()
    share = ((before - goal) / (before - after)).nan_to_num(1.0, 1.0, 1.0)
    crossing = torch.where(at > 0, low + share * (high - low), high + after - goal)
    return torch.where(known.any(0), crossing.exp(), torch.inf)


def bounds(
    robot: Robot,
    s: Float[Tensor, " P"],
    noise: float,
    force: float,
    locations: Float[Tensor, " K"] | None = None,
    tension: Float[Tensor, " T"] | None = None,
    registration: Registration | None = None,
    width_known: bool = True,
    directions: int = 8,
    steps: int = 0,
    uncertainty: Uncertainty | None = None,
) -> Observability:
    """What markers at s (m) with this noise (m) see of a push at every place (m; 60 from 2 % of L to the tip) and direction.

    force: its magnitude (N) for the bounds. tension: readings of the tendons (N). Localizable: the smallest force at which the
    location's standard deviation is 5 % of L, on a ladder that turns the rod by 0.02 to 1.62 rad at the push (F s^2 / 2 EI).
    registration, uncertainty: what is known of a base frame that is unknown, and of a robot that is only nearly known.
    Errors: ValueError for markers, force, noise or tensions that do not fit the robot. Source: Kay 1993, ch. 3 (see the module).
    """
    check(robot, s, noise, force, tension)
    at = places(robot, PLACES) if locations is None else as_float64(locations)
    angle, e = around(directions)
    K = len(at)

    def stds(size: Float[Tensor, " K"]) -> tuple[Float[Tensor, "K D"], Float[Tensor, "K D"]]:
        where, F = at.repeat_interleave(directions), (size[:, None, None] * e).flatten(0, 1)
        markers = seen_by(s, where, noise)
        problem = push_problem(robot, markers, tension, registration, steps, uncertainty)
        wrench = problem.state.base.of(pushed(problem, F, where))
        found = load_bound(robot, markers, F, where, wrench, tension, registration, width_known, steps, uncertainty)
        return found[0].reshape(K, -1), found[1].reshape(K, -1)

    place, magnitude = stds(torch.full_like(at, force))
    ladder = torch.stack([2 * robot.rod.bending_stiffness * bend / at**2 for bend in BENDS])
    localizable = _localizable(ladder, torch.stack([stds(rung)[0] for rung in ladder]), LOCALIZED * robot.rod.length)
    nothing = push_problem(robot, seen_by(s, at, noise), tension, registration, steps, uncertainty)
    detectable = _detectable(nothing, at, e)
    return Observability(force, at, angle, place, magnitude, detectable, localizable)


def check(robot: Robot, s: Float[Tensor, " P"], noise: float, force: float, tension: Float[Tensor, " T"] | None) -> None:
    """Raise ValueError, naming the remedy, for what does not fit the robot."""
    L, tendons = robot.rod.length, len(robot.tendons)
    if not noise > 0:
        raise ValueError(f"noise is {noise} m; it must be positive")
    if not 0 < force < torch.inf:
        raise ValueError(f"force is {force} N; it must be positive")
    if len(s) < 2:
        raise ValueError(f"{len(s)} markers cannot show where a push is; give at least 2")
    if not bool((on_rod(s, L) & (s > 0)).all()):
        raise ValueError(
            f"marker arc lengths run from {float(s.min())} to {float(s.max())} m; they must be above 0 and at most {L} m"
        )
    given = 0 if tension is None else len(tension)
    if given != tendons:
        raise ValueError(f"{given} tensions for {tendons} tendons; give one per tendon")
