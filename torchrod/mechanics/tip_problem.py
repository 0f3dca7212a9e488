"""The rod marched from its tip to its base: which orientation of the tip lets the base sit in its clamp.

Beyond the tip there is nothing, so the wrench is known there and only the tip's orientation is unknown: three numbers. r, the
rotation vector by which the base misses the identity, must vanish; damped Newton finds where.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .grid import Grid
from .integrate import march_linearized
from .jacobian import pointwise_jacobian
from .lie import Matrix, Quaternion, Vector, cross, hat, inverse3, logarithm, matvec, normalized, turned
from .section import STATE, Section, StageTable

ORIENTATION_TOLERANCE = 1e-11  # rad: the forward solve's residual, far below what RK4 leaves
SETTLED = 1e-7  # rad: where rounding, which a rod under tension multiplies, lets Newton come no nearer
MAX_NEWTON = 40


@dataclass(frozen=True)
class TipProblem:
    """The march from a guessed tip orientation, with the loads of the base frame scaled by a fraction per sample.

    wrench: what the tip carries, [N~, M~] of mechanics.section just beyond it. turned: (B, T) rad, how far the tendons have turned
    from the base to the tip, where they rub: unknown, like the tip's orientation.
    """

    section: Section
    table: StageTable
    grid: Grid
    wrench: Float[Tensor, "B 6"]
    turned: Float[Tensor, "B T"] | None = None

    def take(self, index: Int[Tensor, " b"]) -> "TipProblem":
        """The samples of an index, which may repeat."""
        turned = None if self.turned is None else self.turned[index]
        return replace(self, table=self.table.take(index), grid=self.grid.take(index), wrench=self.wrench[index], turned=turned)

    def march(
        self, q_tip: Float[Tensor, "B 4"], dq_tip: Float[Tensor, "B m n"], fraction: Float[Tensor, " B"], keep: Int[Tensor, "*B P"]
    ) -> tuple[Float[Tensor, "B P c"], Float[Tensor, "B P c n"]]:
        """States at the nodes `keep`, and their derivatives when the tip's orientation moves along dq_tip.

        Where the tendons rub, more columns of dq_tip may move Theta at the tip as well: (B, 4 + T, n).
        """
        y, tendons = self.tip_state(q_tip), 0 if self.turned is None else self.turned.shape[-1]
        dq, dturned = dq_tip[:, :4], dq_tip[:, 4:]
        dy = torch.cat(
            [torch.nn.functional.pad(dq, (0, 0, 3, 6)), torch.nn.functional.pad(dturned, (0, 0, 0, tendons - dturned.shape[1]))], 1
        )
        return march_linearized(
            self.section, y, dy, self.table.with_base_frame_loads_scaled(fraction), None, self.grid, keep, reverse=True
        )

    def tip_state(self, q_tip: Float[Tensor, "B 4"]) -> Float[Tensor, "B c"]:
        """y at the tip."""
        parts = [torch.zeros_like(q_tip[:, :3]), q_tip, self.wrench]
        return torch.cat(parts if self.turned is None else [*parts, self.turned], -1)

    def base(
        self, q_tip: Float[Tensor, "B 4"], dq_tip: Float[Tensor, "B 4 n"], fraction: Float[Tensor, " B"]
    ) -> tuple[Vector, Tensor]:
        """r(q_tip), the rotation vector by which the base misses the identity (rad), and its derivatives (B, 3, n)."""
        first = torch.zeros(*self.grid.nodes.shape[:-1], 1, dtype=torch.int64)
        states, tangents = self.march(q_tip, dq_tip, fraction, first)
        if dq_tip.shape[-1] == 0:
            return logarithm(states[:, 0, 3:7]), tangents[:, 0, :3]
        r, dr = pointwise_jacobian(logarithm, states[:, 0, 3:7])
        return r, dr @ tangents[:, 0, 3:7]

    def newton_step(self, q_tip: Float[Tensor, "B 4"], fraction: Float[Tensor, " B"]) -> tuple[Vector, Vector]:
        """r, and the tip's turn -J^-1 r in the base frame."""
        r, J = self.base(q_tip, turning(q_tip), fraction)
        return r, -matvec(inverse3(J), r)

    def turns(
        self, q_tip: Float[Tensor, "B 4"], fraction: Float[Tensor, " B"], pieces: int
    ) -> tuple[Float[Tensor, "B n 3 3"], Float[Tensor, "B 3 3"]]:
        """Theta(s): how the section turns (base frame) with the tip, at both ends of so many pieces of the rod, cut at nodes.

        And how the tip moves from the base (m).
        """
        states, tangents = self.march(q_tip, turning(q_tip), fraction, self.grid.cut(pieces))
        q, dq = states[..., 3:7].unsqueeze(-2), tangents[..., 3:7, :].mT
        Theta = 2 * (q[..., 3:] * dq[..., :3] - dq[..., 3:] * q[..., :3] - cross(dq[..., :3], q[..., :3]))
        return Theta.mT, -tangents[:, 0, :3]


def turning(q: Float[Tensor, "B 4"]) -> Float[Tensor, "B 4 3"]:
    """dq = (e_k, 0) q / 2 of a unit turn about each axis e_k of the base frame."""
    v, w = q[:, :3], q[:, 3, None, None]
    return 0.5 * torch.cat([w * torch.eye(3, dtype=q.dtype) - hat(v), -v.unsqueeze(1)], 1)


def with_turning(problem: TipProblem, q: Float[Tensor, "B 4"], fraction: Float[Tensor, " B"]) -> tuple[Tensor, Tensor]:
    """r and dr of orientation and of Theta at the base together, (B, 3 + T) and (B, 3 + T, 3 + T): both must vanish there."""
    assert problem.turned is not None
    T = problem.turned.shape[-1]
    moves = torch.cat([torch.nn.functional.pad(turning(q), (0, T, 0, T)), q.new_zeros(len(q), 4 + T, 0)], -1)
    moves[:, 4:, 3:] = torch.eye(T, dtype=q.dtype)
    first = torch.zeros(*problem.grid.nodes.shape[:-1], 1, dtype=torch.int64)
    states, tangents = problem.march(q, moves, fraction, first)
    r, dr = pointwise_jacobian(logarithm, states[:, 0, 3:7])
    return torch.cat([r, states[:, 0, STATE:]], -1), torch.cat([dr @ tangents[:, 0, 3:7], tangents[:, 0, STATE:]], 1)


def newton_with_turning(
    problem: TipProblem, q: Quaternion, fraction: Float[Tensor, " B"], enough: float, most: int = MAX_NEWTON
) -> tuple[TipProblem, Quaternion, Float[Tensor, " B"], Int[Tensor, " B"]]:
    """As `newton`, of the tip's orientation and of how far the tendons have turned there, which the problem returned has."""
    so_far = problem.turned
    assert so_far is not None
    best, damping = torch.full_like(fraction, torch.inf), torch.ones_like(fraction)
    anchor, at, move = q, so_far, torch.zeros_like(torch.cat([q[:, :3], so_far], -1))
    iterations = torch.zeros(best.shape, dtype=torch.int64)
    for _ in range(most):
        r, J = with_turning(problem, q, fraction)
        step = -torch.linalg.solve_ex(J, r.unsqueeze(-1)).result.squeeze(-1)
        size = r.norm(dim=-1)
        better = (size < best).unsqueeze(-1)
        anchor, at, move = torch.where(better, q, anchor), torch.where(better, so_far, at), torch.where(better, step, move)
        best, damping = torch.where(size < best, size, best), torch.where(size < best, 1.0, 0.5 * damping)
        active = (best > enough) & torch.isfinite(best) & (damping > 1e-3)
        iterations = iterations + active
        if not active.any():
            break
        scaled = (damping / move[:, :3].norm(dim=-1).clamp(min=1.0)).unsqueeze(-1) * move
        go = active.unsqueeze(-1)
        q = torch.where(go, normalized(turned(scaled[:, :3], anchor)), anchor)
        so_far = torch.where(go, at + scaled[:, 3:], at)
        problem = replace(problem, turned=so_far)
    return replace(problem, turned=at), anchor, best, iterations


def newton(
    problem: TipProblem, q: Quaternion, fraction: Float[Tensor, " B"], enough: Float[Tensor, " B"], most: int = MAX_NEWTON
) -> tuple[Quaternion, Float[Tensor, " B"], Int[Tensor, " B"]]:
    """Damped Newton on the tip's orientation until it is good enough (rad): the best one, its residual (rad), the iterations."""
    best = torch.full_like(fraction, torch.inf)
    anchor, turn, damping = q, torch.zeros_like(q[..., :3]), torch.ones_like(best)
    iterations = torch.zeros(best.shape, dtype=torch.int64)
    for _ in range(most):
        r, step = problem.newton_step(q, fraction)
        size = r.norm(dim=-1)
        better = size < best
        anchor, turn = torch.where(better.unsqueeze(-1), q, anchor), torch.where(better.unsqueeze(-1), step, turn)
        best, damping = torch.where(better, size, best), torch.where(better, 1.0, 0.5 * damping)
        active = (best > enough) & torch.isfinite(best) & (damping > 1e-3)
        iterations = iterations + active
        if not active.any():
            break
        scale = (damping / turn.norm(dim=-1).clamp(min=1.0)).unsqueeze(-1)
        q = torch.where(active.unsqueeze(-1), normalized(turned(scale * turn, anchor)), anchor)
    return anchor, best, iterations


def angle_between(a: Quaternion, b: Quaternion) -> Float[Tensor, "..."]:
    """The angle (rad) of the turn from one orientation to the other."""
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((0.5 * chord).clamp(max=1.0))


def smallest(Theta: Matrix) -> Float[Tensor, "..."]:
    """A lower bound of the least singular value, within a factor sqrt(3)."""
    return 1 / inverse3(Theta).flatten(-2).norm(dim=-1)
