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
the same data at every iteration, Sigma+ is not the posterior covariance; that is (H^T W H + P)^-1, see `posterior`.
"""

import torch
from jaxtyping import Float
from torch import Tensor

Information = tuple[Float[Tensor, "B n n"], Float[Tensor, "B n"]]


def information(
    H: Float[Tensor, "B z n"],
    r: Float[Tensor, "B z"],
    w: Float[Tensor, "B z"],
    x: Float[Tensor, "B n"],
    prior_mean: Float[Tensor, " n"],
    prior_precision: Float[Tensor, " n"],
) -> Information:
    """H^T W H + P and g = H^T W r + P (x0 - x), with r = z - h(x) and W = diag(w)."""
    WH = w.unsqueeze(-1) * H
    A = torch.matmul(H.transpose(-1, -2), WH) + torch.diag(prior_precision)
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


def update(
    Sigma_bar: Float[Tensor, "B n n"], A: Float[Tensor, "B n n"], g: Float[Tensor, "B n"]
) -> tuple[Float[Tensor, "B n"], Float[Tensor, "B n n"]]:
    """(5): the step x+ - x and Sigma+, from the predicted covariance and the information of the data and the prior."""
    eye = torch.eye(A.shape[-1], dtype=A.dtype)
    Lambda = solve_spd(Sigma_bar, eye.expand_as(A)) + A
    both = solve_spd(Lambda, torch.cat([g.unsqueeze(-1), eye.expand_as(A)], -1))
    Sigma = both[..., 1:]
    return both[..., 0], 0.5 * (Sigma + Sigma.mT)


def limited(step: Float[Tensor, "B n"], limit: float) -> Float[Tensor, "B n"]:
    """The step, shortened so that no entry changes by more than the limit; zero where the update failed."""
    step = step.nan_to_num(0.0, 0.0, 0.0)
    return step * (limit / step.abs().amax(-1, keepdim=True).clamp(min=1e-300)).clamp(max=1.0)


def posterior(A: Float[Tensor, "B n n"]) -> Float[Tensor, "B n n"]:
    """(H^T W H + P)^-1 with the true noise: the covariance of the estimate."""
    return solve_spd(A, torch.eye(A.shape[-1], dtype=A.dtype).expand_as(A))


def decrement(A: Float[Tensor, "B n n"], g: Float[Tensor, "B n"]) -> Float[Tensor, " B"]:
    """g^T A^-1 g: by how much a full Gauss-Newton step would lower the cost r^T W r + (x0 - x)^T P (x0 - x), to first order."""
    return (g * solve_spd(A, g.unsqueeze(-1)).squeeze(-1)).sum(-1)


def inflation(w: Float[Tensor, "B z"], markers: int, decrement: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """decrement / m, with m the number of marker coordinates seen: what a Gauss-Newton step promises to remove from each.

    Zero where there is no such step: without a prior, a load of no force makes H^T W H singular.
    """
    return decrement.nan_to_num(0.0) / (w[:, :markers] > 0).sum(-1).clamp(min=1)


def adapted_weights(w: Float[Tensor, "B z"], markers: int, inflated: Float[Tensor, " B"]) -> Float[Tensor, "B z"]:
    """Residual-adaptive noise: R = sigma^2 (1 + inflated) on the first `markers` entries of z.

    With inflated = decrement / m, R is sigma^2 + mean(r^2) far from the data, where nearly all of r^T W r can be removed, and the
    true sigma^2 at a minimum, whether or not the model explains the data there. The tip residual keeps its weight: the first
    iterations look for an equilibrium that bends the right way rather than for a rod through all the markers.
    """
    return torch.cat([w[:, :markers] / (1 + inflated).unsqueeze(-1), w[:, markers:]], -1)
