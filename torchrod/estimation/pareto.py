"""Pareto-smoothed importance weights, for many samples at once.

The largest M = min(D / 5, 3 sqrt(D)) of D weights are replaced by expected order statistics of the generalized Pareto distribution
fitted to them, and none is left above the largest raw one. Its shape k says how far the weights can be trusted: above 0.7 the
proposal is too unlike the target. Source: Vehtari, Simpson, Gelman, Yao & Gabry, JMLR 2024; the fit: Zhang & Stephens,
Technometrics 2009, with the weak prior of Vehtari et al. on k.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

GOOD = 0.7  # weights of a larger k are not to be trusted
FEWEST = 5  # weights in the tail that a fit takes
PRIOR_WEIGHT, PRIOR_K = 10.0, 0.5


def generalized_pareto(x: Float[Tensor, "B M"]) -> tuple[Float[Tensor, " B"], Float[Tensor, " B"]]:
    """Shape k and scale of the distribution that the excesses x >= 0, in rising order, are drawn from.

    Zhang & Stephens' posterior mean of theta = -k / scale over a grid, by its profile likelihood.
    """
    M = x.shape[-1]
    count = 30 + int(math.sqrt(M))
    grid = 1 - (count / (torch.arange(1, count + 1, dtype=x.dtype) - 0.5)).sqrt()
    quartile = x[:, int(M / 4 + 0.5) - 1 : int(M / 4 + 0.5)]
    theta = grid / (3 * quartile) + 1 / x[:, -1:]
    shape = torch.log1p(-theta.unsqueeze(-1) * x.unsqueeze(1)).mean(-1)
    likelihood = M * ((-theta / shape).log() - shape - 1)
    weight = torch.softmax(likelihood.nan_to_num(-torch.inf), -1)
    theta = (theta * weight).sum(-1, keepdim=True)
    k = torch.log1p(-theta * x).mean(-1)
    scale = -k / theta.squeeze(-1)
    return (M * k + PRIOR_WEIGHT * PRIOR_K) / (M + PRIOR_WEIGHT), scale


def smoothed(log_weight: Float[Tensor, "B D"]) -> tuple[Float[Tensor, "B D"], Float[Tensor, " B"]]:
    """Logarithms of weights that sum to 1, smoothed, and k-hat; inf where fewer than FEWEST weights can be told apart."""
    raw = log_weight.nan_to_num(-torch.inf, -torch.inf, -torch.inf)
    raw = raw - raw.amax(-1, keepdim=True).clamp(min=-1e300)
    D = raw.shape[-1]
    M = math.floor(min(D / 5, 3 * math.sqrt(D)))
    ordered, order = raw.sort(-1)
    cut = ordered[:, -M - 1 : -M].clamp(min=-700.0).exp()
    excess = (ordered[:, -M:].clamp(min=-700.0).exp() - cut).clamp(min=0)
    k, scale = generalized_pareto(excess.clamp(min=1e-300))
    sound = (excess > 0).sum(-1).ge(FEWEST) & torch.isfinite(k) & torch.isfinite(scale) & (scale > 0)
    p = (torch.arange(M, dtype=raw.dtype) + 0.5) / M
    by = torch.where(k.abs() < 1e-9, 1e-9, k).unsqueeze(-1)
    tail = scale.unsqueeze(-1) * torch.expm1(-by * torch.log1p(-p)) / by + cut
    tail = torch.where(sound.unsqueeze(-1), tail.log().clamp(max=0.0), ordered[:, -M:])
    ordered = torch.cat([ordered[:, :-M], tail], -1)
    weights = torch.empty_like(ordered).scatter(-1, order, ordered)
    level = (cut.squeeze(-1) - 1).abs() < 1e-9  # nothing but equal weights in the tail: as light as a tail can be
    k = torch.where(sound, k, torch.where(level, -torch.inf, torch.inf))
    return weights - weights.logsumexp(-1, keepdim=True), k


def effective_size(log_weight: Float[Tensor, "B D"]) -> Float[Tensor, " B"]:
    """1 / sum w^2 of weights that sum to 1."""
    return torch.exp(-(2 * log_weight).logsumexp(-1))
