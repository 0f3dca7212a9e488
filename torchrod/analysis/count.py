"""How many loads, and of what kind: the Bayesian information criterion, each sample deciding for itself.

Stage k fits k contacts to the samples that still need it: those that no fit so far explains, and those whose residual asks for one
more load by the test of analysis.score_test, from which its fit starts. Where something at the tip competes, there is a way back:
a fit with fewer loads may only have been led astray, so it is tried again from the one that was chosen, without one of its loads.
"""

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.fit import Evidence
from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate
from ..estimation.starts import Start, StartRule
from ..model.measurement import Markers, Model
from ..model.validate import check, usable
from ..util.status import Status
from .score_test import probe, start_with_one_more

PROMISING = 0.4  # one more load is tried where the score test promises this much of what BIC asks for: it is linear, so only a hint


@dataclass(frozen=True)
class Hypothesis:
    """One explanation: `contacts` loads, fitted by `model`; name is what files call it."""

    name: str
    contacts: int
    model: Model


def free_parameters(model: Model) -> int:
    """Load parameters that the data alone must determine."""
    return model.load_size - model.coordinates.informative_priors


def bic(fit: Estimate, model: Model, markers: Markers) -> Float[Tensor, " B"]:
    """chi^2 + k ln(n): k load parameters that no prior holds, n marker coordinates seen; inf where not converged.

    Source: Schwarz 1978, for Gaussian noise of known size. A width with a prior is paid for in chi^2, which contains the prior.
    """
    n = 3.0 * markers.present.sum(-1)
    value = fit.cost + free_parameters(model) * torch.log(n.clamp(min=math.e))
    return torch.where((fit.status == int(Status.CONVERGED)) & torch.isfinite(value), value, torch.inf)


def _common(value: Tensor | None, other: Tensor | None) -> tuple[Tensor | None, Tensor | None]:
    """Both with NaN entries added where the other one has more loads or unknowns, so that samples of either can stand together."""
    if value is None and other is None:
        return None, None
    like = other if value is None else value
    assert like is not None
    shapes = [v.shape for v in (value, other) if v is not None]
    wide = torch.Size(max(sizes) for sizes in zip(*(s[1:] for s in shapes), strict=True))

    def padded(v: Tensor | None, count: int) -> Tensor:
        if v is not None and v.shape[1:] == wide:
            return v
        full = torch.full((count, *wide), torch.nan, dtype=like.dtype)
        if v is not None:
            full[(slice(None), *(slice(0, n) for n in v.shape[1:]))] = v
        return full

    counts = [0 if v is None else len(v) for v in (value, other)]
    return padded(value, counts[0]), padded(other, counts[1])


def _replaced(fit: Estimate, other: Estimate, index: Int[Tensor, " b"], better: Bool[Tensor, " b"]) -> Estimate:
    """`fit` with the samples of `index` that are better in `other`, which holds only those samples; every evaluation is counted."""
    B, b = len(fit.status), len(index)
    changed = {}
    for f in fields(Estimate):
        mine, theirs = getattr(fit, f.name), getattr(other, f.name)
        if mine is None and theirs is not None:
            mine = torch.full((B, *theirs.shape[1:]), torch.nan, dtype=theirs.dtype)
        if theirs is None and mine is not None:
            theirs = torch.full((b, *mine.shape[1:]), torch.nan, dtype=mine.dtype)
        wide, part = _common(mine, theirs)
        if wide is not None and part is not None:
            wide = wide.clone()
            wide[index[better]] = part[better]
        changed[f.name] = wide
    changed["iterations"] = fit.iterations.index_add(0, index, other.iterations)
    changed["restarts"] = fit.restarts.index_add(0, index, other.restarts)
    return replace(fit, **changed)


def select(
    hypotheses: list[Hypothesis],
    markers: Markers,
    noise: float,
    settings: Settings,
    start: Callable[[Model], StartRule],
    bar: Callable[[int, str], AbstractContextManager[Any]],
) -> tuple[Estimate, Evidence]:
    """Fit the hypotheses stage by stage, the fewest contacts first, and keep, per sample, the one of least BIC.

    Loads that the chosen hypothesis does not have are NaN.

    start: the rule a model starts by where the residual of an earlier fit suggests nothing. A sample for which nothing converges is
    reported with the fit that left the smallest chi^2. One with too few markers for any load is invalid: it would show none.
    Errors: ValueError where that is so of the whole file.
    """
    markers = _that_show_a_load(hypotheses, markers, noise)
    B = len(markers.positions)
    hasty = replace(settings, restarts=())  # a count that is too low fails however it starts
    fit: Estimate | None = None
    scores = torch.full((B, len(hypotheses)), torch.nan, dtype=torch.float64)
    foreseen = scores.clone()
    best, choice = torch.full((B,), torch.inf, dtype=torch.float64), torch.zeros(B, dtype=torch.int64)
    fits: dict[str, tuple[Estimate, Int[Tensor, " b"]]] = {}
    for h, hypothesis in enumerate(hypotheses):
        model = hypothesis.model
        if fit is not None and 3 * len(markers.s) < model.free_size:
            continue
        index, begin = _needed(hypothesis, hypotheses, fits, markers, noise, start(model), foreseen[:, h])
        if not len(index):
            continue
        part = markers.take(index)
        with bar(len(index), hypothesis.name) as b:
            other = estimate(model, part, noise, hasty, begin, b.update)
        fits[hypothesis.name] = other, index
        scores[index, h] = bic(other, model, part)
        if fit is None:
            fit, best, choice = other, scores[:, h].clone(), choice + h
            continue
        lower = _explains_better(scores[index, h], best[index], other, fit, index)
        fit = _replaced(fit, other, index, lower)
        best[index[lower]], choice[index[lower]] = scores[index[lower], h], h
    assert fit is not None
    fit = _simplified(hypotheses, fit, choice, scores, markers, noise, hasty)
    if settings.restarts:
        fit = _tried_again(hypotheses, fit, choice, scores, markers, noise, settings, start)
    return fit, Evidence(tuple(h.name for h in hypotheses), choice, scores, foreseen)


def _simplified(
    hypotheses: list[Hypothesis],
    fit: Estimate,
    choice: Int[Tensor, " B"],
    scores: Float[Tensor, "B H"],
    markers: Markers,
    noise: float,
    settings: Settings,
) -> Estimate:
    """The fit on the way back; choice and scores change with it."""
    for more, fewer, dropped in _ways_back(hypotheses):
        index = ((choice == more) & fit.accepted).nonzero().squeeze(-1)
        if not len(index):
            continue
        model, part = hypotheses[fewer].model, markers.take(index)
        x = _with_one_less(fit.x[index], hypotheses[more].model, model, dropped)
        other = estimate(model, part, noise, settings, Start(x, None, torch.ones_like(index, dtype=torch.bool)))
        again = bic(other, model, part)
        lower = again < scores[index, more]
        fit = _replaced(fit, other, index, lower)
        scores[index[lower], fewer], choice[index[lower]] = again[lower], fewer
    return fit


def _tried_again(
    hypotheses: list[Hypothesis],
    fit: Estimate,
    choice: Int[Tensor, " B"],
    scores: Float[Tensor, "B H"],
    markers: Markers,
    noise: float,
    settings: Settings,
    start: Callable[[Model], StartRule],
) -> Estimate:
    """The fit with restarts of the chosen hypothesis where that explains nothing; scores change with it."""
    for h, hypothesis in enumerate(hypotheses):
        index = ((choice == h) & ~fit.accepted & torch.isfinite(fit.x[:, -1])).nonzero().squeeze(-1)
        if not len(index):
            continue
        part = markers.take(index)
        other = estimate(hypothesis.model, part, noise, settings, start(hypothesis.model))
        fit = _replaced(fit, other, index, other.accepted)
        scores[index[other.accepted], h] = bic(other, hypothesis.model, part)[other.accepted]
    return fit


def _ways_back(hypotheses: list[Hypothesis]) -> list[tuple[int, int, int]]:
    """Where something at the tip competes: a hypothesis, one with a contact less, and which contact to leave out; the most first.

    Numbers of contacts alone are not worth it: there a fit with too few loads that explains nothing is nearly always what it seems.
    """
    if len({h.model.tip for h in hypotheses}) < 2:
        return []
    found = []
    for more, a in reversed(list(enumerate(hypotheses))):
        for fewer, b in enumerate(hypotheses):
            kept = same_kind(a.model, b.model) or (b.model.tip != "none" and same_kind(a.model, replace(b.model, tip="none")))
            if a.contacts > 1 and b.contacts == a.contacts - 1 and kept:
                found += [(more, fewer, dropped) for dropped in range(a.contacts)]
    return found


def _with_one_less(x: Float[Tensor, "b m"], more: Model, fewer: Model, dropped: int) -> Float[Tensor, "b n"]:
    """A start for `fewer`: the state of `more` without one of its loads; what acts on the tip, if that is new, is still nothing."""
    g, n = more.coordinates.size, fewer.coordinates.size
    kept = torch.cat([x[:, : (g - n) * dropped], x[:, (g - n) * (dropped + 1) : g]], -1)
    tip = x[:, g : more.load_size] if more.tip == fewer.tip else x.new_zeros(len(x), fewer.load_size - n)
    return torch.cat([kept, tip, x[:, more.load_size : more.size]], -1)


def _that_show_a_load(hypotheses: list[Hypothesis], markers: Markers, noise: float) -> Markers:
    """The markers, without those of samples that have too few for the simplest hypothesis with a load."""
    loaded = [h.model for h in hypotheses if h.model.load_size]
    simplest = min(loaded or [hypotheses[0].model], key=lambda model: model.free_size)
    check(simplest, markers, noise)
    return replace(markers, positions=markers.positions.where(usable(simplest, markers)[:, None, None], torch.nan))


def _explains_better(
    score: Float[Tensor, " b"], best: Float[Tensor, " b"], other: Estimate, fit: Estimate, index: Int[Tensor, " b"]
) -> Bool[Tensor, " b"]:
    """By BIC; where neither converged, by chi^2."""
    neither = torch.isinf(score) & torch.isinf(best)
    return torch.where(neither, other.cost < fit.cost[index].nan_to_num(torch.inf), score < best)


def _needed(
    hypothesis: Hypothesis,
    hypotheses: list[Hypothesis],
    fits: dict[str, tuple[Estimate, Int[Tensor, " b"]]],
    markers: Markers,
    noise: float,
    rule: StartRule,
    foreseen: Float[Tensor, " B"],
) -> tuple[Int[Tensor, " b"], StartRule | Start]:
    """The samples that a hypothesis is to be fitted to, and from where: the fit of the same kind with one contact less, if any.

    foreseen: takes the BIC that its score test promises.
    """
    everyone = torch.arange(len(markers.positions))
    before = [h for h in hypotheses if h.contacts == hypothesis.contacts - 1 and same_kind(h.model, hypothesis.model)]
    if not before:
        return everyone, rule
    if before[0].name not in fits:
        return everyone[:0], rule
    fitted, index = fits[before[0].name]
    model = before[0].model
    sound = torch.isfinite(fitted.x).all(-1)
    found = probe(model, fitted.x.nan_to_num(0.0), markers.take(index), noise)
    per_load = free_parameters(hypothesis.model) - free_parameters(model)
    asked = per_load * torch.log((3.0 * markers.present[index].sum(-1)).clamp(min=math.e))
    foreseen[index] = bic(fitted, model, markers.take(index)) - found.drop + asked
    wanted = sound & ((found.drop > PROMISING * asked) | ~fitted.accepted)
    rows = wanted.nonzero().squeeze(-1)
    begin = start_with_one_more(hypothesis.model, found.take(rows))
    return index[rows], begin if hypothesis.contacts > 1 else rule


def same_kind(a: Model, b: Model) -> bool:
    """Whether two models differ in the number of loads only; a model without loads has no width prior to differ in."""
    alike = getattr(a.coordinates, "prior_name", "") == getattr(b.coordinates, "prior_name", "") or not a.coordinates.size
    return a.tip == b.tip and alike
