"""How many loads: the Bayesian information criterion over nested models, each sample deciding for itself."""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import fields, replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from .estimator import Settings, estimate
from .measurement import Markers, Model
from .result import Estimate
from .starts import StartRule, cold_start
from .status import Status


def bic(fit: Estimate, model: Model, markers: Markers) -> Float[Tensor, " B"]:
    """chi^2 + k ln(n): k free load parameters (one with a prior counts too), n marker coordinates seen; inf where not converged.

    Source: Schwarz 1978, for Gaussian noise of known size.
    """
    n = 3.0 * markers.present.sum(-1)
    value = fit.chi2 + model.coordinates.size * torch.log(n.clamp(min=math.e))
    return torch.where((fit.status == int(Status.CONVERGED)) & torch.isfinite(value), value, torch.inf)


def _widened(fit: Estimate, like: Estimate) -> Estimate:
    """The fit with NaN loads added, so that it stands beside one with more loads."""
    padded = {}
    for field in fields(Estimate):
        value, wide = getattr(fit, field.name), getattr(like, field.name)
        if value is not None and value.shape != wide.shape:
            full = torch.full_like(wide, torch.nan)
            full[tuple(slice(0, n) for n in value.shape)] = value
            padded[field.name] = full
    return replace(fit, **padded)


def select_count(
    models: list[Model],
    markers: Markers,
    noise: float,
    settings: Settings,
    bar: Callable[[int, str], AbstractContextManager[Any]],
    start_of: Callable[[Model], StartRule] = lambda _: cold_start,
) -> Estimate:
    """Fit 0, 1, 2, ... loads (one model each) and keep, per sample, the count of least BIC; loads that are not there are NaN.

    start_of: where the fits of a model start. A sample for which no count converges is reported with the count that left the
    smallest chi^2.
    """
    fits = []
    for model in models:
        if 3 * len(markers.s) < model.size - 6:
            break
        with bar(len(markers.positions), f"count {len(fits)}") as b:
            fits.append(estimate(model, markers, noise, settings, start_of(model), b.update))
    if not fits:
        raise ValueError(f"{len(markers.s)} markers are too few; add markers")
    scores = torch.stack([bic(f, m, markers) for f, m in zip(fits, models, strict=False)])
    misfit = torch.stack([f.chi2.nan_to_num(torch.inf) for f in fits])
    scores = torch.where(torch.isinf(scores).all(0), misfit, scores)
    choice = scores.argmin(0)
    wide = [_widened(f, fits[-1]) for f in fits]
    chosen = {}
    for field in fields(Estimate):
        values = [getattr(f, field.name) for f in wide]
        if values[0] is not None:
            stack = torch.stack(values)
            chosen[field.name] = stack[choice, torch.arange(stack.shape[1])]
    return replace(wide[-1], **chosen)
