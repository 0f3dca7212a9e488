"""What is known whatever the hypothesis: their probabilities, and resultants and bands averaged by them.

The marginal likelihood of a hypothesis is the mean weight of the draws of its posterior (estimation.draws), with priors that are
normalized. Probabilities p_h, by which loads are reported, are in its proportion, times ONE_MORE for each load and UNTOLD for a
force at the tip that nobody told of; a smooth load is reported where no other explains the readings. The resultant, and f(s) along
the rod, which all of them have, are of draws of all of them, weighted by the marginal likelihood alone: a load that is not reported
may be there, and must not be left out of an interval. Intervals of the loads that are reported are of draws of their own, by
Jeffreys' prior.
Source: Hoeting et al., Statistical Science 14 (1999) 382.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.draws import Draws, picked, posterior_draws, systematic
from ..estimation.intervals import CHUNK, Collected, Intervals, either, intervals, of_sizes, quantiles, resultant
from ..estimation.load_profile import DRAWS as OF_BAND
from ..estimation.load_profile import NODES, densities
from ..estimation.result import Estimate
from ..model.problem import Problem
from ..util.precision import DTYPE
from .count import ANY_FORM, UNTOLD, Bar, Evidence, Hypothesis, Selection, no_bar

ONE_MORE = 0.1  # how probable one more load is before the data: one too many is worse than one that hides behind another
OF_ANY_FORM = 0.0  # loads that a smooth one counts as: there are more forms of a distributed load than one
POSSIBLE = 0.05  # of the probability: a form of the loads that is not left out,
UNLIKELY = 0.02  # nor from force and place of a single load, which are known better and so go wrong sooner
RUNNING = 12.0  # of BIC: a hypothesis that is behind by more is out, by e^-6
NEGLIGIBLE = 0.005  # of the probability: all other hypotheses together
TRUSTED = 1.0  # of k-hat: draws whose weights are worse tell no evidence


@dataclass(frozen=True)
class Averaged:
    """The selection by evidence: the fit of the likeliest hypothesis of each sample, evidence with probabilities, and intervals."""

    fit: Estimate
    evidence: Evidence
    intervals: Intervals


@dataclass(frozen=True)
class _Drawn:
    """Draws by hypothesis h of some samples of a chunk. spare: it has a force at the tip that nobody told of."""

    h: int
    rows: Int[Tensor, " b"]
    fit: Estimate
    draws: Draws
    spare: bool


def average(
    problem: Problem, candidates: Sequence[Hypothesis], found: Selection, nu: float = math.inf, bar: Bar = no_bar
) -> Averaged:
    """Probabilities of the hypotheses that the BIC leaves in the running, and what is averaged by them.

    nu: degrees of freedom of Student's t of a robust fit. bar: shows progress.
    """
    problems = [problem.of(c.unknowns) for c in candidates]
    scores = found.evidence.bic
    held = torch.tensor([own.state.loads.size > 0 and own.state.loads.informative == own.state.loads.size for own in problems])
    running = _running(scores, ~held) | _running(scores, held)
    running.scatter_(1, found.evidence.choice.unsqueeze(-1), True)
    probability = torch.full_like(scores, torch.nan)
    localized = ~held & found.evidence.loaded if found.evidence.loaded is not None else ~held
    more = [
        (OF_ANY_FORM if h else c.contacts) + (own.state.tip.size > 0)
        for h, c, own in zip(held.tolist(), candidates, problems, strict=True)
    ]
    untold = math.log(UNTOLD) * torch.tensor([c.spare for c in candidates])
    rarer = math.log(ONE_MORE) * torch.tensor(more) + untold
    kinds, forms = _kinds(candidates), _forms_of_one_load(candidates)
    fit, choice = found.fit, found.evidence.choice.clone()
    collected = Collected(fit)
    with bar(problem.batch, "draws") as shown:
        for chunk in torch.arange(problem.batch).split(CHUNK):
            drawn = []
            for h, own in enumerate(problems):
                drawn += _drawn(own, h, candidates[h].spare, found, chunk, running[chunk, h], nu)
            probability[chunk] = _probabilities(drawn, scores[chunk], rarer, untold)
            likeliest = _likeliest(drawn, probability[chunk], held, localized)
            for d in drawn:
                at = chunk[d.rows]
                better = (likeliest[d.rows] == d.h) & (choice[at] != d.h) & (d.fit.accepted | ~fit.accepted[at])
                fit = fit.merged(d.fit, at, better)
                choice[at[better]] = d.h
            for d in drawn:
                chosen = (choice[chunk[d.rows]] == d.h).nonzero().squeeze(-1)
                if len(chosen):
                    part = d.fit.of(chosen, problems[d.h].size)
                    collected.put(chunk[d.rows[chosen]], intervals(_for_intervals(d, chosen, part, nu), part, d.spare))
            shares = _probabilities(drawn, scores[chunk])
            _mix(collected, chunk, drawn, shares, kinds)
            _mix_forms(collected, chunk, drawn, shares, choice[chunk], forms)
            shown.update(len(chunk))
    evidence = replace(found.evidence, choice=choice, probability=probability)
    return Averaged(fit, evidence, collected.whole(fit))


@dataclass(frozen=True)
class _Kind:
    """Hypotheses (H,) of loads of one kind. whenever: however improbable they are, if they explain a sample."""

    mine: Bool[Tensor, " H"]
    whenever: bool


def _kinds(candidates: Sequence[Hypothesis]) -> list[_Kind]:
    """Of each form of load, where there are several; and with a force at the tip that nobody told of, and without."""
    form = [_form(c) for c in candidates]
    names = sorted({name for name in form if name})
    spare = torch.tensor([c.spare for c in candidates])
    loaded = torch.tensor([c.unknowns.tip != "none" or c.unknowns.loads.size > 0 for c in candidates])
    found = [_Kind(torch.tensor([own == name for own in form]), name == ANY_FORM) for name in names if names[1:]]
    return found + [_Kind(mine, True) for mine in (spare, ~spare & loaded) if bool(spare.any())]


@dataclass(frozen=True)
class _Form:
    """Hypotheses (H,) of one load of one form; and those of one load of any form, with the same at the tip."""

    mine: Bool[Tensor, " H"]
    alike: Bool[Tensor, " H"]


def _forms_of_one_load(candidates: Sequence[Hypothesis]) -> list[_Form]:
    """Where several compete, or several sizes and length scales of one."""
    keys = [(c.unknowns.tip, _form(c)) if c.contacts == 1 and not c.spare else None for c in candidates]
    found = []
    for tip in sorted({key[0] for key in keys if key}):
        names = sorted({key[1] for key in keys if key and key[0] == tip})
        alike = torch.tensor([key is not None and key[0] == tip for key in keys])
        found += [_Form(torch.tensor([key == (tip, name) for key in keys]), alike) for name in names]
    return [form for form in found if int(form.alike.sum()) > 1]


def _form(candidate: Hypothesis) -> str:
    """Of its loads; "" for none."""
    loads = candidate.unknowns.loads
    return getattr(loads, "prior_name", "").partition("(")[0] if loads.size else ""


def _running(scores: Float[Tensor, "B H"], kind: Bool[Tensor, " H"]) -> Bool[Tensor, "B H"]:
    """Of the hypotheses of a kind those near the best of them: what priors hold altogether has a BIC on a scale of its own."""
    known = torch.where(kind & torch.isfinite(scores), scores, torch.inf)
    return (known <= known.amin(-1, keepdim=True) + RUNNING) & torch.isfinite(known)


def _drawn(
    own: Problem, h: int, spare: bool, found: Selection, chunk: Int[Tensor, " c"], running: Bool[Tensor, " c"], nu: float
) -> list[_Drawn]:
    """Draws by hypothesis h of those samples of a chunk for which it is in the running: of the chosen fit, and of the others."""
    chosen, drawn = found.evidence.choice[chunk] == h, []
    sources = [(running & chosen, found.fit, chunk)]
    if h in found.fits:
        other, index = found.fits[h]
        place = torch.full((len(found.evidence.choice),), -1).index_copy(0, index, torch.arange(len(index)))[chunk]
        sources.append((running & ~chosen & (place >= 0), other, place))
    for wanted, fit, place in sources:
        rows = wanted.nonzero().squeeze(-1)
        if len(rows):
            part = fit.of(place[rows], own.size)
            draws = posterior_draws(own.take(chunk[rows]), part, nu=nu, prior="normalized")
            drawn.append(_Drawn(h, rows, part, draws, spare))
    return drawn


def _for_intervals(d: _Drawn, which: Int[Tensor, " c"], fit: Estimate, nu: float) -> Draws:
    """Of some of its samples and their fit, by Jeffreys' prior where that makes a difference."""
    draws = d.draws.take(which)
    return posterior_draws(draws.problem, fit, nu=nu) if draws.has_pushes else draws


def _probabilities(
    drawn: list[_Drawn],
    scores: Float[Tensor, "c H"],
    before: Float[Tensor, " H"] | float = 0.0,
    before_bic: Float[Tensor, " H"] | float = 0.0,
) -> Float[Tensor, "c H"]:
    """By the evidence and what hypotheses are worth before it, in logarithms; where draws are not to be trusted by the BIC, which
    weighs the number of loads by itself.
    """
    log_evidence = torch.full_like(scores, -torch.inf)
    for d in drawn:
        sound = (d.draws.k_hat <= TRUSTED) & torch.isfinite(d.draws.log_evidence)
        log_evidence[d.rows, d.h] = torch.where(sound, d.draws.log_evidence, torch.nan)
    doubtful = log_evidence.isnan().any(-1, keepdim=True)
    by_bic = before_bic - 0.5 * scores.nan_to_num(torch.inf, torch.inf)
    by_bic = torch.where(log_evidence == -torch.inf, -torch.inf, by_bic)
    return torch.softmax(torch.where(doubtful, by_bic, log_evidence + before), -1)


def _likeliest(
    drawn: list[_Drawn], probability: Float[Tensor, "c H"], held: Bool[Tensor, " H"], localized: Bool[Tensor, " H"]
) -> Int[Tensor, " c"]:
    """The hypothesis to report. A load of any form explains nearly all that other loads do, and says less of it: where these
    compete it widens bands, and is reported where none of them explains a sample.
    """
    explained = torch.zeros(len(probability), dtype=torch.bool)
    for d in drawn:
        if not held[d.h]:
            explained[d.rows] |= d.fit.accepted
    aside = (explained & bool(localized.any())).unsqueeze(-1) & held
    return torch.where(aside, -1.0, probability).argmax(-1)


def _mix(
    collected: Collected,
    chunk: Int[Tensor, " c"],
    drawn: list[_Drawn],
    probability: Float[Tensor, "c H"],
    kinds: Sequence[_Kind],
) -> None:
    """Resultants and bands of draws of all hypotheses, of the samples that have several.

    Of loads of several kinds these hold what each kind has for itself, where it has a share of POSSIBLE or, any form and a force at
    the tip, explains a sample at all: readings that several kinds explain alike say nothing of which it is, while the marginal
    likelihood takes the one with the fewest numbers. So a pull at the tip passes for two opposed pushes near it, and they for it.
    """
    several = (probability.amax(-1) < 1 - NEGLIGIBLE).nonzero().squeeze(-1)
    _put(collected, chunk, several, _mixed(drawn, probability, several), hull=False)
    for kind in kinds:
        of_kind, share = [d for d in drawn if kind.mine[d.h]], torch.where(kind.mine, probability, 0.0)
        possible = share.sum(-1) > POSSIBLE
        for d in of_kind if kind.whenever else []:
            possible[d.rows] |= d.fit.accepted
        rows = (possible & (share.sum(-1) > 0)).nonzero().squeeze(-1)
        _put(collected, chunk, rows, _mixed(of_kind, share, rows), hull=True)


def _put(
    collected: Collected, chunk: Int[Tensor, " c"], rows: Int[Tensor, " r"], mixed: tuple[Tensor, Tensor | None] | None, hull: bool
) -> None:
    """Instead of the intervals of rows of a chunk; or, hull, beside them."""
    if mixed is None:
        return
    at = chunk[rows]
    for name, new in zip(("resultant", "band"), mixed, strict=True):
        values = collected.values[name]
        if new is None or values is None:
            continue
        old = values[at]
        values[at] = torch.where(torch.isfinite(new), either(new, old) if hull else new, old)


def _mix_forms(
    collected: Collected,
    chunk: Int[Tensor, " c"],
    drawn: list[_Drawn],
    probability: Float[Tensor, "c H"],
    choice: Int[Tensor, " c"],
    forms: Sequence[_Form],
) -> None:
    """Force and place of a single load hold what each form has that has a share of UNLIKELY: of a load that is spread over a third
    of the rod a Gaussian of one width knows the place too well.
    """
    for form in forms:
        share = torch.where(form.mine, probability, 0.0)
        rows = (form.alike[choice] & (share.sum(-1) > UNLIKELY)).nonzero().squeeze(-1)
        of_form = [d for d in drawn if form.mine[d.h]]
        if not (len(rows) and of_form):
            continue
        each = [(d, *_weighted(d, share, rows)) for d in of_form]
        total = torch.cat([weight for _, _, weight in each], 1)
        weight = total / total.sum(-1, keepdim=True)
        reports = [d.draws.problem.unknowns.loads.describe(x[..., d.draws.problem.state.loads.at]) for d, x, _ in each]
        force, place = (
            torch.cat(parts, 1) for parts in zip(*((r.force[..., :1, :], r.location[..., :1]) for r in reports), strict=True)
        )
        known = weight.nan_to_num(1.0)
        found = {
            "magnitude": of_sizes(force, known),
            "location": quantiles(place, known),
            "force": quantiles(force.flatten(-2), known).unflatten(1, (1, 2)),
        }
        for name, new in found.items():
            values = collected.values[name]
            assert values is not None
            values[chunk[rows], :1] = either(_or_nan(new, weight), values[chunk[rows], :1])


def _weighted(
    d: _Drawn, probability: Float[Tensor, "c H"], rows: Int[Tensor, " r"]
) -> tuple[Float[Tensor, "r D n"], Float[Tensor, "r D"]]:
    """The draws of a hypothesis of some rows of a chunk, zero where it has none, with weights that sum to its probability."""
    own = torch.full((len(probability),), -1).index_copy(0, d.rows, torch.arange(len(d.rows)))[rows]
    there, some = (own >= 0).unsqueeze(-1), own.clamp(min=0)
    weight = d.draws.weight[some].nan_to_num(0.0) * probability[rows, d.h].unsqueeze(-1)
    return d.draws.x[some].nan_to_num(0.0), torch.where(there, weight, 0.0)


def _mixed(
    drawn: list[_Drawn], probability: Float[Tensor, "c H"], rows: Int[Tensor, " r"]
) -> tuple[Float[Tensor, "r 4 2"], Float[Tensor, "r S 3 2"] | None] | None:
    """95 % intervals of the resultant, and the band, of draws of several hypotheses; NaN without any; None of no rows."""
    if not len(rows):
        return None
    values, weights, profiles = [], [], []
    for d in drawn:
        x, weight = _weighted(d, probability, rows)
        values.append(resultant(d.draws.problem, x, d.spare))
        weights.append(weight)
        state, family = d.draws.problem.state, d.draws.problem.unknowns.loads
        gamma = picked(x[..., state.loads.at], systematic(weight + 1e-300, OF_BAND))
        s = torch.linspace(0.0, d.draws.problem.robot.rod.length, NODES, dtype=DTYPE)
        profiles.append((densities(family, gamma, s), weight.sum(-1, keepdim=True) / OF_BAND))
    total = torch.cat(weights, 1)
    total = total / total.sum(-1, keepdim=True)  # NaN of a sample without draws
    R, weight = torch.cat(values, 1), total.nan_to_num(1.0)
    whole = _or_nan(torch.cat([quantiles(R, weight), of_sizes(R.unsqueeze(2), weight)], 1), total)
    if any(f is None for f, _ in profiles):
        return whole, None
    f = torch.cat([f for f, _ in profiles if f is not None], -1).double().flatten(1, 2)
    share = torch.cat([w.expand(-1, OF_BAND) for _, w in profiles], -1)
    share = share / share.sum(-1, keepdim=True)
    mixed = quantiles(f.transpose(1, 2), share.nan_to_num(1.0)).unflatten(1, (3, NODES)).transpose(1, 2)
    return whole, _or_nan(mixed, total)


def _or_nan(values: Float[Tensor, "r ..."], weight: Float[Tensor, "r D"]) -> Float[Tensor, "r ..."]:
    known = torch.isfinite(weight).all(-1).view(-1, *[1] * (values.ndim - 1))
    return torch.where(known, values, torch.nan)
