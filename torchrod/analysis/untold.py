"""Loads that nobody told of: others where the number of contacts is told, and one spread along the rod where all are narrow.

A shape that one contact explains may be of a force at the tip that also pulls along the rod, which looks like a contact farther
down, of a contact beside such a force, or of two loads of which the fit has made one. All are tried: a force at the tip instead of
the contact nearest to it, one beside all contacts, and one contact more. The first is named where it is nearly as probable by the
BIC, the others where chi^2 falls by more than it does in one of a hundred shapes without them; of several those that are nearly as
probable as the likeliest, with the weights that hypotheses have in analysis.averaging. Where the fit explains nothing, a force at
the tip is named that explains the readings. The fit that is reported is never changed.

One contact, or two, explain many a load that is spread over a part of the rod, and make too little of its force. Where one spread
load is more probable than the contacts, it is named.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..estimation.result import Estimate
from ..estimation.shared import Parts
from ..estimation.solve import Settings, estimate_each
from ..model.load_families import GaussianCoordinates
from ..model.problem import Problem
from .alternatives import read_at_few_places
from .averaging import ONE_MORE
from .count import CLOSE, MAX_CONTACTS, MOST_BESIDE_TIP, NEAR_TIP, UNTOLD, StartFor, always_cold, bic
from .score_test import drop_by_tip_force

BY_CHANCE = 11.34  # chi^2 with 3 degrees of freedom is above that in 1 %; the drop by one contact more in 1.0 to 1.4 %
LINEAR = 0.8  # a fit is made where the score test promises so much of it
NARROW = "point", "contact"  # priors of a width
MORE = 2.0  # times as probable; of single pushes 2 to 5 % come to that by chance
MOST_ODDS = 1000.0  # that are told
WEIGH = "--contacts auto weighs both"
MOST_UNEXPLAINED = 64  # samples without a fit that explains them, for which a force at the tip is tried
Named = dict[int, tuple[float, str]]  # by sample: by how much the BIC is behind, and the sentence


def untold(problem: Problem, fit: Estimate, settings: Settings | None = None, start: StartFor = always_cold) -> tuple[str, ...]:
    """For every sample a sentence on loads that explain its readings as well as those that were told, or "".

    problem: with Gaussian loads of unknown places, and nothing unknown at the tip; of another there is nothing said. fit: of it.
    start: the rule that other fits start by.
    """
    said = [""] * problem.batch
    loads = problem.unknowns.loads
    if (
        not isinstance(loads, GaussianCoordinates)
        or not loads.count
        or loads.locations is not None
        or problem.unknowns.tip != "none"
    ):
        return tuple(said)
    many, known = ~read_at_few_places(problem), torch.isfinite(fit.chi2)
    rows = (fit.accepted & many).nonzero().squeeze(-1)
    unexplained = (~fit.accepted & many & known).nonzero().squeeze(-1)[:MOST_UNEXPLAINED]
    other = _Others(problem, loads, fit, bic(problem, fit), replace(settings or Settings(), restarts=()), start)
    if len(rows):
        kinds = _instead(other, rows), _beside(other, rows), _force_beside(other, rows)
        for b in rows.tolist():
            found = sorted(kind[b] for kind in kinds if b in kind)
            said[b] = " ".join(words for behind, words in found if behind < found[0][0] - 2 * math.log(CLOSE))
    for b, words in _explaining(other, unexplained).items():
        said[b] = words
    return tuple(said)


def spread(
    problem: Problem,
    fit: Estimate,
    parts: Parts,
    settings: Settings | None = None,
    start: StartFor = always_cold,
    told: bool = True,
) -> tuple[str, ...]:
    """For every sample a sentence on one load spread along the rod that is more probable than its contacts, or fewer, or "".

    fit: of the problem with the unknowns of each of the parts. start: the rule that other fits start by. told: whether the number
    of contacts was, which the remedy then changes.
    """
    said = [""] * problem.batch
    for unknowns, index in parts:
        loads, own = unknowns.loads, problem.of(unknowns)
        if not isinstance(loads, GaussianCoordinates) or not loads.count or loads.locations is not None:
            continue
        rows = index[(fit.accepted & ~read_at_few_places(own))[index]]
        if loads.prior_name not in NARROW or not len(rows):
            continue
        wide = replace(loads, prior_name="distributed")
        others = _Others(own, wide, fit, bic(own, fit), replace(settings or Settings(), restarts=()), start)
        other, behind = others.of(1, unknowns.tip, rows)
        ahead = torch.zeros_like(behind)  # fewer contacts: of one push, any one load is more probable than several
        for fewer in range(1, loads.count):
            left = (behind < -2 * math.log(MORE)).nonzero().squeeze(-1)
            if len(left):
                ahead[left] = torch.minimum(ahead[left], replace(others, loads=loads).of(fewer, unknowns.tip, rows[left])[1])
        behind = behind - ahead
        remedy = "--contacts 1 --load-prior auto" if told and loads.count > 1 else "--load-prior auto"
        for i in (behind < -2 * math.log(MORE)).nonzero().squeeze(-1).tolist():
            load = f"{float(other.magnitude[i, 0]):.3g} N about s = {1e3 * float(other.location[i, 0]):.3g} mm"
            odds = f"{_times(-0.5 * float(behind[i]))} as probable as contacts"
            said[int(rows[i])] = f"One load spread along the rod ({load}) is {odds}; try {remedy}."
    return tuple(said)


def _times(log_odds: float) -> str:
    odds = math.exp(min(log_odds, math.log(MOST_ODDS)))
    if odds >= MOST_ODDS:
        return f"more than {MOST_ODDS:.0f} times"
    return f"{odds:.1f} times" if odds < 10 else f"{odds:.0f} times"


@dataclass(frozen=True)
class _Others:
    """Fits of other loads than those of a problem and its fit, of a BIC `own` (B,)."""

    problem: Problem
    loads: GaussianCoordinates
    fit: Estimate
    own: Float[Tensor, " B"]
    settings: Settings
    start: StartFor

    def of(self, contacts: int, tip: str, rows: Int[Tensor, " b"], share: float = 1.0) -> tuple[Estimate, Float[Tensor, " b"]]:
        """The fit of other loads to some samples, and by how much its BIC, that of a hypothesis with a share, is behind."""
        part = self.problem.of(replace(self.problem.unknowns, loads=replace(self.loads, count=contacts), tip=tip)).take(rows)
        if not part.determined:
            return self.fit.of(rows, self.problem.size), torch.full((len(rows),), torch.inf, dtype=self.own.dtype)
        other = estimate_each(part, self.settings, self.start(part))
        behind = bic(part, other) - 2 * math.log(share) - self.own[rows]
        return other, torch.where(other.accepted, behind, torch.inf)

    def needed(self, other: Estimate, behind: Float[Tensor, " b"], rows: Int[Tensor, " b"]) -> list[int]:
        """Of which rows chi^2 asks for other loads, of which these are some more."""
        return (torch.isfinite(behind) & (self.fit.cost[rows] - other.cost > BY_CHANCE)).nonzero().squeeze(-1).tolist()

    def better(self, other: Estimate, i: int, rows: Int[Tensor, " b"]) -> str:
        """How much better other loads explain row i; of a robust fit the cost alone tells, as its chi^2 leaves outliers out."""
        now, then = float(other.chi2[i]), float(self.fit.chi2[rows[i]])
        return f" better (chi2 = {now:.3g} instead of {then:.3g})" if math.isinf(self.settings.robust) else " better"


def _instead(others: _Others, rows: Int[Tensor, " b"]) -> Named:
    """A force at the tip instead of a contact near it, where that is needed; it counts as if somebody had told of it."""
    fewer, fit = others.loads.count - 1, others.fit
    rows = rows[(fit.location[rows] > NEAR_TIP * fit.rod_length[rows].unsqueeze(-1)).any(-1)]
    if fewer > MOST_BESIDE_TIP or not len(rows):
        return {}
    rows = rows[others.of(fewer, "none", rows)[1] > 0]
    if not len(rows):
        return {}
    other, behind = others.of(fewer, "force", rows)
    found: Named = {}
    for i in (behind < -2 * math.log(CLOSE)).nonzero().squeeze(-1).tolist():
        found[int(rows[i])] = float(behind[i]), f"{_force(other, i, fewer, ' as well')}; {WEIGH}."
    return found


def _explaining(others: _Others, rows: Int[Tensor, " b"]) -> dict[int, str]:
    """A force at the tip, instead of a contact or beside all, that explains what the fit does not."""
    found: dict[int, str] = {}
    for contacts in range(others.loads.count - 1, others.loads.count + 1):
        left = torch.tensor([b for b in rows.tolist() if b not in found], dtype=torch.int64)
        if contacts <= MOST_BESIDE_TIP and len(left):
            other, behind = others.of(contacts, "force", left)
            for i in torch.isfinite(behind).nonzero().squeeze(-1).tolist():
                found[int(left[i])] = f"{_force(other, i, contacts)}; --contacts auto tries it too."
    return found


def _force(fit: Estimate, i: int, contacts: int, how: str = "") -> str:
    """What explains a sample of a fit with a force at the tip, and the option for it."""
    assert fit.tip is not None
    force = ", ".join(f"{v:.3g}" for v in fit.tip[i, :3].tolist())
    beside = f" beside {contacts} contact{'s' * (contacts > 1)}" if contacts else ""
    return f"A force of ({force}) N at the tip{beside} explains the readings{how} (--contacts {contacts} --unknown-tip force)"


def _beside(others: _Others, rows: Int[Tensor, " b"]) -> Named:
    """One contact more, where chi^2 asks for one."""
    more = others.loads.count + 1
    if more > MAX_CONTACTS:
        return {}
    other, behind = others.of(more, "none", rows, ONE_MORE)
    found: Named = {}
    for i in others.needed(other, behind, rows):
        found[int(rows[i])] = float(behind[i]), f"One contact more explains the readings{others.better(other, i, rows)}; {WEIGH}."
    return found


def _force_beside(others: _Others, rows: Int[Tensor, " b"]) -> Named:
    """A force at the tip beside all contacts, where chi^2 asks for one."""
    fit, settings = others.fit, others.settings
    rows = rows[drop_by_tip_force(others.problem.take(rows), fit.x[rows], settings.robust) > LINEAR * BY_CHANCE]
    if not len(rows):
        return {}
    other, behind = others.of(others.loads.count, "force", rows, UNTOLD)
    found: Named = {}
    for i in others.needed(other, behind, rows):
        found[int(rows[i])] = float(behind[i]), f"{_force(other, i, others.loads.count, others.better(other, i, rows))}."
    return found
