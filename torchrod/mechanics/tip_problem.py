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
from .section import Section, StageTable

ORIENTATION_TOLERANCE = 1e-11  # rad: the forward solve's residual, far below what RK4 leaves
SETTLED = 1e-7  # rad: where rounding, which a rod under tension multiplies, lets Newton come no nearer
MAX_NEWTON = 40


@dataclass(frozen=True)
class TipProblem:
    """The march from a guessed tip orientation, with the loads of the base frame scaled by a fraction per sample.

    wrench: what the tip carries, [N~, M~] of mechanics.section just beyond it.
    """

    section: Section
    table: StageTable
    grid: Grid
    wrench: Float[Tensor, "B 6"]

    def take(self, index: Int[Tensor, " b"]) -> "TipProblem":
        """The samples of an index, which may repeat."""
        return replace(self, table=self.table.take(index), grid=self.grid.take(index), wrench=self.wrench[index])

    def march(
        self, q_tip: Float[Tensor, "B 4"], dq_tip: Float[Tensor, "B 4 n"], fraction: Float[Tensor, " B"], keep: Int[Tensor, "*B P"]
    ) -> tuple[Float[Tensor, "B P 13"], Float[Tensor, "B P 13 n"]]:
        """States at the nodes `keep`, and their derivatives when the tip's orientation moves along dq_tip."""
        y = torch.cat([torch.zeros_like(q_tip[:, :3]), q_tip, self.wrench], -1)
        dy = torch.nn.functional.pad(dq_tip, (0, 0, 3, 6))
        return march_linearized(
            self.section, y, dy, self.table.with_base_frame_loads_scaled(fraction), None, self.grid, keep, reverse=True
        )

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
