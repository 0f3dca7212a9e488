"""How many loads, and of what kind: the Bayesian information criterion, each sample deciding for itself.

Stage k fits k contacts to the samples that still need it: those that no fit so far explains, and those whose residual asks for one
more load by the score test, from which its fit starts. Where something at the tip competes, there is a way back: a fit with fewer
loads may only have been led astray, so it is tried again from the one that was chosen, without one of its loads.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.solve import Settings, estimate_each
from ..estimation.starts import Origin, Start, StartRule, cold_start
from ..model.problem import Problem
from ..model.unknowns import Unknowns
from ..util.status import Status
from .score_test import score_test, start_with_one_more

PROMISING = 0.4  # one more load is tried where the score test promises this much of what BIC asks for: it is linear, so only a hint
MAX_CONTACTS = 4
MOST_BESIDE_TIP = 1  # contacts beside a force at the tip that nobody told of
NEAR_TIP = 0.75  # of the length: a force at the tip that also pulls along the rod looks like a contact this far out, or farther
UNTOLD = 0.02  # how probable a force at the tip is before the data where nobody told of one, times that of a contact
CLOSE = 0.1  # of the probability: an explanation with more is told
ANY_FORM = "smooth"
TOLD_ANY_FORM = (
    "No contact explains the readings: told is one load of any form along the rod, by its net force and the place of its moment. "
    "Where several contacts may push, try --contacts auto."
)
OR_ANY_FORM = "One load of any form along the rod explains the readings too: what is there may be spread."
Parts = list[tuple[Unknowns, Int[Tensor, " b"]]]
StartFor = Callable[[Problem], StartRule]


class Bar(Protocol):
    """A progress bar: called with the number of samples and a name, it is entered, and its `update` told of samples done."""

    def __call__(self, total: int, name: str, /) -> AbstractContextManager[Any]:
        """The bar."""
        ...


class _NoBar:
    def update(self, _: int) -> None:
        """Nothing."""


def no_bar(total: int, name: str) -> AbstractContextManager[Any]:
    """No progress bar."""
    return nullcontext(_NoBar())


def always_cold(_: Problem) -> StartRule:
    """Every hypothesis starts cold."""
    return cold_start


@dataclass(frozen=True)
class Evidence:
    """What speaks for each hypothesis: names (H); bic (B, H), chi^2 + k ln(n), of which the least is chosen; choice (B,), an index.

    NaN where a hypothesis was not needed, inf where its fit did not converge. foreseen (B, H): the BIC that the score test of the
    fit with one load less promises, to first order, by which a hypothesis was needed or not; NaN where there is no such fit. spare:
    the names of those that are tried only where the others do not serve. probability (B, H): of each hypothesis, by draws of its
    posterior (analysis.averaging), by which then the choice goes; None without draws. loaded (H): which of them have a load at all.
    """

    names: tuple[str, ...]
    choice: Int[Tensor, " B"]
    bic: Float[Tensor, "B H"]
    foreseen: Float[Tensor, "B H"]
    spare: frozenset[str] = frozenset()
    probability: Float[Tensor, "B H"] | None = None
    loaded: Bool[Tensor, " H"] | None = None

    @property
    def something(self) -> Float[Tensor, " B"] | None:
        """The probability that anything pushes at all; None where that is part of every hypothesis."""
        if self.probability is None or self.loaded is None or bool(self.loaded.all()):
            return None
        return self.probability[:, self.loaded].sum(-1).clamp(max=1.0)

    def rival(self, sample: int) -> str:
        """A sentence on another explanation that is nearly as probable as the one that was chosen; "" where there is none.

        A force at the tip that nobody told of counts as if somebody had.
        """
        if self.probability is None:
            return ""
        shares: dict[str, float] = {}  # smooth loads of all sizes and length scales, which stand in brackets, together
        for name, share in zip(self.names, self.probability[sample].nan_to_num(0.0).tolist(), strict=True):
            kind = name.partition("(")[0]
            shares[kind] = shares.get(kind, 0.0) + share
        chosen = self.names[int(self.choice[sample])]
        any_form = sum(share for name, share in shares.items() if ANY_FORM in name)
        if ANY_FORM in chosen:
            return TOLD_ANY_FORM * (len(shares) > 1)
        said = [OR_ANY_FORM] if any_form > CLOSE else []
        rest = {name: share for name, share in shares.items() if ANY_FORM not in name}
        untold = self.spare if chosen not in self.spare else frozenset[str]()
        evenly = {name: share / (UNTOLD if name in untold else 1.0) for name, share in rest.items()}
        best = max((name for name in rest if name != chosen), key=lambda name: evenly[name], default=chosen)
        if best != chosen and evenly[best] > CLOSE * sum(evenly.values()):
            whole = 100 / sum(rest.values())
            both = f"{chosen} ({whole * rest[chosen]:.0f} %) and {best} ({whole * rest[best]:.0f} %) remain possible"
            rarer = f"; that a force acts at the tip is taken to be {1 / UNTOLD:.0f} times rarer unless --unknown-tip says so"
            said.insert(0, f"Among the numbers and kinds of loads, {both}{rarer * bool({chosen, best} & self.spare)}.")
        return " ".join(said)


@dataclass(frozen=True)
class Hypothesis:
    """One explanation of the readings: `contacts` loads among its unknowns; name is what files call it.

    spare: tried only where the others take at least two contacts more than it has, or one more that lies near the tip, or explain
    nothing; and one that nobody told of is not as likely as the others.
    """

    name: str
    contacts: int
    unknowns: Unknowns
    spare: bool = False


def free_parameters(problem: Problem) -> int:
    """Load parameters that the data alone must determine."""
    return problem.state.external.stop - problem.state.loads.informative


def bic(problem: Problem, fit: Estimate) -> Float[Tensor, " B"]:
    """chi^2 + k ln(n): k load parameters that no prior holds, n numbers read; inf where not converged.

    Source: Schwarz 1978, for Gaussian noise of known size. A width with a prior is paid for in chi^2, which contains the prior.
    Loads that priors hold altogether pay for what they narrow down, by Laplace's method: log det (posterior precision / prior
    precision).
    """
    value = fit.cost + free_parameters(problem) * torch.log(problem.seen.to(fit.cost.dtype).clamp(min=math.e))
    loads = problem.state.loads
    if loads.size and loads.informative == loads.size:
        root = loads.precision.sqrt()
        narrowed = root.unsqueeze(-1) * fit.covariance[:, loads.at, loads.at] * root
        value = value - torch.linalg.slogdet(narrowed)[1]
    return torch.where((fit.status == int(Status.CONVERGED)) & torch.isfinite(value), value, torch.inf)


@dataclass
class _Selection:
    """What the stages have come to, changed as they go: the fit chosen for each sample, which one it is, and every score."""

    fit: Estimate
    choice: Int[Tensor, " B"]
    scores: Float[Tensor, "B H"]
    foreseen: Float[Tensor, "B H"]

    def swap(
        self, h: int, index: Int[Tensor, " b"], other: Estimate, better: Bool[Tensor, " b"], score: Float[Tensor, " b"]
    ) -> None:
        """Hypothesis h with the fit `other` of the samples `index`, for those that are better so."""
        self.fit = self.fit.merged(other, index, better)
        rows = index[better]
        self.scores[rows, h], self.choice[rows] = score[better], h


@dataclass(frozen=True)
class Selection:
    """What the stages found: the fit that was chosen for each sample, why, and every other fit with the samples that it is of."""

    fit: Estimate
    evidence: Evidence
    fits: dict[int, tuple[Estimate, Int[Tensor, " b"]]]


def select(
    problem: Problem,
    candidates: Sequence[Hypothesis],
    settings: Settings | None = None,
    start: StartFor = always_cold,
    bar: Bar = no_bar,
) -> tuple[Estimate, Evidence]:
    """For each sample the fit of the hypothesis of least BIC, and what spoke for every one of them.

    problem: robot and readings of B samples; its unknowns are replaced by each candidate's. candidates: H hypotheses, the fewest
    contacts first, each tried where the score test of the one before promises that it is worth its parameters. start: the rule
    that the fits begin by where no earlier fit suggests anything better. bar: shows progress, called with a total and a name.
    In the estimate, loads that a sample's hypothesis does not have are NaN. Errors: ValueError where no sample has enough markers
    for any load. Source: Schwarz 1978 (BIC); Rao 1948 (score test).
    """
    found = selection(problem, candidates, settings, start, bar)
    return found.fit, found.evidence


def selection(
    problem: Problem,
    candidates: Sequence[Hypothesis],
    settings: Settings | None = None,
    start: StartFor = always_cold,
    bar: Bar = no_bar,
    thorough: bool = False,
) -> Selection:
    """Fit the hypotheses stage by stage, the fewest contacts first, and keep, per sample, the one of least BIC.

    problem: robot and readings; its unknowns are replaced by each candidate's. Loads that the chosen hypothesis does not have are
    NaN. start: the rule a hypothesis starts by where the residual of an earlier fit suggests nothing. A sample for which nothing
    converges is reported with the fit that left the smallest chi^2. One with too few markers for any load is invalid: it would show
    none. thorough: one more load than a sample asks for is tried, if it has one, for analysis.averaging: what hardly shows is not
    chosen, but moves the others and their resultant. Errors: ValueError where that is so of the whole problem.
    """
    settings = settings or Settings()
    problem = _that_show_a_load(problem, candidates)
    problems = [problem.of(h.unknowns) for h in candidates]
    B, H = problem.batch, len(candidates)
    hasty = replace(settings, restarts=())  # a count that is too low fails however it starts
    chosen: _Selection | None = None
    nothing = torch.full((B, H), torch.nan, dtype=torch.float64)
    scores, foreseen = nothing, nothing.clone()
    fits: dict[int, tuple[Estimate, Int[Tensor, " b"]]] = {}
    unasked = torch.full((B, H), not thorough)
    for h, (hypothesis, own) in enumerate(zip(candidates, problems, strict=True)):
        if chosen is not None and not own.determined:
            continue
        if hypothesis.spare and chosen is not None:
            index, begin = _wanting(hypothesis, candidates, chosen), start(own)
        else:
            index, begin = _needed(h, candidates, problems, fits, start(own), foreseen[:, h], unasked)
        if not len(index):
            continue
        part = own.take(index)
        with bar(len(index), hypothesis.name) as shown:
            other = estimate_each(part, hasty, begin, shown.update)
        fits[h] = other, index
        scores[index, h] = bic(part, other)
        if chosen is None:
            chosen = _Selection(other, torch.full((B,), h), scores, foreseen)
            continue
        best, score = scores[index, chosen.choice[index]], scores[index, h]
        if hypothesis.spare:
            as_many = [not c.spare and c.contacts <= hypothesis.contacts + 1 for c in candidates]
            score = score - 2 * math.log(UNTOLD) * torch.tensor(as_many)[chosen.choice[index]]
        better = _explains_better(score, best, other, chosen.fit, index)
        better = better & other.accepted if hypothesis.spare else better
        if hypothesis.spare and not bool(better.any()):
            continue  # nothing of it in the result, then
        chosen.swap(h, index, other, better, scores[index, h])
    assert chosen is not None
    _simplify(chosen, candidates, problems, hasty)
    if settings.restarts:
        _try_again(chosen, problems, settings, start)
    spare = frozenset(h.name for h in candidates if h.spare)
    loaded = torch.tensor([p.state.external.stop > 0 for p in problems])
    evidence = Evidence(tuple(h.name for h in candidates), chosen.choice, chosen.scores, chosen.foreseen, spare, loaded=loaded)
    return Selection(chosen.fit, evidence, fits)


def _wanting(spare: Hypothesis, candidates: Sequence[Hypothesis], chosen: _Selection) -> Int[Tensor, " b"]:
    """The samples that a spare hypothesis is tried on."""
    contacts = torch.tensor([c.contacts for c in candidates])[chosen.choice]
    at_tip = (chosen.fit.location > NEAR_TIP * chosen.fit.rod_length.unsqueeze(-1)).any(-1)
    more = (contacts >= spare.contacts + 2) | ((contacts > spare.contacts) & at_tip)
    return ((more | ~chosen.fit.accepted) & torch.isfinite(chosen.fit.chi2)).nonzero().squeeze(-1)


def parts_of(candidates: Sequence[Hypothesis], evidence: Evidence) -> Parts:
    """The unknowns of every hypothesis, and the samples for which it was chosen."""
    return [(c.unknowns, (evidence.choice == h).nonzero().squeeze(-1)) for h, c in enumerate(candidates)]


def _simplify(chosen: _Selection, candidates: Sequence[Hypothesis], problems: list[Problem], settings: Settings) -> None:
    """The way back."""
    for more, fewer, dropped in _ways_back(candidates):
        index = ((chosen.choice == more) & chosen.fit.accepted).nonzero().squeeze(-1)
        if not len(index):
            continue
        part = problems[fewer].take(index)
        x = _with_one_less(chosen.fit.x[index], problems[more], problems[fewer], dropped)
        other = estimate_each(part, settings, Start.at(x, Origin.OTHER_FIT, challenged=True))
        again = bic(part, other)
        chosen.swap(fewer, index, other, again < chosen.scores[index, more], again)


def _try_again(chosen: _Selection, problems: list[Problem], settings: Settings, start: StartFor) -> None:
    """Restarts of the chosen hypothesis where that explains nothing."""
    for h, own in enumerate(problems):
        index = ((chosen.choice == h) & ~chosen.fit.accepted & torch.isfinite(chosen.fit.x[:, -1])).nonzero().squeeze(-1)
        if not len(index):
            continue
        part = own.take(index)
        other = estimate_each(part, settings, start(own))
        chosen.swap(h, index, other, other.accepted, bic(part, other))


def _ways_back(candidates: Sequence[Hypothesis]) -> list[tuple[int, int, int]]:
    """Where something at the tip competes: a hypothesis, one with a contact less, and which contact to leave out; the most first.

    Numbers of contacts alone are not worth it: there a fit with too few loads that explains nothing is nearly always what it seems.
    """
    if len({h.unknowns.tip for h in candidates if not h.spare}) < 2:
        return []
    found = []
    for more, a in reversed(list(enumerate(candidates))):
        for fewer, b in enumerate(candidates):
            without = replace(b.unknowns, tip="none")
            kept = same_kind(a.unknowns, b.unknowns) or (b.unknowns.tip != "none" and same_kind(a.unknowns, without))
            if a.contacts > 1 and b.contacts == a.contacts - 1 and kept:
                found += [(more, fewer, dropped) for dropped in range(a.contacts)]
    return found


def _with_one_less(x: Float[Tensor, "b m"], more: Problem, fewer: Problem, dropped: int) -> Float[Tensor, "b n"]:
    """A start for `fewer`: the state of `more` without one of its loads; what acts on the tip, if that is new, is still nothing."""
    g, n = more.state.loads.size, fewer.state.loads.size
    kept = torch.cat([x[:, : (g - n) * dropped], x[:, (g - n) * (dropped + 1) : g]], -1)
    same = more.unknowns.tip == fewer.unknowns.tip
    tip = x[:, more.state.tip.at] if same else x.new_zeros(len(x), fewer.state.tip.size)
    return torch.cat([kept, tip, x[:, more.state.external.stop : more.size]], -1)


def _that_show_a_load(problem: Problem, candidates: Sequence[Hypothesis]) -> Problem:
    """The problem with nothing read of samples that have too few readings for the simplest hypothesis with a load."""
    problems = [problem.of(h.unknowns) for h in candidates if not h.spare]
    loaded = [p for p in problems if p.state.external.stop]
    simplest = min(loaded or problems[:1], key=lambda p: p.state.free_size)
    simplest.check()
    return problem.without((~simplest.usable).unsqueeze(-1).expand_as(problem.present))


def _explains_better(
    score: Float[Tensor, " b"], best: Float[Tensor, " b"], other: Estimate, fit: Estimate, index: Int[Tensor, " b"]
) -> Bool[Tensor, " b"]:
    """By BIC; where neither converged, by chi^2."""
    neither = torch.isinf(score) & torch.isinf(best)
    return torch.where(neither, other.cost < fit.cost[index].nan_to_num(torch.inf), score < best)


def _needed(
    h: int,
    candidates: Sequence[Hypothesis],
    problems: list[Problem],
    fits: dict[int, tuple[Estimate, Int[Tensor, " b"]]],
    rule: StartRule,
    foreseen: Float[Tensor, " B"],
    unasked: Bool[Tensor, "B H"],
) -> tuple[Int[Tensor, " b"], StartRule | Start]:
    """The samples that hypothesis h is to be fitted to, and from where: the fit of the same kind with one contact less, if any.

    foreseen: takes the BIC that its score test promises. unasked: which hypotheses a sample did not ask for, and from which no
    further one is tried unless the sample asks for that.
    """
    own, contacts, everyone = problems[h], candidates[h].contacts, torch.arange(problems[h].batch)
    kin = [i for i, c in enumerate(candidates) if c.contacts == contacts - 1 and same_kind(c.unknowns, own.unknowns)]
    if not kin:
        return everyone, rule
    if kin[0] not in fits:
        return everyone[:0], rule
    fitted, index = fits[kin[0]]
    before = problems[kin[0]].take(index)
    sound = torch.isfinite(fitted.x).all(-1)
    found = score_test(before, fitted.x.nan_to_num(0.0))
    per_load = free_parameters(own) - free_parameters(before)
    asked = per_load * torch.log(before.seen.to(fitted.cost.dtype).clamp(min=math.e))
    foreseen[index] = bic(before, fitted) - found.drop + asked
    needed = sound & ((found.drop > PROMISING * asked) | ~fitted.accepted)
    wanted = needed | (sound & ~unasked[index, kin[0]] & (contacts > 1))
    unasked[index, h] |= ~needed
    rows = wanted.nonzero().squeeze(-1)
    return index[rows], start_with_one_more(own.unknowns, found.take(rows)) if contacts > 1 else rule


def same_kind(a: Unknowns, b: Unknowns) -> bool:
    """Whether two differ in the number of loads only; one without loads has no width prior to differ in."""
    alike = getattr(a.loads, "prior_name", "") == getattr(b.loads, "prior_name", "") or not a.loads.size
    return a.tip == b.tip and alike
