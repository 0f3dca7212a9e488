"""Which equilibria a rod can be seen in, and how to stay on them while the load is put on.

March from tip to base and turn the tip a little: every section turns by Theta(s) w, and the wrench beyond the tip stays what it is,
so these are the equilibria of the rod from s to its tip nearest to the one at hand.

(1) s is conjugate to the tip where det Theta(s) = 0: the part beyond s, clamped there, has a second equilibrium at no distance.
(2) The second variation of the total potential energy has as many negative directions as there are conjugate points between
    base and tip, each as often as the rank is lost (Morse's index theorem; for rods R. S. Manning, K. A. Rogers &
    J. H. Maddocks, Proc. R. Soc. A 454, 1998). None: a strict minimum, the rod rests there. Any: it leaves at the least touch.
(3) From one node to the next Theta is multiplied by I - h K^-1 P with P symmetric but for terms that vanish with h, so its
    eigenvalues are real, and every negative one is a conjugate point in the step. Two at once, as in a round column, both count.
(4) There is none for sure where, with the least stiffness K and the forces and moments n(s), m(s) that a section carries,
        int_0^L |n| s ds + (int_0^L m^2 s ds)^(1/2) < K
    because th(0) = 0 makes |th(s)|^2 <= s int |th'|^2, and the second variation is at least
        int_0^L K |th'|^2 - |m| |th| |th'| - |n| |th|^2.

The energy is that of loads that keep their direction in the base frame, of weight and of tendons. A load that turns with the
section and a dead moment have none: there (1) still says where equilibria meet and part, and the count is that of divergence;
flutter is not looked for.
"""

import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from .lie import Matrix, Quaternion, exponential, inverse3, normalized, product, turned
from .tip_problem import SETTLED, TipProblem, angle_between, newton, smallest

INCREMENT_TOLERANCE = 1e-3  # rad: enough on the way to the full load, but where solutions are about to meet
NEARLY_SINGULAR = 0.25  # of Theta(0), whose singular values are 1 without load: solutions are about to meet
WIDE_TURN, NARROW_TURN = 1.5, 0.2  # rad: how far the tip may turn in one increment at most, and where solutions meet
TURN_PER_SIGMA = 4.0  # rad: in between
HALVINGS = 12  # of an increment, before the branch is held to end or to lose its stability
ROUNDS = 600  # increments, taken or refused
ESCAPES = 3  # times that another branch is looked for
BEYOND = 1.05  # of the load at which a branch ended: where another is looked for
NEUTRAL = 1e-5  # of Theta over the piece at the base: a rod that the load lets turn freely about its axis is not unstable
ESCAPE_NEWTON = 20
AMPLITUDES = (0.03, 0.1, 0.3, 0.7, 1.2, 2.0)  # rad: turns of the tip tried along each mode
SIDE = 0.1  # rad: by how much less a tip may have turned and yet be refused for having gone to the other side
ORIENTATIONS = 64  # of the tip tried all round


def conjugate_points(Theta: Float[Tensor, "B S1 3 3"]) -> Int[Tensor, " B"]:
    """How many lie between base and tip, by (3)."""
    T = Theta[:, :-1] @ inverse3(Theta[:, 1:])
    T = torch.cat([T[:, :1] + NEUTRAL * torch.eye(3, dtype=T.dtype), T[:, 1:]], 1)
    minors = 0.5 * (T.diagonal(dim1=-2, dim2=-1).sum(-1) ** 2 - (T * T.mT).sum((-2, -1)))
    p = torch.stack([torch.ones_like(minors), -T.diagonal(dim1=-2, dim2=-1).sum(-1), minors, -torch.linalg.det(T)], -1)
    positive = (p[..., 1:] * p[..., :-1] < 0).sum(-1)  # Descartes: exact where all roots are real
    return (3 - positive).sum(-1)


def follow(
    problem: TipProblem,
    q: Quaternion,
    increments: Int[Tensor, " B"],
    unique_below: Float[Tensor, " B"],
    mine: Bool[Tensor, " B"],
    pieces: int,
    tolerance: float,
) -> tuple[Quaternion, Float[Tensor, " B"], Int[Tensor, " B"], Bool[Tensor, " B"]]:
    """Put the loads of the base frame on, from none, and stay in stable equilibrium all the way.

    q: the tip without them. increments: in how many steps at least. unique_below: the fraction of the load up to which (4) holds.
    mine: which samples are asked for. pieces: into which the rod is cut to count.
    An increment counts when Newton settles, nothing is conjugate, and the tip has turned no further than it should; else it is
    halved. Where that ends, another branch is looked for just beyond (`_escape`).
    Returns q, the residual (rad), the iterations and whether it is stable; where it is not, q is Newton's own from there.
    """
    most = 1 / increments.to(q.dtype)
    done, step, residual = torch.zeros_like(most), most.clone(), torch.full_like(most, torch.inf)
    iterations, escapes = torch.zeros_like(increments), torch.zeros_like(increments)
    near = torch.full_like(most, torch.inf)  # the least singular value of Theta(0)
    stable, live = torch.zeros_like(mine), mine.clone()
    for _ in range(ROUNDS):
        rows = live.nonzero().squeeze(-1)
        if not len(rows):
            break
        part = problem if len(rows) == len(q) else problem.take(rows)
        at = done[rows] + step[rows]
        at = torch.where(at > 1 - 1e-9, 1.0, at)
        loose = (at < 1) & (near[rows] >= NEARLY_SINGULAR)
        enough = torch.where(loose, max(INCREMENT_TOLERANCE, tolerance), tolerance)
        found, missed, more = newton(part, q[rows], at, enough)
        sigma, holds = torch.full_like(at, torch.inf), missed <= (10 * enough).clamp(min=SETTLED)
        check = (holds & (at > unique_below[rows])).nonzero().squeeze(-1)
        if len(check):
            Theta, _ = (part if len(check) == len(rows) else part.take(check)).turns(found[check], at[check], pieces)
            sigma[check] = smallest(Theta[:, 0])
            holds[check] = conjugate_points(Theta) == 0
        wide = torch.where(torch.isinf(sigma), math.pi, WIDE_TURN)
        limit = torch.minimum((TURN_PER_SIGMA * torch.minimum(sigma, near[rows])).clamp(min=NARROW_TURN), wide)
        angle = angle_between(found, q[rows])
        holds &= angle <= limit
        iterations[rows] += more
        good = rows[holds]
        q, residual = q.index_copy(0, good, found[holds]), residual.index_copy(0, good, missed[holds])
        done[good], near[good] = at[holds], sigma[holds]
        step[good] = torch.minimum(torch.where(angle < 0.45 * limit, 2.0, 1.0)[holds] * step[good], most[good])
        step[rows[~holds]] *= 0.5
        stable[good] = done[good] == 1
        stuck = live & ~stable & (step < most * 0.5**HALVINGS)
        live &= ~stable & ~stuck
        for b in stuck.nonzero().squeeze(-1).tolist():
            escapes[b] += 1
            new = _escape(problem, b, q[b], float(done[b]), pieces, tolerance) if int(escapes[b]) <= ESCAPES else None
            if new is not None:
                q_b, at_b, missed_b = new
                q = q.index_copy(0, torch.tensor([b]), q_b.unsqueeze(0))
                done[b], residual[b], near[b], step[b] = at_b, missed_b, 0.0, most[b] / 4
                stable[b], live[b] = at_b == 1, at_b < 1
    lost = (mine & ~stable).nonzero().squeeze(-1)
    if len(lost):
        part = problem.take(lost)
        found, missed, more = newton(part, q[lost], torch.ones_like(most[lost]), torch.full_like(most[lost], tolerance))
        q, residual = q.index_copy(0, lost, found), residual.index_copy(0, lost, missed)
    return q, residual, iterations, stable


def _escape(
    problem: TipProblem, b: int, q: Float[Tensor, " 4"], done: float, pieces: int, tolerance: float
) -> tuple[Float[Tensor, " 4"], float, float] | None:
    """A stable equilibrium of sample b beyond the fraction `done` of the load, where its own branch ends, nearest to q.

    Newton from tips turned both ways along the modes of Theta(0), and from orientations all round. Of two that are as near, as
    where a straight column buckles, the one whose tip has gone the way of `_direction`. Returns q, the fraction and the residual;
    None where there is none.
    """
    one = torch.tensor([b])
    Theta, tip_moves = problem.take(one).turns(q.unsqueeze(0), torch.full((1,), done, dtype=q.dtype), pieces)
    _, sigma, Vh = torch.linalg.svd(Theta[0, 0].nan_to_num(0.0))
    modes = Vh.flip(0)
    way, mode = _direction(tip_moves[0].nan_to_num(0.0) @ modes.mT, sigma.flip(0))
    turns = torch.cat([s * a * torch.cat([(mode @ modes).unsqueeze(0), modes]) for a in AMPLITUDES for s in (1.0, -1.0)])
    guesses = torch.cat([turned(turns, q), product(_all_round(q), q.expand(ORIENTATIONS, 4))])
    part = problem.take(one.expand(len(guesses)))
    for at in sorted({min(1.0, max(BEYOND * done, done + 0.5**HALVINGS)), 1.0}):
        fraction = torch.full((len(guesses),), at, dtype=q.dtype)
        found, missed, _ = newton(part, guesses, fraction, torch.full_like(fraction, tolerance), ESCAPE_NEWTON)
        Theta, _ = part.turns(found, fraction, pieces)
        good = (missed <= max(10 * tolerance, SETTLED)) & (conjugate_points(Theta) == 0)
        if bool(good.any()):
            states, _ = part.march(found, found.new_zeros(len(found), 4, 0), fraction, part.grid.outputs_and_base[..., -1:])
            tip = -states[:, 0, :3]
            aside = (tip @ way) / tip.norm(dim=-1)
            order = torch.where(good, angle_between(found, q.expand_as(found)) - SIDE * aside, torch.inf)
            best = int(order.argmin())
            return found[best], at, float(missed[best])
    return None


def _direction(moves: Matrix, sigma: Float[Tensor, " 3"]) -> tuple[Float[Tensor, " 3"], Float[Tensor, " 3"]]:
    """A unit vector along which the weakest modes move the tip: +x where it is among them, else near it; and what it is made of.

    moves: (3, 3), column k the tip's motion in mode k; sigma: rising. The second: how much of each mode.
    """
    along = moves / moves.norm(dim=0).clamp(min=1e-300)
    weight = (sigma[0] / sigma.clamp(min=1e-300)).clamp(max=1.0) ** 4
    share = weight * (along.new_tensor([1.0, 1e-6, 1e-9]) @ along)
    way = along @ share
    return way / way.norm().clamp(min=1e-300), share / share.norm().clamp(min=1e-300)


def _all_round(like: Tensor) -> Float[Tensor, "n 4"]:
    """Turns spread evenly over all: rotation vectors on a spiral of directions, with angles from 0 to pi."""
    i = torch.arange(ORIENTATIONS, dtype=like.dtype) + 0.5
    z, azimuth = 1 - 2 * i / ORIENTATIONS, math.pi * (3 - math.sqrt(5)) * i
    axis = torch.stack([(1 - z * z).sqrt() * azimuth.cos(), (1 - z * z).sqrt() * azimuth.sin(), z], -1)
    angle = math.pi * (0.1 + 0.9 * (i * 0.7548776662466927 % 1))
    return normalized(exponential(angle.unsqueeze(-1) * axis))
