"""One arc-length step of the rod: the definition of the section's statics, with the strain balance of mechanics.tendons.

(torchrod/kernel/kernel.cpp is its compiled copy; tests/test_fast.py fails when the two differ.)

The state is y = [p (m), q, N~ (N), M~ (N m)], (..., 13): position and orientation of the section in the base frame, and its
wrench in the section frame with the applied loads taken out,

    (1)  N = N~ - G + R^T Wn,        M = M~ + e3 x G2 - Gm + R^T Wm        (the whole section's wrench, rod and tendons)

G, G2, Gm, Wn, Wm are the closed-form integrals of mechanics.loads. Then, with v, u from the balance of mechanics.tendons,

    (2)  p' = R v,   q' = q (u, 0) / 2
    (3)  N' = -u x N - f - R^T f_w           and (1)  give   N~' = -u x (N~ - G)
    (4)  M' = -u x M - v x N - l - R^T l_w   and (1)  give   M~' = -u x (M - R^T Wm) - v x N - e3 x G

    (5)  Theta_j' = |u x t_j + t_j'|,   tau_j = tau_j(0) exp(-mu_j Theta_j)        where tendons rub (tendons.py, turning_rate)

In (3) and (4) no load density is left, so a narrow Gaussian costs no accuracy, and without world-frame loads they do not see
the orientation. Source: docs/model.md, which rewrites Rucker & Webster 2011 for the whole section.
Everything here is pointwise in the leading dimensions and free of branches on values: it can be mapped, differentiated in
forward mode, compiled whole, or traced into a kernel.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from .lie import Matrix, Vector, cross, inverse3, matvec, normalized, quaternion_rate, rotate, unrotate
from .loads import LoadIntegrals
from .tendons import TendonTable, balanced_strains, turning_rate

State = Float[Tensor, "... state"]  # 13 numbers, with Theta of every tendon behind it where there is friction
STATE_PARTS = [3, 4, 3, 3]
STATE = sum(STATE_PARTS)
MATRICES = ("K_se", "K_bt", "K_se_inverse", "K_bt_inverse")  # of a section


@dataclass(frozen=True)
class Section:
    """What the section is made of: stiffnesses, their inverses and the unstretched direction e3.

    One for the whole rod, or tensors of (..., S, 3, 3, 3) in a StageTable.
    """

    K_se: Matrix
    K_bt: Matrix
    K_se_inverse: Matrix
    K_bt_inverse: Matrix
    e3: Vector

    @classmethod
    def of(cls, K_se: Matrix, K_bt: Matrix) -> "Section":
        """From the stiffness matrices (N, N m^2)."""
        return cls(K_se, K_bt, inverse3(K_se), inverse3(K_bt), K_se.new_tensor([0.0, 0.0, 1.0]))


@dataclass(frozen=True)
class StageTable:
    """Everything known beforehand along the rod: tensors of (..., S, 3, .) for S steps, or (..., 3, .) for one step's stages."""

    loads: LoadIntegrals
    u_star: Vector
    tendons: TendonTable | None
    section: Section | None = None  # where it varies along the rod

    def _map(self, function) -> "StageTable":
        def at(x: Tensor | None) -> Tensor | None:
            return None if x is None else function(x)

        loads, t, of = self.loads, self.tendons, self.section
        return StageTable(
            LoadIntegrals(at(loads.G), at(loads.G2), at(loads.Gm), at(loads.Wn), at(loads.Wm)),
            function(self.u_star),
            None
            if t is None
            else replace(
                t,
                L=function(t.L, 3),
                dr=function(t.dr, 2),
                tau=function(t.tau),
                friction=t.friction if t.friction is None or t.friction.ndim == 1 else function(t.friction),
                ddr=None if t.ddr is None else function(t.ddr, 2),
                chord=None if t.chord is None else function(t.chord, 2),
            ),
            None if of is None else replace(of, **{name: function(getattr(of, name), 2) for name in MATRICES}),
        )

    def step(self, i: int) -> "StageTable":
        """The three stages of step i."""
        return self._map(lambda x, trailing=1: x.select(-2 - trailing, i))

    def stage(self, k: int) -> "StageTable":
        """One stage (0, 1, 2: start, middle, end) of a single step."""
        return self._map(lambda x, trailing=1: x.select(-1 - trailing, k))

    def reversed(self) -> "StageTable":
        """A single step's stages in the order in which a walk towards the base meets them."""
        return self._map(lambda x, trailing=1: x.flip(-1 - trailing))

    def take(self, index: Int[Tensor, " b"]) -> "StageTable":
        """The samples of an index, of the whole table; what the samples share stays shared."""
        return self._map(lambda x, trailing=1: x if x.ndim == 2 + trailing or len(x) == 1 else x[index])

    def detached(self) -> "StageTable":
        """The same numbers without their derivatives."""
        return self._map(lambda x, trailing=1: x.detach())

    def with_base_frame_loads_scaled(self, fraction: Float[Tensor, " B"]) -> "StageTable":
        """The loads of the base frame multiplied by a fraction per sample: increments of load in the forward solve."""

        def scaled(W: Vector | None) -> Vector | None:
            return None if W is None else fraction[:, None, None, None] * W

        loads = replace(self.loads, Wn=scaled(self.loads.Wn), Wm=scaled(self.loads.Wm))
        return replace(self, loads=loads)


def section_wrench(q: Float[Tensor, "... 4"], N: Vector, M: Vector, e3: Vector, loads: LoadIntegrals) -> tuple[Vector, Vector]:
    """(1): the whole section's force (N) and moment (N m) in the section frame, from N~ and M~."""
    if loads.G is not None and loads.G2 is not None:
        N, M = N - loads.G, M + cross(e3, loads.G2)
    if loads.Gm is not None:
        M = M - loads.Gm
    if loads.Wn is not None:
        N = N + unrotate(q, loads.Wn)
    if loads.Wm is not None:
        M = M + unrotate(q, loads.Wm)
    return N, M


def derivative(section: Section, y: State, at: StageTable) -> State:
    """dy/ds by (1)-(4), and (5) where there is friction."""
    (_, q, N_tilde, M_tilde), turned = y[..., :STATE].split(STATE_PARTS, -1), y[..., STATE:]
    loads, section = at.loads, at.section or section
    N, M = section_wrench(q, N_tilde, M_tilde, section.e3, loads)
    tendons = at.tendons if at.tendons is None or at.tendons.friction is None else at.tendons.after(turned)
    if tendons is None:
        v = section.e3 + matvec(section.K_se_inverse, N)
        u = at.u_star + matvec(section.K_bt_inverse, M)
    else:
        v, u = balanced_strains(section.K_se, section.K_bt, section.e3, at.u_star, N, M, tendons)
    N_turning, M_turning, couple = N_tilde, M, cross(v, N)
    if loads.G is not None:
        N_turning, couple = N_tilde - loads.G, couple + cross(section.e3, loads.G)
    if loads.Wm is not None:
        M_turning = M - unrotate(q, loads.Wm)
    rates = [rotate(q, v), quaternion_rate(q, u), -cross(u, N_turning), -cross(u, M_turning) - couple]
    if tendons is not None and tendons.friction is not None:
        rates.append(turning_rate(torch.cat([v, u], -1), tendons))
    return torch.cat(rates, -1)


def rk4_step(section: Section, y: State, table: StageTable, h: Float[Tensor, "..."]) -> State:
    """One classical Runge-Kutta step of length h (m); h < 0 walks towards the base with the table's stages reversed."""
    start, middle, end = table.stage(0), table.stage(1), table.stage(2)
    h = h.unsqueeze(-1)
    k1 = derivative(section, y, start)
    k2 = derivative(section, y + 0.5 * h * k1, middle)
    k3 = derivative(section, y + 0.5 * h * k2, middle)
    k4 = derivative(section, y + h * k3, end)
    y = y + h / 6 * (k1 + 2 * (k2 + k3) + k4)
    return torch.cat([y[..., :3], normalized(y[..., 3:7]), y[..., 7:]], -1)
