"""Tendons: where they run in the section, where they end, and the strains they leave for the rod to carry."""

import math
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..util.precision import DTYPE
from .lie import Matrix, Vector, cross, hat, inverse3, matvec

# Stiff rods: values to round-off and derivatives to 1e-9 (with two steps 1e-12 and only 1e-5). One more, differentiated, follows.
NEWTON_STEPS = 3
NEWTON_STEPS_SOFT = 16  # where a tension is not small beside the rod's own stiffness
SOFT = 0.1  # this much of it
STRAIGHT = 1e-3  # rad over the longest tendon: the turning below which a path is as good as straight
LEAK = 0.02  # of an unknown tension below slack: the slope that a filter still feels
SLACK = 0.1  # of its standard deviation: within this of zero its going slack is eased, so that the filter can settle there
SETTLED = 1e-7  # relative change of the strains that further steps may still make
Strains = Float[Tensor, "... 6"]


@dataclass(frozen=True)
class Tendon:
    """One tendon.

    routing: rows [s, x, y] (m): its offset from the centre line in the section frame; one row is a straight tendon, more rows
    are joined by a C2 cubic spline in s. ends_at: arc length (m) at which it is fixed to the rod.
    tension_offset, tension_gain: N and 1, what makes a reading of its load cell its tension (`Tendons.true_tension`).
    friction: mu, its coefficient of friction on the robot (`turning_rate`). motion: 1 while it is pulled, -1 while it is let out,
    anything between where that is not known; what counts is motion times friction. discs: arc lengths (m) of the discs through
    whose holes the tendon runs straight, the one where it ends and the base plate need not be among them; none: it follows the rod
    (`chords`). Errors: ValueError for what is no tendon.
    """

    routing: tuple[tuple[float, float, float], ...]
    ends_at: float
    tension_offset: float = 0.0
    friction: float = 0.0
    motion: float = 1.0
    tension_gain: float = 1.0
    discs: tuple[float, ...] = ()

    def __post_init__(self):
        if not self.routing or any(len(row) != 3 or not all(map(math.isfinite, row)) for row in self.routing):
            raise ValueError("a tendon's routing must be rows of three finite numbers [s, x, y], in m")
        if any(b[0] <= a[0] for a, b in pairwise(self.routing)):
            raise ValueError("a tendon's routing: s must increase from row to row")
        if not (math.isfinite(self.ends_at) and self.ends_at > 0):
            raise ValueError(f"a tendon ends at {self.ends_at} m; it must be positive and finite")
        if not math.isfinite(self.tension_offset):
            raise ValueError(f"a tendon's tension_offset is {self.tension_offset} N; it must be finite")
        if not (math.isfinite(self.tension_gain) and self.tension_gain > 0):
            raise ValueError(f"a tendon's tension_gain is {self.tension_gain}; it must be positive and finite")
        if not math.isfinite(self.friction):
            raise ValueError(f"a tendon's friction is {self.friction}; it must be finite")
        if not -1 <= self.motion <= 1:
            raise ValueError(f"a tendon's motion is {self.motion}; it must be 1 (pulled), -1 (let out) or between")
        object.__setattr__(self, "discs", tuple(self.discs))
        if any(not (math.isfinite(s) and s > 0) for s in self.discs) or any(b <= a for a, b in pairwise(self.discs)):
            raise ValueError("a tendon's discs: arc lengths must be positive, finite, and increase")

    @classmethod
    def straight(cls, x: float, y: float, ends_at: float, tension_offset: float = 0.0) -> "Tendon":
        """A tendon parallel to the centre line at offset (x, y) (m)."""
        return cls(((0.0, x, y),), ends_at, tension_offset)

    @property
    def holes(self) -> tuple[float, ...]:
        """Arc lengths (m) of base plate, discs and end, between which the tendon runs straight; () where it does not."""
        within = (s for s in self.discs if s < self.ends_at * (1 - 1e-9))
        return (0.0, *within, self.ends_at) if self.discs else ()

    def chords_at(self, s: Float[Tensor, "..."], inside: Float[Tensor, "..."]) -> Float[Tensor, "... 4"]:
        """c_0 .. c_3 of `chords` at s; `inside` decides in which gap. Zero where the tendon follows the rod."""
        if not self.holes:
            return s.new_zeros(*s.shape, 4)
        holes = torch.tensor(self.holes, dtype=DTYPE)
        gap = torch.searchsorted(holes[1:-1].contiguous(), inside.detach().contiguous())
        half, x = 0.5 * (holes[gap + 1] - holes[gap]), s - 0.5 * (holes[gap + 1] + holes[gap])
        room = half * half - x * x
        found = torch.stack([0.5 * room, -x, 0.5 * x * x + half * half / 6, -x * room / 3], -1)
        return found * (inside < self.ends_at).unsqueeze(-1)

    def offset_at(self, s: Float[Tensor, "..."]) -> tuple[Vector, Vector]:
        """r(s) (m) and r'(s) (-), section frame, third component zero; s may carry derivatives (moving nodes)."""
        r, dr, _ = self.path_at(s)
        return r, dr

    def path_at(self, s: Float[Tensor, "..."]) -> tuple[Vector, Vector, Vector]:
        """The same with r''(s) (1/m)."""
        rows = np.asarray(self.routing)
        zero = s.new_zeros(*s.shape, 1)
        if len(self.routing) == 1:
            none = torch.cat([zero, zero, zero], -1)
            return torch.cat([torch.from_numpy(rows[0, 1:]).expand(*s.shape, 2), zero], -1), none, none
        from scipy.interpolate import CubicSpline  # a third of a second, for routings that need it

        spline = CubicSpline(rows[:, 0], rows[:, 1:])
        knots, c = torch.from_numpy(spline.x), torch.from_numpy(spline.c)
        piece = (torch.searchsorted(knots, s.detach().contiguous(), right=True) - 1).clamp(0, len(knots) - 2)
        t, (c3, c2, c1, c0) = (s - knots[piece]).unsqueeze(-1), c[:, piece]
        r, dr = ((c3 * t + c2) * t + c1) * t + c0, (3 * c3 * t + 2 * c2) * t + c1
        return torch.cat([r, zero], -1), torch.cat([dr, zero], -1), torch.cat([6 * c3 * t + 2 * c2, zero], -1)


def eased(tau: Float[Tensor, "... T"], w: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    """Tensions (N) without a kink where a tendon goes slack: for tau within +-w of 0, and below,

        max(tau, 0)  ->  (1 - e) (tau + w)^2 / (4 w) + e tau,    (1 - e) 0 + e tau

    e: LEAK, by which a filter that is to lower the tension still feels that it cannot: without it, it would step from below -w to
    the prior's mean and back. w = 0: max(tau, 0).
    """
    soft = (1 - LEAK) * (tau + w).clamp(min=0.0).square() / torch.where(w > 0, 4 * w, 1.0) + LEAK * tau
    return torch.where(w > 0, torch.where(tau < w, soft, tau), tau.clamp(min=0.0))


def eased_slope(tau: Float[Tensor, "... T"], w: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
    """How `eased` moves with tau."""
    soft = (1 - LEAK) * (tau + w).clamp(min=0.0) / torch.where(w > 0, 2 * w, 1.0) + LEAK
    return torch.where(w > 0, torch.where(tau < w, soft, 1.0), (tau > 0).to(tau.dtype))


@dataclass(frozen=True)
class TendonTable:
    """Every tendon at given arc lengths, for strains x = [v, u] (..., 6).

    along_j = L_j x + r'_j with L_j = [I, -hat(r_j)]: L (..., T, 3, 6), dr (..., T, 3); tau (..., T) N, zero past a tendon's end.
    newton: how many steps the strain balance takes. friction: of every tendon, (T,) or (..., T), with the sign of its motion, and
    then ddr, r''_j (..., T, 3), and floor (1/m) as well; tau is then the tension at the base, where it is known. chord: c_0 .. c_3
    of `chords`, (..., T, 4), where tendons run straight between discs, and then ddr as well.
    """

    L: Float[Tensor, "... T 3 6"]
    dr: Float[Tensor, "... T 3"]
    tau: Float[Tensor, "... T"]
    newton: int = NEWTON_STEPS
    friction: Float[Tensor, "... T"] | None = None
    ddr: Float[Tensor, "... T 3"] | None = None
    floor: float = 0.0
    chord: Float[Tensor, "... T 4"] | None = None

    def after(self, turned: Float[Tensor, "... T"]) -> "TendonTable":
        """What is left of the tensions where the tendons have turned so far (rad): tau exp(-mu Theta), the capstan's."""
        assert self.friction is not None
        return replace(self, tau=self.tau * torch.exp(-self.friction * turned))


@dataclass(frozen=True)
class Tendons:
    """The robot's tendons; an empty tuple is a passive rod.

    clamped: whether tensions below zero are none; not of `eased`. followed: whether Theta is known of every tendon even where none
    rubs.
    """

    tendons: tuple[Tendon, ...] = field(default=())
    clamped: bool = True
    followed: bool = False

    def __len__(self) -> int:
        return len(self.tendons)

    @property
    def ends(self) -> tuple[float, ...]:
        """Arc lengths (m) at which tendons end: step boundaries of the integration."""
        return tuple(t.ends_at for t in self.tendons)

    @property
    def knots(self) -> tuple[float, ...]:
        """Those, and the discs."""
        return tuple(sorted({*self.ends, *(s for t in self.tendons for s in t.holes[1:])}))

    @property
    def friction(self) -> Float[Tensor, " T"] | None:
        """Of every tendon, with the sign of its motion; None where there is none and Theta is not followed."""
        mu = [t.friction * t.motion for t in self.tendons]
        return torch.tensor(mu, dtype=DTYPE) if any(mu) or self.followed else None

    def true_tension(self, reading: Float[Tensor, "... T"]) -> Float[Tensor, "... T"]:
        """tau = max(gain reading + offset, 0) (N): a load cell has a zero offset, and a tendon can only pull (where `clamped`)."""
        gain, offset = self.cells
        tau = gain * reading + offset
        return tau.clamp(min=0.0) if self.clamped else tau

    @property
    def cells(self) -> tuple[Float[Tensor, " T"], Float[Tensor, " T"]]:
        """Gain and offset (N) of every tendon's load cell."""
        gain, offset = (torch.tensor([getattr(t, f"tension_{k}") for t in self.tendons], dtype=DTYPE) for k in ("gain", "offset"))
        return gain, offset

    def eased(self, reading: Float[Tensor, "... T"], width: Float[Tensor, " T"]) -> Float[Tensor, "... T"]:
        """Readings (N) whose true tensions are `eased`. width (N): of a reading."""
        gain, offset = self.cells
        tau, w = gain * reading + offset, gain * width
        return torch.where(tau < w, (eased(tau, w) - offset) / gain, reading)

    def newton_steps(self, K_se: Matrix, K_bt: Matrix, tension: Float[Tensor, "... T"]) -> int:
        """More where sum tau / K_se or sum tau r^2 / K_bt says that the tendons are as stiff as the rod."""
        reach = max(max(x * x + y * y for _, x, y in t.routing) for t in self.tendons)
        gap = max((b - a for t in self.tendons for a, b in pairwise(t.holes)), default=0.0)
        reach += gap * gap / 8
        pulls = tension.detach().nan_to_num(0.0).sum(-1)
        pull = pulls.max() if pulls.numel() else pulls.new_zeros(())
        ratio = pull / K_se.diagonal(dim1=-2, dim2=-1).min() + pull * reach / K_bt.diagonal(dim1=-2, dim2=-1).min()
        return NEWTON_STEPS + (gap > 0) if bool(ratio < SOFT) else NEWTON_STEPS_SOFT

    def table(
        self, s: Float[Tensor, "..."], inside: Float[Tensor, "..."], tension: Float[Tensor, "..."], newton: int = NEWTON_STEPS
    ) -> TendonTable:
        """Offsets and tensions at s; `inside` is a point of the same step and decides on which side of a tendon's end s lies."""
        r, dr, ddr = (torch.stack(x, -2) for x in zip(*(t.path_at(s) for t in self.tendons), strict=True))
        active = inside.detach().unsqueeze(-1) < torch.tensor(self.ends, dtype=DTYPE)
        L = torch.cat([torch.eye(3, dtype=DTYPE).expand(*r.shape, 3), -hat(r)], -1)
        mu, chord = self.friction, None
        if any(t.discs for t in self.tendons):
            chord = torch.stack([t.chords_at(s, inside) for t in self.tendons], -2)
        if mu is None and chord is None:
            return TendonTable(L, dr, tension * active, newton)
        return TendonTable(L, dr, tension * active, newton, mu, ddr, 0.0 if mu is None else STRAIGHT / max(self.ends), chord)


def tendon_directions(x: Strains, table: TendonTable) -> tuple[Float[Tensor, "... T 6"], Float[Tensor, "... T 1"]]:
    """g_j = L_j^T t_j, the wrench of unit tension [t_j, r_j x t_j] (-, m), and the stretch |along_j|, with

        t_j = (v + u x r_j + r_j') / |.|

    so that the tendons' wrench on their side of the section is sum_j tau_j g_j. Source: docs/model.md; Rucker & Webster 2011.
    """
    along = (table.L * x[..., None, None, :]).sum(-1) + table.dr
    stretch = (along * along).sum(-1, keepdim=True).sqrt()
    return (table.L * (along / stretch).unsqueeze(-1)).sum(-2), stretch


def chords(x: Strains, table: TendonTable) -> tuple[Float[Tensor, "... T 6"], Float[Tensor, "... T 1"], Float[Tensor, "... T 6 6"]]:
    """The wrench of unit tension g_j = [t_j, q_j x t_j] (-, m) of tendons that run straight between discs, |along_j|, and dg_j/dx.

    Seen from a section of strains v, u at x = s - s_m of a gap of length 2 h about s_m, the tendon's path through holes that follow
    the rod has the derivatives T, a, b, and the line through the two holes the direction along_j and the point q_j,

        T = v + u x r + r',    a = u x (T + r') + r'',    b = u x a
        along = T - x a + (x^2 / 2 + h^2 / 6) b,     q = r + (h^2 - x^2) / 2 a - x (h^2 - x^2) / 3 b,     t = along / |along|

    to third order in h; what the strains' own change adds is odd in x and averages out. Zero coefficients: `tendon_directions`.
    Source: Taylor's series of the path about x; docs/model.md.
    """
    assert table.chord is not None
    assert table.ddr is not None
    u, L = x[..., None, 3:], table.L
    c0, c1, c2, c3 = (c.unsqueeze(-1) for c in table.chord.unbind(-1))
    r = torch.stack([L[..., 1, 5], -L[..., 0, 5], torch.zeros_like(L[..., 0, 5])], -1)
    T = (L * x[..., None, None, :]).sum(-1) + table.dr
    a = cross(u, T + table.dr) + table.ddr
    b = cross(u, a)
    along, q = T + c1 * a + c2 * b, r + c0 * a + c3 * b
    none = torch.zeros_like(hat(a))
    turn = hat(u).expand_as(none)
    da = _times(turn, L) - torch.cat([none, hat(T + table.dr)], -1)
    db = _times(turn, da) - torch.cat([none, hat(a)], -1)
    d_along = L + c1.unsqueeze(-1) * da + c2.unsqueeze(-1) * db
    dq = c0.unsqueeze(-1) * da + c3.unsqueeze(-1) * db
    stretch = (along * along).sum(-1, keepdim=True).sqrt()
    t = along / stretch
    dt = (d_along - t.unsqueeze(-1) * (t.unsqueeze(-1) * d_along).sum(-2, keepdim=True)) / stretch.unsqueeze(-1)
    return torch.cat([t, cross(q, t)], -1), stretch, torch.cat([dt, _times(hat(q), dt) - _times(hat(t), dq)], -2)


def _times(A: Float[Tensor, "... i k"], B: Float[Tensor, "... k j"]) -> Float[Tensor, "... i j"]:
    """The matrix product, pointwise."""
    return (A.unsqueeze(-1) * B.unsqueeze(-3)).sum(-2)


def chord_inverse(
    K_se: Matrix, K_bt: Matrix, tau: Float[Tensor, "... T"], dg: Float[Tensor, "... T 6 6"]
) -> Float[Tensor, "... 6 6"]:
    """Inverse (..., 6, 6) of diag(K_se, K_bt) + sum_j tau_j dg_j, which need not be symmetric, by 3 x 3 blocks [[A, B], [C, D]]."""
    J = (tau[..., None, None] * dg).sum(-3)
    A, B, C, D = K_se + J[..., :3, :3], J[..., :3, 3:], J[..., 3:, :3], K_bt + J[..., 3:, 3:]
    Ainv = inverse3(A)
    left, right = _times(C, Ainv), _times(Ainv, B)
    S = inverse3(D - _times(C, right))
    top = Ainv + _times(right, _times(S, left))
    return torch.cat([torch.cat([top, -_times(right, S)], -1), torch.cat([-_times(S, left), S], -1)], -2)


def turning_rate(x: Strains, table: TendonTable) -> Float[Tensor, "... T"]:
    """Theta'_j = |u x t_j + t_j'| (1/m): how fast every tendon's path turns along the rod; zero where it carries nothing.

    t_j' is how t_j changes with the routing, at the strains of the section: (u x r_j' + r_j'') / |along_j| normal to t_j. What the
    strains' own change adds is left out: v' is of the size of a load's force per length / GA, and r_j u_z' is nothing without
    torsion that varies. Exact where the strains are uniform, as on a helix, and where the rod bends in a plane under straight
    tendons. Smooth at zero: (Theta'^2 + floor^2)^(1/2). tau' = -mu tau Theta' is the capstan. Source: docs/model.md.
    """
    assert table.ddr is not None
    along = (table.L * x[..., None, None, :]).sum(-1) + table.dr
    stretch = (along * along).sum(-1, keepdim=True).sqrt()
    t, u = along / stretch, x[..., None, 3:]
    change = cross(u, table.dr) + table.ddr
    turn = cross(u, t) + (change - (t * change).sum(-1, keepdim=True) * t) / stretch
    return (table.tau.detach() > 0) * ((turn * turn).sum(-1) + table.floor**2).sqrt()


def balance_inverse(
    K_se: Matrix,
    K_bt: Matrix,
    tau: Float[Tensor, "... T"],
    LtL: Float[Tensor, "... T 6 6"],
    g: Float[Tensor, "... T 6"],
    stretch: Float[Tensor, "... T 1"],
) -> Float[Tensor, "... 6 6"]:
    """Inverse (..., 6, 6) of the Hessian of strain energy plus tendon energy, symmetric positive definite,

        diag(K_se, K_bt) + sum_j (tau_j / stretch_j) (L_j^T L_j - g_j g_j^T)

    by 3 x 3 blocks [[A, B], [B^T, C]] with the Schur complement of A.
    """
    weight = (tau.unsqueeze(-1) / stretch).unsqueeze(-1)
    J = (weight * (LtL - g.unsqueeze(-1) * g.unsqueeze(-2))).sum(-3)
    A, B, C = K_se + J[..., :3, :3], J[..., :3, 3:], K_bt + J[..., 3:, 3:]
    Ainv = inverse3(A)
    AinvB = (Ainv.unsqueeze(-1) * B.unsqueeze(-3)).sum(-2)
    D = inverse3(C - (B.unsqueeze(-1) * AinvB.unsqueeze(-2)).sum(-3))
    E = -(AinvB.unsqueeze(-1) * D.unsqueeze(-3)).sum(-2)
    top = Ainv - (E.unsqueeze(-2) * AinvB.unsqueeze(-3)).sum(-1)
    return torch.cat([torch.cat([top, E], -1), torch.cat([E.transpose(-1, -2), D], -1)], -2)


def balanced_strains(
    K_se: Matrix, K_bt: Matrix, v_star: Vector, u_star: Vector, N: Vector, M: Vector, table: TendonTable
) -> tuple[Vector, Vector]:
    """Strains v (-), u (1/m) that carry the whole section's wrench N (N), M (N m), all in the section frame:

        N = K_se (v - v*) + sum_j tau_j t_j(v, u),    M = K_bt (u - u*) + sum_j tau_j r_j x t_j(v, u)

    Newton on the convex energy from the unstrained section. Only the last step is differentiated, with its matrix held fixed:
    exact, because dx = -J^-1 dF at the solution, and cheap. Tendons between discs: t_j and the arm of their moment by `chords`.
    Source: docs/model.md.
    """
    x_star = torch.cat([v_star.expand_as(u_star), u_star], -1)

    def misfit(
        x: Strains, w: Strains, g: Float[Tensor, "... T 6"], tau: Float[Tensor, "... T"], K_se: Matrix, K_bt: Matrix
    ) -> Strains:
        elastic = x - x_star
        rod = torch.cat([matvec(K_se, elastic[..., :3]), matvec(K_bt, elastic[..., 3:])], -1)
        return w - rod - (tau.unsqueeze(-1) * g).sum(-2)

    w = torch.cat([N, M], -1)
    w0, K_se0, K_bt0 = w.detach(), K_se.detach(), K_bt.detach()
    frozen = replace(table, tau=table.tau.detach())
    if table.chord is not None:
        x, inverse = x_star, x_star
        for _ in range(table.newton):
            g, _, dg = chords(x, frozen)
            inverse = chord_inverse(K_se0, K_bt0, frozen.tau, dg)
            x = x + (inverse * misfit(x, w0, g, frozen.tau, K_se0, K_bt0).unsqueeze(-2)).sum(-1)
        g = chords(x, frozen)[0]
        x = x + (inverse * misfit(x, w, g, table.tau, K_se, K_bt).unsqueeze(-2)).sum(-1)
        return x[..., :3], x[..., 3:]
    LtL = (table.L.unsqueeze(-1) * table.L.unsqueeze(-2)).sum(-3)
    x, inverse = x_star, x_star
    for _ in range(table.newton):
        g, stretch = tendon_directions(x, frozen)
        inverse = balance_inverse(K_se0, K_bt0, frozen.tau, LtL, g, stretch)
        x = x + (inverse * misfit(x, w0, g, frozen.tau, K_se0, K_bt0).unsqueeze(-2)).sum(-1)
    g, _ = tendon_directions(x, frozen)
    x = x + (inverse * misfit(x, w, g, table.tau, K_se, K_bt).unsqueeze(-2)).sum(-1)
    return x[..., :3], x[..., 3:]


def strains_settled(
    K_se: Matrix, K_bt: Matrix, v_star: Vector, u_star: Vector, N: Vector, M: Vector, table: TendonTable | None
) -> Bool[Tensor, "..."]:
    """Whether further Newton steps would leave the strains where they are: false where the tendons crush the rod (no solution)."""
    if table is None:
        return torch.isfinite(N).all(-1)
    once, again = (
        torch.cat(balanced_strains(K_se, K_bt, v_star, u_star, N, M, t), -1)
        for t in (table, replace(table, newton=table.newton + NEWTON_STEPS_SOFT))
    )
    return ((once - again).norm(dim=-1) <= SETTLED * again.norm(dim=-1)) & (again[..., 2] > 0)
