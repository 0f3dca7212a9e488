"""95 % intervals and bands from draws of the posterior: of forces, places, resultant, tip wrench and the load profile."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.precision import DTYPE
from .draws import DRAWS, Draws, Method, picked, posterior_draws, systematic
from .load_profile import DRAWS as OF_BAND
from .load_profile import LEVELS, NODES, band_of_draws
from .result import Z95, Estimate
from .valley import line_of

FLAT = 0.3  # times EI: how stiff the soft side of a flat rod is at most
ALL_THREE = (0.0085, 0.9915)  # between which three numbers are in 95 % of cases
NEXT_TO_NONE = 1e-3  # of the draws: below it lies what stands for the least
CHUNK = 64  # samples at a time: their draws are not kept


@dataclass(frozen=True)
class Intervals:
    """95 % intervals of B samples; NaN where a fit has not converged or its draws are not to be trusted (k_hat above 1). Where the
    first proposal did not do (method), those of loads and tip take in the normal ones.

    magnitude, location (B, K, 2) N, m, and force (B, K, 2, 2) N of every load, in the section frame; axial (B, K, 2) N of its force
    along the rod, or None. resultant (B, 4, 2) N: of the three components, in the base frame, and the size of all that pushes
    together, without the weight and the unknown tip; but with a force at the tip that nobody told of. tip (B, 6, 2) [N, N m]: the
    unknown wrench at the tip, or None. band (B, S, 3, 2) N/m: of f_x, f_y and |f| at evenly spaced places from base to tip, or None
    for point loads. k_hat, ess, method (B,): see Draws.
    """

    magnitude: Float[Tensor, "B K 2"]
    location: Float[Tensor, "B K 2"]
    force: Float[Tensor, "B K 2 2"]
    axial: Float[Tensor, "B K 2"] | None
    resultant: Float[Tensor, "B 4 2"]
    tip: Float[Tensor, "B 6 2"] | None
    band: Float[Tensor, "B S 3 2"] | None
    k_hat: Float[Tensor, " B"]
    ess: Float[Tensor, " B"]
    method: Int[Tensor, " B"]


def quantiles(
    values: Float[Tensor, "B D k"], weight: Float[Tensor, "B D"], levels: tuple[float, float] = LEVELS
) -> Float[Tensor, "B k 2"]:
    """The weighted quantiles of two levels, linear between the draws."""
    ordered, order = values.movedim(1, -1).sort(-1)
    share = weight.unsqueeze(1).expand(-1, values.shape[-1], -1).gather(-1, order)
    ends = share.cumsum(-1) - 0.5 * share
    found = []
    for level in levels:
        i = torch.searchsorted(ends.contiguous(), torch.full_like(ends[..., :1], level)).clamp(1, ends.shape[-1] - 1)
        (e0, e1), (v0, v1) = ((t.gather(-1, i - 1), t.gather(-1, i)) for t in (ends, ordered))
        found.append(v0 + ((level - e0) / (e1 - e0).clamp(min=1e-300)).clamp(0, 1) * (v1 - v0))
    return torch.cat(found, -1)


def of_sizes(vectors: Float[Tensor, "B D k d"], weight: Float[Tensor, "B D"], flat: bool = False) -> Float[Tensor, "B k 2"]:
    """Intervals of the sizes of vectors: between the quantiles of LEVELS.

    The size of what is only known to be small is never small in the draws: where two components or more are not told from zero, the
    interval begins at the least size that all components allow. On a flat rod it begins at the least draw where that is shorter: a
    force's component along the stiff side hardly shows there, and its likeliest size is the least one.
    """
    sizes = vectors.norm(dim=-1)
    found = quantiles(sizes, weight)
    if flat:
        below = quantiles(sizes, weight, (NEXT_TO_NONE, LEVELS[1] - LEVELS[0]))
        shorter = below[..., 1] - below[..., 0] < found[..., 1] - found[..., 0]
        found = torch.where(shorter.unsqueeze(-1), below, found)
    each = quantiles(vectors.flatten(-2), weight, ALL_THREE).unflatten(1, vectors.shape[-2:])
    least = torch.where(each[..., 0] > 0, each[..., 0], each[..., 1].clamp(max=0.0))  # nearest to zero in each interval
    low, high = found.unbind(-1)
    unsure = (least == 0).sum(-1) >= 2
    return torch.stack([torch.where(unsure, low.minimum(least.norm(dim=-1)), low), high], -1)


def interval_of(estimate: Estimate, drawn: Intervals | None, name: Literal["magnitude", "location"]) -> Float[Tensor, "B K 2"]:
    """Of the draws where there are any, else of the normal distribution."""
    own = estimate.magnitude_interval if name == "magnitude" else estimate.location_interval
    if drawn is None:
        return own
    found = drawn.magnitude if name == "magnitude" else drawn.location
    return torch.where(found.isnan(), own, found)


def resultant(problem: Problem, x: Float[Tensor, "B D n"], with_tip: bool = False) -> Float[Tensor, "B D 3"]:
    """Of all loads on the rod (N, base frame): what the base carries, less the weight and, but with_tip, what acts on the tip."""
    loads = problem.state.base.of(x)[..., :3] - problem.own_weight(x)
    return loads if with_tip else loads - problem.state.tip_wrench(x)[..., :3]


def _normal_resultant(problem: Problem, fit: Estimate, with_tip: bool) -> Float[Tensor, "B 4 2"]:
    """By the covariance of a fit."""
    with torch.inference_mode(False), torch.enable_grad():
        x = fit.x.clone().requires_grad_()
        R = resultant(problem, x.unsqueeze(1), with_tip).squeeze(1)
        J = torch.stack([torch.autograd.grad(R[:, i].sum(), x, retain_graph=True)[0] for i in range(3)], 1)
    R, C = R.detach(), J @ fit.covariance @ J.mT
    size = R.norm(dim=-1, keepdim=True)
    way = R / size.clamp(min=1e-300)
    along = (way * (C @ way.unsqueeze(-1)).squeeze(-1)).sum(-1, keepdim=True)
    std = torch.cat([C.diagonal(dim1=-2, dim2=-1), along], -1).clamp(min=0).sqrt()
    whole = _normal(torch.cat([R, size], -1), std)
    return torch.cat([whole[:, :3], whole[:, 3:].clamp(min=0.0)], 1)


def _normal(value: Float[Tensor, "*n"], std: Float[Tensor, "*n"]) -> Float[Tensor, "*n 2"]:
    return value.unsqueeze(-1) + std.unsqueeze(-1) * Z95 * value.new_tensor([-1.0, 1.0])


def _deviations(C: Float[Tensor, "*n m m"]) -> Float[Tensor, "*n m"]:
    return C.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()


def _missed(draws: Draws) -> Bool[Tensor, " B"]:
    """Where draws about a fit miss much of what turns in space what pushes: beside a wrench at the tip, by its torque, where the
    first proposal did not do; and with a base frame whose turn about the rod nothing tells.
    """
    state, problem = draws.problem.state, draws.problem
    if state.registration.size:
        return torch.ones_like(draws.method, dtype=torch.bool)
    return (draws.method > int(Method.IMPORTANCE)) & (state.tip.size == 6 and line_of(problem) is None)


def intervals(draws: Draws, fit: Estimate, with_tip: bool = False) -> Intervals:
    """The intervals of draws of the posterior about a fit. with_tip: the resultant counts an unknown force at the tip."""
    problem, x, weight = draws.problem, draws.x, draws.weight
    family, state = problem.unknowns.loads, problem.state
    gamma = x[..., state.loads.at]
    report, R = family.describe(gamma), resultant(problem, x, with_tip)
    flat, K = min(problem.robot.rod.sides) < FLAT, report.location.shape[-1]
    place, force = quantiles(torch.cat([report.location, report.force.flatten(-2)], -1), weight).split([K, 2 * K], 1)
    size, force = of_sizes(report.force, weight, flat), force.unflatten(1, (K, 2))
    whole = torch.cat([quantiles(R, weight), of_sizes(R.unsqueeze(2), weight, flat)], 1)
    missed = _missed(draws)
    if bool(missed.any()):
        rows = missed[:, None, None]
        whole = torch.where(rows, either(whole, _normal_resultant(problem, fit, with_tip)), whole)
        turned = _normal(fit.force, _deviations(fit.load_covariance[..., :2, :2]))[:, :K]
        force = torch.where(rows.unsqueeze(-1), either(force, turned), force)
    drag = None if report.axial is None else quantiles(report.axial, weight)
    tip = quantiles(state.tip_wrench(x), weight) if state.tip.size else None
    s = torch.linspace(0.0, problem.robot.rod.length, NODES, dtype=DTYPE)
    band = band_of_draws(family, picked(gamma, systematic(weight, OF_BAND)), s)
    made = Intervals(size, place, force, drag, whole, tip, band, draws.k_hat, draws.ess, draws.method)
    return _masked(made, draws.k_hat <= 1)


def either(a: Float[Tensor, "*n 2"], b: Float[Tensor, "*n 2"]) -> Float[Tensor, "*n 2"]:
    """The least interval that holds both, of which one may be NaN."""
    return torch.stack([torch.fmin(a[..., 0], b[..., 0]), torch.fmax(a[..., 1], b[..., 1])], -1)


def _masked(made: Intervals, sound: Tensor) -> Intervals:
    """NaN where not sound."""

    def only(v: Tensor | None) -> Tensor | None:
        return v if v is None else torch.where(sound.reshape(-1, *[1] * (v.ndim - 1)), v, torch.nan)

    names = ("magnitude", "location", "force", "axial", "resultant", "tip", "band")
    return replace(made, **{name: only(getattr(made, name)) for name in names})


def sampled_intervals(
    problem: Problem,
    estimate: Estimate,
    parts: Sequence[tuple[Unknowns, Int[Tensor, " b"]]] | None = None,
    draws: int = DRAWS,
    nu: float = math.inf,
) -> Intervals:
    """Intervals from draws of every sample; loads and entries that a sample's unknowns do not have are NaN.

    parts: of the batch, each with the unknowns it was fitted by (analysis.count); None: all by the problem's. draws, nu: see
    posterior_draws. Errors: ValueError for an estimate of other unknowns. Source: Vehtari et al., JMLR 2024.
    """
    parts = [(problem.unknowns, torch.arange(problem.batch))] if parts is None else parts
    found = Collected(estimate)
    for unknowns, index in parts:
        own = problem.of(unknowns) if unknowns is not problem.unknowns else problem
        for rows in index.split(CHUNK):
            if len(rows):
                part, fit = own.take(rows), estimate.of(rows, own.size)
                found.put(rows, intervals(posterior_draws(part, fit, draws, nu), fit))
    return found.whole(estimate)


class Collected:
    """Intervals of a batch, put together from those of some samples at a time; NaN where there are none."""

    def __init__(self, like: Estimate):
        """like: the fit of the whole batch, which says what there is to have intervals of."""
        B, K = like.location.shape
        shapes: dict[str, tuple[int, ...] | None] = {
            "magnitude": (K, 2),
            "location": (K, 2),
            "force": (K, 2, 2),
            "axial": None if like.axial is None else (K, 2),
            "resultant": (4, 2),
            "tip": None if like.tip is None else (6, 2),
            "band": (NODES, 3, 2),
            "k_hat": (),
            "ess": (),
        }
        full = (
            (name, None if shape is None else torch.full((B, *shape), torch.nan, dtype=DTYPE)) for name, shape in shapes.items()
        )
        self.values: dict[str, Tensor | None] = dict(full) | {"method": torch.zeros(B, dtype=torch.int64)}

    def put(self, rows: Int[Tensor, " b"], made: Intervals) -> None:
        """Those of some samples, in place of what was there."""
        for f in fields(Intervals):
            value, into = getattr(made, f.name), self.values[f.name]
            if f.name == "band" and value is None:
                self.values["band"] = None
            elif value is not None and into is not None:
                into[(rows, *(slice(0, n) for n in value.shape[1:]))] = value

    def whole(self, fit: Estimate) -> Intervals:
        """Of all samples of a fit."""
        band = self.values["band"]
        if band is not None:  # |f| of draws is never nothing: where neither component is told from zero, it may be
            nothing = ((band[:, :, :2, 0] <= 0) & (band[:, :, :2, 1] >= 0)).all(-1)
            band[:, :, 2, 0] = torch.where(nothing, 0.0, band[:, :, 2, 0])
        return _hull(Intervals(**self.values), fit)  # pyright: ignore[reportArgumentType]


def _hull(drawn: Intervals, fit: Estimate) -> Intervals:
    """With the normal intervals in them where the first proposal did not do: then the draws may miss a part of the posterior."""
    doubtful = drawn.method > int(Method.IMPORTANCE)

    def joined(own: Tensor | None, normal: Tensor | None) -> Tensor | None:
        if own is None or normal is None:
            return own
        known = torch.isfinite(own) & torch.isfinite(normal)
        return torch.where(doubtful.reshape(-1, *[1] * (own.ndim - 1)) & known, either(own, normal), own)

    def about(value: Tensor | None, std: Tensor | None) -> Tensor | None:
        return None if value is None or std is None else _normal(value, std)

    return replace(
        drawn,
        magnitude=joined(drawn.magnitude, fit.magnitude_interval),
        location=joined(drawn.location, fit.location_interval),
        force=joined(drawn.force, _normal(fit.force, _deviations(fit.load_covariance[..., :2, :2]))),
        axial=joined(drawn.axial, about(fit.axial, fit.axial_std)),
        tip=joined(drawn.tip, about(fit.tip, None if fit.tip_covariance is None else _deviations(fit.tip_covariance))),
    )
