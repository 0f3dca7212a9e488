"""Where to put markers, so that the worst push along the rod is located best.

Information adds up over markers:

(1) A = H^T W H + held of (1) of analysis.observability is a sum over the rows of H, since W is diagonal: A = held + sum_i A_i with
    A_i = H_i^T H_i / noise^2 of the three rows of marker i.
(2) H_i is how marker i moves in equilibrium. It knows nothing of the other markers: alpha is gone, by the tip residual and not by
    them. So the A_i of every candidate are computed once, and any layout is a sum of them. This is exact.
(3) The layout minimizes the largest standard deviation of the location over all pushes (a minimax design). Exchange: each marker in
    turn moves to the candidate that lowers it most, until none helps, so that it never rises (V. V. Fedorov, Theory of Optimal
    Experiments, 1972, ch. 3, for the exchange).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..mechanics.robot import Robot
from ..model.uncertainty import Uncertainty
from ..model.unknowns import Registration
from ..util.precision import DTYPE
from .observability import around, check, covariance, held, places, push_problem, pushed, seen_by, sensitivity

CANDIDATES = 50  # evenly spaced along the rod, beside those of the even layout; the last is the tip
PLACES = 24  # of the push
FROM = 0.1  # of L: pushes nearer the base are not asked for
GAP = 0.02  # of L: two markers are no closer
GAIN = 1e-6  # an exchange counts when it lowers the worst case by more than this share
MAX_ROUNDS = 50
KNOWN = (0, 1, 2)  # unknown are F_x, F_y, s


@dataclass(frozen=True)
class Placement:
    """Proposed markers s (P,) m, rising, and the even ones they are compared with, even (P,) m.

    nearest: m, pushes nearer the base were not asked for. history: (E,) m, the largest standard deviation of the location, first of
    the even markers, then after every exchange.
    """

    s: Float[Tensor, " P"]
    even: Float[Tensor, " P"]
    nearest: float
    history: Float[Tensor, " E"]

    @property
    def worst(self) -> float:
        """The largest standard deviation of the location (m) with the proposed markers."""
        return float(self.history[-1])

    @property
    def worst_even(self) -> float:
        """And with the even ones."""
        return float(self.history[0])


def even_layout(robot: Robot, count: int) -> Float[Tensor, " P"]:
    """Evenly spaced markers (m), the last at the tip."""
    return robot.rod.length * torch.arange(1, count + 1, dtype=DTYPE) / count


def _worst(A: Float[Tensor, "... B m m"]) -> Float[Tensor, "..."]:
    """The largest standard deviation of the location over the pushes, in L; inf where one cannot be seen."""
    C, singular = covariance(A)
    return C[..., 2, 2].sqrt().masked_fill(singular, torch.inf).amax(-1)


def _information(
    robot: Robot,
    candidates: Float[Tensor, " C"],
    noise: float,
    force: float,
    nearest: float,
    tension: Float[Tensor, " T"] | None,
    registration: Registration | None,
    directions: int,
    steps: int,
    uncertainty: Uncertainty | None = None,
) -> tuple[Float[Tensor, "C B m m"], Float[Tensor, "m m"]]:
    """A_i of (1) for every candidate and push, and `held`. Pushes without an equilibrium are left out."""
    at = places(robot, PLACES, nearest).repeat_interleave(directions)
    F = force * around(directions)[1].repeat(PLACES, 1)
    problem = push_problem(robot, seen_by(candidates, at, noise), tension, registration, steps, uncertainty)
    J = sensitivity(problem, pushed(problem, F, at), KNOWN)[:, : len(candidates)] / noise
    solved = torch.isfinite(J).flatten(1).all(-1)
    if not bool(solved.any()):
        raise ValueError(f"force {force} N: no equilibrium was found under it anywhere along the rod; check its size and units")
    return (J.mT @ J)[solved].movedim(0, 1), held(problem, KNOWN)


def _apart(candidates: Float[Tensor, " C"], others: Int[Tensor, " P1"], gap: float) -> Bool[Tensor, " C"]:
    """Candidates no closer than the gap to any of the other markers."""
    return ((candidates.unsqueeze(-1) - candidates[others]).abs() >= gap * (1 - 1e-9)).all(-1)


def _exchange(
    A: Float[Tensor, "C B m m"], known: Float[Tensor, "m m"], candidates: Float[Tensor, " C"], layout: Int[Tensor, " P"], gap: float
) -> tuple[Int[Tensor, " P"], list[float]]:
    """(3): the layout that no exchange of one marker betters, and the worst case after every exchange."""
    layout, history = layout.clone(), [float(_worst(known + A[layout].sum(0)))]
    for _ in range(MAX_ROUNDS):
        before = len(history)
        for i in range(len(layout)):
            others = torch.cat([layout[:i], layout[i + 1 :]])
            free = _apart(candidates, others, gap).nonzero().squeeze(-1)
            worst = _worst(known + A[others].sum(0) + A[free])
            best = int(worst.argmin())
            if float(worst[best]) < (1 - GAIN) * history[-1]:
                layout[i] = free[best]
                history.append(float(worst[best]))
        if len(history) == before:
            break
    return layout, history


def place(
    robot: Robot,
    count: int,
    noise: float,
    force: float,
    tension: Float[Tensor, " T"] | None = None,
    registration: Registration | None = None,
    nearest: float | None = None,
    gap: float | None = None,
    directions: int = 8,
    steps: int = 0,
    uncertainty: Uncertainty | None = None,
) -> Placement:
    """Propose `count` markers for pushes of `force` (N) from `nearest` (m; 10 % of L) to the tip, in every direction.

    noise: standard deviation of a marker coordinate (m). tension: readings (N). gap: least distance of two markers (m; 2 % of L, or
    the even spacing if that is less). uncertainty: what is only nearly known of the robot. Starts from the even layout and is never
    worse. Errors: ValueError for what does not fit.
    """
    L = robot.rod.length
    even = even_layout(robot, count)
    check(robot, even, noise, force, tension)
    nearest = FROM * L if nearest is None else nearest
    if not 0 < nearest < L:
        raise ValueError(f"pushes from {nearest} m on: must lie on the rod, above 0 and below {L} m")
    gap = min(GAP * L, L / count) if gap is None else gap
    if not 0 <= gap <= L / count * (1 + 1e-9):
        raise ValueError(f"a gap of {gap} m leaves no room for {count} markers on {L} m; it must be from 0 to {L / count:.6g} m")
    candidates = torch.cat([even, even_layout(robot, CANDIDATES)]).sort().values
    candidates = candidates[torch.cat([torch.tensor([True]), candidates.diff() > 1e-9 * L])]
    start = (candidates.unsqueeze(0) - even.unsqueeze(-1)).abs().argmin(-1)
    A, known = _information(robot, candidates, noise, force, nearest, tension, registration, directions, steps, uncertainty)
    layout, history = _exchange(A, known, candidates, start, gap)
    return Placement(candidates[layout].sort().values, even, nearest, L * torch.tensor(history, dtype=DTYPE))
