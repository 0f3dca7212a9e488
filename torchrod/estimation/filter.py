"""The extended Kalman filter's algebra, as pure batched functions in the paper's symbols.

The paper (4) iterates, on data z that do not change with the iteration,

    (1)  Sigma_bar = Sigma + Q
    (2)  K = Sigma_bar H^T (H Sigma_bar H^T + W^-1)^-1
    (3)  x+ = x + K (z - h(x)),    Sigma+ = (I - K H) Sigma_bar

With the matrix inversion lemma, and Lambda = Sigma_bar^-1 + H^T W H,

    (4)  K = Lambda^-1 H^T W,      Sigma+ = Lambda^-1

which needs n x n algebra only (n unknowns, far fewer than measurements): 12-21 us a sample where (2) costs 74-115. A Gaussian prior
(mean x0, precision P) enters as one more, linear, measurement of x:

    (5)  Lambda = Sigma_bar^-1 + H^T W H + P,    x+ = x + Lambda^-1 (H^T W (z - h) + P (x0 - x))

Sigma_bar^-1 acts as Levenberg-Marquardt damping: a larger Q means LESS damping (the paper says the reverse). Because (3) counts
the same data at every iteration, Sigma+ is not the posterior covariance; that is (H^T W H + P)^-1.

The tip residual c (17) is no measurement: it is zero. Far from the answer it is weighed like one, which eases the way; near it, x
moves where c(x) = 0 to first order (`TipCondition`), and so does the posterior.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

TURN = 0.1  # a step turns back that undoes a last one of at least this part of it
BASE = 6  # entries of the base wrench alpha, the last of x
Information = tuple[Float[Tensor, "B n n"], Float[Tensor, "B n"]]


def information(
    H: Float[Tensor, "B z n"],
    r: Float[Tensor, "B z"],
    w: Float[Tensor, "B z"],
    x: Float[Tensor, "B n"],
    prior_mean: Float[Tensor, "*B n"],
    prior_precision: Float[Tensor, "*B n"],
) -> Information:
    """H^T W H + P and g = H^T W r + P (x0 - x), with r = z - h(x) and W = diag(w)."""
    WH = w.unsqueeze(-1) * H
    A = torch.matmul(H.transpose(-1, -2), WH) + torch.diag_embed(prior_precision)
    g = (WH * r.unsqueeze(-1)).sum(-2) + prior_precision * (prior_mean - x)
    return A, g


def solve_spd(A: Float[Tensor, "B n n"], b: Float[Tensor, "B n k"]) -> Float[Tensor, "B n k"]:
    """A^-1 b for symmetric positive definite A, by a Cholesky factor of A scaled to unit diagonal; NaN where A is not one.

    Each sample is factored by itself: one that fails holds NaN and leaves its neighbours alone.
    """
    d = A.diagonal(dim1=-2, dim2=-1).rsqrt().unsqueeze(-1)
    factor, info = torch.linalg.cholesky_ex(
        A.nan_to_num(0.0, 0.0, 0.0) * d.nan_to_num(0.0, 0.0, 0.0) * d.mT.nan_to_num(0.0, 0.0, 0.0)
    )
    good = (info == 0) & torch.isfinite(A).flatten(1).all(-1)
    factor = torch.where(good[:, None, None], factor, torch.eye(A.shape[-1], dtype=A.dtype))
    return torch.where(good[:, None, None], d * torch.cholesky_solve(d * b, factor), torch.nan)


def predict(Sigma: Float[Tensor, "B n n"], Q: Float[Tensor, " n"]) -> Float[Tensor, "B n n"]:
    """(1): Sigma_bar = Sigma + diag(Q)."""
    return Sigma + torch.diag(Q)


def inverse(A: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
    """A^-1 by `solve_spd`."""
    return solve_spd(A, torch.eye(A.shape[-1], dtype=A.dtype).expand_as(A))


def update(
    Sigma_bar: Float[Tensor, "B n n"], A: Float[Tensor, "B n n"], g: Float[Tensor, "B n"], tip: "TipCondition | None" = None
) -> tuple[Float[Tensor, "B n"], Float[Tensor, "B n n"], Float[Tensor, " B"]]:
    """(5): the step x+ - x, Sigma+ and step^T Lambda step, the decrement that the damped step promises, from the predicted
    covariance and the information of the data and the prior; tip: under (7).
    """
    Lambda = inverse(Sigma_bar) + A
    if tip is not None:
        step, Sigma = tip.solve(Lambda, g)
        return step, Sigma, square(Lambda, step)
    eye = torch.eye(A.shape[-1], dtype=A.dtype).expand_as(A)
    both = solve_spd(Lambda, torch.cat([g.unsqueeze(-1), eye], -1))
    step, Sigma = both[..., 0], both[..., 1:]
    return step, 0.5 * (Sigma + Sigma.mT), (g * step).sum(-1)


def limited(step: Float[Tensor, "B n"], limit: float | Float[Tensor, "B 1"]) -> Float[Tensor, "B n"]:
    """The step, shortened so that no entry changes by more than the limit; zero where the update failed."""
    step = step.nan_to_num(0.0, 0.0, 0.0)
    return step * (limit / step.abs().amax(-1, keepdim=True).clamp(min=1e-300)).clamp(max=1.0)


def reached(
    step: Float[Tensor, "B n"], last: Float[Tensor, "B n"], reach: Float[Tensor, " B"], limit: float
) -> Float[Tensor, " B"]:
    """The share of the step limit that the next step may use, from what the one before could.

    Half of it where the largest entry turns back, else up to a fifth more. Along a direction in which the cost is far from a
    parabola, such as the logarithm of a width, steps would otherwise swing to and fro for ever. Source: Rprop, Riedmiller & Braun
    1993.
    """
    size, at = step.nan_to_num(0.0, 0.0, 0.0).abs().max(-1, keepdim=True)
    came = (last.gather(-1, at) * step.gather(-1, at).sign()).squeeze(-1)
    back = -came > TURN * torch.minimum(size.squeeze(-1), limit * reach)
    return torch.where(back, 0.5 * reach, (1.2 * reach).clamp(max=1.0))


@dataclass(frozen=True)
class TipCondition:
    """c(x + dx) = 0 to first order, solved for the base wrench alpha, which are the last BASE entries of x = [y, alpha]:

    (7)  dalpha = d - T dy,    d = -C_alpha^-1 c,    T = C_alpha^-1 C_y,    C = dc/dx

    T (B, 6, m), d (B, 6). C_alpha is singular where the rod is about to buckle; the solution is NaN there.
    """

    T: Float[Tensor, "B 6 m"]
    d: Float[Tensor, "B 6"]

    @classmethod
    def of(cls, C: Float[Tensor, "B 6 n"], r: Float[Tensor, "B 6"]) -> "TipCondition":
        """From C = dc/dx and r = -c."""
        both, info = torch.linalg.solve_ex(C[..., -BASE:], torch.cat([C[..., :-BASE], r.unsqueeze(-1)], -1))
        both = torch.where((info == 0)[:, None, None], both, torch.nan)
        return cls(both[..., :-1], both[..., -1])

    def reduced(self, A: Float[Tensor, "B n n"], g: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B m m"], Float[Tensor, "B m"]]:
        """Information and gradient of y alone, from those of [y, alpha]:

        (8)  Z^T A Z and Z^T (g - A [0, d]),    Z = [1, -T]
        """
        pulled = A[:, -BASE:, -BASE:] @ self.T - A[:, -BASE:, :-BASE]
        A_y = A[:, :-BASE, :-BASE] + self.T.mT @ pulled - A[:, :-BASE, -BASE:] @ self.T
        g_y = g[:, :-BASE] - (self.T.mT @ g[:, -BASE:].unsqueeze(-1)).squeeze(-1) + (pulled.mT @ self.d.unsqueeze(-1)).squeeze(-1)
        return A_y, g_y

    def along(self, dy: Float[Tensor, "B m k"]) -> Float[Tensor, "B n k"]:
        """Z dy: how x moves with y, c unchanged."""
        return torch.cat([dy, -self.T @ dy], -2)

    def solve(self, A: Float[Tensor, "B n n"], g: Float[Tensor, "B n"]) -> tuple[Float[Tensor, "B n"], Float[Tensor, "B n n"]]:
        """The step dx that minimizes dx^T A dx / 2 - g^T dx under (7), and Z (Z^T A Z)^-1 Z^T, the covariance."""
        A_y, g_y = self.reduced(A, g)
        eye = torch.eye(A_y.shape[-1], dtype=A.dtype).expand_as(A_y)
        both = solve_spd(A_y, torch.cat([g_y.unsqueeze(-1), eye], -1))
        step = self.along(both[..., :1]).squeeze(-1)
        C = self.along(self.along(both[..., 1:]).mT)
        return torch.cat([step[:, :-BASE], step[:, -BASE:] + self.d], -1), 0.5 * (C + C.mT)


def square(A: Float[Tensor, "B n n"], dx: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
    """dx^T A dx."""
    return (dx * (A @ dx.unsqueeze(-1)).squeeze(-1)).sum(-1)


def decrement(A: Float[Tensor, "B n n"], g: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
    """g^T A^-1 g: by how much a full Gauss-Newton step would lower the cost r^T W r + (x0 - x)^T P (x0 - x), to first order."""
    return (g * solve_spd(A, g.unsqueeze(-1)).squeeze(-1)).sum(-1)


class Limits(NamedTuple):
    """When the filter has arrived, and how far it may go in one iteration.

    step: the largest change of any entry of x. decrement, share: converged when a further step promises to lower the cost (chi^2)
    by less than this, or by less than this share of it: a model that cannot explain the data need not be fitted to round-off.
    gain: converged, too, when the step that is taken, damped as it is, promises less than this; 0: never. For a recursion that
    creeps along a direction in which the cost has no minimum (the paper's width c).
    settled: the cost with adapted weights is at its minimum when a step promises less than this. The step that shows that the
    filter has arrived is still taken: it has been computed already, and removes nearly all of the decrement that it promises.
    exact: steps keep (7). What they promise is then dx^T A dx, the change of what is read, which counts the way back to c = 0, too.
    """

    step: float = 0.6
    decrement: float = 1e-3
    share: float = 1e-6
    settled: float = 1.0
    gain: float = 0.0
    exact: bool = False


@dataclass(frozen=True)
class Normal:
    """Normal equations of B samples, markers and tip residual apart, because only the markers' noise is adapted.

    A (B, 2, n, n) = H^T W H, g (B, 2, n) = H^T W r, cost (B, 2) = r^T W r; seen (B,): marker coordinates that were seen; tip: the
    condition that the tip residual is zero, to first order, where there is one.
    """

    A: Float[Tensor, "B 2 n n"]
    g: Float[Tensor, "B 2 n"]
    cost: Float[Tensor, "B 2"]
    seen: Int[Tensor, " B"]
    tip: TipCondition | None = None

    def whole(
        self, x: Float[Tensor, "B n"], mean: Float[Tensor, "*B n"], precision: Float[Tensor, "*B n"], share: Tensor | float = 1.0
    ) -> tuple[Float[Tensor, "B n n"], Float[Tensor, "B n"], Float[Tensor, " B"]]:
        """A, g and cost with the prior; the markers' part multiplied by `share`, a number or (B, 1)."""
        off = mean - x
        w = share.unsqueeze(-1) if isinstance(share, Tensor) else share
        A = w * self.A[:, 0] + self.A[:, 1] + torch.diag_embed(precision)
        return A, share * self.g[:, 0] + self.g[:, 1] + precision * off, self.cost.sum(-1) + (precision * off**2).sum(-1)

    @property
    def readings(self) -> "Normal":
        """Without the tip residual."""
        scale = self.cost.new_tensor([1.0, 0.0])
        return Normal(self.A * scale[:, None, None], self.g * scale[:, None], self.cost * scale, self.seen, self.tip)

    def posterior(
        self, x: Float[Tensor, "B n"], mean: Float[Tensor, "*B n"], precision: Float[Tensor, "*B n"], exact: bool
    ) -> tuple[Float[Tensor, "B n n"], Float[Tensor, " B"]]:
        """Covariance of the estimate, with the true noise and c = 0, and the cost with the prior.

        exact: the cost where the step under (7) leads, to second order; at x the tip may still be a little out of balance, which
        can look cheaper than any equilibrium. Where that is no cost, far from an equilibrium, that of the readings at x. Otherwise
        the cost at x, that of c included.
        """
        assert self.tip is not None
        A, g, cost = self.readings.whole(x, mean, precision)
        finite = torch.isfinite(self.A).flatten(1).all(-1)
        step, C = self.tip.solve(A, g)
        onward = cost - 2 * (g * step).sum(-1) + square(A, step)
        C = torch.where(finite[:, None, None], C, torch.nan)
        return C, torch.where(torch.isfinite(onward) & (onward >= 0), onward, cost) if exact else cost + self.cost[:, 1]


def student(
    s: Float[Tensor, "B G"], nu: float, rows: Float[Tensor, " G"] | float = 3.0
) -> tuple[Float[Tensor, "B G"], Float[Tensor, "B G"]]:
    """Student's t with nu degrees of freedom for the rows of a group (a marker's three coordinates), s = r^T W r of that group:

    (6)  cost (nu + rows) log(1 + s / nu),  weight times (nu + rows) / (nu + s)

    The cost is -2 log of the density; the weight makes the gradient of r^T W r that of the cost (iteratively reweighted least
    squares, which never raises it). nu = inf is the normal distribution. Source: Lange, Little & Taylor, JASA 1989.
    """
    if math.isinf(nu):
        return s, torch.ones_like(s)
    return (nu + rows) * torch.log1p(s / nu), (nu + rows) / (nu + s)


def by_group(square: Float[Tensor, "B rows"], groups: Int[Tensor, " rows"]) -> Float[Tensor, "B G"]:
    """The sums of w r^2 over the rows of each group."""
    return square.new_zeros(len(square), int(groups[-1]) + 1).index_add(1, groups, square)


def sensors_cost(
    square: Float[Tensor, "B rows"], groups: Int[Tensor, " rows"], nu: float
) -> tuple[Float[Tensor, " B"], Float[Tensor, "B rows"]]:
    """The cost (6) of the sensors' rows, from their w r^2, and the factor of each row's weight."""
    cost, factor = student(by_group(square, groups), nu, torch.bincount(groups).to(square.dtype))
    return cost.sum(-1), factor[:, groups]


def normal_equations(
    H: Float[Tensor, "B z n"], r: Float[Tensor, "B z"], w: Float[Tensor, "B z"], groups: Int[Tensor, " rows"], nu: float = math.inf
) -> Normal:
    """Of residuals r = z - h(x), zero where nothing was read, whose last rows, beyond those of `groups`, are the tip's."""
    m = len(groups)
    seen = (w[:, :m] > 0).sum(-1)
    cost, factor = sensors_cost((w * r * r)[:, :m], groups, nu)
    w = torch.cat([w[:, :m] * factor, w[:, m:]], -1)
    parts = [(H[:, :m], r[:, :m], w[:, :m]), (H[:, m:], r[:, m:], w[:, m:])]
    A = torch.stack([H.mT @ (w.unsqueeze(-1) * H) for H, _, w in parts], 1)
    g = torch.stack([((w * r).unsqueeze(-1) * H).sum(-2) for H, r, w in parts], 1)
    tip = TipCondition.of(H[:, m:], r[:, m:]) if H.shape[1] - m == BASE else None
    return Normal(A, g, torch.stack([cost, (w * r * r)[:, m:].sum(-1)], -1), seen, tip)


STATE = ("x", "Sigma", "before", "cap", "reach", "done")


@dataclass(frozen=True)
class Iterate:
    """Where the filter stands: x, the covariance Sigma of (1), the last x at which the model was sound, and the cap on the
    inflation of the noise, which falls each time that the adapted problem has settled. reach: the share of the step limit that a
    step may use (`reached`). done: whether x has arrived.
    """

    x: Float[Tensor, "B n"]
    Sigma: Float[Tensor, "B n n"]
    before: Float[Tensor, "B n"]
    cap: Float[Tensor, " B"]
    reach: Float[Tensor, " B"]
    done: Bool[Tensor, " B"]

    @classmethod
    def start(cls, x: Float[Tensor, "B n"], Sigma: Float[Tensor, "B n n"], cap: float) -> "Iterate":
        """Before the first iteration, in memory of its own."""
        none = torch.zeros(len(x), dtype=torch.bool)
        return cls(x.clone(), Sigma.clone(), x.clone(), x.new_full((len(x),), cap), x.new_ones(len(x)), none)

    def take(self, index: Int[Tensor, " b"]) -> "Iterate":
        """The samples of an index."""
        return Iterate(*(getattr(self, name)[index] for name in STATE))

    def put(self, index: Int[Tensor, " b"], other: "Iterate") -> None:
        """Write the samples of an index, in place."""
        for name in STATE:
            getattr(self, name)[index] = getattr(other, name)


def advance(
    at: Iterate,
    N: Normal,
    Sigma0: Float[Tensor, "B n n"],
    prior: tuple[Float[Tensor, "*B n"], Float[Tensor, "*B n"]],
    Q: Float[Tensor, " n"],
    limits: Limits,
) -> Iterate:
    """One iteration: (1)-(5) with residual-adaptive noise. Its compiled copy is torchrod/kernel/filter.h."""
    tip = N.tip if limits.exact else None
    counted = N if tip is None else N.readings
    A, g, cost = counted.whole(at.x, *prior)
    promised = decrement(A, g) if tip is None else square(A, tip.solve(A, g)[0])
    sound = torch.isfinite(cost) & torch.isfinite(N.A).flatten(1).all(-1)
    done = (promised < (limits.share * cost).clamp(min=limits.decrement)) & sound
    inflated = torch.minimum(promised.nan_to_num(0.0) / N.seen.clamp(min=1), at.cap)
    A, g, _ = counted.whole(at.x, *prior, share=1 / (1 + inflated).unsqueeze(-1))
    step, Sigma, gain = update(predict(at.Sigma, Q), A, g, tip)
    done = done | ((gain < limits.gain) & sound)
    # Where the adapted problem has settled but the true one has not, the weights must move on towards the true ones.
    cap = torch.where(gain < limits.settled, 0.1 * inflated, at.cap)
    fresh = torch.isfinite(Sigma).flatten(1).all(-1) & sound
    reach = reached(step, at.x - at.before, at.reach, limits.step)
    most = limits.step * reach.unsqueeze(-1)
    # A model that overflowed says nothing: go half way back to the last place where it did.
    onward = torch.where(sound.unsqueeze(-1), at.x + limited(step, most), 0.5 * (at.x + at.before))
    return Iterate(
        onward,
        torch.where(fresh[:, None, None], Sigma, Sigma0),
        torch.where(sound.unsqueeze(-1), at.x, at.before),
        cap,
        reach,
        done,
    )
